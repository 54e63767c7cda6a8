"""Reproduce the thesis's table and figures with this library: train the missing runs, measure them and draw them.

    python -m experiments.thesis                        # five garments, ours and NCS: an hour each on two cores
    python -m experiments.thesis --garments tshirt
    python -m experiments.thesis --garments tshirt --no-training    # of the present runs

It writes into `runs/thesis/` the runs, `<garment>/{ours,ncs}` and `tshirt/direct`, and `report.html`, one file with
all pictures, beside `report.json`. Stopped and started again, training goes on where it stopped.

Ours (`configs/thesis.yaml`) and NCS (`configs/ncs.yaml`) have the same garment, body, motions, losses and time. Figures
are numbered as in the thesis.
"""

import dataclasses
import functools
import io
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np

from clothjax import cli
from clothjax.config import Config
from clothjax.evaluation import pictures
from clothjax.evaluation.report import evaluate
from clothjax.evaluation.rollouts import Tracks
from clothjax.files import checkpoint, configuration
from clothjax.render import ray_cast
from clothjax.runtime import inference, loading, trained
from clothjax.runtime.models import Bounds, Model
from clothjax.simulation import assembly
from clothjax.training.pipeline import train
from clothjax.types import Pose
from experiments.benchmark import pareto
from experiments.html_page import Section, image, page, picture, sheet, table

matplotlib.use("Agg")

GARMENTS = ("tshirt", "long_sleeve", "tank", "pants", "dress")
VERTICES = 1000
CONFIGS = {"ours": "configs/thesis.yaml", "ncs": "configs/ncs.yaml", "direct": "configs/direct.yaml"}
TRAINED = [each.name for each in dataclasses.fields(Config) if each.name not in ("directory", "evaluation")]
ABLATION = "tshirt"
MOMENTS = 4
MEASURES = {
    "energy_gap": "energy gap",
    "hold_gap": "hold gap",
    "step_error_mm": "step, mm",
    "swing_ratio": "swing",
    "swing_correlation": "its correlation",
    "penetration_percent": "inside, %",
    "edge_strain_ratio": "strain / solver's",
    "jitter": "jitter / solver's",
}
PARETO = {"rounds": 30, "frames": 60, "gaps": 5}
LOOSE = "dress"  # of figure 9, where it is there
FRAME = 40  # of the bodies of figure 6
BROKEN, AFTER = 20, 60  # frames before and after a code is broken
FARNESS = 10.0  # deviations, of the broken code


def main(argv: list[str]) -> None:
    parser = cli.Parser("experiments.thesis", __doc__)
    parser.add_argument("--garments", nargs="+", choices=GARMENTS, default=GARMENTS)
    parser.add_argument("--out", type=Path, default=Path("runs") / "thesis", help="default: runs/thesis")
    parser.add_argument("--no-training", action="store_true", help="only of the runs that are there")
    arguments = parser.parse_args(argv)
    runs = {name: networks(name, arguments.out, not arguments.no_training) for name in arguments.garments}
    runs = {name: of_garment for name, of_garment in runs.items() if of_garment}
    if not runs:
        raise ValueError(
            f"{arguments.out}: no finished run of {', '.join(arguments.garments)}; leave out --no-training"
        )
    report, sections = {}, []
    for make in (appearance, shapes, ablation, failure, times, inputs):
        print(f"{make.__name__}", flush=True)
        figures, section = make(runs)
        report[make.__name__] = figures
        sections.append(section)
    (arguments.out / "report.json").write_text(json.dumps(report, indent=1) + "\n")
    (arguments.out / "report.html").write_text(
        page("clothjax: the thesis again", "The thesis's experiments, with clothjax", sections)
    )
    print(f"written to {arguments.out / 'report.html'}")


def networks(name: str, folder: Path, training: bool) -> dict[str, Path]:
    """Return finished runs of a garment, by network; train missing ones first."""
    wanted = [key for key in CONFIGS if key != "direct" or name == ABLATION]
    runs = {}
    for key in wanted:
        run = folder / name / key
        if training:
            config = configuration.cli(
                Config, [CONFIGS[key], "--garment", f"{name}_{VERTICES}", "--directory", str(run)]
            )
            if not finished(run, config):
                print(f"training {run}", flush=True)
                train(config, run)
        if finished(run):
            runs[key] = run
    return runs


def finished(run: Path, config: Config | None = None) -> bool:
    """Return whether a run has been trained to its end.

    Raises:
        ValueError: if it was trained with another configuration than this.
    """
    if not checkpoint.steps(run / "stage1" / "checkpoints"):
        return False
    there = trained.configured(run)
    config = config or there
    differing = [name for name in TRAINED if getattr(there, name) != getattr(config, name)]
    if assembly.training_motions(there) != assembly.training_motions(config):  # which are those not held out
        differing = [*dict.fromkeys([*differing, "motions"])]
    if differing:
        raise ValueError(
            f"{run}: trained with another {' and '.join(differing)} than is configured now: move it away, or take "
            "--no-training"
        )
    return not trained.unfinished(run)


@functools.cache
def measures(run: Path) -> dict[str, dict[str, float]]:
    """Return the measures of each method of a run, the same as `clothjax evaluate`."""
    return evaluate(run)["evaluation"]


# --- the figures: each gives its numbers and its section ----------------------------------------------------------

Runs = dict[str, dict[str, Path]]  # by garment and network


def appearance(runs: Runs) -> tuple[dict, Section]:
    """Draw figure 5: Phi, Psi and NCS beside the solver."""
    figures, parts = {}, []
    for garment, of_it in runs.items():
        figures[garment], tracks = {}, {}
        shown = {key: run for key, run in of_it.items() if key != "direct"}
        if not shown:
            continue
        for run in shown.values():
            measured = measures(run)
            figures[garment] |= {name: values for name, values in measured.items() if name != "lbs"}
            config = trained.configured(run)
            motion = config.evaluation.motions[0]
            saved = Tracks.load(run, motion)
            tracks |= {name: track for name, track in saved.methods.items() if name != "lbs"}
            solver = saved.solver
        experiment = assembly.assemble(config)
        rows, columns = pictures.at_moments(experiment, motion, tracks | {"solver": solver}, MOMENTS)
        parts.append(f"<h3>{garment}</h3>" + table(figures[garment], MEASURES) + sheet(rows, columns))
    text = (
        "<p>Every network in its own rollout on a motion and a body that none has seen. A gap of 0 is the solver, "
        "1 plain skinning (energy) or cloth that keeps its shape (hold).</p>"
    )
    return figures, ("Figure 5: ours and NCS", text + "".join(parts))


def shapes(runs: Runs) -> tuple[dict, Section]:
    """Draw figure 6: a thin, the mean and a heavy body."""
    parts = []
    for garment, of_it in runs.items():
        if "ours" in of_it:
            config = trained.configured(of_it["ours"])
            parts.append(
                f"<h3>{garment}</h3>" + sheet(*pictures.gallery(of_it["ours"], config.evaluation.motions[:1], FRAME))
            )
    text = "<p>One network for all bodies: thin, mean and heavy, at the same frame.</p>"
    return {}, ("Figure 6: bodies", text + "".join(parts))


def ablation(runs: Runs) -> tuple[dict, Section]:
    """Draw figure 7: Psi trained directly on the physics, without stage 1."""
    of_it, title = runs.get(ABLATION, {}), "Figure 7: without stage 1"
    if not {"ours", "direct"} <= set(of_it):
        return {}, (title, f"<p>Needs both runs of the {ABLATION}.</p>")
    figures, tracks = {}, {}
    for key, method in (("ours", "psi"), ("direct", "direct")):
        figures[method] = measures(of_it[key])[method]
        config = trained.configured(of_it[key])
        motion = config.evaluation.motions[0]
        saved = Tracks.load(of_it[key], motion)
        tracks |= {method: saved.methods[method], "solver": saved.solver}
    rows, columns = pictures.at_moments(assembly.assemble(config), motion, tracks, MOMENTS)
    text = "<p>Predictor, decoder and blend shapes trained on the losses alone, for the same time.</p>"
    return figures, (title, text + table(figures, MEASURES) + sheet(rows, columns))


def failure(runs: Runs) -> tuple[dict, Section]:
    """Draw figure 9: a wrong code feeds back, and the ways that it recovers."""
    garment = LOOSE if "ours" in runs.get(LOOSE, {}) else next((g for g in runs if "ours" in runs[g]), None)
    title = "Figure 9: a failure, and its mend"
    if garment is None:
        return {}, (title, "<p>Needs a run of ours.</p>")
    run = runs[garment]["ours"]
    experiment = assembly.assemble(trained.configured(run))
    model = loading.load(run, betas=assembly.betas(experiment.config))
    everywhere = Bounds(*(jnp.full_like(model.network.first, x) for x in (-1e9, 1e9, 0.0)))
    free = dataclasses.replace(model, network=model.network._replace(code_bounds=everywhere))
    motion = experiment.config.evaluation.motions[0]
    clip = assembly.motion(experiment, motion)
    poses = Pose(jnp.asarray(clip.rotations, jnp.float32), jnp.asarray(clip.translation, jnp.float32))
    sound = broken(model, poses, 0.0)
    tracks = {"as it is": broken(model, poses, FARNESS), "without bounds": broken(free, poses, FARNESS)}
    apart = {name: 1e3 * np.linalg.norm(track - sound, axis=-1).mean(axis=1) for name, track in tracks.items()}
    figure, axis = plt.subplots(figsize=(7, 3.5), constrained_layout=True)
    for name, values in apart.items():
        axis.semilogy(np.arange(len(values)) - BROKEN, np.maximum(values, 1e-3), label=name)
    axis.set(xlabel="frames since the code was broken", ylabel="mm from the undisturbed garment")
    axis.legend()
    body, _ = pictures.body_trajectory(experiment, clip)
    moments = [BROKEN, BROKEN + 3, BROKEN + 10, BROKEN + 40]
    camera = ray_cast.camera_for(body[np.array(moments) - 1])
    rows = {
        name: [
            ray_cast.render(
                pictures.dressed(experiment, body[t - 1], track[t] - clip.translation[t]), camera, pictures.SIZE
            )
            for t in moments
        ]
        for name, track in (tracks | {"undisturbed": sound}).items()
    }
    figures = {
        name: {
            "mm": values.tolist(),
            "frames_until_1_mm": _recovery(values),
        }
        for name, values in apart.items()
    }
    text = (
        "<p>In the thesis, cloth that has gone into the body spoils the code, and the code all that follows. Here the "
        f"code before frame 0 is replaced by one {FARNESS:.0f} standard deviations off. What brings it back: codes are "
        "held to the range of training, a tenth of them is forgotten in a frame, and Psi was trained from noisy codes. "
        "Contact of edges, not of vertices alone, prevents it.</p>"
    )
    columns = [f"frame {t - BROKEN}" for t in moments]
    return {"garment": garment, **figures}, (title, text + image(figure) + sheet(rows, columns))


def _recovery(values: np.ndarray) -> int | None:
    """Return frames from the broken code until distances [T] mm stay below 1; None if they do not."""
    away = np.flatnonzero(values > 1.0)
    if len(away) == 0:
        return 0
    return None if away[-1] == len(values) - 1 else int(away[-1]) + 1 - BROKEN


def broken(model: Model, poses: Pose, deviations: float) -> np.ndarray:
    """Return vertices [T, V, 3] m in the world over a clip, with the code of one frame moved that far; 0 for not."""
    state, frames = inference.initial_state(model, jax.tree.map(lambda x: x[0], poses)), []
    wrong = deviations * jax.random.normal(jax.random.key(0), state.latent.shape)
    for frame in range(min(len(poses.translation), BROKEN + AFTER)):
        if frame == BROKEN and deviations > 0:
            state = state._replace(latent=wrong)
        state, vertices = inference.step(model, state, jax.tree.map(lambda x, t=frame: x[t], poses))
        frames.append(np.asarray(vertices))
    return np.stack(frames)


def times(runs: Runs) -> tuple[dict, Section]:
    """Draw the run-time table, and error against time."""
    figures = pareto.measure([run for of_it in runs.values() for run in of_it.values()], **PARETO)
    buffer = io.BytesIO()
    pareto.plot(figures, buffer)
    rows = {}
    for point in figures["points"]:
        name = f"{Path(point['garment']).stem.split('_')[0]}: {point['name']} ({point['runtime']})"
        rows[name] = {key: point[key] for key in ("us", *pareto.ERRORS)}
    columns = {"us": "us a frame"} | {key: label.split(":")[0] for key, label in pareto.ERRORS.items()}
    won = ", ".join(f"{key}: {len(figures[key])}" for key in ("compared", "wins_at_equal_time", "wins_at_equal_error"))
    text = (
        "<p>One character, weights in the cache; Psi and the baselines in ONNX Runtime on one thread, with "
        "pose inputs and joint transforms given unless it says from the pose; C from the pose; jax on all cores. "
        f"Of the garments with both: {won}.</p>"
    )
    return figures, ("Run time, and error against it", text + picture(buffer.getvalue()) + table(rows, columns))


def inputs(runs: Runs) -> tuple[dict, Section]:
    """Count the numbers that each network reads in a frame."""
    figures = {}
    of_it = next(iter(runs.values()))
    if "ours" in of_it:
        psi = trained.psi(of_it["ours"])
        code, pose = (len(part.mean) for part in psi.normalizers)
        rows = len(psi.predictor["dense_0"]["kernel"])
        figures["ours"] = {"code": code, "pose": pose, "wearer": rows - code - pose, "all": rows}
    if "ncs" in of_it:
        params = trained.network(of_it["ncs"])[1]["params"]
        joints = len(params["dynamic"]["0"]["kernel"]) // params["local"]["1"]["kernel"].shape[1]
        code, static = len(params["unit"]["state"]["kernel"]), len(params["static"]["0"]["kernel"])
        pose, wearer = 21 * joints, static - 9 * joints
        figures["ncs"] = {"code": code, "pose": pose, "wearer": wearer, "all": code + pose + wearer}
    columns = {"code": "carried from the last frame", "pose": "pose", "wearer": "body and cloth", "all": "all"}
    return figures, ("Inputs", "<p>Numbers read in a frame.</p>" + table(figures, columns))


if __name__ == "__main__":
    cli.run(main)
