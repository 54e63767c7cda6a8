"""Measures how fast and how small the parts are, each beside something it is compared with, in one interleaved run.

    python -m experiments.benchmark --part stage1 --json benchmark.json            # the paper's Phi, 4 000 vertices
    python -m experiments.benchmark --part stage1 --quick                          # the embedded 1 000 vertices

Every time is the median of rounds in which all variants take turns. The processor is measured
with and without recomputing its blocks in the backward pass (`model.remat`).
"""

import argparse
import json
import os
import platform
import sys
from pathlib import Path

import jax

from clothjax import configuration
from clothjax.config import Config
from experiments.benchmarks import stage1
from experiments.session import fail_clearly, setup

PAPER = ["configs/paper_tshirt.yaml"]
QUICK = ["configs/quickstart.yaml", "--model.body_nodes", "updated"]
PARTS = {"stage1": stage1.measure}


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--part", choices=PARTS, default="stage1")
    parser.add_argument("--json", type=Path, default=Path("benchmark.json"))
    parser.add_argument("--quick", action="store_true", help="a small network and few rounds")
    arguments = parser.parse_args(argv)
    config = configuration.cli(Config, QUICK if arguments.quick else PAPER)
    rounds = 3 if arguments.quick else 5
    report = {"machine": machine(), arguments.part: PARTS[arguments.part](config, rounds)}
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    print(json.dumps(report, indent=1))
    print(f"written to {arguments.json}")


def machine() -> dict:
    """What the figures were measured on."""
    return {
        "device": str(jax.devices()[0].device_kind),
        "devices": jax.device_count(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "jax": jax.__version__,
    }


if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
