"""How the cost of a training step grows with the vertices of the garment."""

import dataclasses
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from clothjax import experiment, scene, storage
from clothjax import stage1 as training
from clothjax.config import Config
from data_prep import garment as garments
from experiments.benchmarks.timing import interleaved, program
from experiments.session import progress

SIZES = (500, 1000, 2000, 4000, 8000, 20000)


def measure(config: Config, rounds: int, sizes: tuple[int, ...]) -> dict:
    """Seconds of a training step on t-shirts of about so many vertices, and the exponent of their growth."""
    body, names = storage.load_body(config.body), storage.joint_names(config.body)
    config = dataclasses.replace(config, stage1=dataclasses.replace(config.stage1, pool=1))
    programs, reel = {}, None
    with progress("compiling for each size", len(sizes)) as report:
        for done, size in enumerate(sizes):
            cloth = garments.build("tshirt", size, body, names)
            built = scene.build(cloth, body, config)
            whole = experiment.Experiment(config, names, body, cloth, built)
            reel = reel or experiment.training_clips(whole)[0]
            update = training.make_update(built, reel, config, 1, 1)
            programs[len(cloth.vertices)] = program(update, training.init(built, reel, config))
            report(done + 1)
    seconds = interleaved(programs, rounds)
    exponent, _ = np.polyfit(np.log(list(seconds)), np.log(list(seconds.values())), 1)
    return {"vertex_exponent": float(exponent), "seconds_by_vertices": {str(n): s for n, s in seconds.items()}}


def plot(report: dict, path: Path) -> None:
    """Seconds against vertices, with the fit and proportional growth."""
    vertices = np.array([int(n) for n in report["seconds_by_vertices"]])
    seconds = np.array(list(report["seconds_by_vertices"].values()))
    exponent = report["vertex_exponent"]
    fitted = np.exp(np.mean(np.log(seconds) - exponent * np.log(vertices))) * vertices**exponent
    figure, axis = plt.subplots(figsize=(6, 4.5), constrained_layout=True)
    axis.loglog(vertices, seconds, "o", label="a training step")
    axis.loglog(vertices, fitted, "-", label=f"fit, exponent {exponent:.2f}")
    axis.loglog(vertices, seconds[-1] * vertices / vertices[-1], ":", color="black", label="proportional")
    axis.set(xlabel="vertices of the garment", ylabel="s")
    axis.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)
