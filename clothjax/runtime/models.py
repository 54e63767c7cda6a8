"""The model that `inference` runs, Psi on one character, and the state that it carries.

A model belongs to one character: betas and material decide `Model.wearer`, and a crowd shares everything else.
`clothjax.runtime.specialise.specialise` makes it smaller and faster; it then runs through the same functions.
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from clothjax.config import Config
from clothjax.geometry.clusters import Clusters
from clothjax.networks.normalisation import ForceScales
from clothjax.types import Array, Material, Mesh, Rest

CAUSES = ("not finite", "pose", "wearer", "code")
"""Causes of a frame outside of the range of training: no pose, inputs of the pose, the character, the code."""


class Layer(NamedTuple):
    """A dense layer."""

    kernel: Array  # [inputs, outputs]
    bias: Array  # [outputs]


class FoldedLayer(NamedTuple):
    """The rest of a layer that reads the code in a specialised model: the bias alone.

    The state of such a model carries the code's products with the kernels of these layers in place of the code
    (`specialise.without_code`).
    """

    bias: Array  # [outputs]


class Bounds(NamedTuple):
    """The range of inputs or codes in training; values are clipped to it."""

    low: Array
    high: Array
    slack: Array  # how far out still counts as inside


class PosePredictor(NamedTuple):
    """The latent predictor of a Psi that reads the pose."""

    pose: Array  # [P, H] kernel of the first layer
    pose_mean: Array  # [P] mean of the inputs, subtracted first
    pose_bounds: Bounds  # [P] of the centred inputs
    code: Layer | FoldedLayer  # [C, H] of the same layer, without the character's part of the bias
    hidden: tuple[Layer, ...]  # the last of which gives [C]


class Shown(NamedTuple):
    """A garment as the decoder moves it: blend shapes and skinning weights."""

    shapes: Array  # [K, 3 V] m, the x of all vertices first; zero where they are pinned
    weights: Array  # [J', V] skinning weights of the joints `Model.moving`


class Felt(NamedTuple):
    """The garment that feels the forces, where it is not the one that is shown."""

    shapes: Array  # [K, 3 V] m, as of `Shown`
    weights: Array  # [J', V]
    around: Array  # [V', 3] int32, the corners of its face that is nearest to each vertex that is shown, and ...
    shares: Array  # [V', 3] ... how much of their relaxation this one takes; the first share is the largest
    mesh: Mesh | None = None  # on which the garment that is shown is relaxed by itself; None: it takes that share
    # [V', 3 or 6] int32, then: corners of that face and, counted after all vertices, its edges; it touches their planes
    beside: Array | None = None

    @property
    def nearest(self) -> Array:
        """Return the vertex [V'] at each one that is shown."""
        return self.around[:, 0]


class ForcePredictor(NamedTuple):
    """The latent predictor of a Psi with forces, and the geometry on which it feels them."""

    params: dict  # of `psi.of_character`
    scales: ForceScales
    mesh: Mesh  # of the garment's elements
    faces: Array  # [F, 3] int32 of the part of the body that can be touched
    clusters: Clusters  # of the vertices that feel, with the edges that touch, and of the centroids of these faces
    body: Array  # [J', B] skinning weights of that part
    corrections: Array | None  # [B, 3, 9 (J - 1)] m, its pose blend shapes
    felt: Felt | None  # the garment that feels, if it is not the one that is shown


class Network(NamedTuple):
    """The arrays of Psi that all characters share: latent predictor, decoder, blend shapes, skinning weights.

    P counts pose inputs, H the predictor's first hidden layer, D the decoder's first layer. C counts what the state
    carries: the code, C = L, or its products with the layers that read it, if the model is specialised.
    """

    predictor: PosePredictor | ForcePredictor
    code_bounds: Bounds  # [C]
    first: Array  # [C] the code before the first frame
    read: Layer | FoldedLayer  # [C, D] the decoder's first layer; with a skip [C, D + K], the last K being the skip
    decoder: tuple[Layer, ...]  # the decoder's other layers, to [K]
    mix: Layer | None  # [K, K'] from the decoder's weights to those of fewer shapes
    shapes: Array  # [K, 3 V] m, or [K', 3 V], the x of all vertices first; zero where they are pinned
    weights: Array  # [J', V] skinning weights of the joints `Model.moving`

    @property
    def folded(self) -> bool:
        """True if `specialise` has folded the code into the layers around it."""
        return isinstance(self.read, FoldedLayer)

    @property
    def readers(self) -> tuple[Layer, Layer] | None:
        """The two layers that alone read the code: of a pose predictor and of the decoder; None if it is otherwise."""
        code = self.predictor.code if isinstance(self.predictor, PosePredictor) else None
        return (code, self.read) if isinstance(code, Layer) and isinstance(self.read, Layer) else None

    @property
    def width(self) -> int:
        """Outputs [D] of the decoder's first layer; further outputs of `read` are the skip."""
        return len(self.decoder[0].kernel)


class ShownCloth(NamedTuple):
    """The cloth of a garment that does not feel, and is relaxed on `Felt.mesh`."""

    rest: Rest
    mobility: Array  # [V'] m/N, of `relaxation.mobility`


class Cloth(NamedTuple):
    """The cloth of a character with a Psi with forces, and the body that it can touch."""

    constants: Array  # [C] of `psi.constant_inputs`
    mass: Array  # [V] kg
    rest: Rest
    material: Material
    body: Array  # [B, 3] m in the canonical pose
    mobility: Array | None  # [V] m/N, of `relaxation.mobility`; None without relaxation
    template: Array | None  # [3, V] m, of the garment that feels, if it is not the one that is shown
    shown: ShownCloth | None = None  # None where `Felt.mesh` is


class Wearer(NamedTuple):
    """The arrays of a model that depend on its character: on betas and material."""

    bias: Array  # [H] added to the predictor's first layer; [0] with forces
    template: Array  # [3, V] m, the shaped garment in the canonical pose
    joints: Array  # [J, 3] m of the shaped body
    known: Array  # bool, True if the character is within the range of training
    cloth: Cloth | None = None  # with forces


@partial(
    jax.tree_util.register_dataclass,
    data_fields=("network", "wearer", "faces"),
    meta_fields=("names", "parents", "input_joints", "moving", "config"),
)
@dataclasses.dataclass(frozen=True)
class Model:
    """A trained Psi on one character, ready to run: a pytree whose other fields are static."""

    network: Network
    wearer: Wearer  # of a crowd, with a leading axis [N]
    faces: Array  # [F, 3] int32
    names: tuple[str, ...]  # of the joints
    parents: tuple[int, ...]
    input_joints: tuple[int, ...]  # joints whose pose is an input
    moving: tuple[int, ...]  # joints that move the garment
    config: Config


def in_float32(model: Model) -> Model:
    """Return a model whose numbers are float32, also in a process with `jax_enable_x64`."""
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32) if x.dtype == "float64" else x, model)


class Drape(NamedTuple):
    """How the garment hangs and moves, which a Psi with forces feels. Positions are relative to the root's translation.

    V are the vertices of the garment that feels.
    """

    change: Array  # [L] of the code in the last frame
    garment: Array  # [3, V] m, carried back to the canonical pose
    position: Array  # [V, 3] m
    velocity: Array  # [V, 3] m per frame
    still: Array  # frames for which the body has stood still and nothing else has pushed, as a float


class State(NamedTuple):
    """The state that a model carries from frame to frame."""

    latent: Array  # [C] the code, in standard deviations; of a folded model its products with the layers that read it
    rotations: Array  # [2, J, 3, 3] local, of the last two poses, newest first
    positions: Array  # [2, J, 3] m of their joints, from the root's canonical place
    translation: Array  # [2, 3] m
    outside: Array  # [4] bool, which of `CAUSES` brought the last frame out of the range of training
    drape: Drape | None = None  # with forces, whose code is not in standard deviations

    @property
    def ok(self) -> Array:
        """Return whether the last frame was within the range of training, a bool."""
        return ~jnp.any(self.outside, axis=-1)
