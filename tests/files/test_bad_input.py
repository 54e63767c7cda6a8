"""What users really get wrong: each mistake ends in one clear error that names the place, and loses nothing."""

import dataclasses
import json
import os
import pickle
import re
import shutil
import subprocess
import sys
from pathlib import Path

import faults
import h5py
import numpy as np
import pytest
import trimesh
import yaml
from samples import AMC, ASF, BVH, recording
from toy import small

from clothjax.cli import fail_clearly
from clothjax.files import checkpoint, configuration, storage
from clothjax.runtime import loading, trained
from clothjax.training import run_folder
from data_prep import amass, asf_amc, bvh, garment, smpl
from experiments import convert, evaluate, gallery, quickstart, render, sweep, thesis, train, tune
from experiments.benchmark import report
from experiments.demo import viewer

CASES: dict = {}


def case(*said: str):
    """A mistake: a function of a folder that returns what a user would call. Its error has to match each of `said`."""

    def keep(function):
        CASES[function.__name__] = (function, said)
        return function

    return keep


def settings(folder: Path, **changed) -> Path:
    """A small experiment's configuration file."""
    values = configuration.to_dict(dataclasses.replace(small(), motions=("walk_0",)))
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump(json.loads(json.dumps(values | changed))))
    return path


def training(folder: Path, *flags: str, **changed):
    path = settings(folder, **changed)
    return lambda: train.main([str(path), "--directory", str(folder / "run"), *flags])


def asset(kind: str, folder: Path, change) -> Path:
    """An embedded file with something changed in it."""
    name = {"motion": "walk_0", "garment": "tshirt_1000", "body": "body"}[kind]
    path = folder / f"mine.{kind}.h5"
    shutil.copy(storage.asset(name), path)
    with h5py.File(path, "r+") as file:
        change(file)
    return path


def replaced(name: str, make):
    """A change of an embedded file: a dataset computed anew."""

    def change(file):
        value = make(file[name][()])
        del file[name]
        file[name] = value

    return change


def wrong_at(index, value):
    def make(array):
        array = array.astype(float)
        array[index] = value
        return array

    return make


def on_motion(change):
    return lambda folder: training(folder, motions=[str(asset("motion", folder, change))])


def on_garment(change):
    return lambda folder: training(folder, garment=str(asset("garment", folder, change)))


def on_body(change):
    return lambda folder: training(folder, body=str(asset("body", folder, change)))


def add(name: str, function, *said: str):
    CASES[name] = (function, said)


# --- configurations -----------------------------------------------------------------------------------------------


@case("mine.yaml", "stage1.learning_rat", "did you mean 'learning_rate'")
def a_misspelt_setting(folder):
    return training(folder, stage1={"learning_rat": 1e-3})


@case("walk_3", "8 frames to measure on", "at least 12")
def too_few_frames_to_measure(folder):
    return training(folder, "--evaluation.frames", "8")


@case("learning_rat")
def a_misspelt_flag(folder):
    return training(folder, "--stage1.learning_rat", "1")


@case("mine.yaml", r"stage1\.steps", "expected int, got 'many'")
def a_word_for_a_number(folder):
    return training(folder, stage1={"steps": "many"})


@case("mine.yaml", "line 2")
def a_file_that_is_not_yaml(folder):
    (folder / "mine.yaml").write_text("garment: tshirt_1000\n  stage1: [\n")
    return lambda: train.main([str(folder / "mine.yaml")])


@case("mine.yaml, line 2", "'garment' is set twice")
def a_setting_twice(folder):
    (folder / "mine.yaml").write_text("garment: tshirt_1000\ngarment: dress_1000\n")
    return lambda: train.main([str(folder / "mine.yaml")])


@case("mine.yaml", "python")
def a_yaml_file_that_would_run_something(folder):
    (folder / "mine.yaml").write_text("garment: !!python/object/apply:os.system ['touch pwned']\n")
    return lambda: train.main([str(folder / "mine.yaml")])


@case("none.yaml", "cannot be read")
def a_configuration_that_is_not_there(folder):
    return lambda: train.main([str(folder / "none.yaml")])


@case("other.yaml", "extended by .*mine.yaml")
def a_parent_that_is_not_there(folder):
    return training(folder, extends="other.yaml")


@case("mine.yaml", "circle")
def a_configuration_that_extends_itself(folder):
    return training(folder, extends="mine.yaml")


@case("mine.yaml", "model", "sizes must be > 0")
def a_size_below_zero(folder):
    return training(folder, model={"width": -4})


@case("hat_1000", "tshirt_1000")
def a_garment_that_is_not_embedded(folder):
    return training(folder, garment="hat_1000")


@case("stroll_0", "walk_0")
def a_motion_that_is_not_embedded(folder):
    return training(folder, motions=["stroll_0"])


@case("stroll_0", "walk_0")
def a_motion_of_the_evaluation_that_is_not_there(folder):
    return training(folder, evaluation={"motions": ["stroll_0"]})


@case("mine.yaml", r"stage1\.start_timestep to 0")
def a_peer_with_a_long_first_step(folder):
    return training(folder, peer={"network": "ncs"})


@case("devices", "several")
def devices_that_are_no_number(folder):
    return training(folder, "--devices", "several")


@case("ADDRESS:PORT,COUNT,INDEX", "node1")
def processes_that_are_not_described(folder):
    return training(folder, "--processes", "node1")


@case("configuration file", "--help")
def no_configuration(folder):
    return lambda: train.main(["--stage1.steps", "3"])


# --- motions ------------------------------------------------------------------------------------------------------

add(
    "nan_in_a_motion",
    on_motion(replaced("poses", wrong_at((7, 3, 1), np.nan))),
    "motion.h5",
    r"'poses' is nan at \(7, 3, 1\)",
    "finite",
)
add("a_motion_without_frames", on_motion(replaced("poses", lambda x: x[:0])), "motion.h5", "no frames")
add(
    "a_motion_of_one_frame",
    on_motion(lambda f: [replaced(n, lambda x: x[:1])(f) for n in ("poses", "trans")]),
    "mine.motion|walk|clip",
    "frames",
)
add(
    "a_motion_with_a_joint_too_few",
    on_motion(lambda f: [replaced("poses", lambda x: x[:, 1:])(f), replaced("joint_names", lambda x: x[1:])(f)]),
    "motion.h5",
    "lacks",
    "retarget",
)
add(
    "a_motion_of_another_skeleton",
    on_motion(replaced("joint_names", lambda x: np.array([b"bone_%d" % i for i in range(len(x))]))),
    "motion.h5",
    "lacks",
    "retarget",
)
add(
    "poses_and_translations_of_unlike_length",
    on_motion(replaced("trans", lambda x: x[:-3])),
    "motion.h5",
    "'trans' has shape",
)
add("a_motion_at_another_rate", on_motion(lambda f: f.attrs.modify("fps", 24.0)), "motion.h5", "24", "resample")
add(
    "a_motion_in_centimetres",
    on_motion(replaced("trans", lambda x: 100.0 * x)),
    "motion.h5",
    "centimetres",
    "divide by 100",
)
add(
    "a_motion_in_other_units_by_its_own_words",
    on_motion(lambda f: f.attrs.modify("units", "cm")),
    "motion.h5",
    "'units'",
    "'m'",
)
add("a_motion_without_translations", on_motion(lambda f: f.__delitem__("trans")), "motion.h5", "'trans' is missing")
add("a_rate_of_zero", on_motion(lambda f: f.attrs.modify("fps", 0.0)), "motion.h5", "'fps' must be a number > 0")


@case("mine.h5", "cut short")
def a_motion_cut_short(folder):
    (folder / "mine.h5").write_bytes(storage.asset("walk_0").read_bytes()[:5000])
    return training(folder, motions=[str(folder / "mine.h5")])


@case("mine.h5", "not a readable HDF5 file")
def a_motion_that_is_text(folder):
    (folder / "mine.h5").write_text("frame 1\n")
    return training(folder, motions=[str(folder / "mine.h5")])


@case("body.h5", "clothjax/body", "clothjax/motion")
def a_body_for_a_motion(folder):
    return training(folder, motions=[str(storage.asset("body"))])


@case("motion.h5", "left out|joint moves impossibly|no .* frames")
def a_motion_that_jumps_everywhere(folder):
    path = asset("motion", folder, replaced("trans", lambda x: x + np.random.default_rng(0).normal(size=x.shape)))
    return training(folder, motions=[str(path)])


# --- garments and bodies ------------------------------------------------------------------------------------------

add(
    "nan_in_a_garment",
    on_garment(replaced("vertices", wrong_at((5, 1), np.nan))),
    "garment.h5",
    r"'vertices' is nan at \(5, 1\)",
)
add(
    "a_face_of_a_vertex_that_is_not_there",
    on_garment(replaced("faces", lambda x: np.where(x == 3, 99999, x))),
    "garment.h5",
    "'faces' is 99999",
)
add(
    "a_face_with_a_vertex_twice",
    on_garment(replaced("faces", lambda x: np.concatenate([x, [[1, 1, 2]]]).astype(x.dtype))),
    "garment.h5",
    "vertex twice",
    "remove it",
)
add("a_garment_in_centimetres", on_garment(replaced("vertices", lambda x: 100 * x)), "garment.h5", "centimetres")
add(
    "a_garment_far_from_the_body",
    on_garment(replaced("vertices", lambda x: x + [3.0, 0, 0])),
    "garment.h5",
    "m from the body",
    "align",
)
add(
    "weights_that_do_not_sum_to_one",
    on_garment(replaced("weights_value", lambda x: 0.5 * x)),
    "garment.h5",
    "weights_value', row 0",
    "sum to 1",
)
add(
    "a_garment_of_another_body",
    on_garment(replaced("shapedirs", lambda x: x[..., :4])),
    "garment.h5",
    "'shapedirs' has shape",
)
add("pins_for_another_mesh", on_garment(replaced("pin", lambda x: x[:-5])), "garment.h5", "'pin' has shape")
add(
    "a_garment_with_its_seam_in_threes",
    on_garment(
        replaced(
            "faces",
            lambda x: np.concatenate([x, np.roll(x[900:903], 1, axis=0) * [0, 0, 1] + x[900:903] * [1, 1, 0]]).astype(
                x.dtype
            ),
        )
    ),
    "tshirt|garment.h5",
    "has [345] faces",
    "separate",
)
add(
    "a_garment_with_a_face_turned",
    on_garment(replaced("faces", lambda x: np.concatenate([x[:1, ::-1], x[1:]]))),
    "garment",
    "faces 0 and",
    "opposite ways: turn one",
)
add(
    "a_body_in_centimetres",
    on_body(lambda f: [replaced(n, lambda x: 100 * x)(f) for n in ("vertices", "joints")]),
    "body.h5",
    "centimetres",
)
add(
    "a_body_whose_joints_go_in_circles",
    on_body(replaced("parents", lambda x: np.concatenate([x[:3], [7], x[4:]]).astype(x.dtype))),
    "body.h5",
    "'parents'",
    "a joint before it",
)
add("a_body_without_its_faces", on_body(lambda f: f.__delitem__("faces")), "body.h5", "'faces' is missing")


# --- meshes -------------------------------------------------------------------------------------------------------


def mesh(folder: Path, change=lambda vertices, faces: (vertices, faces), name: str = "shirt.obj", **options):
    body = storage.load_body("body")
    cloth = storage.load_garment("skirt_1000", body)
    vertices, faces = change(np.asarray(cloth.vertices, float), np.asarray(cloth.faces))
    trimesh.Trimesh(vertices, faces, process=False).export(folder / name)
    return lambda: garment.main(garment.Arguments(folder / "mine.h5", mesh=folder / name, **options))


add(
    "a_mesh_in_centimetres", lambda folder: mesh(folder, lambda v, f: (100 * v, f)), "shirt.obj", r"--units cm --up y\?"
)
add(
    "a_mesh_with_z_up",
    lambda folder: mesh(folder, lambda v, f: (v[:, [0, 2, 1]] * [1, -1, 1], f)),
    "shirt.obj",
    r"--up z\?",
)
add(
    "a_mesh_beside_the_body",
    lambda folder: mesh(folder, lambda v, f: (v + [2.0, 0, 0], f)),
    "shirt.obj",
    "move the mesh onto the body",
)
add(
    "a_mesh_of_a_thinner_body",
    lambda folder: mesh(folder, lambda v, f: (v * [0.4, 1, 0.4], f)),
    "shirt.obj",
    "another body",
    r"at \[",
)
add(
    "a_mesh_whose_pins_are_not_there", lambda folder: mesh(folder, pin="object:waist"), "shirt.obj", "no object 'waist'"
)
add("a_mesh_that_nobody_painted", lambda folder: mesh(folder, pin="red"), "shirt.obj", "painted red")
add("more_vertices_than_can_be_trained", lambda folder: mesh(folder, vertices=10**6), "--vertices 1000000", "20000")


@case("shirt.obj", "no triangles")
def a_mesh_without_faces(folder):
    (folder / "shirt.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    return lambda: garment.main(garment.Arguments(folder / "mine.h5", mesh=folder / "shirt.obj"))


@case("either --template or --mesh")
def neither_a_template_nor_a_mesh(folder):
    return lambda: garment.main(garment.Arguments(folder / "mine.h5"))


# --- others' files ------------------------------------------------------------------------------------------------


class Hostile:
    def __reduce__(self):
        return os.system, ("touch pwned",)


@case("SMPL.pkl", "system")
def a_pickle_that_would_run_something(folder):
    (folder / "SMPL.pkl").write_bytes(pickle.dumps({"v_template": Hostile()}))
    return lambda: smpl.main(smpl.Arguments(folder / "SMPL.pkl", folder / "mine.h5"))


@case(r"SMPL\.npz", "has no f, weights, .*kintree_table")
def a_body_that_lacks_an_array(folder):
    np.savez(folder / "SMPL.npz", v_template=np.zeros((9, 3)))
    return lambda: smpl.main(smpl.Arguments(folder / "SMPL.npz", folder / "mine.h5"))


@case("take.npz", "poses")
def a_recording_that_lacks_its_poses(folder):
    np.savez(folder / "take.npz", **{name: x for name, x in recording(frames=9).items() if name != "poses"})
    return lambda: amass.main(amass.Arguments(folder / "take.npz", folder / "mine.h5"))


@case("take.npz")
def a_recording_cut_short(folder):
    np.savez(folder / "take.npz", **recording(frames=9))
    whole = (folder / "take.npz").read_bytes()
    (folder / "take.npz").write_bytes(whole[: len(whole) // 2])
    return lambda: amass.main(amass.Arguments(folder / "take.npz", folder / "mine.h5"))


@case("walk.bvh", r"line \d+")
def a_bvh_with_a_word_for_a_number(folder):
    lines = BVH.splitlines()
    lines[-1] = lines[-1].replace(lines[-1].split()[2], "left", 1)
    (folder / "walk.bvh").write_text("\n".join(lines))
    return lambda: bvh.main(bvh.Arguments(folder / "walk.bvh", folder / "mine.h5"))


@case("take.amc", r"line \d+")
def a_take_of_another_skeleton(folder):
    (folder / "bones.asf").write_text(ASF)
    (folder / "take.amc").write_text(
        re.sub(r"(?m)^lowerback", "tail", AMC, count=1) if "lowerback" in AMC else AMC + "tail 1 2 3\n"
    )
    return lambda: asf_amc.main(asf_amc.Arguments(folder / "bones.asf", folder / "take.amc", folder / "mine.h5"))


@case("none.bvh", "no such file|cannot be read|No such file")
def a_recording_that_is_not_there(folder):
    return lambda: bvh.main(bvh.Arguments(folder / "none.bvh", folder / "mine.h5"))


# --- runs and models ----------------------------------------------------------------------------------------------


def packed(folder: Path, change) -> Path:
    """A garment of the library with something changed in its weights."""
    shutil.copytree(trained.find("skirt"), folder / "skirt")
    change(folder / "skirt" / trained.WEIGHTS)
    return folder / "skirt"


def begun(folder: Path) -> Path:
    """A run with a checkpoint of stage 1."""
    config = dataclasses.replace(small(), motions=("walk_0",))
    checkpoint.save(
        folder / "run" / "stage1" / "checkpoints", 20, {"step": np.int32(20)}, configuration.to_dict(config)
    )
    return folder / "run"


@case("model.npz", "not a whole packed model", "install clothjax again")
def a_model_cut_short(folder):
    run = packed(folder, lambda path: path.write_bytes(path.read_bytes()[:90000]))
    return lambda: loading.load(run)


@case("model.npz")
def a_model_that_would_run_something(folder):
    run = packed(folder, lambda path: np.savez(path, predictor=np.array([Hostile()], dtype=object)))
    return lambda: loading.load(run)


@case("coat", "skirt")
def a_garment_that_does_not_come_with_the_library(folder):
    return lambda: render.main(["coat", "--out", str(folder / "a.webp")])


@case("run", "train first")
def a_folder_without_a_run(folder):
    (folder / "run").mkdir()
    return lambda: evaluate.main([str(folder / "run")])


@case("run", "garment")
def a_run_that_goes_on_with_another_garment(folder):
    begun(folder)
    return training(folder, garment="dress_1000")


@case("run", r"width")
def a_run_that_goes_on_with_another_network(folder):
    begun(folder)
    values = configuration.to_dict(small())
    return training(folder, model=values["model"] | {"width": 12})


@case("run", "is training here", "another directory")
def two_trainings_in_one_folder(folder):
    (folder / "run" / "stage1").mkdir(parents=True)
    held = run_folder.lock(folder / "run" / "stage1")
    held.__enter__()
    FILES.append(held)
    return training(folder)


FILES: list = []
TRIED: list[str] = []  # mistakes
CLEAR: list[str] = []  # of these, what was told clearly


@pytest.fixture(scope="module", autouse=True)
def counted():
    """What this run has tried, and how many of it were not told clearly."""
    yield
    faults.record("inputs", cases=len(TRIED), unclear=len(TRIED) - len(CLEAR))


@case("run", "checkpoint")
def a_checkpoint_whose_every_file_is_empty(folder):
    for path in begun(folder).rglob("*"):
        if path.is_file():
            path.write_bytes(b"")
    return lambda: evaluate.main([str(folder / "run")])


@case("file.txt|Not a directory")
def a_folder_that_is_a_file(folder):
    (folder / "file.txt").write_text("")
    return lambda: train.main([str(settings(folder)), "--directory", str(folder / "file.txt" / "run")])


@case("betas have shape", r"\(10,\)")
def betas_of_another_body(folder):
    return lambda: loading.load("skirt", betas=np.zeros(3))


@case("--betas", "10")
def betas_of_another_body_to_convert(folder):
    return lambda: convert.main(["skirt", "--betas", *"123456789012", "--out", str(folder / "a.onnx")])


@case(r"a\.gif", "cannot write '.gif'", "webp")
def a_picture_of_an_unknown_kind(folder):
    return lambda: render.main(["skirt", "--out", str(folder / "a.gif")])


@case("--pretrained", "RUN_OR_NAME")
def a_model_named_as_it_once_was(folder):
    return lambda: render.main(["--pretrained", "skirt", "--out", str(folder / "a.webp")])


@case("walk_3 has frames 1 to", "not 100000")
def a_frame_after_the_end(folder):
    return lambda: gallery.main(["skirt", "--frame", "100000", "--out", str(folder / "a.png")])


@case("coat", "skirt|no such")
def a_garment_to_tune_that_is_not_there(folder):
    return lambda: tune.main(["coat", "--out", str(folder / "out")])


@case(r"old\.json", "not a report")
def a_benchmark_compared_with_something_else(folder):
    (folder / "old.json").write_text("[]")
    return lambda: report.main(["--quick", "--compare", str(folder / "old.json")])


@case("runs are for the part pareto")
def a_run_for_a_part_that_takes_none(folder):
    return lambda: report.main(["skirt", "--part", "stage1"])


@case("hat_1000", "tshirt_1000")
def a_sweep_over_a_garment_that_is_not_there(folder):
    return lambda: sweep.main([str(settings(folder)), "--garments", "hat_1000", "--directory", str(folder / "sweep")])


@case("no finished run", "train")
def a_report_without_runs(folder):
    return lambda: thesis.main(["--no-training", "--garments", "tshirt", "--out", str(folder / "thesis")])


@case("none.h5|no such")
def a_clip_for_the_demo_that_is_not_there(folder):
    return lambda: viewer.main(["--motions", str(folder / "none.h5"), "--frames", "1"])


@case("quickstart.yaml|latent", "sizes must be > 0")
def a_quickstart_without_a_code(folder):
    (folder / "configs").symlink_to(Path(__file__).parents[2] / "configs")
    return lambda: quickstart.main(["--model.latent", "0"])


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*is damaged:UserWarning")  # a checkpoint, before an older one is looked for
@pytest.mark.parametrize("name", CASES)
def test_a_mistake_gets_one_clear_error_and_loses_nothing(name, tmp_path, capsys, monkeypatch):
    TRIED.append(name)
    make, said = CASES[name]
    call = make(tmp_path)
    before = contents(tmp_path)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended, fail_clearly():
        call()
    code = ended.value.code
    shown = capsys.readouterr().err + (code if isinstance(code, str) else "")
    assert code not in (0, None), shown
    assert "Traceback" not in shown
    lines = [line for line in shown.splitlines() if line.strip()]
    assert len(lines) == 1 or "For full helptext" in shown, shown  # tyro says more of a wrong flag
    unsaid = [words for words in said if not re.search(words, shown)]
    assert not unsaid, f"{unsaid} not in: {shown}"
    assert not (tmp_path / "pwned").exists()
    after = contents(tmp_path)
    assert all(after.get(path) == data for path, data in before.items())
    while FILES:
        FILES.pop().__exit__(None, None, None)
    CLEAR.append(name)


FULL = """
import resource, sys
from functools import partial
from pathlib import Path
from clothjax.files import checkpoint
from clothjax.training import loop
from experiments import train
from clothjax.cli import fail_clearly
save = checkpoint.save
def onto_a_full_disk(directory, step, *args, **options):
    if Path(directory).parent.name == "stage2" and step > int(sys.argv[2]):
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, -1))
    save(directory, step, *args, **options)
checkpoint.save = onto_a_full_disk
loop.fit = partial(loop.fit, checkpoint_seconds=0.0)
with fail_clearly():
    train.main([sys.argv[1] + "/mine.yaml", "--directory", sys.argv[1] + "/run"])
"""


@pytest.mark.slow
def test_a_full_disk_loses_nothing(tmp_path):
    """A limit on the size of files stands for a disk that is full: writing fails in the same place. So it does at the
    first checkpoint of a stage, and at one that has another before it."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    settings(tmp_path)

    def run(room_until: int) -> subprocess.CompletedProcess:
        command = [sys.executable, "-c", FULL, str(tmp_path), str(room_until)]
        return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600)

    def checkpoints() -> dict[str, bytes]:
        files = contents(tmp_path / "run")
        return {path: files[path] for path in files if "checkpoints" in path and "checkpoint-tmp" not in path}

    stage2 = tmp_path / "run" / "stage2" / "checkpoints"
    kept: dict[str, bytes] = {}
    for room_until in (0, 20):
        full = run(room_until)
        # around it, what Orbax and jax write themselves; their threads may still do so at the end
        said = re.search(r"^error: .*stage2.*could not be written.*make room", full.stderr, re.MULTILINE)
        assert full.returncode == 1 and said, full.stderr
        left = checkpoints()
        assert {path: left.get(path) for path in kept} == kept
        kept = left
        assert checkpoint.steps(stage2) == [20] * (room_until == 20)
    again = run(2**40)
    assert again.returncode == 0, again.stderr
    assert checkpoint.steps(stage2)[-1] == 40


def test_there_are_sixty_mistakes():
    assert len(CASES) >= 60
