"""Psi made smaller and faster for one use (METHOD.md, Psi): exactly, or at the price of an error to be measured.

All of these take a model of `inference` and give another, which runs through the same functions.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.body import skinning
from clothjax.files import storage
from clothjax.geometry import proximity
from clothjax.runtime.inference import NO_KERNEL, Bounds, Layer, Model, Network, blend_weights, initial_state, step
from clothjax.types import Array, Garment, Motion, Pose

FOLD_RATIO = 0.75  # of the weights of the layers around the code, that folding it away must leave at the most
CALIBRATION_CLIPS = ("walk_0", "run_0", "jump_0", "twist_0", "dance_0", "arms_0")  # that tell which displacements occur
UNSEEN_VARIANCE = 1e-3  # of the mean variance of blend-shape weights: that of those that do not vary there
CALIBRATION_CODES = 2048  # codes that do, where these do not fit


def specialise(model: Model, *, blendshapes: int | None = None, max_influences: int | None = None) -> Model:
    """The model with nothing in it that its use does not need.

    Exact are: the code is carried as what the two layers that read it make of it, where that takes much fewer weights;
    joints that move no vertex are not asked. (A code outside the range of training is then held only to what that
    range becomes, and `State.ok` may not tell it.) The arguments are lossy.

    Args:
        blendshapes: so many, fitted to those there are.
        max_influences: joints that move a vertex, at the most.

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
    return without_code(_without_idle_joints(model))


def without_code(model: Model) -> Model:
    """The model with the code folded into the layers before and behind it, if these then have much fewer weights.

    The code is given by a linear layer and read by two: the predictor's first in the next frame, and the decoder's.
    """
    network = model.network
    if network.folded:
        return model
    readers = jnp.concatenate([network.code.kernel, network.read.kernel], axis=1)
    *hidden, last = network.hidden
    folded = Layer(_product(last.kernel, readers), _product(last.bias, readers))
    if folded.kernel.size > FOLD_RATIO * (last.kernel.size + readers.size):
        return model
    low, high, slack = network.code_bounds
    middle, radius = _product(0.5 * (low + high), readers), _product(0.5 * (high - low), jnp.abs(readers))
    network = network._replace(
        code=Layer(NO_KERNEL, network.code.bias),
        hidden=(*hidden, folded),
        code_bounds=Bounds(middle - radius, middle + radius, _product(slack, jnp.abs(readers))),
        first=_product(network.first, readers),
        read=Layer(NO_KERNEL, network.read.bias),
    )
    return dataclasses.replace(model, network=network)


def smoothed(model: Model) -> Model:
    """Return the same model with code and blend shapes scaled by `smoothing_scale`, for runtimes that quantise all
    inputs of a layer alike."""
    network = model.network
    largest = np.abs(ordinary_weights(model)).max(axis=0)
    of_shapes = smoothing_scale(largest, network.shapes)
    *decoder, last = network.decoder
    wide, mix, read = network.decoder_width, network.mix, network.read
    if mix is not None:
        mix = Layer(mix.kernel / of_shapes[None], mix.bias / of_shapes)
    else:
        last = Layer(last.kernel / of_shapes[None], last.bias / of_shapes)
        beside = np.concatenate([np.ones(wide), of_shapes])[: len(read.bias)]
        read = Layer(read.kernel if network.folded else read.kernel / beside[None], read.bias / beside)
    if network.folded:  # the code is what the readers make of it: here of `read`, at its end
        scale = np.ones(len(network.first), np.float32)
        if mix is None:
            scale[-len(read.bias) :] = beside
    else:
        limits = np.maximum(-np.asarray(network.code_bounds.low), np.asarray(network.code_bounds.high))
        scale = smoothing_scale(limits, jnp.concatenate([network.code.kernel, read.kernel], axis=1))
        read = read._replace(kernel=read.kernel * scale[:, None])
        network = network._replace(code=network.code._replace(kernel=network.code.kernel * scale[:, None]))
    *hidden, final = network.hidden
    network = network._replace(
        hidden=(*hidden, Layer(final.kernel / scale[None], final.bias / scale)),
        code_bounds=Bounds(*(row / scale for row in network.code_bounds)),
        first=network.first / scale,
        read=read,
        decoder=(*decoder, last),
        mix=mix,
        shapes=network.shapes * of_shapes[:, None],
    )
    return dataclasses.replace(model, network=network)


def smoothing_scale(limits: Array, kernel: Array) -> np.ndarray:
    """Return the scale [n] that balances inputs against weights before int8 (SmoothQuant, Xiao et al. 2023).

    Inputs that reach to `limits` [n] are divided by it, and the rows of their kernel [n, m] multiplied: eight bits are
    shared by all of a row, so neither may be small beside the others.
    """
    weights = np.abs(np.asarray(kernel)).max(axis=1)
    return np.sqrt(np.maximum(limits, 1e-6) / np.maximum(weights, 1e-6)).astype(np.float32)


def part(model: Model, vertices: Array) -> Model:
    """The model of some vertices [n] of its garment, as those that are not hidden; of its faces those they make up."""
    vertices = np.unique(np.asarray(vertices))
    number = np.full(model.wearer.template.shape[-1], -1)
    number[vertices] = np.arange(len(vertices))
    faces = number[np.asarray(model.faces)]
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


def on_mesh(model: Model, garment: Garment, betas: Array) -> Model:
    """The model on another mesh of the same garment, finer or coarser: a level of detail.

    A vertex of it is displaced as the place of the model's own mesh that it is nearest to.

    Args:
        model: as it was loaded; what comes of it can be specialised.
        betas: [S] of the model's wearer.

    Raises:
        ValueError: for a model that was specialised: the mesh may need what that has left out.
    """
    if len(model.moving) < len(model.names) or len(model.network.shapes) != model.config.model.blendshapes:
        raise ValueError("this model is specialised already: put it on the other mesh first")
    template = np.asarray(skinning.shaped_vertices(garment, jnp.asarray(betas, jnp.float32)))
    own, faces = np.asarray(model.wearer.template).T, np.asarray(model.faces)
    groups = proximity.patches(own, faces).groups
    face = np.asarray(jax.jit(proximity.nearest_face)(template, own[faces], groups))
    weights = np.asarray(proximity.closest_on_triangle(template, own[faces[face]])[0])
    corners = np.asarray(_rows(model.network))[:, :, faces[face]]
    shapes = np.einsum("kcvi,vi->kcv", corners, weights)
    shapes[:, :, np.asarray(garment.pinned)] = 0.0
    network = model.network._replace(
        shapes=jnp.asarray(shapes.reshape(len(shapes), -1)),
        weights=jnp.asarray(garment.weights).T[np.array(model.moving)],
    )
    return dataclasses.replace(
        model,
        network=network,
        wearer=model.wearer._replace(template=jnp.asarray(template.T)),
        faces=jnp.asarray(garment.faces),
    )


def ordinary_weights(model: Model) -> np.ndarray:
    """Blend-shape weights [n, K] of rollouts over embedded clips; of random codes, for a body they do not fit."""
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
    """Return the codes [T, C] of a rollout."""
    poses = Pose(jnp.asarray(motion.rotations, jnp.float32), jnp.asarray(motion.translation, jnp.float32))

    def frame(state, pose):
        state, _ = step(model, state, pose, vertices=False)
        return state, state.latent

    return jax.lax.scan(frame, initial_state(model, jax.tree.map(lambda x: x[0], poses)), poses)[1]


def _product(a: Array, b: Array) -> Array:
    return jnp.asarray(np.asarray(a, np.float64) @ np.asarray(b, np.float64), jnp.float32)


def _rows(network: Network) -> Array:
    return network.shapes.reshape(len(network.shapes), 3, -1)


def _fewer_shapes(model: Model, count: int) -> Model:
    """Principal components of ordinary displacements in the place of the blend shapes; their mean goes into the
    template."""
    mix, shapes, moved = principal_rows(ordinary_weights(model), np.asarray(model.network.shapes), count)
    network = model.network._replace(shapes=jnp.asarray(shapes))
    template = model.wearer.template + jnp.asarray(moved).reshape(3, -1)
    network = network._replace(mix=mix) if model.config.model.blendshape_relu else _mixed(network, mix)
    return dataclasses.replace(model, network=network, wearer=model.wearer._replace(template=template))


def principal_rows(weights: np.ndarray, shapes: np.ndarray, count: int) -> tuple[Layer, np.ndarray, np.ndarray]:
    """Fewer rows in the place of blend shapes [K, N], the best for weights [n, K] that occur: the layer that gives
    their weights, themselves [count, N], and what is to be added [N]."""
    weights = weights.astype(np.float64)
    mean, spread = weights.mean(axis=0), np.cov(weights.T)
    root = np.linalg.cholesky(spread + UNSEEN_VARIANCE * np.trace(spread) / len(mean) * np.eye(len(mean)))
    # weights are mean + u root^T with isotropic u: the rows that serve u best are principal in root^T shapes
    unmixed = root.T @ shapes.astype(np.float64)
    chosen = np.linalg.eigh(unmixed @ unmixed.T)[1][:, -count:]
    # in coordinates that are not large and cancelled by others: eight bits could not hold these
    turned, upper = np.linalg.qr(np.linalg.solve(root.T, chosen))
    rows = upper @ chosen.T @ unmixed
    axes = np.linalg.eigh(rows @ rows.T)[1]
    mixing = turned @ axes
    mix = Layer(*(jnp.asarray(x, jnp.float32) for x in (mixing, -mean @ mixing)))
    return mix, (axes.T @ rows).astype(np.float32), (mean @ shapes).astype(np.float32)


def _mixed(network: Network, mix: Layer) -> Network:
    """The decoder with a linear layer behind it folded in."""
    *others, last = network.decoder
    wide = network.decoder_width

    def beside(rows: Array) -> Array:
        return jnp.concatenate([rows[..., :wide], _product(rows[..., wide:], mix.kernel)], axis=-1)

    return network._replace(
        decoder=(*others, Layer(_product(last.kernel, mix.kernel), _product(last.bias, mix.kernel) + mix.bias)),
        read=network.read if network.read.kernel.shape[1] == wide else Layer(*(beside(x) for x in network.read)),
    )


def _fewer_influences(model: Model, count: int) -> Model:
    weights = np.array(model.network.weights)
    ranks = np.argsort(np.argsort(-weights, axis=0, kind="stable"), axis=0)
    weights[ranks >= count] = 0.0
    weights /= weights.sum(axis=0, keepdims=True)
    return dataclasses.replace(model, network=model.network._replace(weights=jnp.asarray(weights)))


def _without_idle_joints(model: Model) -> Model:
    weights = np.asarray(model.network.weights)
    busy = weights.any(axis=1)
    return dataclasses.replace(
        model,
        network=model.network._replace(weights=jnp.asarray(weights[busy])),
        moving=tuple(int(joint) for joint in np.array(model.moving)[busy]),
    )
