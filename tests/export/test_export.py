"""What other runtimes make of a model is what jax makes of it."""

import dataclasses
import json
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import save_file
from samples import ROOT, apart, random_force_psi, random_model, slowly
from toy import assert_same, small

from clothjax.body import skinning
from clothjax.commands import convert
from clothjax.export import formats, frame, litert, native, onnx, onnx_drape, onnx_forces, safetensors, stablehlo
from clothjax.export.onnx_graph import Graph, session
from clothjax.files import storage
from clothjax.geometry import clusters
from clothjax.networks import forces
from clothjax.physics import compilers, relaxation
from clothjax.runtime import drape, inference, specialise
from clothjax.types import Material, Motion, Pose

STIFF = Material(0.2, 2e4, 4e4, 10.0)  # bends so hard that nothing else would count, if it did


def test_onnx_is_the_model_in_closed_loop(model, motion, tmp_path):
    path = onnx.to_onnx(model, tmp_path / "g.onnx")
    assert apart(onnx.run_onnx(path, model, motion), model, motion).max() < 2e-5
    small_model = specialise.specialise(model, blendshapes=100)
    path = onnx.to_onnx(small_model, tmp_path / "s.onnx")
    found = onnx.run_onnx(path, small_model, motion)
    assert apart(found, small_model, motion).max() < 2e-5 and apart(found, model, motion).max() > 1e-3


def test_onnx_of_a_folded_code_and_of_a_relu(motion, tmp_path):
    model = random_model(skip=False)
    for name, each in (("plain", model), ("folded", specialise.specialise(model)),
                       ("fewer", specialise.specialise(model, blendshapes=5))):  # fmt: skip
        path = onnx.to_onnx(each, tmp_path / f"{name}.onnx")
        assert apart(onnx.run_onnx(path, each, motion), each, motion).max() < 1e-5
    assert model.config.model.blendshape_relu and small().model.decoder_skip


def test_onnx_of_a_model_that_sees_the_root_alone(motion, tmp_path):
    others = ("joint", "leg", "foot", "back", "spine", "shoulder", "arm", "neck", "head")
    model = random_model(True, others)
    assert [model.names[i] for i in model.input_joints] == ["Hips"]
    path = onnx.to_onnx(model, tmp_path / "g.onnx")
    assert apart(onnx.run_onnx(path, model, motion), model, motion).max() < 2e-5


def test_onnx_takes_wild_input_as_the_model_does(model, motion, tmp_path):
    run = session(onnx.to_onnx(model, tmp_path / "g.onnx"))
    rotations, translation = np.array(motion.rotations[:12]), np.array(motion.translation[:12])
    rotations[4, 3, 1, 1] = np.nan
    translation[7] = np.inf
    rotations[9] = 0.0  # no rotation at all, but finite
    state = inference.initial_state(model, Pose(rotations[0], translation[0]))
    tensors = onnx.first_state(model, Pose(rotations[0], translation[0]))
    told = []
    for t, (turn, place) in enumerate(zip(rotations, translation)):
        if t == 2:  # an engine gave back a damaged state
            tensors[0] = np.where(np.arange(tensors[0].size) % 3, tensors[0], np.float32(np.nan))
            state = state._replace(latent=jnp.asarray(tensors[0][0]))
        state, vertices = inference.step(model, state, Pose(jnp.asarray(turn), jnp.asarray(place)))
        feed = dict(zip(onnx.INPUTS, (*tensors, turn[None], place[None])))
        *tensors, ok, shown = run.run([*onnx.FOLLOWING, "vertices"], feed)
        np.testing.assert_allclose(shown[0], vertices, atol=1e-4)
        assert ok.shape == (1,) and bool(ok[0]) == bool(state.ok)
        told.append(bool(ok[0]))
    assert not told[2] and not told[4] and not told[7] and not told[9] and any(told)


def test_onnx_holds_codes_to_their_range_and_says_so(model, motion, tmp_path):
    pose = Pose(np.asarray(motion.rotations[5], np.float32), motion.translation[5])
    feed = dict(zip(onnx.INPUTS, (*onnx.first_state(model, pose), pose.rotations[None], pose.translation[None])))
    bounds = model.network.code_bounds
    narrow = bounds._replace(low=0 * bounds.low - 0.2, high=0 * bounds.high + 0.2, slack=0 * bounds.slack + 1e-3)
    strict = dataclasses.replace(model, network=model.network._replace(code_bounds=narrow))
    stranger = dataclasses.replace(model, wearer=model.wearer._replace(known=jnp.asarray(False)))
    for name, each, fine in (("usual", model, True), ("strict", strict, False), ("stranger", stranger, False)):
        run = session(onnx.to_onnx(each, tmp_path / f"{name}.onnx"))
        latent, ok = run.run(["next_latent", "ok"], feed)
        expected, _ = inference.step(each, inference.initial_state(each, pose), pose)
        np.testing.assert_allclose(latent[0], expected.latent, atol=1e-4)
        assert bool(ok[0]) == bool(expected.ok) == fine
    assert np.abs(session(tmp_path / "strict.onnx").run(["next_latent"], feed)[0]).max() <= 0.2 + 1e-6


def test_formats_of_one_name_leave_each_other_their_json(model, tmp_path):
    told = {}
    for ending, write in (("json", onnx.to_onnx), ("psi.json", native.to_c)):
        write(model, tmp_path / ("g.onnx" if write is onnx.to_onnx else "g.psi"))
        told[ending] = (tmp_path / f"g.{ending}").read_text()
    assert "next_latent" in told["json"] and "psi.h" in told["psi.json"]
    assert all((tmp_path / f"g.{ending}").read_text() == text for ending, text in told.items())


def test_int8_is_small_and_near(model, motion, tmp_path):
    whole = onnx.to_onnx(model, tmp_path / "f.onnx")
    eight = onnx.to_onnx(model, tmp_path / "e.onnx", int8=True)
    assert eight.stat().st_size < 0.3 * whole.stat().st_size
    error = apart(onnx.run_onnx(eight, model, motion), model, motion)
    assert error.max() < 2e-3 and error.mean() < 4e-4
    assert error.mean() > 1e-6


@pytest.mark.parametrize("batch", [3, None])
def test_onnx_of_many_characters(batch, model, motion, tmp_path):
    run = session(onnx.to_onnx(model, tmp_path / "g.onnx", batch=batch))
    pose = Pose(np.asarray(motion.rotations[20:23], np.float32), motion.translation[20:23])
    states = [onnx.first_state(model, Pose(pose.rotations[i], pose.translation[i])) for i in range(3)]
    together = [np.concatenate(parts) for parts in zip(*states)]
    *_, vertices = run.run([*onnx.FOLLOWING, "vertices"], dict(zip(onnx.INPUTS, (*together, *pose))))
    for i in range(3):
        alone = Pose(jnp.asarray(pose.rotations[i]), jnp.asarray(pose.translation[i]))
        expected = inference.step(model, inference.initial_state(model, alone), alone)[1]
        np.testing.assert_allclose(vertices[i], expected, atol=2e-5)


def test_an_engine_can_skin_the_garment_and_need_not_see_it(model, motion, tmp_path):
    pose = Pose(np.asarray(motion.rotations[5], np.float32), motion.translation[5])
    feed = dict(zip(onnx.INPUTS, (*onnx.first_state(model, pose), pose.rotations[None], pose.translation[None])))
    shown = session(onnx.to_onnx(model, tmp_path / "w.onnx")).run(None, feed)
    canonical = onnx.to_onnx(specialise.specialise(model), tmp_path / "c.onnx", output="canonical")
    *state, vertices = session(canonical).run(None, feed)
    told = json.loads(canonical.with_suffix(".json").read_text())
    transforms = skinning.joint_transforms(
        jnp.asarray(pose.rotations), jnp.asarray(told["joint_positions"]), np.array(told["parents"])
    )
    blended = skinning.blend(jnp.asarray(told["skin_weights"]), transforms[np.array(told["skin_joints"])])
    placed = skinning.apply(blended, jnp.asarray(vertices[0])) + pose.translation[None]
    np.testing.assert_allclose(placed, shown[-1][0], atol=1e-4)
    unseen = session(onnx.to_onnx(model, tmp_path / "n.onnx", output="none")).run(None, feed)
    assert len(unseen) == len(shown) - 1
    for one, other, same in zip(shown, unseen, state):
        np.testing.assert_allclose(one, other, atol=1e-5)
        np.testing.assert_allclose(one, same, atol=1e-5)


def test_the_first_state_as_the_json_says(model, motion, tmp_path):
    path = onnx.to_onnx(model, tmp_path / "g.onnx")
    told = json.loads(path.with_suffix(".json").read_text())
    assert told["joints"][0] and len(told["joints"]) == len(told["parents"]) and told["fps"] == 30.0
    run = session(path)
    turn, place = np.asarray(motion.rotations[:1], np.float32), motion.translation[:1]
    latent = np.asarray(told["first_latent"], np.float32)[None]
    anything = np.ones(told["shapes"]["history"], np.float32)
    (found,) = run.run(["next_history"], dict(zip(onnx.INPUTS, (latent, anything, turn, place))))
    state = [latent, np.repeat(found[:, :1], 2, axis=1)]
    for mine, theirs in zip(state, onnx.first_state(model, Pose(turn[0], place[0]))):
        np.testing.assert_allclose(mine, theirs, atol=1e-6)


OLD = """
import sys
import numpy as np
import onnxruntime

given = np.load(sys.argv[2])
run = onnxruntime.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
state, vertices = [given["latent"], given["history"]], []
for rotations, translation in zip(given["rotations"][:, None], given["translation"][:, None]):
    names = ("latent", "history", "rotations", "translation")
    *state, ok, shown = run.run(None, dict(zip(names, (*state, rotations, translation))))
    vertices.append(shown[0])
np.save(sys.argv[3], np.stack(vertices))
print(onnxruntime.__version__)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.version_info >= (3, 12), reason="ONNX Runtime 1.15 is for Python 3.11 at the most")
@pytest.mark.parametrize("int8", [False, True])
def test_an_old_runtime_agrees_over_300_frames(int8, model, tmp_path):
    venv.create(tmp_path / "old", with_pip=True)
    python = tmp_path / "old" / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "-q", "onnxruntime==1.15.1", "numpy<2"], check=True)
    motion = convert.validation(model)
    latent, history = onnx.first_state(model, Pose(motion.rotations[0], motion.translation[0]))
    given, found = tmp_path / "given.npz", tmp_path / "found.npy"
    rotations, translation = (np.asarray(x, np.float32) for x in motion[:2])
    np.savez(given, latent=latent, history=history, rotations=rotations, translation=translation)
    path = onnx.to_onnx(model, tmp_path / "g.onnx", int8=int8)
    done = subprocess.run([python, "-c", OLD, path, given, found], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "1.15.1" and len(np.load(found)) == 300
    assert apart(np.load(found), model, motion).max() < (2e-3 if int8 else 1e-4)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("npm") is None, reason="needs Node")
def test_the_web_runtime_agrees_over_300_frames(model, tmp_path):
    subprocess.run(["npm", "install", "--silent", "onnxruntime-web"], check=True, cwd=tmp_path)
    for name in ("psi.mjs", "garment.mjs"):
        shutil.copy(ROOT / "experiments" / "deploy" / name, tmp_path)
    motion = convert.validation(model)
    rotations = np.asarray(motion.rotations).reshape(len(motion.rotations), -1)
    given = {"rotations": rotations.tolist(), "translation": motion.translation.tolist()}
    (tmp_path / "motion.json").write_text(json.dumps(given))
    for int8, most in ((False, 1e-4), (True, 2e-3)):
        onnx.to_onnx(model, tmp_path / "g.onnx", int8=int8)
        command = ["node", "psi.mjs", "g.onnx", "motion.json", "vertices.bin"]
        done = subprocess.run(command, check=True, cwd=tmp_path, capture_output=True, text=True)
        assert "ms a frame, one thread of WebAssembly" in done.stdout
        found = np.fromfile(tmp_path / "vertices.bin", np.float32).reshape(300, -1, 3)
        assert apart(found, model, motion).max() < most


@pytest.mark.slow
@pytest.mark.skipif(
    compilers.compiler("C") is None or shutil.which("go") is None,
    reason="needs a C compiler, and Go to fetch ONNX Runtime's header",
)
def test_a_program_in_c_drives_the_file_over_300_frames(model, tmp_path):
    import onnxruntime

    module = "github.com/yalue/onnxruntime_go@v1.27.0"  # brings the header; the library is that of the Python package
    got = subprocess.run(["go", "mod", "download", "-json", module], check=True, capture_output=True, text=True)
    (library,) = (Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.so.*")
    (tmp_path / "libonnxruntime.so.1").symlink_to(library)
    source = ROOT / "experiments" / "deploy" / "play_onnx.c"
    header = json.loads(got.stdout)["Dir"]
    command = [compilers.compiler("C"), "-std=c99", "-O2", "-Wall", "-Werror", "-isystem", header]
    program = tmp_path / "play_onnx"
    command += [source, tmp_path / "libonnxruntime.so.1", f"-Wl,-rpath,{tmp_path}", "-o", program]
    subprocess.run(command, check=True)
    motion = convert.validation(model)
    rows = [np.asarray(x, np.float32).reshape(300, -1) for x in (motion.rotations, motion.translation)]
    np.concatenate(rows, axis=1).tofile(tmp_path / "motion.bin")
    for int8, most in ((False, 1e-4), (True, 2e-3)):
        onnx.to_onnx(model, tmp_path / "g.onnx", int8=int8)
        command = [program, tmp_path / "g.onnx", tmp_path / "motion.bin", tmp_path / "vertices.bin"]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        assert done.stdout.endswith("us a frame, one thread\n")
        found = np.fromfile(tmp_path / "vertices.bin", np.float32).reshape(300, -1, 3)
        assert apart(found, model, motion).max() < most
    (tmp_path / "g.json").unlink()
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1 and "g.json: cannot be opened" in done.stderr


@pytest.mark.slow
def test_litert_agrees_over_300_frames(model, tmp_path):
    """In an environment of its own, as its module says: TensorFlow wants older packages."""
    venv.create(tmp_path / "tf", with_pip=True)
    python = tmp_path / "tf" / "bin" / "python"
    root = ROOT
    packages = (f"{root}[export]", "tensorflow-cpu", "ai-edge-litert")
    subprocess.run([python, "-m", "pip", "install", "-q", *packages], check=True)
    for int8, most in (((), 0.1), (("--int8",), 2.0)):
        out = tmp_path / "t.tflite"
        command = [python, "-m", "clothjax", "convert", "tshirt_pose", "--to", "litert", "--out", out, *int8]
        subprocess.run(command, check=True, cwd=root)
        told = json.loads((tmp_path / "t.tflite.json").read_text())
        assert told["distance_to_jax"]["frames"] == 300 and 0 < told["distance_to_jax"]["max_mm"] < most
        assert told["results"][-1] == "vertices" and told["arguments"]["translation"] == [3]


def test_stablehlo_runs_without_clothjax(model, motion, tmp_path):
    path = stablehlo.to_stablehlo(model, tmp_path / "g.stablehlo")
    assert apart(stablehlo.run_stablehlo(path, model, motion), model, motion).max() < 2e-5


def test_safetensors_hold_the_whole_model(model, motion, tmp_path, monkeypatch):
    for each in (model, specialise.specialise(model, blendshapes=50)):
        path = safetensors.to_safetensors(each, tmp_path / "g.safetensors")
        again = safetensors.from_safetensors(path)
        np.testing.assert_array_equal(inference.animate(again, motion)[0], inference.animate(each, motion)[0])
    newest = safetensors.FORMAT
    refused = rf"has format {newest}, .* reads up to {newest - 1}; update it"
    with monkeypatch.context() as older, pytest.raises(ValueError, match=refused):
        older.setattr(safetensors, "FORMAT", newest - 1)
        safetensors.from_safetensors(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"g\.safetensors: not a whole model in safetensors .*convert it again"):
        safetensors.from_safetensors(path)


def test_safetensors_of_format_1_are_read(model, motion, tmp_path):
    """Where the arrays of the latent predictor stood beside the others, and no setting named forces."""
    path = safetensors.to_safetensors(model, tmp_path / "new.safetensors")
    with safetensors._library().safe_open(str(path), framework="numpy") as file:
        arrays = {name.replace(".predictor", ""): file.get_tensor(name) for name in sorted(file.keys())}
        about = {name: value for name, value in file.metadata().items() if name != "format"} | {"format": "1"}
    settings = json.loads(about["config"])
    del settings["stage2"]["forces"]
    about["config"] = json.dumps(settings)
    save_file(arrays, str(tmp_path / "old.safetensors"), metadata=about)
    again = safetensors.from_safetensors(tmp_path / "old.safetensors")
    np.testing.assert_array_equal(inference.animate(again, motion)[0], inference.animate(model, motion)[0])


@pytest.fixture(scope="module")
def forced():
    """Models of a random Psi with forces: a skip, a ReLU on the weights, another mesh, few shapes, few energies, and
    one that relaxes, also on a finer mesh."""
    skip, relu = random_force_psi(), random_force_psi(skip=False)
    mesh = specialise.on_mesh(skip.model(), skip.experiment.garment, np.zeros(10))
    few = specialise.specialise(relu.model(betas=np.ones(10)), blendshapes=7)
    relaxed = random_force_psi(relaxation=3).model(betas=np.ones(10))
    return {
        "limp": random_force_psi(without=("bending", "gravity"), edge_contact=False).model(material=STIFF),
        "skip": skip.model(),
        "gated": random_force_psi(gated=True).model(betas=np.ones(10)),
        "scaled": random_force_psi(scaled=0.02).model(betas=np.ones(10)),
        "relu": relu.model(betas=np.ones(10)),
        "mesh": specialise.specialise(mesh),
        "few": few,
        "relaxed": relaxed,
        "relaxed mesh": specialise.on_mesh(
            relaxed, storage.load_garment("tshirt_4000", skip.experiment.body), np.ones(10)
        ),
        "coarse": random_force_psi(relaxation=3, meshes=("tshirt_4000", "tshirt_1000")).model(betas=np.ones(10)),
    }


def stiff(model):
    """The same model without relaxation."""
    cloth = model.wearer.cloth._replace(mobility=None)
    return dataclasses.replace(model, wearer=model.wearer._replace(cloth=cloth))


@pytest.mark.parametrize(
    "name",
    ["skip", "gated", "coarse", *slowly("scaled", "relu", "mesh", "few", "limp", "relaxed", "relaxed mesh")],
)
def test_onnx_of_forces_is_the_model_in_closed_loop(forced, name, motion, tmp_path):
    model, clip = forced[name], Motion(motion.rotations[:10], motion.translation[:10], motion.fps)
    found = onnx.run_onnx(onnx.to_onnx(model, tmp_path / "g.onnx"), model, clip)
    far = apart(found, model, clip)
    # rounding may push a vertex between two faces out of the other one, and steps after that move its neighbours
    assert far.max() < 5e-3 and (far > 2e-4).sum(axis=1).max() < (40 if name == "coarse" else 4)
    several = onnx.to_onnx(model, tmp_path / "n.onnx", batch=None, output="none")
    names = {x.name for x in session(several).get_outputs()}
    assert {"next_garment", "next_velocity", "ok"} <= names and "vertices" not in names
    if name.startswith("relaxed"):
        assert apart(found, stiff(model), clip).max() > 1e-2


def test_onnx_of_forces_relaxes_many_characters_seen_and_unseen(forced, motion, tmp_path):
    """Two at once; the canonical garment is the relaxed one carried back, so that an engine's skinning relaxes it."""
    model, several = forced["relaxed"], (3, 40)
    poses = [Pose(jnp.asarray(motion.rotations[t]), jnp.asarray(motion.translation[t])) for t in several]
    names, following = (*onnx.STATE, *onnx_drape.DRAPE), ("garment", "position", "velocity")
    given = [np.concatenate(x) for x in zip(*(onnx.first_state(model, pose) for pose in poses))]
    nearby = Pose(motion.rotations[[4, 41]], motion.translation[[4, 41]])
    given = dict(zip((*names, *onnx.POSE), (*given, *nearby))) | {"external": np.zeros((2, 3), np.float32)}
    given = {name: np.asarray(x, np.float32) for name, x in given.items()}
    shown = {}
    for output in ("world", "canonical", "none"):
        run = session(onnx.to_onnx(model, tmp_path / f"{output}.onnx", batch=None, output=output))
        last = "ok" if output == "none" else "vertices"
        *state, shown[output] = run.run([*(f"next_{x}" for x in following), last], given)
        for i in range(2):
            pose = jax.tree.map(lambda x, i=i: jnp.asarray(x[i], jnp.float32), nearby)
            after, vertices = inference.step(model, inference.initial_state(model, poses[i]), pose)
            for name, mine in zip(following, state):
                np.testing.assert_allclose(mine[i], getattr(after.drape, name), atol=2e-5)
            if output == "world":
                np.testing.assert_allclose(shown[output][i], vertices, atol=2e-5)
    np.testing.assert_array_equal(shown["canonical"], state[0].transpose(0, 2, 1))


def test_onnx_gives_an_engine_the_garment_that_is_relaxed_by_itself(forced, motion, tmp_path):
    """Skinned, the canonical garment is the one that is shown, relaxed."""
    model, (before, now) = (
        forced["coarse"],
        (Pose(jnp.asarray(motion.rotations[t]), jnp.asarray(motion.translation[t])) for t in (3, 4)),
    )
    run = session(onnx.to_onnx(model, tmp_path / "c.onnx", output="canonical"))
    names = (*onnx.STATE, *onnx_drape.DRAPE)
    given = dict(zip(names, onnx.first_state(model, before))) | {"external": np.zeros((1, 3), np.float32)}
    given |= {"rotations": np.asarray(now.rotations)[None], "translation": np.asarray(now.translation)[None]}
    (found,) = run.run(["vertices"], {name: np.asarray(x, np.float32) for name, x in given.items()})
    after, _ = inference.step(model, inference.initial_state(model, before), now)
    turned, joints = skinning.forward_kinematics(now.rotations, model.wearer.joints, np.array(model.parents))
    transforms = inference._transforms(model, turned, joints)
    unrelaxed, cloth = drape.shown(model, after.latent, transforms), model.wearer.cloth
    expected = relaxation.relaxed(
        unrelaxed, cloth.shown.mobility, cloth.shown.rest, cloth.material, model.network.predictor.felt.mesh, 5, 0.8
    )
    skinned = skinning.apply(skinning.blend(model.network.weights.T, transforms), jnp.asarray(found[0]))
    np.testing.assert_allclose(skinned, expected, atol=1e-4)
    assert np.abs(np.asarray(expected - unrelaxed)).max() > 1e-3


def test_onnx_in_eight_bits_relaxes_in_full_precision(forced, motion, tmp_path, monkeypatch):
    model, steps = forced["relaxed"], []
    weights = specialise.ordinary_weights(model)
    monkeypatch.setattr(specialise, "ordinary_weights", lambda _: weights)
    pose = Pose(jnp.asarray(motion.rotations[5]), jnp.asarray(motion.translation[5]))
    names, wanted = (*onnx.STATE, *onnx_drape.DRAPE, *onnx.POSE), ("next_latent", "next_position", "next_garment")
    given = (*onnx.first_state(model, pose), *(np.asarray(x)[None] for x in pose))
    given = dict(zip(names, given)) | {"external": np.zeros((1, 3), np.float32)}
    for each in (model, stiff(model)):
        run = session(onnx.to_onnx(each, tmp_path / "g.onnx", int8=True))
        steps.append([x[0] for x in run.run(wanted, given)])
    (latent, position, garment), (same, decoded, canonical) = steps
    np.testing.assert_array_equal(latent, same)
    cloth, mesh = model.wearer.cloth, model.network.predictor.mesh
    relaxed = relaxation.relaxed(jnp.asarray(decoded), cloth.mobility, cloth.rest, cloth.material, mesh, 3, 0.5)
    np.testing.assert_allclose(position, relaxed, atol=2e-6)
    assert np.abs(position - decoded).max() > 3e-3
    transforms = skinning.joint_transforms(pose.rotations, model.wearer.joints, np.array(model.parents))
    blended = skinning.blend(model.network.weights.T, transforms[np.array(model.moving)])
    np.testing.assert_allclose(skinning.apply(blended, jnp.asarray(canonical.T)), decoded, atol=1e-5)
    np.testing.assert_allclose(skinning.apply(blended, jnp.asarray(garment.T)), position, atol=1e-5)


def test_onnx_of_forces_raises_planes_as_far_as_jax(forced, motion, tmp_path, monkeypatch):
    """By 2 mm at most: few are raised by the centimetre that is set."""
    clip = Motion(motion.rotations[:10], motion.translation[:10], motion.fps)
    usual, _ = inference.animate(forced["skip"], clip)
    monkeypatch.setattr(forces, "HIGHEST", 0.002)
    jax.clear_caches()  # it is a constant of compiled programs
    found = onnx.run_onnx(onnx.to_onnx(forced["skip"], tmp_path / "g.onnx"), forced["skip"], clip)
    assert apart(found, forced["skip"], clip).max() < 2e-4
    assert np.abs(found - np.asarray(usual)).max() > 1e-3
    monkeypatch.undo()
    jax.clear_caches()


def test_onnx_searches_for_what_is_nearest_to_edges_as_jax(tmp_path):
    """Some clusters have no edges, as at a pinned waist."""
    random = np.random.default_rng(0)
    positions, points = (random.normal(size=(count, 3)).astype(np.float32) for count in (200, 6000))
    edges = np.stack([np.arange(0, 40, 2), np.arange(1, 40, 2)], axis=1)
    near = clusters.divided(positions, points, edges)
    assert (near.edges < 0).any()
    order, g = np.asarray(near.points).reshape(-1), Graph()
    among = onnx_forces.searched(g, near, "positions", "points")
    middles = g.constant(positions[edges].mean(axis=1).T[None])
    for name, rows, members in (("own", "positions", near.positions), ("between", middles, near.edges)):
        point, _ = onnx_forces.nearest_planes(g, among, rows, np.asarray(members), ("points", "points"))
        g("Identity", point, name=name)
    given = {"positions": positions.T[None], "points": points[order].T[None]}
    shapes = {"own": (1, 3, 200), "between": (1, 3, len(edges))}
    g.save(tmp_path / "g.onnx", {name: x.shape for name, x in given.items()}, shapes)
    found = session(tmp_path / "g.onnx").run(["own", "between"], given)
    expected = clusters.nearest_and_of_edges(positions, points, near, edges)
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours[0].T, points[theirs])


def test_onnx_of_forces_feels_an_acceleration(forced, motion, tmp_path):
    model = forced["skip"]
    run = session(onnx.to_onnx(model, tmp_path / "g.onnx", batch=2))
    first, pose = (Pose(jnp.asarray(motion.rotations[t]), jnp.asarray(motion.translation[t])) for t in (0, 1))
    names = (*onnx.STATE, *onnx_drape.DRAPE, *onnx.POSE)
    given = (*onnx.first_state(model, first, 2), *(np.repeat(np.asarray(x)[None], 2, axis=0) for x in pose))
    external = np.array([[0, 0, 0], [50, 10, -30]], np.float32)
    (found,) = run.run(["vertices"], dict(zip(names, given)) | {"external": external})
    state = inference.initial_state(model, first)
    for i in range(2):
        _, expected = inference.step(model, state, pose, external=jnp.asarray(external[i]))
        np.testing.assert_allclose(found[i], expected, atol=1e-5)
    assert np.abs(found[0] - found[1]).max() > 1e-4


def test_onnx_of_forces_comes_to_rest_as_the_model(forced, motion, tmp_path):
    """Two characters: one has stood for 74 frames, the other for 10."""
    model, pose = forced["skip"], Pose(jnp.asarray(motion.rotations[0]), jnp.asarray(motion.translation[0]))
    run, names = session(onnx.to_onnx(model, tmp_path / "g.onnx", batch=2)), (*onnx.STATE, *onnx_drape.DRAPE)
    given = dict(zip(names, onnx.first_state(model, pose, 2)))
    given["still"] = np.array([74, 10], np.float32)
    wanted = [f"next_{name}" for name in ("change", "still")]
    for moved, pushed in ((0.0, 0.0), (2e-5, 0.0), (4e-5, 0.0), (0.0, 1e-3)):
        there = Pose(pose.rotations, pose.translation + jnp.array([0.0, moved, 0.0]))
        external = np.array([[0.0, pushed, 0.0]] * 2, np.float32)
        poses = {"rotations": np.stack([there.rotations] * 2), "translation": np.stack([there.translation] * 2)}
        change, still = run.run(wanted, given | poses | {"external": external})
        for i, stood in enumerate((74.0, 10.0)):
            state = inference.initial_state(model, pose)
            state = state._replace(drape=state.drape._replace(still=jnp.float32(stood)))
            expected = inference.step(model, state, there, external=jnp.asarray(external[i]))[0].drape
            np.testing.assert_allclose(change[i], expected.change, atol=1e-4)
            assert still[i] == expected.still
        asleep = np.abs(change[0]).max() / np.abs(change[1]).max()
        assert asleep == pytest.approx(1.0 if moved > 2e-5 or pushed else 0.95**15, rel=1e-3)


def test_onnx_of_forces_forgets_what_is_not_finite(motion, tmp_path):
    model = random_force_psi(limit=1e3).model()
    run = session(onnx.to_onnx(model, tmp_path / "g.onnx"))
    names = (*onnx.STATE, *onnx_drape.DRAPE)
    pose = Pose(jnp.asarray(motion.rotations[0]), jnp.asarray(motion.translation[0]))
    state = onnx.first_state(model, pose)
    for t in range(1, 8):
        external = np.array([[np.nan if t == 2 else 0, 0, 0]], np.float32)
        if t == 4:
            state[names.index("velocity")] = np.full_like(state[names.index("velocity")], np.nan)
        given = dict(zip((*names, *onnx.POSE), (*state, motion.rotations[t][None], motion.translation[t][None])))
        given = {name: np.asarray(x, np.float32) for name, x in given.items()} | {"external": external}
        *state, ok, vertices = run.run([*(f"next_{name}" for name in names), "ok", "vertices"], given)
        assert np.isfinite(vertices).all() and (t not in (2, 4) or not ok[0])
    assert all(np.isfinite(part).all() for part in state) and ok[0]


@pytest.mark.parametrize("name", ["skip", "relaxed"])
def test_the_first_state_is_as_the_json_says(forced, name, motion):
    """Of programs that jax traces: from zeros, as an engine without clothjax begins."""
    model, clip = forced[name], [np.asarray(x[0], np.float32) for x in motion[:2]]
    run = jax.jit(frame.function(model))
    given = {name: np.zeros(shape, np.float32) for name, shape in frame.shapes(model).items()}
    given |= {"rotations": clip[0], "translation": clip[1]}
    given |= {f"previous_{name}": np.stack([given[name]] * 2) for name in ("rotations",)}
    given |= {"previous_translations": np.stack([clip[1]] * 2)}
    names, back = frame.arguments(model), [name.removeprefix("next_") for name in frame.results(model)[:8]]
    once = dict(zip(frame.results(model), run(*(given[name] for name in names))))
    given |= {f"previous_{name}": once[f"next_{name}"] for name in ("garment", "position")}
    for _ in range(inference.SETTLING):
        found = run(*(given[name] for name in names))
        given |= {("latent" if name == "latent" else f"previous_{name}"): x for name, x in zip(back, found)}
    expected = inference.initial_state(model, Pose(*map(jnp.asarray, clip)))
    apart, begun = (
        np.linalg.norm(x - expected.drape.position, axis=1).mean()
        for x in (given["previous_position"], once["next_position"])
    )
    assert apart < 0.5 * begun, (apart, begun)
    assert "Run 60 times" in frame.describe(model)["first_state"]


@pytest.mark.parametrize("int8", [False, True])
def test_litert_refuses_forces(forced, tmp_path, int8):
    with pytest.raises(ValueError, match="LiteRT cannot run a model with forces: take ONNX or plain C"):
        litert.to_litert(forced["skip"], tmp_path / "g.tflite", int8=int8)


@pytest.mark.slow
def test_other_formats_of_forces_are_the_model(forced, motion, tmp_path):
    clip = Motion(motion.rotations[:10], motion.translation[:10], motion.fps)
    for model in (forced["relu"], forced["mesh"], forced["relaxed"]):
        path = stablehlo.to_stablehlo(model, tmp_path / "g.shlo")
        assert apart(stablehlo.run_stablehlo(path, model, clip), model, clip).max() < 1e-4
        again = safetensors.from_safetensors(safetensors.to_safetensors(model, tmp_path / "g.safetensors"))
        assert_same(again, model)
        about = json.loads((tmp_path / "g.shlo.json").read_text())
        assert about["arguments"]["external"] == [3] and len(about["results"]) == 11


def test_safetensors_of_forces_of_older_formats_are_refused(forced, tmp_path):
    """What the body's contact is found from is not in them."""
    path = safetensors.to_safetensors(forced["skip"], tmp_path / "new.safetensors")
    with safetensors._library().safe_open(str(path), framework="numpy") as file:
        arrays = {name: file.get_tensor(name) for name in sorted(file.keys()) if not name.endswith(".clusters.edges")}
        about = file.metadata()
    for version in ("2", "4"):
        save_file(arrays, str(tmp_path / "old.safetensors"), metadata=about | {"format": version})
        with pytest.raises(ValueError, match=rf"old\.safetensors: .* \(format {version}\); export it again"):
            safetensors.from_safetensors(tmp_path / "old.safetensors")


def test_safetensors_of_forces_hold_all_that_a_model_has(forced, tmp_path):
    for name in ("mesh", "relaxed", "coarse"):
        path = safetensors.to_safetensors(forced[name], tmp_path / f"{name}.safetensors")
        assert_same(safetensors.from_safetensors(path), forced[name])
    path = safetensors.to_safetensors(forced["relaxed"], tmp_path / "relaxed.safetensors")
    with safetensors._library().safe_open(str(path), framework="numpy") as file:
        arrays = {name: file.get_tensor(name) for name in sorted(file.keys()) if not name.endswith(".mobility")}
        about = file.metadata()
    save_file(arrays, str(path), metadata=about)
    with pytest.raises(ValueError, match=r"relaxed\.safetensors: not a whole model .*mobility"):
        safetensors.from_safetensors(path)


def test_convert_says_how_far_it_is(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(convert, "FRAMES", 40)
    out = tmp_path / "s.onnx"
    convert.main(["tshirt_pose", "--to", "onnx", "--int8", "--betas", "1", "--out", str(out)])
    told = json.loads(out.with_suffix(".json").read_text())
    assert told["betas"] == [1.0] and 0 < told["distance_to_jax"]["mean_mm"] < 1
    assert "over 40 frames of autoregressive rollout" in capsys.readouterr().out
    with pytest.raises(ValueError, match="is of onnx and litert, not of stablehlo"):
        convert.main(["skirt", "--to", "stablehlo", "--int8"])
    with pytest.raises(ValueError, match="is of onnx, not of c"):
        convert.main(["skirt", "--to", "c", "--batch", "3"])


def test_convert_writes_what_no_motion_fits_and_says_so(model, tmp_path, capsys, monkeypatch):
    """As of a character whose joints have other names than those of the embedded motions."""
    fast = dataclasses.replace(model, config=dataclasses.replace(model.config, fps=60.0))
    with pytest.raises(ValueError, match="walk_3 has 30 frames a second, the model 60"):
        convert.validation(fast)
    other = dataclasses.replace(model, names=tuple(f"mixamorig:{name}" for name in model.names))
    monkeypatch.setattr(convert.loading, "load", lambda *_, **__: other)
    convert.main(["tshirt_pose", "--to", "c", "--out", str(tmp_path / "g.psi")])
    assert "not compared: " in (said := capsys.readouterr().out) and "joints differ from the body's" in said
    assert "mixamorig:Hips" in (tmp_path / "g.psi.json").read_text() and (tmp_path / "g.psi").stat().st_size > 1e6


def test_what_is_not_installed_is_said(model, monkeypatch, tmp_path):
    for package, write, ending in (
        ("onnx", onnx.to_onnx, "onnx"),
        ("safetensors", safetensors.to_safetensors, "safetensors"),
    ):
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(ImportError, match=r"pip install clothjax\[export\]"):
            write(model, tmp_path / f"g.{ending}")
    monkeypatch.setitem(sys.modules, "tensorflow", None)
    with pytest.raises(ImportError, match="pip install tensorflow-cpu ai-edge-litert"):
        litert.to_litert(model, tmp_path / "g.tflite")


def test_a_garment_of_the_library_is_converted_under_its_own_name(tmp_path, monkeypatch):
    """Several are of one mesh, and a level of detail is another file."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(formats, "export", lambda model, name, out, *_: out.write_text(f"{len(model.faces)}") and None)
    for extra in ((), ("--coarse",)):
        convert.main(["tshirt_fine", "--to", "safetensors", *extra])
    fine, coarse = (int(Path(f"tshirt_fine{kind}.safetensors").read_text()) for kind in ("", "_coarse"))
    assert 3000 > coarse > 1000 and fine > 3 * coarse
