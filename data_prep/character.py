"""The body of a rigged character in a glTF file: its skinned mesh, in the pose in which it was bound to its skeleton.

A file does not say which way the character faces, its unit, or which joint is which part. All are read off the pose and
the names. A mesh of several objects, with openings or with clothes on is wrapped in one closed surface.
"""

from pathlib import Path
from typing import NamedTuple

import igl
import numpy as np

from clothjax.files.storage import Rig
from clothjax.types import Body
from data_prep import skeleton
from data_prep.gltf_file import Document, Part, naming, parts
from data_prep.gltf_skeleton import bind_places, distinct_names, humanoid, known_names, to_world
from data_prep.mesh import carried_over
from data_prep.program import METRES, Unit, known_parts
from data_prep.rest_pose import AXES, to_t_pose, unit
from data_prep.wrap import VERTICES, is_closed, wrap

TALL = (1.0, 2.3)  # m, of a figure whose unit of length is looked for
FARTHEST = 2.5  # m, of a vertex from the hips
WELD = 1e-5  # m, within which vertices are one: files split them where textures and normals do
MOST_FACES = 30_000  # of a body as it is; contact is sought on every one
ELSEWHERE = 1e-3  # of the height, by which a vertex may be elsewhere, as it was bound in another pose
MOVED = 0.005  # m, by which a morph target moves the trunk or a limb at least to be a shape of the body
FULL = 3.0  # betas at which a morph target is taken in full


class Bound(NamedTuple):
    """A character in the pose in which it was bound to its skeleton, in the axes and the unit of its file."""

    nodes: tuple[int, ...]  # of the joints, the hips first, parents before children
    names: tuple[str, ...]
    parents: np.ndarray  # [J]
    places: np.ndarray  # [J, 4, 4] of the joints
    vertices: np.ndarray  # [V, 3]
    faces: np.ndarray  # [F, 3]
    weights: np.ndarray  # [V, J]
    morphs: dict[str, np.ndarray]  # [V, 3] by name


class Upright(NamedTuple):
    """From a file's axes and unit to metres, with y up and z forward."""

    turn: np.ndarray  # [3, 3]
    scale: float

    def points(self, x: np.ndarray) -> np.ndarray:
        """Return points [..., 3] in m."""
        return self.scale * x @ self.turn.T

    def rotations(self, x: np.ndarray) -> np.ndarray:
        """Return rotations [..., 3, 3] between points of the file as those between points in m."""
        return self.turn @ x @ self.turn.T


class Character(NamedTuple):
    """A body, and how to read the motions of its joints."""

    rig: Rig
    canonical_rotation: np.ndarray  # [J, 3, 3], as of `save_body`
    document: Document
    bound: Bound
    upright: Upright
    log: tuple[str, ...]  # what was done, and what of the file is left out


def read(
    path: str | Path,
    objects: tuple[str, ...] = (),
    shapes: tuple[str, ...] = (),
    joints: Path | None = None,
    units: Unit | None = None,
) -> Character:
    """Read the character in a file.

    Args:
        path: of a .glb, .gltf or .vrm file.
        objects: names of the objects, meshes or materials that are its body; default: all that its skeleton moves.
        shapes: morph targets that become shape parameters; default: those that move more than its head.
        joints: a mapping file, as of `skeleton.mapped`.
        units: the unit of length of the file; default: what makes it as tall as people are.

    Raises:
        ValueError: naming the file, the place in it and what to do.
    """
    if not Path(path).is_file():
        raise ValueError(f"{path}: no such file")
    with naming(path):
        document = Document(path)
        found = parts(document)
        skinned = [part for part in found if part.skinned is not None and len(part.faces)]
        if not skinned:
            raise ValueError("no mesh is skinned: export the character with its skeleton")
        chosen = _chosen(skinned, objects)
        bound, of_body, log = _bound(document, chosen, joints)
        upright, told = _upright(bound, of_body, units)
        body, wrapped = _body(bound, upright, shapes)
        known = skeleton.landmarks(bound.names, bound.parents)
        canonical = to_t_pose(np.asarray(body.joints), bound.parents, known)
    left = [part for part in found if not any(part is each for each in chosen)]
    if left:
        names = dict.fromkeys(part.names[0] for part in left if part.names)
        log.append(f"left out, not of the body: {', '.join(names)}")
    return Character(Rig(body, bound.names), canonical, document, bound, upright, (*log, *told, *wrapped))


def _chosen(skinned: list[Part], objects: tuple[str, ...]) -> list[Part]:
    """Return the parts that have one of some names, all if none is given."""
    names = dict.fromkeys(name for part in skinned for name in part.names)
    absent = [name for name in objects if name not in names]
    if absent:
        raise ValueError(f"no skinned object is called {', '.join(absent)}; there are {', '.join(names)}")
    return [part for part in skinned if not objects or set(objects) & set(part.names)]


def _bound(document: Document, chosen: list[Part], joints: Path | None) -> tuple[Bound, skeleton.Parts, list[str]]:
    """Return a character as it was bound, the parts of its body, and what was done."""
    scene = document.places()
    skins = {part.skinned.skin for part in chosen if part.skinned is not None}
    moving = {joint for skin in skins for joint in document.entries("skins")[skin]["joints"]}
    carrying = {above for node in moving for above in document.above(node)}
    nodes = [node for node in scene if node in carrying]
    names, parents, of_body, log = _skeleton(document, nodes, joints)
    pulling = {*of_body.chain, *of_body.limbs.values()}
    for part in chosen:
        assert part.skinned is not None
        skin = document.entries("skins")[part.skinned.skin]["joints"]
        pulling |= {nodes.index(skin[k]) for k in np.unique(part.skinned.joints[part.skinned.weights > 0])}
    needed = {above for joint in pulling for above in skeleton.ancestors(joint, parents)}
    below = [j for j in sorted(needed) if of_body.hips in skeleton.ancestors(j, parents)]
    if len(nodes) > len(needed):
        log.append(f"{len(nodes) - len(needed)} joints that move nothing are left out")
    largest = max((part.skinned for part in chosen if part.skinned is not None), key=lambda it: len(it.bound))
    places = bind_places(document, scene, nodes, parents, largest.skin)
    if not np.allclose(places, np.stack([scene[node] for node in nodes]), atol=1e-3):
        log.append(
            "the scene shows another pose than the one it was bound in, which is taken: clothes in it do not fit"
        )
    number = {nodes[j]: k for k, j in enumerate(below)}

    vertices, faces, weights, moves, outside, bent = [], [], [], [], 0, 0.0
    for part in chosen:
        assert part.skinned is not None
        skin, count = document.entries("skins")[part.skinned.skin], len(part.vertices)
        mesh_to_world = to_world(document, part.skinned.skin, nodes, places)
        inverse = document.inverse_bind(part.skinned.skin)
        carrying = np.tile(mesh_to_world, (len(skin["joints"]), 1, 1))
        if inverse is not None:  # a part may have been bound in another pose than the largest one
            carrying = places[[nodes.index(joint) for joint in skin["joints"]]] @ inverse
        by_vertex = np.einsum("vk,vkab->vab", part.skinned.weights, carrying[part.skinned.joints])
        by_vertex += (1.0 - part.skinned.weights.sum(axis=1))[:, None, None] * mesh_to_world
        columns = np.array([number.get(joint, 0) for joint in skin["joints"]])[part.skinned.joints]
        elsewhere = np.array([joint not in number for joint in skin["joints"]])[part.skinned.joints]
        outside += int(((part.skinned.weights * elsewhere).sum(axis=1) > 0.01).sum())
        own = np.zeros((count, len(below)))
        np.add.at(own, (np.arange(count)[:, None], columns), part.skinned.weights)
        own[own.sum(axis=1) == 0, 0] = 1.0
        faces.append(part.faces + sum(map(len, vertices)))
        turns, moved = by_vertex[:, :3, :3], by_vertex[:, :3, 3]
        vertices.append(np.einsum("vab,vb->va", turns, part.skinned.bound) + moved)
        plain = part.skinned.bound @ mesh_to_world[:3, :3].T + mesh_to_world[:3, 3]
        bent = max(bent, float(np.linalg.norm(vertices[-1] - plain, axis=1).max(initial=0.0)))
        weights.append(own)
        moves.append({name: np.einsum("vab,vb->va", turns, added) for name, added in part.morphs.items()})
    if bent > ELSEWHERE * np.ptp(np.concatenate(vertices), axis=0).max():
        log.append("an object was bound in another pose than the largest one: it is carried into that pose")
    if outside:
        log.append(f"{outside} vertices follow joints that do not hang on the hips: they follow the hips")
    vertices, faces, weights = (np.concatenate(each) for each in (vertices, faces, weights))
    if faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
        raise ValueError("a face names a vertex that is not there, or a vertex is not finite")
    still = [np.zeros_like(part.vertices) for part in chosen]
    bound = Bound(
        nodes=tuple(number),
        names=tuple(names[j] for j in below),
        parents=np.array([below.index(parents[j]) if parents[j] in below else -1 for j in below]),
        places=places[below],
        vertices=vertices,
        faces=faces,
        weights=weights,
        morphs={
            name: np.concatenate([own.get(name, zero) for own, zero in zip(moves, still, strict=True)])
            for name in dict.fromkeys(name for own in moves for name in own)
        },
    )
    return bound, skeleton.find(bound.names, bound.parents), log


def _skeleton(
    document: Document, nodes: list[int], joints: Path | None
) -> tuple[tuple[str, ...], np.ndarray, skeleton.Parts, list[str]]:
    """Return names and parents [n] of nodes, the parts of the body among them, and which are called otherwise."""
    parents = np.array([nodes.index(above) if (above := document.parent(node)) in nodes else -1 for node in nodes])
    names = distinct_names([document.name(node) for node in nodes])
    said = {part: names[nodes.index(node)] for part, node in humanoid(document).items() if node in nodes}
    if said and joints is None:
        of_body = skeleton.told(said, names, parents, "its VRM humanoid")
    else:
        of_body = known_parts(names, parents, joints, document.path)
    known = known_names(names, parents, of_body)
    log = [f"joint {old} is called {new}" for old, new in zip(names, known, strict=True) if old != new]
    return known, parents, of_body, log


def _upright(bound: Bound, of_body: skeleton.Parts, units: Unit | None) -> tuple[Upright, list[str]]:
    """Return how a character is turned and scaled, and what is to be told of it."""
    at, limbs, told = bound.places[:, :3, 3], of_body.limbs, []
    trunk = unit(at[of_body.chain[-1]] - at[of_body.hips])
    name = max(AXES, key=lambda axis: float(trunk @ AXES[axis]))
    up = AXES[name]
    across = at[limbs["left thigh"]] - at[limbs["right thigh"]]
    left = unit(across - (across @ up) * up)
    if trunk @ up < 0.8 or np.linalg.norm(left) == 0.0:
        raise ValueError("it was not bound to its skeleton standing: bind it in a T-pose or an A-pose")
    nearest = max(AXES.values(), key=lambda axis: float(left @ axis))
    left = nearest if left @ nearest > np.cos(np.radians(10.0)) and nearest @ up == 0 else left
    turn = np.stack([left, up, np.cross(left, up)])
    if not np.allclose(turn, np.eye(3)):
        told.append(f"turned: {name} of the file is up, and it faces {np.round(turn[2], 2).tolist()}")
    for side in skeleton.SIDES:
        foot = limbs[f"{side} foot"]
        share = bound.weights[:, [foot in skeleton.ancestors(j, bound.parents) for j in range(len(at))]].sum(axis=1)
        if share.sum() > 0 and (share @ (bound.vertices - at[foot]) / share.sum()) @ turn[2] < 0:
            raise ValueError(
                f"its {side} foot points backwards: it is mirrored, or the names of left and right are exchanged"
            )
    tall, own = np.ptp(bound.vertices @ up), at[[*of_body.chain, *limbs.values()]] @ up
    if not 0.5 < np.ptp(own) / tall < 2.0 or not (bound.vertices @ up).min() < own.mean() < (bound.vertices @ up).max():
        raise ValueError(
            f"its joints, {np.ptp(own):.3g} units tall, are not in its mesh, {tall:.3g} tall: bind the mesh to the "
            "skeleton again, and export the inverse bind matrices"
        )
    scale = METRES[units] if units else next((x for x in METRES.values() if TALL[0] < x * tall < TALL[1]), 0.0)
    scale = 1.0 if not units and 0.3 < tall < 3.0 else scale
    if not 0.3 < scale * tall < 3.0:
        raise ValueError(f"it is {tall:.4g} units tall, 0.3 to 3 m is expected: give its unit (--units)")
    reach = np.linalg.norm(bound.vertices - at[of_body.hips], axis=1)
    if scale * reach.max() > FARTHEST:
        raise ValueError(
            f"a vertex at {np.round(bound.vertices[reach.argmax()], 2).tolist()} is {scale * reach.max():.1f} m from "
            "the hips: leave out what is not the body (--object)"
        )
    told.append(f"{scale * tall:.2f} m tall" + ("" if scale == 1.0 else f": a unit of the file is {1000 * scale:g} mm"))
    return Upright(turn, scale), told


def _body(bound: Bound, upright: Upright, shapes: tuple[str, ...]) -> tuple[Body, list[str]]:
    """Return a character's body in m, wrapped if it is not one closed surface, and what was done."""
    vertices, joints = upright.points(bound.vertices), upright.points(bound.places[:, :3, 3])
    _, first, index = np.unique(np.round(vertices / WELD), axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)  # as they are in the file
    first, faces = first[order], np.argsort(order)[index.reshape(-1)][bound.faces]
    used, faces = np.unique(faces[(faces != faces[:, [1, 2, 0]]).all(axis=1)], return_inverse=True)
    first, faces = first[used], faces.reshape(-1, 3)
    weights, vertices = bound.weights[first], vertices[first]
    chosen = _shapes(bound, upright, shapes)
    directions = np.stack([added[first] for added in chosen.values()] or [np.zeros((len(vertices), 0))], axis=-1)
    directions = directions.reshape(len(vertices), 3, -1) / FULL
    log = [f"shape parameters, {FULL:g} for the whole of it: {', '.join(chosen)}"] if chosen else []
    closed = is_closed(vertices, faces)
    if not closed or len(faces) > MOST_FACES:
        surface, triangles = wrap(vertices, faces, VERTICES)
        distance = np.sqrt(igl.point_mesh_squared_distance(vertices, surface, triangles)[0])
        reason = f"it has {len(faces)} faces" if closed else "it is not one closed surface"
        log.append(
            f"wrapped in a closed surface of {len(surface)} vertices, as {reason}; its vertices are "
            f"{1000 * np.median(distance):.0f} mm from it (median), at most {1000 * distance.max():.0f} mm"
        )
        weights, directions = (carried_over(surface, vertices, faces, x) for x in (weights, directions))
        vertices, faces = surface, triangles
    weights = np.where(weights > 1e-3, weights, 0.0)
    body = Body(
        vertices=vertices.astype(np.float32),
        faces=faces.astype(np.int32),
        joints=joints.astype(np.float32),
        parents=bound.parents.astype(np.int32),
        weights=(weights / weights.sum(axis=1, keepdims=True)).astype(np.float32),
        shapedirs=directions.astype(np.float32),
        joint_shapedirs=np.zeros((len(joints), 3, directions.shape[-1]), np.float32),
    )
    return body, log


def _shapes(bound: Bound, upright: Upright, wanted: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Return the morph targets [V, 3] in m that become shape parameters, by name."""
    absent = [name for name in wanted if name not in bound.morphs]
    if absent:
        raise ValueError(
            f"no morph target is called {', '.join(absent)}; there are {', '.join(bound.morphs) or 'none'}"
        )
    moves = {name: upright.points(added) for name, added in bound.morphs.items()}
    if wanted:
        return {name: moves[name] for name in wanted}
    neck = skeleton.landmarks(bound.names, bound.parents)["Neck"]
    of_head = [neck in skeleton.ancestors(joint, bound.parents) for joint in range(len(bound.names))]
    elsewhere = bound.weights[:, of_head].sum(axis=1) < 0.5
    return {name: x for name, x in moves.items() if np.linalg.norm(x[elsewhere], axis=1).max(initial=0.0) > MOVED}
