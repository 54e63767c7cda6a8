"""The thesis by name: from files of SMPL and AMASS, written here in their layouts, to trained and exported garments."""

import dataclasses
import json
import pickle
import re
import shlex
import sys

import numpy as np
import pytest
import trimesh
from recorded import amass_arrays, smpl_model
from samples import ROOT, run
from toy import shrink

from clothjax.commands import convert
from clothjax.config import Config
from clothjax.files import checkpoint, configuration, storage
from clothjax.training import pipeline
from data_prep import procedural
from data_prep.takes import Takes

pytestmark = pytest.mark.slow
THESIS = ROOT / "configs" / "thesis"
GARMENTS = ("dress", "long_sleeve", "pants", "tank", "tshirt")
GENERATED = {"torso": "twist", "avoidance": "walk"}  # kinds of generated motions for those of the takes
UPDATES = 2


def command(name, program):
    """Return the words of the first command of a program in the comment of a garment's configuration."""
    text = (THESIS / f"{name}.yaml").read_text().replace("\\\n#", " ")
    (found, *_) = re.findall(rf"(?m)^#\s+python (-m {program}.*)$", text)
    return [sys.executable, *shlex.split(found.replace("AMASS_FOLDER", "AMASS").replace("4400", "400"))]


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """A folder in which body and motions are prepared by the commands in the comments of the configurations."""
    folder = tmp_path_factory.mktemp("thesis")
    for name in ("clothjax", "configs", "data_prep"):
        (folder / name).symlink_to(ROOT / name)
    (folder / "SMPL_FEMALE.pkl").write_bytes(pickle.dumps(smpl_model(), protocol=2))
    takes = configuration.load(Takes, THESIS / "takes.yaml")
    kinds = {take: GENERATED.get(kind, kind) for kind, of_kind in takes.train.items() for take in of_kind}
    arrays = {kind: amass_arrays(kind, 0, 60) for kind in procedural.KINDS}
    for take in takes.all:
        path = folder / "AMASS" / "CMU" / take.partition("_")[0] / f"{take}_poses.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, **arrays[kinds.get(take, "walk")])
    for program in ("data_prep.smpl", "data_prep.amass"):
        run(command("tshirt", program), folder)
    return folder


@pytest.mark.parametrize("name", GARMENTS)
def test_a_garment_of_the_thesis_trains_both_stages(name, prepared, monkeypatch):
    run(command(name, r"data_prep.garment \S+ --template"), prepared)
    monkeypatch.chdir(prepared)
    if name == "tshirt":  # the template stands in for HOOD's mesh
        cloth = storage.load_garment("data/thesis/tshirt.h5", storage.load_body("data/thesis/body.h5"))
        trimesh.Trimesh(np.asarray(cloth.vertices), np.asarray(cloth.faces), process=False).export("tshirt.obj")
        run(command(name, r"data_prep.garment \S+ --mesh"), prepared)
    monkeypatch.setattr(pipeline, "STEPS_PER_CALL", UPDATES)
    path = f"configs/thesis/{name}.yaml"
    config = shrink(configuration.load(Config, path))
    config = dataclasses.replace(
        config,
        stage1=dataclasses.replace(config.stage1, steps=UPDATES),
        stage2=dataclasses.replace(config.stage2, steps=UPDATES),
    )
    folder = pipeline.run_directory(config, [path])
    assert str(folder) == f"runs/thesis_{name}"
    pipeline.train(config, folder)
    for stage in ("stage1", "stage2"):
        assert checkpoint.steps(folder / stage / "checkpoints") == [UPDATES]
        assert json.loads((folder / stage / "metrics.jsonl").read_text())["nonfinite"] == 0
    if name == "tshirt":
        for form, ending in (("onnx", "onnx"), ("c", "psi")):
            convert.main([str(folder), "--to", form])
            assert (folder / f"tshirt.{ending}").is_file()
