"""Growth of the cost of a training step with the vertices of the garment."""

import dataclasses
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np

from clothjax.config import Config
from clothjax.files import storage
from clothjax.progress import progress_bar
from clothjax.simulation import assembly, scene
from clothjax.training import stage1
from data_prep import templates
from experiments.benchmark.timing import interleaved, program

matplotlib.use("Agg")

SIZES = (500, 1000, 2000, 4000, 8000, 20000)


def measure(config: Config, rounds: int, sizes: tuple[int, ...]) -> dict:
    """Measure seconds of a training step on t-shirts of about these sizes in vertices, and the exponent of growth."""
    body, names = storage.load_rig(config.body)
    config = dataclasses.replace(config, stage1=dataclasses.replace(config.stage1, pool=1))
    programs, clips = {}, None
    with progress_bar("compiling for each size", len(sizes)) as report:
        for done, size in enumerate(sizes):
            cloth = templates.build("tshirt", size, body, names)
            built = scene.build_scene(cloth, body, config)
            experiment = assembly.Experiment(config, names, body, cloth, built)
            clips = clips or assembly.training_clips(experiment)[0]
            update = stage1.make_update(built, clips, config, 1, 1)
            programs[len(cloth.vertices)] = program(update, stage1.init(built, clips, config))
            report(done + 1)
    seconds = interleaved(programs, rounds)
    exponent, _ = np.polyfit(np.log(list(seconds)), np.log(list(seconds.values())), 1)
    return {"vertex_exponent": float(exponent), "seconds_by_vertices": {str(n): s for n, s in seconds.items()}}


def plot(report: dict, path: Path) -> None:
    """Plot seconds against vertices, with the fit and proportional growth."""
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
