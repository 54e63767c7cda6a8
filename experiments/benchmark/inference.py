"""Psi at inference: microseconds a frame against error, beside NCS, on one thread."""

import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import onnxruntime

from clothjax import material
from clothjax.config import Config
from clothjax.export import native, onnx, onnx_drape, psi_ffi, stablehlo
from clothjax.export.onnx_graph import Graph, session
from clothjax.files import configuration, storage
from clothjax.networks import decoder, psi
from clothjax.networks.normalisation import Normalizers, Scale
from clothjax.physics import compilers
from clothjax.runtime import inference, loading, specialise
from clothjax.runtime.models import Model
from clothjax.simulation import assembly
from clothjax.types import Motion, Pose
from experiments.benchmark import baselines, timing
from experiments.benchmark.timing import Call

matplotlib.use("Agg")

PAPER = ["configs/paper_tshirt.yaml"]
SHIPPED, FINE, FORCED = "tshirt_pose", "tshirt_4000", "tshirt"
FRAMES = 300
WARM = 3  # calls in a row of which the last is timed: what a game that draws nothing else would see
CROWDS = (1, 4, 16, 64, 256, 1024)
STILL = 300  # frames that a character stands
NEAR = 1.0  # mm, the error that is put up with


def measure(rounds: int, frames: int = FRAMES, crowds: tuple[int, ...] = CROWDS, whole: bool = True) -> dict:
    """Measure Psi against NCS at the paper's size, and the variants of a garment of the library.

    Args:
        whole: False leaves out the paper's size, a garment that rests, 4 000 vertices and garments of which a part is
            kept.
    """
    with tempfile.TemporaryDirectory() as folder:
        report = _shipped(Path(folder), rounds, frames, whole)
        if whole:
            errors = {variant["name"]: variant["error_mm"] for variant in report["variants"]}
            report |= paper_size(Path(folder), rounds, errors)
    report |= _crowd(rounds, crowds)
    near = [v for v in report["variants"] if v["error_mm"] <= NEAR and v["runtime"] != "jax"]
    best = min(near, key=lambda v: v["us"])
    shown = {"shipped_us": best["us"], "shipped_form": best["name"], "shipped_floor_us": best["floor_us"]}
    if whole:
        report["resting"] = _resting()
    report["forces"] = _forces(rounds)
    return report | shown | {"shipped_onnx_us": min(v["us"] for v in near if v["runtime"] == "onnx")}


def paper_model() -> Model:
    """Build Psi at the size of the thesis on the 4 000-vertex t-shirt, with random weights."""
    config = configuration.cli(Config, PAPER)
    experiment = assembly.assemble(config)
    input_joints = psi.input_joints(experiment.names, config.stage2)
    size, count = config.model.latent, 6 + 18 * len(input_joints) + 9 * (len(input_joints) - 1)
    random = np.random.default_rng(0)
    basis = 1e-3 * random.standard_normal((config.model.blendshapes, len(experiment.garment.vertices), 3)).astype(
        np.float32
    )
    garment = decoder.init(jax.random.key(0), size, jnp.asarray(basis), config.model)
    last = garment["decoder"][f"dense_{len(config.model.decoder)}"]
    last["kernel"] = 50.0 * last["kernel"]
    constants = psi.constant_inputs(jnp.zeros(10), material.configured_material(config), config.material)
    predictor = psi.init(jax.random.key(1), size, count, len(constants), config.stage2)

    def scale(size: int) -> Scale:
        return Scale(jnp.zeros(size), jnp.ones(size), jnp.full(size, -8.0), jnp.full(size, 8.0))

    normalizers = Normalizers(scale(size), scale(count))
    return loading.build(config, experiment.garment, experiment.body, experiment.names, garment, predictor, normalizers)


def paper_size(folder: Path, rounds: int, errors: dict[str, float]) -> dict:
    """Measure the paper's Psi and NCS for the same number of vertices, complete and as networks alone.

    Args:
        errors: of the same forms on a trained garment, mm; the best form is the fastest that errs little enough.
    """
    plain = paper_model()
    folded = specialise.specialise(plain)
    vertices = plain.wearer.template.shape[1]
    forms = {"plain": plain, "folded": folded} | _fewer(plain)
    calls, size, kinds = {}, {}, {}
    for name, model in forms.items():
        for int8 in (False, True):
            kind = f"{name}, int8" if int8 else name
            path = onnx.to_onnx(model, folder / "psi.onnx", int8=int8)
            kinds[kind] = errors[kind]
            calls[f"psi: {kind}"], size[f"psi: {kind}"] = onnx_call(path, model), path.stat().st_size
            path = given_features(model, folder / "network.onnx", int8=int8, skinned=False)
            calls[f"psi network: {kind}"], size[f"psi network: {kind}"] = session_call(path), path.stat().st_size
    ncs = baselines.published(vertices)
    for int8 in (False, True):
        for skinned in (True, False):
            name = f"ncs{'' if skinned else ' network'}{': int8' if int8 else ''}"
            path = baselines.write(folder / "ncs.onnx", ncs, int8=int8, skinned=skinned)
            calls[name], size[name] = session_call(path), path.stat().st_size
    calls |= {f"jax: {name}": jax_call(forms[name]) for name in ("plain", "folded")}
    library = _library(folder)
    for name, model in forms.items() if library else ():
        path = native.to_c(model, folder / "psi.psi")
        calls[f"psi: C, {name}"], size[f"psi: C, {name}"] = c_call(library, path, model), path.stat().st_size
    us = interleaved(calls, rounds)
    best = min((name for name in kinds if kinds[name] <= NEAR), key=lambda name: us[f"psi: {name}"])
    return {
        "full_over_ncs_fp32": us[f"psi: {best}"] / us["ncs"],
        "full_over_ncs_int8": us[f"psi: {best}"] / us["ncs: int8"],
        "network_over_ncs_int8": us["psi network: folded, int8"] / us["ncs network: int8"],
        "jax_fold_ratio": us["jax: folded"] / us["jax: plain"],
        "paper_form": best,
        "paper_us": us,
        "paper_bytes": size,
        "paper_floor_us": {name: floor_us(size[name]) for name in (f"psi: {best}", "ncs", "ncs: int8")},
    }


def _shipped(folder: Path, rounds: int, frames: int, whole: bool) -> dict:
    """Measure variants of a garment of the library: time, bytes, and distance in a rollout to the unspecialised one.

    Arguments as of `measure`.
    """
    config = loading.load(SHIPPED).config
    betas = assembly.betas(config)
    model = loading.load(SHIPPED, betas=betas)
    clip = assembly.there_and_back(storage.load_motion("walk_3", model.names), frames)
    motion = Motion(clip.rotations, (clip.translation - clip.translation[:1]).astype(np.float32), clip.fps)
    reference = np.asarray(inference.animate(model, motion)[0])
    forms = {"plain": model, "folded": specialise.specialise(model)}
    if whole:
        forms |= _fewer(model)
        forms["half of the shapes"] = specialise.specialise(model, blendshapes=len(model.network.shapes) // 2)
        forms["4 influences"] = specialise.specialise(model, max_influences=4)
    library = _library(folder)
    calls, outcomes = {}, {}
    for name, form in forms.items():
        for int8 in (False, True):
            path = onnx.to_onnx(form, folder / "form.onnx", int8=int8)
            error = np.linalg.norm(onnx.run_onnx(path, form, motion) - reference, axis=-1)
            kind = f"{name}, int8" if int8 else name
            calls[kind] = onnx_call(path, form)
            outcomes[kind] = (error, path.stat().st_size, "onnx")
        if library:
            path = native.to_c(form, folder / "form.psi")
            error = np.linalg.norm(native.run_c(library, path, motion) - reference, axis=-1)
            calls[f"C: {name}"] = c_call(library, path, form)
            outcomes[f"C: {name}"] = (error, path.stat().st_size, "c")
        if name in ("plain", "folded", "a third of the shapes"):
            error = np.linalg.norm(np.asarray(inference.animate(form, motion)[0]) - reference, axis=-1)
            calls[f"jax: {name}"] = jax_call(form)
            outcomes[f"jax: {name}"] = (error, sum(x.nbytes for x in jax.tree.leaves(form.network)), "jax")
    folded = forms["folded"]
    calls["jax: off screen"] = jax_call(folded, vertices=False)
    if whole:
        calls |= _parts(folder, model, folded, betas, library)
    us = interleaved(calls, rounds)
    variants = [
        {"name": name, "us": us[name], "error_mm": 1e3 * float(error.mean()), "error_mm_max": 1e3 * float(error.max()),
         "bytes": size, "floor_us": floor_us(size), "runtime": runtime}
        for name, (error, size, runtime) in outcomes.items()
    ]  # fmt: skip
    exact = stablehlo.run_stablehlo(stablehlo.to_stablehlo(folded, folder / "form.stablehlo"), folded, motion)
    worst = {v["name"]: v["error_mm_max"] for v in variants}
    return {
        "variants": variants,
        "export_error_mm": {
            "onnx": worst["folded"],
            "onnx_int8": worst["folded, int8"],
            "stablehlo": 1e3 * float(np.linalg.norm(exact - reference, axis=-1).max()),
        }
        | ({"c": worst["C: folded"]} if library else {}),
        "offscreen_ratio": us["jax: off screen"] / us["jax: folded"],
        "shipped_us_all": us,
    } | ({"level_of_detail_ratio": us["jax: folded"] / us["jax: on 4 000 vertices"]} if whole else {})


def _parts(folder: Path, model: Model, folded: Model, betas: np.ndarray, library: Path | None) -> dict[str, Call]:
    """Return calls of a garment of the library of which more is kept, or less: other meshes, outputs and runtimes.

    Args:
        folded: the model, specialised.
        library: of plain C, or None.
    """
    calls: dict[str, Call] = {}
    fine = specialise.on_mesh(model, storage.load_garment(FINE, storage.load_body(model.config.body)), betas)
    fine = specialise.specialise(fine)
    for int8 in (False, True):
        kind = ", int8" if int8 else ""
        for output in ("canonical", "none"):
            path = onnx.to_onnx(folded, folder / "form.onnx", int8=int8, output=output)
            calls[f"{output}{kind}"] = onnx_call(path, folded)
        calls[f"on 4 000 vertices{kind}"] = onnx_call(onnx.to_onnx(fine, folder / "fine.onnx", int8=int8), fine)
    if psi_ffi.available():
        calls["jax: plain C inside"] = packed_call(folded)
    shown = specialise.part(folded, np.arange(folded.wearer.template.shape[1] // 2))
    calls["jax: half of the vertices"] = jax_call(shown)
    if library:
        calls["C: half of the vertices"] = c_call(library, native.to_c(shown, folder / "shown.psi"), shown)
        calls["C: off screen"] = c_call(library, native.to_c(folded, folder / "form.psi"), folded, vertices=False)
        calls["C: on 4 000 vertices"] = c_call(library, native.to_c(fine, folder / "fine.psi"), fine)
    calls["jax: on 4 000 vertices"] = jax_call(fine)
    return calls


def _resting() -> dict:
    """Measure the time saved on a character that stops and is skipped once `resting` is true, and the error."""
    model = specialise.specialise(loading.load(SHIPPED))
    clip = storage.load_motion("walk_3", model.names)
    poses = [Pose(jnp.asarray(clip.rotations[t]), jnp.asarray(clip.translation[t], jnp.float32)) for t in range(20)]
    poses += poses[-1:] * STILL
    going = state = inference.initial_state(model, poses[0])
    taken, error, rest = 0, 0.0, False
    for pose in poses:
        going, exact = inference.step(model, going, pose)
        if not rest:  # on the same pose: it stays so
            before, taken = state, taken + 1
            state, vertices = inference.step(model, state, pose)
            rest = bool(inference.resting(before, state))
        error = max(error, float(jnp.linalg.norm(vertices - exact, axis=-1).max()))
    return {"frames": len(poses), "frames_moving": 20, "frames_taken": taken, "error_mm_max": 1e3 * error}


def _forces(rounds: int) -> dict:
    """Measure a garment of the library with forces, `FORCED`, beside the one without."""
    calls: dict[str, Call] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        library = _library(folder)
        for garment in (SHIPPED, FORCED):
            model = specialise.specialise(loading.load(garment))
            calls[f"{garment}: jax"] = jax_call(model)
            for kind in ("onnx", "onnx, int8"):
                path = onnx.to_onnx(model, folder / f"{garment}.onnx", int8=kind.endswith("int8"))
                calls[f"{garment}: {kind}"] = onnx_call(path, model)
            if library:
                calls[f"{garment}: C"] = c_call(library, native.to_c(model, folder / f"{garment}.psi"), model)
        us = interleaved(calls, rounds)
    kinds = [call.partition(": ")[2] for call in calls if call.startswith(FORCED)]
    return {"us": us, "ratio": {kind: us[f"{FORCED}: {kind}"] / us[f"{SHIPPED}: {kind}"] for kind in kinds}}


def _crowd(rounds: int, crowds: tuple[int, ...]) -> dict:
    """Measure microseconds a character in crowds in jax, each character with its own body."""
    wearers = [specialise.specialise(loading.load(SHIPPED, betas=np.full(10, 0.2 * i - 0.8))) for i in range(8)]
    calls = {}
    for count in crowds:
        crowd = loading.crowd([wearers[i % len(wearers)] for i in range(count)])
        pose = _pose(wearers[0])
        states = jax.tree.map(lambda x, n=count: jnp.stack([x] * n), inference.initial_state(wearers[0], pose))
        poses = jax.tree.map(lambda x, n=count: jnp.stack([x] * n), pose)
        calls[str(count)] = compiled(inference.step_crowd, crowd, states, poses)
    us = {name: each / int(name) for name, each in interleaved(calls, max(3, rounds // 10)).items()}
    last = "256" if "256" in us else str(crowds[-1])
    return {"crowd_us": us, "crowd_ratio": us[last] / us["1"]}


def interleaved(calls: dict[str, Call], rounds: int) -> dict[str, float]:
    """Return the times of `timing.interleaved` in microseconds."""
    return {name: 1e6 * seconds for name, seconds in timing.interleaved(calls, rounds, WARM).items()}


def onnx_call(path: Path, model: Model) -> Call:
    """Return a call of one frame of an exported model."""
    pose = _pose(model)
    state = onnx.first_state(model, pose)
    names = (*onnx.STATE, *onnx_drape.DRAPE)[: len(state)]
    given = dict(zip(names, state, strict=True)) | {x: np.asarray(getattr(pose, x))[None] for x in onnx.POSE}
    return bound(path, given | ({"external": np.zeros((1, 3), np.float32)} if model.wearer.cloth else {}))


def session_call(path: Path) -> Call:
    """Return a call of a graph on random inputs."""
    return bound(path, baselines.feed(path))


def bound(path: Path, feed: dict[str, np.ndarray]) -> Call:
    """Return a call that reads and writes its own buffers, like an engine's."""
    run = session(path)
    binding = run.io_binding()
    for name, value in feed.items():
        binding.bind_cpu_input(name, np.asarray(value, order="C"))
    for result in run.get_outputs():
        kind = np.bool_ if "bool" in result.type else np.float32
        buffer = onnxruntime.OrtValue.ortvalue_from_shape_and_type(result.shape, kind, "cpu")
        binding.bind_ortvalue_output(result.name, buffer)
    return lambda: run.run_with_iobinding(binding)


def _library(folder: Path) -> Path | None:
    """Compile `psi.c`; return its library, None on a machine without a C compiler."""
    return native.build(folder) if compilers.compiler("C") else None


def c_call(library: Path, path: Path, model: Model, vertices: bool = True) -> Call:
    """Return a call of one frame in plain C."""
    pose = _pose(model)
    return native.Psi(library, path, *pose).bound(*pose, vertices)


def jax_call(model: Model, vertices: bool = True) -> Call:
    """Return a call of one frame in jax, compiled."""
    pose = _pose(model)
    state = inference.initial_state(model, pose)
    return compiled(lambda model, state, pose: inference.step(model, state, pose, vertices), model, state, pose)


def compiled(step: Callable, model: Model, *arguments: Any) -> Call:
    """Return a call of a compiled step; it takes the leaves of a model, which jax describes one by one."""
    leaves, tree = jax.tree.flatten(model)
    return timing.program(lambda leaves, *rest: step(tree.unflatten(leaves), *rest), leaves, *arguments)


def packed_call(model: Model) -> Call:
    """Return a call of one frame in jax, compiled, that calls plain C."""
    pose, packed = _pose(model), psi_ffi.pack(model)
    state = inference.initial_state(model, pose)
    return timing.program(psi_ffi.step, packed, state, pose)


def _pose(model: Model) -> Pose:
    clip = storage.load_motion("walk_3", model.names)
    return Pose(jnp.asarray(clip.rotations[0]), jnp.asarray(clip.translation[0], jnp.float32))


def _fewer(model: Model) -> dict[str, Model]:
    parts = {"three quarters": 3 / 4, "a third": 1 / 3, "a sixth": 1 / 6, "a twelfth": 1 / 12}
    count = len(model.network.shapes)
    return {
        f"{name} of the shapes": specialise.specialise(model, blendshapes=int(x * count)) for name, x in parts.items()
    }


def given_features(model: Model, path: Path, *, int8: bool, skinned: bool = True) -> Path:
    """Write Psi with the inputs that NCS and SNUG get in `baselines.write`: pose features and skinning transforms.

    Args:
        skinned: with blend shapes and skinning; else to the weights of the shapes.
    """
    g, network = Graph(int8), model.network
    count, size, vertices = len(network.predictor.pose_mean), len(network.first), model.wearer.template.shape[1]
    inputs, outputs = {"inputs": (1, count), "latent": (1, size)}, {"next_latent": (1, size)}
    latent, _ = onnx.predicted(g, "inputs", model, np.arange(count))
    if skinned:
        inputs["transforms"], outputs["vertices"] = (1, len(network.weights), 12), (1, vertices, 3)
        moved = g.skinned(onnx.canonical(g, latent, model), "transforms", network.weights)
        g("Transpose", moved, perm=[0, 2, 1], name="vertices")
    else:
        outputs["weights"] = (1, len(network.shapes))
        g("Identity", onnx.shape_weights(g, latent, model), name="weights")
    g.save(path, inputs, outputs)
    return path


def floor_us(size: int, rounds: int = 50) -> float:
    """Measure the microseconds in which one thread of this machine reads that many bytes, repeatedly."""
    row = np.ones(max(size // 4, 1), np.float32)
    seconds = []
    for _ in range(rounds):
        began = time.perf_counter()
        row @ row
        seconds.append(time.perf_counter() - began)
    return 1e6 * float(np.median(seconds))


def one_thread() -> None:
    """Restrict this process to one core; call it before jax starts."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def plot(report: dict, path: Path) -> None:
    """Plot error against time of the variants, with their Pareto front."""
    points = sorted((v["us"], max(v["error_mm"], 1e-4), v["name"], v["runtime"]) for v in report["variants"])
    front = sorted(p for p in points if not any(q[0] <= p[0] and q[1] <= p[1] and q != p for q in points))
    figure, axis = plt.subplots(figsize=(8, 5), constrained_layout=True)
    for runtime, label in (("onnx", "ONNX Runtime"), ("jax", "jax"), ("c", "plain C, eight bits")):
        chosen = [p for p in points if p[3] == runtime]
        axis.loglog([p[0] for p in chosen], [p[1] for p in chosen], "o", label=label)
    corners = {"color": "black", "lw": 0.8, "where": "post", "label": "Pareto front"}
    axis.step([p[0] for p in front], [p[1] for p in front], **corners)
    for us, error, name, runtime in points:
        if (us, error, name, runtime) in front or runtime == "jax":
            axis.annotate(name, (us, error), fontsize=7, xytext=(3, 5), textcoords="offset points", rotation=25)
    axis.set(xscale="log", xlabel="us a frame, one thread", ylabel="mean error, mm (1e-4: that or less)")
    axis.set(ylim=(5e-5, 30), xlim=(0.7 * points[0][0], 2 * points[-1][0]))
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(loc="upper right")
    figure.savefig(path, dpi=110)
    plt.close(figure)
