"""What several test modules use: meshes, bodies, motion, a model, and the commands of the documents."""

import dataclasses
import os
import re
import shlex
import subprocess
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
import trimesh
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from toy import small

from clothjax.config import Config, PeerConfig
from clothjax.files import storage
from clothjax.geometry import topology
from clothjax.geometry.proximity import PATCH
from clothjax.networks import decoder, forces, mlp, psi
from clothjax.networks.normalisation import ForceScales, Normalizers, Scale
from clothjax.physics import energies
from clothjax.physics.incremental_potential import TimeStep
from clothjax.runtime import inference, loading
from clothjax.simulation import assembly
from clothjax.training import laplacian_shapes
from clothjax.types import Body, Contact, EdgeContact, Garment, Material, Motion, SelfContact


def slowly(*values) -> list:
    """These as parameters of a test, which `make test` leaves to `make test-slow`."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


# Shapes


def icosphere(rounds=2, radius=1.0):
    """A sphere of triangles facing outwards: (vertices, faces)."""
    t = (1 + 5**0.5) / 2
    # twelve vertices: the cyclic turns of (0, +-1, +-t)
    corner = np.array([[0, a, b * t] for a in (-1, 1) for b in (-1, 1)])
    vertices = np.concatenate([np.roll(corner, turn, axis=1) for turn in range(3)])
    faces = ConvexHull(vertices).simplices
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    inwards = np.sum(np.cross(b - a, c - a) * a, axis=1) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    for _ in range(rounds):
        edges = topology.edges(faces)
        middle = {tuple(edge): len(vertices) + i for i, edge in enumerate(edges.tolist())}
        vertices = np.concatenate([vertices, vertices[edges].mean(axis=1)])
        vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
        finer = []
        for a, b, c in faces.tolist():
            d, e, f = (middle[tuple(sorted(pair))] for pair in ((a, b), (b, c), (c, a)))
            finer += [[a, d, f], [b, e, d], [c, f, e], [d, e, f]]
        faces = np.array(finer)
    return radius * vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces


def limb(half_width=0.01):
    """A bar along z, 20 mm wide: (vertices, faces)."""
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    faces = ConvexHull(corner).simplices
    a, b, c = np.moveaxis(corner[faces], 1, 0)
    inwards = np.sum(np.cross(b - a, c - a) * (a + b + c), axis=1) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    return (corner * [half_width, 0.02, 0.3]).astype(np.float32), faces


def sheet(n=6, size=0.3):
    """A flat n x n sheet in the plane y = 0: (vertices, mesh)."""
    grid = np.stack(np.meshgrid(*[np.linspace(0, size, n)] * 2, indexing="ij"), -1).reshape(-1, 2)
    i, j = np.divmod(np.arange((n - 1) ** 2), n - 1)
    a = i * n + j
    faces = np.concatenate([np.stack([a, a + 1, a + n], 1), np.stack([a + n, a + 1, a + n + 1], 1)])
    vertices = np.stack([grid[:, 0], np.zeros(n * n), grid[:, 1]], axis=1)
    return vertices, topology.mesh(faces)


# A time step of a sheet

MATERIAL = Material(density=0.2, mu=23600.0, lam=44400.0, bending=3.96e-5)
DT = 1 / 30


def soup(random, faces, scale=1.0):
    """Triangles [F, 3, 3] m of all shapes: slivers and segments in any direction among them; groups of strangers."""
    shape = random.normal(size=(faces, 3, 3)) * random.choice([1e-3, 0.3], faces)[:, None, None]
    line = shape[:, :1] + shape[:, 1:2] * random.normal(size=(faces, 3, 1))
    thickness = random.choice([0.0, 1e-6, 1e-3], faces)[:, None, None]
    flat = line + thickness * random.normal(size=(faces, 3, 3))
    corners = random.normal(size=(faces, 1, 3)) + np.where(random.random((faces, 1, 1)) < 0.3, flat, shape)
    count = -(-faces // PATCH)
    groups = np.minimum(np.arange(count * PATCH), faces - 1).reshape(count, PATCH)
    return (scale * corners).astype(np.float32), groups.astype(np.int32)


def time_step(
    vertices, mesh, position=None, velocity=None, ground=-1e3, touching=False, dt=DT, edges=False, self_contact=False
):
    """A step over level ground at height `ground` m, in float64."""
    with jax.enable_x64(True):
        rest = jax.tree.map(np.asarray, energies.rest_measures(vertices, mesh))
        areas = np.asarray(energies.vertex_areas(vertices, mesh.faces))
    position = vertices if position is None else position
    up, under = np.zeros_like(position), position.copy()
    up[:, 1], under[:, 1] = 1.0, ground
    return TimeStep(
        position=position,
        velocity=np.zeros_like(position) if velocity is None else velocity,
        mass=areas * MATERIAL.density,
        rest=rest,
        material=MATERIAL,
        contact=Contact(under, under, up, up, np.zeros(len(position), np.int32)),
        touching=np.full(len(position), touching),
        timestep=np.float64(dt),
        edge_contact=on_ground(mesh, ground) if edges else None,
        self_contact=on_a_far_triangle(position, mesh) if self_contact else None,
    )


def on_ground(mesh, ground):
    """Contact of the edges at all kinds of places."""
    count = len(mesh.edges)
    up, under = np.zeros((2, count, 3))
    up[:, 1], under[:, 1] = 1.0, ground
    return EdgeContact(np.random.default_rng(1).uniform(size=count), under, up)


def on_a_far_triangle(position, mesh):
    """Self-contact of every vertex with some triangle that it is no corner of, deep in it."""
    count = len(position)
    random = np.random.default_rng(2)
    faces = [random.choice(np.flatnonzero((mesh.faces != vertex).all(axis=1))) for vertex in range(count)]
    weights = random.dirichlet(np.ones(3), count)
    offset = position - np.einsum("vk,vkc->vc", weights, position[mesh.faces[faces]])
    normal = -offset / np.linalg.norm(offset, axis=1, keepdims=True)
    return SelfContact(mesh.faces[faces], weights, normal)


# The smallest files of our own format


def three_joints(posed: bool = False) -> Body:
    """Six vertices on a chain of three joints."""
    rng = np.random.default_rng(0)
    weights = rng.uniform(size=(6, 3)) * [[1, 1, 0]] * 6
    return Body(
        vertices=rng.uniform(0, 1, (6, 3)).astype(np.float32) * [0.3, 1.5, 0.3],
        faces=np.array([[0, 1, 2], [3, 4, 5]], np.int32),
        joints=np.array([[0, 0, 0], [0, 0.5, 0], [0, 1, 0]], np.float32),
        parents=np.array([-1, 0, 1], np.int32),
        weights=(weights / weights.sum(axis=1, keepdims=True)).astype(np.float32),
        shapedirs=rng.normal(size=(6, 3, 2)).astype(np.float32),
        joint_shapedirs=rng.normal(size=(3, 3, 2)).astype(np.float32),
        posedirs=rng.normal(size=(6, 3, 18)).astype(np.float32) if posed else None,
    )


def two_faces(body: Body) -> Garment:
    """Two triangles over the first four vertices of that body."""
    return Garment(
        vertices=np.asarray(body.vertices)[:4] + np.float32(0.01),
        faces=np.array([[0, 1, 2], [1, 3, 2]], np.int32),
        weights=body.weights[:4],
        shapedirs=body.shapedirs[:4],
        pinned=np.array([True, False, False, True]),
    )


def spin(frames: int = 5, fps: float = 30.0) -> Motion:
    """Random rotations of three joints."""
    vectors = np.random.default_rng(1).uniform(-2, 2, (frames, 3, 3))
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, 3, 3, 3)
    translation = np.cumsum(np.full((frames, 3), 0.1), axis=0) + 1 / 3
    return Motion(rotations.astype(np.float32), translation, fps)


# Recordings: a root, a leg of two bones, a foot

ASF = """# comment
:version 1.10
:units
  mass 1.0
  length 0.45
  angle deg
:root
   order TX TY TZ RX RY RZ
   axis XYZ
   position 0 0 0
:bonedata
  begin
     name lfemur
     direction 0 -1 0
     length 2
     axis 0 0 90 XYZ
    dof rx rz
    limits (-1 1)
           (-1 1)
  end
  begin
     name ltibia
     direction 0 -1 0
     length 3
     axis 0 0 0 XYZ
    dof rx
  end
  begin
     name lfoot
     direction 0 0 1
     length 1
     axis 0 0 0 XYZ
  end
:hierarchy
  begin
    root lfemur
    lfemur ltibia
    ltibia lfoot
  end
"""
AMC = """#!OML:ASF
:FULLY-SPECIFIED
:DEGREES
1
root 1 2 3 0 0 0
lfemur 0 0
ltibia 0
2
root 2 2 3 10 20 30
lfemur 90 0
ltibia 45
"""


SPINE = (("lowerback", "root", "0 1 0", 2), ("thorax", "lowerback", "0 1 0", 4), ("lowerneck", "thorax", "0 1 0", 2),
         ("head", "lowerneck", "0 1 0", 2))  # fmt: skip
LEFT = (("lhipjoint", "root", "0.8 -0.6 0", 2), ("lfemur", "lhipjoint", "0 -1 0", 7), ("ltibia", "lfemur", "0 -1 0", 7),
        ("lfoot", "ltibia", "0 -0.3 0.95", 2), ("ltoes", "lfoot", "0 0 1", 1), ("lclavicle", "thorax", "1 0 0", 3),
        ("lhumerus", "lclavicle", "1 0 0", 5), ("lradius", "lhumerus", "1 0 0", 4))  # fmt: skip


def standing() -> tuple[str, str]:
    """Return an ASF and an AMC file of a whole figure that stands with its arms aside, in CMU's names and lengths."""
    sided = {name for name, *_ in LEFT}
    right = [
        ("r" + name[1:], "r" + parent[1:] if parent in sided else parent, f"-{direction}", length)
        for name, parent, direction, length in LEFT
    ]
    bones = [*SPINE, *LEFT, *right]
    lines = [ASF[: ASF.index(":bonedata")] + ":bonedata"]
    for name, _, direction, length in bones:
        lines += ["begin", f"name {name}", f"direction {direction}", f"length {length}", "axis 0 0 0 XYZ"]
        lines += ["dof rx ry rz", "end"]
    lines += [":hierarchy", "begin", *(f"{parent} {name}" for name, parent, *_ in bones), "end", ""]
    frames = [":FULLY-SPECIFIED", ":DEGREES"]
    for frame in range(1, 31):
        frames += [str(frame), f"root 0 16.2 {0.01 * frame} 0 0 0", *(f"{name} 0 0 0" for name, *_ in bones)]
    return "\n".join(lines), "\n".join([*frames, ""])


BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
  JOINT mixamorig:LeftUpLeg
  {
    OFFSET 0 0 0
    CHANNELS 3 Zrotation Yrotation Xrotation
    JOINT lShin
    {
      OFFSET 0 -2 0
      CHANNELS 3 Zrotation Yrotation Xrotation
      JOINT LeftFoot
      {
        OFFSET 0 -3 0
        CHANNELS 3 Zrotation Yrotation Xrotation
        End Site
        {
          OFFSET 0 0 1
        }
      }
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0083333
1 2 3 0 0 0 0 0 0 0 0 0 0 0 0
2 2 3 30 20 10 0 90 0 0 0 45 0 0 0
"""


# SMPL and AMASS

PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)


SIDED = {
    1: (0.1, -0.05, 0),
    4: (0.1, -0.4, 0),
    7: (0.1, -0.75, 0),
    10: (0.1, -0.8, 0.1),
    13: (0.05, 0.4, 0),
    16: (0.15, 0.4, 0),
    18: (0.3, 0.4, 0),
    20: (0.42, 0.4, 0),
    22: (0.47, 0.4, 0),
}  # the left ones
MIDDLE = {0: 0.0, 3: 0.1, 6: 0.2, 9: 0.3, 12: 0.45, 15: 0.6}  # heights


def smpl_regressor(vertices: np.ndarray) -> scipy.sparse.csc_matrix:
    """What makes SMPL's 24 joints, within an ellipsoid as high as a person, of its vertices."""
    joints = np.zeros((24, 3))
    for joint, place in SIDED.items():
        joints[joint], joints[joint + 1] = place, place * np.array([-1, 1, 1])
    for joint, height in MIDDLE.items():
        joints[joint, 1] = height
    wanted = np.c_[joints, np.ones(24)].T
    return scipy.sparse.csc_matrix(np.linalg.lstsq(np.c_[vertices, np.ones(len(vertices))].T, wanted)[0].T)


def smpl_arrays() -> dict:
    """A body of 24 joints with SMPL's arrays, of few vertices."""
    rng = np.random.default_rng(0)
    mesh = trimesh.creation.icosphere(1)
    vertices, count = np.asarray(mesh.vertices) * [0.5, 0.85, 0.2], len(mesh.vertices)
    weights = rng.uniform(size=(count, 24))
    table = np.array([PARENTS, range(24)])
    table[0, 0] = 2**32 - 1
    return {
        "v_template": vertices,
        "f": np.asarray(mesh.faces, np.uint32),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "shapedirs": 0.01 * rng.normal(size=(count, 3, 12)),
        "posedirs": 0.01 * rng.normal(size=(count, 3, 207)),
        "J_regressor": smpl_regressor(vertices),
        "kintree_table": table,
    }


def recording(frames=121, joints=52, fps=120.0):
    """A second of a walk of sorts in AMASS's layout, up in z, along +y."""
    time = np.arange(frames) / fps
    poses = np.zeros((frames, joints, 3))
    poses[:, 0] = Rotation.from_euler("x", 90, degrees=True).as_rotvec()  # upright
    poses[:, 1, 0], poses[:, 2, 0] = 0.5 * np.sin(6 * time), -0.5 * np.sin(6 * time)
    poses[:, 16, 2], poses[:, 17, 2] = -1.2, 1.2
    trans = np.stack([0 * time, 1.3 * time, 0.9 + 0.02 * np.sin(12 * time)], axis=1)
    return {
        "poses": poses.reshape(frames, -1),
        "trans": trans,
        "betas": np.zeros(16),
        "gender": np.array("female"),
        "mocap_framerate": np.array(fps),
    }


# Models

LATENT = 300  # much wider than the layers around it, as in the thesis


def random_model(skip, excluded=()):
    """A random model with a wide code, and either a skip or a ReLU on the weights, that does not see the joints whose
    names have `excluded` in them."""
    config = small()
    config = dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, decoder=(24,), decoder_skip=skip, blendshape_relu=not skip),
        stage2=dataclasses.replace(config.stage2, hidden=(32, 32), latent_decay=0.3),
    )
    unseen = config.stage2.excluded_joints + tuple(excluded)
    config = dataclasses.replace(
        config,
        stage2=dataclasses.replace(config.stage2, excluded_joints=unseen),
    )
    experiment = assembly.assemble(config)
    rng = np.random.default_rng(0)
    kept = psi.input_joints(experiment.names, config.stage2)
    count, constants = 6 + 3 * 6 * len(kept) + 9 * (len(kept) - 1), 14
    basis = 0.3 * laplacian_shapes.laplacian(experiment.scene, config)
    garment = decoder.init(jax.random.key(0), LATENT, basis, config.model)
    last = garment["decoder"]["dense_1"]
    last |= {"kernel": 50 * last["kernel"], "bias": jnp.asarray(rng.normal(size=last["bias"].shape), jnp.float32)}
    predictor = psi.init(jax.random.key(1), LATENT, count, constants, config.stage2)
    predictor["dense_2"] |= {"kernel": 3 * predictor["dense_2"]["kernel"]}

    def scale(size, low, deviation):
        rows = (0.1 * rng.normal(size=size), deviation * np.ones(size), np.full(size, low), np.full(size, -low))
        return Scale(*(jnp.asarray(row, jnp.float32) for row in rows))

    normalizers = Normalizers(scale(LATENT, -20, 1.0), scale(count, -1e3, 0.5))
    return loading.build(
        config,
        experiment.garment,
        experiment.body,
        experiment.names,
        garment,
        predictor,
        normalizers,
        betas=np.ones(10),
    )


class ForcePsi(NamedTuple):
    """A random Psi with forces: the experiment, its decoder, predictor and scales."""

    experiment: assembly.Experiment
    garment: dict
    predictor: dict
    scales: ForceScales

    def model(self, coarse=False, **character):
        """Return the model of a character, which may show the garment that feels."""
        it = self.experiment
        felt = storage.load_garment(it.config.model.felt, it.body) if it.config.model.felt else None
        config, decoder, garment = it.config, self.garment, it.garment
        if coarse:
            config, decoder, garment, felt = (*loading.as_felt(config, decoder, garment, felt), None)
        return loading.build(
            config, garment, it.body, it.names, decoder, self.predictor, self.scales, felt=felt, **character
        )


def random_force_psi(skip=True, limit=5.0, relaxation=0, scaled=0.0, gated=False, meshes=(), **physics):
    """A random Psi with forces whose code decays, within +-`limit`, with either a skip or a ReLU on the weights.

    Args:
        meshes: garment, and the garment that feels; by default that of `small`.

    The character scales its inputs and layers by random maps of size `scaled`; by default it does not. A `gated` one
    has gates instead.
    """
    config = small()
    config = dataclasses.replace(
        config,
        model=dataclasses.replace(
            config.model,
            decoder=(24, 16),
            decoder_skip=skip,
            blendshape_relu=not skip,
            relaxation=relaxation,
            relaxation_momentum=0.5 if relaxation else 0.0,
        ),
        stage2=dataclasses.replace(config.stage2, forces=True, hidden=(32, 24), gated=gated),
        physics=dataclasses.replace(config.physics, **physics),
    )
    if meshes:
        garment, felt = meshes
        model = dataclasses.replace(config.model, felt=felt, shown_relaxation=5 if relaxation and felt else 0)
        config = dataclasses.replace(config, garment=garment, model=model)
    experiment = assembly.assemble(config)
    scene, size, rng = experiment.scene, 40, np.random.default_rng(0)
    basis = 0.05 * laplacian_shapes.laplacian(scene, config)
    garment = decoder.init(jax.random.key(0), size, basis, config.model)
    last = garment["decoder"]["dense_2"]
    last |= {
        "kernel": 500 * last["kernel"],
        "bias": jnp.asarray(0.1 * rng.normal(size=last["bias"].shape), jnp.float32),
    }
    mixed = rng.normal(size=(size, size))
    whitening = forces.whitening(0.01 * (mixed @ mixed.T / size + 0.1 * np.eye(size)))
    count = psi.DIRECTED * size + 14
    network = psi.ForcePsi(config.stage2, size, 14 if scaled > 0 else 0)
    predictor = mlp.init(network, jax.random.key(1), jnp.zeros(count))
    spread, output = np.repeat([1.0, 1.0, 0.02, 0.02, 3.0, 1.0], [size] * 5 + [14]), 0.3
    kernel = 0.3 * rng.normal(size=predictor["linear"]["kernel"].shape) / np.sqrt(count)
    kernel[:size] = -0.3 / output * whitening.to
    predictor["linear"] |= {"kernel": jnp.asarray(kernel, jnp.float32)}
    if scaled > 0:
        predictor["character"] = {
            name: jnp.asarray(scaled * rng.normal(size=x.shape), jnp.float32)
            for name, x in predictor["character"].items()
        }
    predictor["mlp"]["dense_2"] |= {"kernel": (30 if gated else 300) * predictor["mlp"]["dense_2"]["kernel"]}
    scales = ForceScales(
        *(jnp.asarray(x, jnp.float32) for x in (0.1 * rng.normal(size=count), spread, output)),
        whitening, *(jnp.full(size, x, jnp.float32) for x in (-limit, limit)),
    )  # fmt: skip
    return ForcePsi(experiment, garment, predictor, scales)


def apart(found, model, motion):
    """Distances [T, V] m of vertices found somehow from those of the model in closed loop."""
    return np.linalg.norm(found - np.asarray(inference.animate(model, motion)[0]), axis=-1)


def settings(network: str, **stage) -> Config:
    """A small experiment with a peer's network."""
    config = small()
    stage = {"rollout": 3, "rollout_end": 3, "start_timestep": 0.0, "blendshape_rate": 1.0} | stage
    return dataclasses.replace(
        config,
        motions=("walk_0",),
        stage1=dataclasses.replace(config.stage1, **stage),
        peer=PeerConfig(network, width=8, blendshapes=9),
    )


# Commands of the documents

ROOT = Path(__file__).parents[1]
DOCUMENTS = (
    "README.md",
    "experiments/README.md",
    "clothjax/README.md",
    "clothjax/export/README.md",
    "data_prep/README.md",
)
SMALL = (
    "--shapes.sequences 0 --model.descent_samples 0 --model.width 8 --model.blendshapes 24 --stage1.steps 20 "
    "--stage2.steps 20 --stage2.sequences 2 --stage2.frames 8 --stage2.rollout 2 --tuning.steps 20 --tuning.pool 2 "
    "--labels.rounds 1 --labels.simulations 2 --labels.steps 20 --labels.last_steps 0 "
    "--evaluation.frames 30 "
    "--evaluation.gap_frames 1 --evaluation.solver_frames 20 --evaluation.long_frames 40"
)


def blocks(language: str) -> list[tuple[str, str]]:
    """Blocks of code by the document they are in."""
    found = []
    for name in DOCUMENTS:
        text = (ROOT / name).read_text()
        found += [(name, block) for block in re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)]
    return found


def sentences(text: str) -> list[str]:
    """Return the sentences of a Markdown text; code, formulas, tables and headings are left out."""
    text = re.sub(r"```.*?```|\$\$.*?\$\$", "", text, flags=re.DOTALL)
    text = re.sub(r"(?m)^\s*([|#].*|)$", "\n", text)  # a table, a heading or an empty line ends a paragraph
    paragraphs = re.split(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) )", text)
    plain = [
        re.sub(r"`[^`]*`|\$[^$]*\$", "code", re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", each)) for each in paragraphs
    ]
    return [sentence for each in plain for sentence in re.split(r"(?<=[.!?])[\"')]*\s+", " ".join(each.split()))]


def commands() -> list[str]:
    """Return every command of the documents once, without its comment."""
    lines = "\n".join(block for _, block in blocks("sh")).replace("\\\n", " ").splitlines()
    stripped = [re.sub(r"\s+#.*", "", line).strip() for line in lines]
    return list(dict.fromkeys(re.sub(r"\s+", " ", line) for line in stripped if line))


def run(command: list[str], folder: Path) -> None:
    """A command of the documents, typed in a folder; it has to succeed."""
    environment = os.environ | {"PYTHONPATH": str(folder)}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, f"{shlex.join(command)}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
