"""Psi made smaller and faster for one use (METHOD.md, Psi): exactly, or at the price of an error to be measured.

Every function takes a model of `inference` and returns another, which runs through the same functions.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.body import skinning
from clothjax.files import storage
from clothjax.geometry import correspondence
from clothjax.runtime.drape import blend_weights
from clothjax.runtime.inference import rollout
from clothjax.runtime.models import (
    Bounds,
    Felt,
    FoldedLayer,
    ForcePredictor,
    Layer,
    Model,
    Network,
    PosePredictor,
    ShownCloth,
    in_float32,
)
from clothjax.types import Array, Garment, Motion

FOLD_RATIO = 0.75  # folding must leave at most this part of the weights of the layers around the code
CALIBRATION_CLIPS = ("walk_0", "run_0", "jump_0", "twist_0", "dance_0", "arms_0")  # give the usual displacements
CALIBRATION_CODES = 2048  # random codes, for a body that the clips do not fit
UNSEEN_VARIANCE = 1e-3  # assumed of weights that do not vary in the clips, relative to the mean variance


def specialise(model: Model, *, blendshapes: int | None = None, max_influences: int | None = None) -> Model:
    """Return the model reduced to what its use needs.

    Two reductions are exact. The code is folded into the two layers that read it, where that takes much fewer weights.
    Joints that move no vertex are left out. (A folded code outside the range of training is clipped only to the image
    of that range, and `State.ok` may stay True.) The arguments ask for lossy reductions.

    Args:
        blendshapes: number of blend shapes, fitted to the present ones.
        max_influences: largest number of joints that move a vertex.

    Raises:
        ValueError: for a number that is not at least 1.
    """
    for name, value in (("blendshapes", blendshapes), ("max_influences", max_influences)):
        if value is not None and value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    if blendshapes is not None and blendshapes < len(model.network.shapes):
        if model.network.folded or model.network.mix is not None:
            raise ValueError("this model is specialised already: give `blendshapes` with the first call")
        model = _fewer_shapes(model, blendshapes)
    if max_influences is not None:
        model = _fewer_influences(model, max_influences)
    return in_float32(without_code(_without_idle_joints(model)))


def without_code(model: Model) -> Model:
    """Return the model with the code folded into the layers around it, if these then have much fewer weights.

    A linear layer gives the code and two layers read it: the predictor's first in the next frame, and the decoder's.
    A predictor with forces reads more than the code, which then stays.
    """
    network, predictor = model.network, model.network.predictor
    if network.readers is None or not isinstance(predictor, PosePredictor):
        return model
    code, read = network.readers
    readers = jnp.concatenate([code.kernel, read.kernel], axis=1)
    *hidden, last = predictor.hidden
    folded = Layer(_product(last.kernel, readers), _product(last.bias, readers))
    if folded.kernel.size > FOLD_RATIO * (last.kernel.size + readers.size):
        return model
    low, high, slack = network.code_bounds
    middle, radius = _product(0.5 * (low + high), readers), _product(0.5 * (high - low), jnp.abs(readers))
    network = network._replace(
        predictor=predictor._replace(code=FoldedLayer(code.bias), hidden=(*hidden, folded)),
        code_bounds=Bounds(middle - radius, middle + radius, _product(slack, jnp.abs(readers))),
        first=_product(network.first, readers),
        read=FoldedLayer(read.bias),
    )
    return dataclasses.replace(model, network=network)


def equalised(model: Model) -> Model:
    """Return a model with the same results whose blend shapes and code are scaled by `smoothing_scale`.

    It is for eight bits in runtimes that quantise all inputs of a layer with one scale.
    """
    network = _equalised_shapes(model.network, np.abs(ordinary_weights(model)).max(axis=0))
    return dataclasses.replace(model, network=_equalised_code(network))


def _equalised_shapes(network: Network, limits: np.ndarray) -> Network:
    """Scale the blend shapes, and their weights by the inverse, so that displacements stay the same.

    Args:
        limits: [K], the largest magnitude of each weight.
    """
    scale = smoothing_scale(limits, network.shapes)
    shapes = network.shapes * scale[:, None]
    predictor = network.predictor
    if isinstance(predictor, ForcePredictor) and predictor.felt is not None:
        felt = predictor.felt._replace(shapes=predictor.felt.shapes * scale[:, None])
        network = network._replace(predictor=predictor._replace(felt=felt))
    if network.mix is not None:
        mix = Layer(network.mix.kernel / scale[None], network.mix.bias / scale)
        return network._replace(mix=mix, shapes=shapes)
    *decoder, last = network.decoder
    read = network.read
    of_read = np.concatenate([np.ones(network.width), scale])[: len(read.bias)]  # the skip gives weights directly
    if isinstance(read, Layer):
        read = Layer(read.kernel / of_read[None], read.bias / of_read)
    else:  # the code ends with the product that `read` adds its bias to
        read = FoldedLayer(read.bias / of_read)
        of_code = np.ones(len(network.first), np.float32)
        of_code[-len(of_read) :] = of_read
        network = _divided_code(network, of_code)
    decoder = (*decoder, Layer(last.kernel / scale[None], last.bias / scale))
    return network._replace(read=read, decoder=decoder, shapes=shapes)


def _equalised_code(network: Network) -> Network:
    """Scale the code, and the kernels that read it by the inverse; one folded or with forces is returned as it is."""
    if network.readers is None:
        return network
    code, read = network.readers
    limits = np.maximum(-np.asarray(network.code_bounds.low), np.asarray(network.code_bounds.high))
    scale = smoothing_scale(limits, jnp.concatenate([code.kernel, read.kernel], axis=1))
    network = _divided_code(network, scale)
    assert isinstance(network.predictor, PosePredictor)
    return network._replace(
        predictor=network.predictor._replace(code=code._replace(kernel=code.kernel * scale[:, None])),
        read=read._replace(kernel=read.kernel * scale[:, None]),
    )


def _divided_code(network: Network, scale: np.ndarray) -> Network:
    """Divide the code by `scale` [C] where it is made: last layer, bounds, first code. Who reads it must multiply."""
    predictor = network.predictor
    assert isinstance(predictor, PosePredictor)
    *hidden, last = predictor.hidden
    hidden = (*hidden, Layer(last.kernel / scale[None], last.bias / scale))
    return network._replace(
        predictor=predictor._replace(hidden=hidden),
        code_bounds=Bounds(*(row / scale for row in network.code_bounds)),
        first=network.first / scale,
    )


def smoothing_scale(limits: Array, kernel: Array) -> np.ndarray:
    """Compute a scale [n] that balances a layer's inputs against its weights (SmoothQuant, Xiao et al. 2023).

    Inputs [n] are divided by it, and the rows of the kernel [n, m] multiplied, before both are rounded to eight bits.

    Args:
        limits: [n] largest magnitude of each input.
        kernel: [n, m].
    """
    weights = np.abs(np.asarray(kernel)).max(axis=1)
    return np.sqrt(np.maximum(limits, 1e-6) / np.maximum(weights, 1e-6)).astype(np.float32)


def part(model: Model, vertices: Array) -> Model:
    """Return the model of a part of its garment, such as what is visible.

    Args:
        vertices: [n] indices of the vertices to keep; the faces among them stay, numbered anew.
    """
    vertices = np.unique(np.asarray(vertices))
    number = np.full(model.wearer.template.shape[-1], -1)
    number[vertices] = np.arange(len(vertices))
    faces = number[np.asarray(model.faces)]
    model = _feeling_apart(model, np.repeat(vertices[:, None], 3, axis=1), np.eye(3)[np.zeros(len(vertices), int)])
    network = model.network._replace(
        shapes=_rows(model.network)[:, :, vertices].reshape(len(model.network.shapes), -1),
        weights=model.network.weights[:, vertices],
    )
    return dataclasses.replace(
        model,
        network=network,
        wearer=model.wearer._replace(template=model.wearer.template[..., vertices]),
        faces=jnp.asarray(faces[(faces >= 0).all(axis=1)]),
    )


def _feeling_apart(model: Model, around: Array, shares: Array) -> Model:
    """Return a model that goes on to feel the forces on the garment of now when another is shown.

    Args:
        around, shares: [V', 3] as of `Felt`, of the garment that is shown now at each vertex of the other.
    """
    predictor, cloth = model.network.predictor, model.wearer.cloth
    if isinstance(predictor, PosePredictor) or cloth is None:
        return model
    if predictor.felt is None:
        rows = jnp.asarray(around, jnp.int32), jnp.asarray(shares, jnp.float32)
        felt = Felt(model.network.shapes, model.network.weights, *rows)
        cloth = cloth._replace(template=model.wearer.template)
    else:
        kept = around[:, 0]  # of a part, so each is a vertex of the garment that is shown now
        felt = predictor.felt._replace(around=predictor.felt.around[kept], shares=predictor.felt.shares[kept])
        if felt.mesh is not None and cloth.shown is not None:
            number = np.full(len(cloth.shown.mobility), -1)
            number[kept] = np.arange(len(kept))
            faces = number[np.asarray(felt.mesh.faces)]
            inside = (faces >= 0).all(axis=1)
            mesh = felt.mesh._replace(faces=jnp.asarray(faces[inside], jnp.int32))
            felt = felt._replace(mesh=mesh, beside=None if felt.beside is None else felt.beside[kept])
            rest, mobility = cloth.shown
            rest = rest._replace(inverse=rest.inverse[inside], face_area=rest.face_area[inside])
            cloth = cloth._replace(shown=ShownCloth(rest, mobility[kept]))
    predictor = predictor._replace(felt=felt)
    return dataclasses.replace(
        model, network=model.network._replace(predictor=predictor), wearer=model.wearer._replace(cloth=cloth)
    )


def on_mesh(model: Model, garment: Garment, betas: Array) -> Model:
    """Return the model on another mesh of the same garment, finer or coarser: a level of detail.

    Each vertex takes the displacement and the skinning of the nearest point of the model's own mesh. A pinned one has
    no displacement, and its own skinning.

    Args:
        model: as it was loaded; the result can be specialised.
        betas: [S] of the model's character.

    Raises:
        ValueError: for a specialised model, because the mesh may need the parts that are gone, and for one that is on
            another mesh, or a part, already.
    """
    if isinstance(model.network.predictor, ForcePredictor) and model.network.predictor.felt is not None:
        raise ValueError(
            "this model shows another mesh, or a part, already: begin with the one that was loaded; one trained with "
            "model.felt has load(..., coarse=True)"
        )
    if len(model.moving) < len(model.names) or len(model.network.shapes) != model.config.model.blendshapes:
        raise ValueError("this model is specialised already: put it on the other mesh first")
    template = np.asarray(skinning.shaped_vertices(garment, jnp.asarray(betas, jnp.float32)))
    placed = correspondence.on_mesh(template, np.asarray(model.wearer.template).T, np.asarray(model.faces))
    pinned = np.asarray(garment.pinned)[:, None]
    weights = np.where(pinned, garment.weights, placed.interpolated(model.network.weights.T))
    around, shares = placed.corners, np.where(pinned, 0.0, placed.shares)
    shapes = np.einsum("kcvi,vi->kcv", np.asarray(_rows(model.network))[:, :, around], shares)
    model = _feeling_apart(model, around, shares)
    network = model.network._replace(
        shapes=jnp.asarray(shapes.reshape(len(shapes), -1)),
        weights=jnp.asarray(weights.T),
    )
    return dataclasses.replace(
        model,
        network=network,
        wearer=model.wearer._replace(template=jnp.asarray(template.T)),
        faces=jnp.asarray(garment.faces),
    )


def ordinary_weights(model: Model) -> np.ndarray:
    """Return the blend weights [n, K] that occur in use, from rollouts over the calibration clips.

    For a body whose joints the clips do not fit, they come from random codes.
    """
    limits = model.network.code_bounds
    try:
        clips = [storage.load_motion(name, model.names) for name in CALIBRATION_CLIPS]
        codes = jnp.concatenate([_codes(model, clip) for clip in clips])
    except ValueError:
        codes = jax.random.normal(jax.random.key(0), (CALIBRATION_CODES, len(limits.low)))
        codes = jnp.clip(codes, limits.low[None], limits.high[None])
    return np.asarray(jax.vmap(lambda code: blend_weights(model.network, code, model.config))(codes))


@jax.jit
def _codes(model: Model, motion: Motion) -> Array:
    """Return the codes [T, C] of an autoregressive rollout."""
    return rollout(model, motion, lambda state, _: state.latent, vertices=False)


def _product(a: Array, b: Array) -> Array:
    return jnp.asarray(np.asarray(a, np.float64) @ np.asarray(b, np.float64), jnp.float32)


def _rows(network: Network) -> Array:
    return network.shapes.reshape(len(network.shapes), 3, -1)


def _fewer_shapes(model: Model, count: int) -> Model:
    """Replace the blend shapes by principal components of ordinary displacements; their mean goes into the template."""
    network, wearer, cloth = model.network, model.wearer, model.wearer.cloth
    felt = network.predictor.felt if isinstance(network.predictor, ForcePredictor) else None
    all_shapes = [np.asarray(x) for x in ([network.shapes] if felt is None else [network.shapes, felt.shapes])]
    mix, rows, mean = principal_rows(ordinary_weights(model), np.concatenate(all_shapes, axis=1), count)
    size = all_shapes[0].shape[1]
    if felt is not None and cloth is not None:
        felt = felt._replace(shapes=jnp.asarray(rows[:, size:]))
        network = network._replace(predictor=network.predictor._replace(felt=felt))
        wearer = wearer._replace(cloth=cloth._replace(template=cloth.template + mean[size:].reshape(3, -1)))
    network = network._replace(shapes=jnp.asarray(rows[:, :size]))
    wearer = wearer._replace(template=wearer.template + jnp.asarray(mean[:size]).reshape(3, -1))
    network = network._replace(mix=mix) if model.config.model.blendshape_relu else _mixed(network, mix)
    return dataclasses.replace(model, network=network, wearer=wearer)


def principal_rows(weights: np.ndarray, shapes: np.ndarray, count: int) -> tuple[Layer, np.ndarray, np.ndarray]:
    """Replace blend shapes by fewer ones, the best for the weights that occur.

    Args:
        weights: [n, K] of `ordinary_weights`.
        shapes: [K, N], N being 3 V.
        count: number of shapes to keep.

    Returns:
        The layer [K, count] that gives the weights of the rows, the rows [count, N], and an offset [N] to be added.
    """
    weights = weights.astype(np.float64)
    mean, spread = weights.mean(axis=0), np.cov(weights.T)
    root = np.linalg.cholesky(spread + UNSEEN_VARIANCE * np.trace(spread) / len(mean) * np.eye(len(mean)))
    # weights are mean + u root^T with isotropic u: the rows that serve u best are principal in root^T shapes
    unmixed = root.T @ shapes.astype(np.float64)
    chosen = np.linalg.eigh(unmixed @ unmixed.T)[1][:, -count:]
    # in orthogonal coordinates: eight bits could not hold large ones that cancel each other
    basis, upper = np.linalg.qr(np.linalg.solve(root.T, chosen))
    rows = upper @ chosen.T @ unmixed
    axes = np.linalg.eigh(rows @ rows.T)[1]
    mixing = basis @ axes
    mix = Layer(*(jnp.asarray(x, jnp.float32) for x in (mixing, -mean @ mixing)))
    return mix, (axes.T @ rows).astype(np.float32), (mean @ shapes).astype(np.float32)


def _mixed(network: Network, mix: Layer) -> Network:
    """Return the network, not folded, with a linear layer `mix` folded into the end of its decoder and its skip."""
    *others, last = network.decoder
    width, read = network.width, network.read

    def mixed_skip(rows: Array) -> Array:
        return jnp.concatenate([rows[..., :width], _product(rows[..., width:], mix.kernel)], axis=-1)

    if isinstance(read, Layer) and len(read.bias) > width:
        read = Layer(mixed_skip(read.kernel), mixed_skip(read.bias))
    last = Layer(_product(last.kernel, mix.kernel), _product(last.bias, mix.kernel) + mix.bias)
    return network._replace(decoder=(*others, last), read=read)


def _fewer_influences(model: Model, count: int) -> Model:
    weights = np.array(model.network.weights)
    ranks = np.argsort(np.argsort(-weights, axis=0, kind="stable"), axis=0)
    weights[ranks >= count] = 0.0
    weights /= weights.sum(axis=0, keepdims=True)
    return dataclasses.replace(model, network=model.network._replace(weights=jnp.asarray(weights)))


def _without_idle_joints(model: Model) -> Model:
    network, predictor = model.network, model.network.predictor
    forced = isinstance(predictor, ForcePredictor)
    moved = [network.weights]
    if forced:
        moved += [predictor.body] if predictor.felt is None else [predictor.body, predictor.felt.weights]
    busy = np.any([np.asarray(weights).any(axis=1) for weights in moved], axis=0)
    if forced:
        felt = None if predictor.felt is None else predictor.felt._replace(weights=predictor.felt.weights[busy])
        predictor = predictor._replace(body=predictor.body[busy], felt=felt)
    return dataclasses.replace(
        model,
        network=network._replace(weights=network.weights[busy], predictor=predictor),
        moving=tuple(int(joint) for joint in np.array(model.moving)[busy]),
    )
