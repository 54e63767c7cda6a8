"""Models built from what training left: loaded, of one character or of a crowd."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.body import reach, skinning
from clothjax.config import Config
from clothjax.files import storage
from clothjax.geometry import topology
from clothjax.geometry.clusters import Clusters
from clothjax.geometry.correspondence import OnMesh, on_each_other, rigged_like
from clothjax.networks import forces, normalisation, psi
from clothjax.networks.normalisation import ForceScales, Normalizers
from clothjax.physics import contact_search, energies, relaxation
from clothjax.runtime import trained
from clothjax.runtime.models import (
    Bounds,
    Cloth,
    Felt,
    ForcePredictor,
    Layer,
    Model,
    Network,
    PosePredictor,
    ShownCloth,
    Wearer,
    in_float32,
)
from clothjax.types import Array, Body, Garment, Material, Mesh

FORCE_SLACK = 0.0125  # of the range of a code of a Psi with forces, a tenth of a deviation: how far out is still inside


def build(
    config: Config,
    garment: Garment,
    body: Body,
    names: tuple[str, ...],
    garment_params: dict,
    predictor: dict,
    normalizers: Normalizers | ForceScales,
    *,
    felt: Garment | None = None,
    betas: Array | None = None,
    material: Material | None = None,
) -> Model:
    """Build the model of one character from what training gave.

    Scales and constants of the inputs are folded into the layers that read them.

    Args:
        garment, body, names: as loaded by `storage`; names [J] of the joints.
        garment_params: parameters of the decoder with its blend shapes.
        predictor: parameters of the latent predictor.
        normalizers: scales of its codes and inputs.
        felt: that of `model.felt`, if it is not the garment itself.
        betas: [S] body shape; default the mean body.
        material: default the configured one.

    Raises:
        ValueError: for betas of another shape than the body's.
    """
    betas = jnp.zeros(body.shapedirs.shape[-1]) if betas is None else jnp.asarray(betas, jnp.float32)
    if betas.shape != (body.shapedirs.shape[-1],):
        raise ValueError(f"betas have shape {betas.shape}; this body takes ({body.shapedirs.shape[-1]},)")
    cloth = config.material
    constants = (cloth.density, cloth.mu, cloth.lam, cloth.bending) if material is None else material
    material = Material(*(jnp.asarray(value, jnp.float32) for value in constants))
    touched = mesh = clusters = placed = own_mesh = beside = None
    if felt is not None:
        placed = on_each_other(felt, garment)
        felt = rigged_like(felt, garment)
        own_mesh = topology.free_mesh(np.asarray(garment.faces), np.asarray(garment.pinned))
    feels = garment if felt is None else felt
    if isinstance(normalizers, ForceScales):
        touched = reach.reachable(body, garment, config.physics.reach)
        mesh = topology.free_mesh(np.asarray(feels.faces), np.asarray(feels.pinned))
        edges = forces.touching_edges(mesh, config.physics)
        clusters = contact_search.clusters(feels, touched, edges)
        if placed is not None:
            beside = _beside(np.asarray(placed[1].corners), np.asarray(edges), len(feels.vertices))
    network, wearer = _arrays(
        garment, felt, placed, own_mesh, beside, body, touched, clusters, mesh, garment_params, predictor, normalizers,
        betas, material, config,
    )  # fmt: skip
    model = Model(
        network=network,
        wearer=wearer,
        faces=jnp.asarray(garment.faces),
        names=tuple(names),
        parents=tuple(int(p) for p in body.parents),
        input_joints=tuple(int(joint) for joint in psi.input_joints(names, config.stage2)),
        moving=tuple(range(len(names))),
        config=config,
    )
    return in_float32(model)


@partial(jax.jit, static_argnames="config")
def _arrays(
    garment: Garment,
    felt: Garment | None,
    placed: tuple[OnMesh, OnMesh] | None,
    own_mesh: Mesh | None,
    beside: Array | None,
    body: Body,
    touched: Body | None,
    clusters: Clusters | None,
    mesh: Mesh | None,
    garment_params: dict,
    predictor: dict,
    normalizers: Normalizers | ForceScales,
    betas: Array,
    material: Material,
    config: Config,
) -> tuple[Network, Wearer]:
    """Build the arrays of a model in one compiled program, which starts faster than many small ones.

    Args:
        felt: the garment that feels, if it is not the one that is shown, and ...
        placed: ... where it lies on that one, and that one on it; and ...
        own_mesh: ... the elements of that one, ...
        beside: ... and what touches the planes that each of its vertices may touch, as of `Felt`.
        touched: the part of the body that is felt, ...
        clusters: ... its faces and the garment's vertices and edges in clusters, and ...
        mesh: ... the elements that feel; None without forces.
    """
    given = psi.constant_inputs(betas, material, config.material)
    constants, known = psi.bounded_constants(given, config)
    template = skinning.shaped_vertices(garment, betas)
    bias, cloth, latent = jnp.zeros(0), None, None
    if isinstance(normalizers, ForceScales):
        assert touched is not None and clusters is not None and mesh is not None
        feels = garment if felt is None else felt
        felt_template = skinning.shaped_vertices(feels, betas)
        rest, areas = energies.cloth_measures(feels, felt_template if config.physics.shaped_rest else None, mesh)
        shaped = skinning.shaped_vertices(touched, betas)
        mobility = None
        if config.model.relaxation > 0:
            free = 1.0 - jnp.asarray(feels.pinned, jnp.float32)
            mobility = relaxation.mobility(rest, material, mesh, free)
        cloth = Cloth(constants, areas * material.density, rest, material, shaped, mobility, None)
        if felt is not None:
            cloth = cloth._replace(template=felt_template.T)
        if own_mesh is not None and config.model.relaxation > 0:
            shown, _ = energies.cloth_measures(garment, template if config.physics.shaped_rest else None, own_mesh)
            free = 1.0 - jnp.asarray(garment.pinned, jnp.float32)
            moved = relaxation.mobility(shown, material, own_mesh, free)
            cloth = cloth._replace(shown=ShownCloth(shown, moved))
        corrections = None if touched.posedirs is None else jnp.asarray(touched.posedirs)
        weights = jnp.asarray(touched.weights).T
        predictor = psi.of_character(predictor, psi.scaled_inputs(normalizers, constants))
        parts = ForcePredictor(predictor, normalizers, mesh, touched.faces, clusters, weights, corrections, None)
        bounds = Bounds(normalizers.low, normalizers.high, FORCE_SLACK * (normalizers.high - normalizers.low))
        first = jnp.zeros(len(normalizers.low))
    else:
        latent, pose = normalizers
        size = len(latent.mean)
        layer, *hidden = _layers(predictor)
        of_code, of_pose, of_constants = jnp.split(layer.kernel, [size, size + len(pose.mean)])
        bias = constants @ of_constants
        ranges = pose.low * pose.deviation, pose.high * pose.deviation, jnp.full(len(pose.mean), normalisation.SLACK)
        parts = PosePredictor(
            of_pose / pose.deviation[:, None], pose.mean, Bounds(*ranges), Layer(of_code, layer.bias), tuple(hidden)
        )
        bounds = Bounds(latent.low, latent.high, jnp.full(size, normalisation.CODE_SLACK))
        first = -latent.mean / latent.deviation
    read, *decoder = _layers(garment_params["decoder"])
    if config.model.decoder_skip:
        skip = jnp.asarray(garment_params["skip"])
        read = Layer(jnp.concatenate([read.kernel, skip], axis=1), jnp.pad(read.bias, (0, skip.shape[1])))
    if latent is not None:
        read = Layer(latent.deviation[:, None] * read.kernel, read.bias + latent.mean @ read.kernel)
    shapes = _free(garment_params["blendshapes"], garment)
    if felt is not None and isinstance(parts, ForcePredictor):
        assert placed is not None
        on_garment, of_garment = placed
        of_felt = _flat(jax.vmap(on_garment.interpolated)(shapes))
        weights = jnp.asarray(felt.weights).T
        feeling = Felt(of_felt, weights, *of_garment)
        if config.model.relaxation > 0:
            feeling = feeling._replace(mesh=own_mesh, beside=beside)
        parts = parts._replace(felt=feeling)
    network = Network(
        predictor=parts,
        code_bounds=bounds,
        first=first,
        read=read,
        decoder=tuple(decoder),
        mix=None,
        shapes=_flat(shapes),
        weights=jnp.asarray(garment.weights).T,
    )
    return network, Wearer(bias, template.T, skinning.shaped_joints(body, betas), known, cloth)


def _beside(corners: np.ndarray, edges: np.ndarray, vertices: int) -> np.ndarray:
    """Return `Felt.beside` for the corners [V', 3] of faces, from the edges [E, 2] that touch, of so many vertices."""
    if len(edges) == 0:
        return corners
    number = {tuple(sorted(edge)): vertices + i for i, edge in enumerate(edges.tolist())}
    ends = np.sort(np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1), axis=-1)  # [V', 3, 2]
    of_edges = [[number.get((a, b), a) for a, b in face] for face in ends.tolist()]  # an edge of two pinned ones: not
    return np.concatenate([corners, np.array(of_edges, corners.dtype)], axis=1)


def _free(shapes: Array, garment: Garment) -> Array:
    """Return blend shapes [K, V, 3] m that do not move pinned vertices."""
    return jnp.where(jnp.asarray(garment.pinned)[None, :, None], 0.0, shapes)


def _flat(shapes: Array) -> Array:
    """Return blend shapes [K, V, 3] as rows [K, 3 V], coordinate by coordinate."""
    return jnp.swapaxes(shapes, 1, 2).reshape(len(shapes), -1)


def _layers(mlp: dict) -> list[Layer]:
    layers = (mlp[f"dense_{i}"] for i in range(len(mlp)))
    return [Layer(jnp.asarray(layer["kernel"]), jnp.asarray(layer["bias"])) for layer in layers]


def crowd(models: Sequence[Model]) -> Model:
    """Build one model of many characters in the same garment, for `step_crowd`.

    Args:
        models: of different characters, otherwise the same.

    Raises:
        ValueError: if there is none, or one differs from the first in more than its character.
    """
    if not models:
        raise ValueError("a crowd needs at least one model")
    first, *others = (jax.tree.flatten(dataclasses.replace(model, wearer=models[0].wearer)) for model in models)
    for number, (leaves, structure) in enumerate(others, 1):
        same = structure == first[1] and all(
            a is b or np.array_equal(a, b) for a, b in zip(leaves, first[0], strict=True)
        )
        if not same:
            raise ValueError(
                f"models[{number}] differs from models[0] in more than its wearer: a crowd is of one garment, and of "
                "models whose blend shapes `specialise` has not fitted to their characters"
            )
    wearers = jax.tree.map(lambda *each: jnp.stack(each), *(model.wearer for model in models))
    return dataclasses.replace(models[0], wearer=wearers)


def load(
    run: str | Path, *, betas: Array | None = None, material: Material | None = None, coarse: bool = False
) -> Model:
    """Load the model of a run, or of a garment that comes with the library; warn of a run that is not finished.

    Args:
        run: the folder of a run or of a packed model, or a name from `trained.shipped()`, such as "skirt".
        betas: [S] body shape; default the mean body.
        material: default the configured one.
        coarse: show the garment of `model.felt`, a level of detail. Both have the same states, so that a scene can
            change from one to the other in any frame.

    Raises:
        ValueError: if the run has no readable checkpoint of stage 2, its assets are not found, or it is to be coarse
            and has no `model.felt`.
    """
    folder = trained.find(run)
    config, decoder, predictor, normalizers = trained.psi(folder)
    trained.warn_of_unfinished(folder)
    body, names = storage.load_rig(config.body)
    garment = storage.load_garment(config.garment, body, names)
    felt = storage.load_garment(config.model.felt, body, names) if config.model.felt else None
    if coarse:
        if felt is None:
            raise ValueError(f"{run}: has no coarse mesh: it was trained without model.felt")
        config, decoder, garment, felt = (*as_felt(config, decoder, garment, felt), None)
    return build(
        config, garment, body, names, decoder, predictor, normalizers, felt=felt, betas=betas, material=material
    )


def as_felt(config: Config, decoder: dict, garment: Garment, felt: Garment) -> tuple[Config, dict, Garment]:
    """Return the configuration, decoder and garment of a model that shows the garment that feels.

    Args:
        decoder: parameters of the decoder of `garment`.
        felt: that of `model.felt`.
    """
    on_garment, _ = on_each_other(felt, garment)
    shapes = jax.vmap(on_garment.interpolated)(_free(decoder["blendshapes"], garment))
    model = dataclasses.replace(config.model, felt="", shown_relaxation=0)
    config = dataclasses.replace(config, garment=config.model.felt, model=model)
    return config, decoder | {"blendshapes": shapes}, rigged_like(felt, garment)
