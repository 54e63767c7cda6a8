"""One simulated frame of Phi, and rollouts: a scan of frames with the losses accumulated inside."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax import character as characters
from clothjax import clips as motion
from clothjax import compact_latent, contact, garment_model, latent_predictor, losses, peers
from clothjax.character import Character, Window
from clothjax.clips import Clips
from clothjax.config import Config
from clothjax.experiment import material as configured_material
from clothjax.features import Features
from clothjax.losses import TimeStep
from clothjax.scene import Scene
from clothjax.types import Array, ClothState, Pose


class Taken(NamedTuple):
    """A step that was taken, and what its potential was made of."""

    new: Array  # [V, 3] m, relative to the root at the current frame
    step: TimeStep
    seen: Features | None  # what Phi saw


Animator = Callable[
    [ClothState, Pose, Window, TimeStep, Callable[[Array], Array]], tuple[Array, Array, Features | None]
]
"""From a state, three poses, the character's three frames, a time step and its potential: the next positions [V, 3] m,
their code [L], and what was seen."""
MakeAnimator = Callable[[dict, Scene, Character, Config], Animator]
"""An animator of `params` and `statistics`."""


def memory_size(scene: Scene, config: Config) -> int:
    """Numbers L that an animator carries from frame to frame: the code, or a peer's memory."""
    if config.peer.network:
        return peers.memory_size(config)
    left, channels = compact_latent.latent_size(scene, config.model)
    return left * channels


def start(character: Character, window: Window, memory_size: int) -> ClothState:
    """A garment as skinned at the current frame, moving with the body."""
    now = characters.skinned(character, window.current)
    return ClothState(
        position=now,
        velocity=now - characters.skinned(character, window.previous),
        acceleration=jnp.zeros_like(now),
        latent=jnp.zeros(memory_size, now.dtype),
        change=jnp.zeros(memory_size, now.dtype),
    )


def time_step(
    scene: Scene, character: Character, state: ClothState, window: Window, timestep: Array, config: Config
) -> TimeStep:
    """The incremental potential's constants for the step from `window.current` to `window.following`."""
    physics = config.physics
    body, body_next = window.current.body, window.following.body
    ahead = state.position + state.velocity
    planes = near = at_edges = on_self = None
    if scene.touchable and physics.contact_surface == "triangles":
        planes = contact.find(state.position, body, body_next, scene.patches, ahead)
    elif scene.touchable:
        planes = contact.find_at_centroids(state.position, body, body_next, scene.body.faces)
    if planes is not None and "friction" not in physics.without:
        near = losses.touching(state.position, planes, physics.friction_radius)
    if planes is not None and physics.edge_contact:
        at_edges = contact.find_at_edges(state.position, planes, scene.mesh, body, body_next, scene.patches, ahead)
    if physics.self_contact:
        on_self = contact.find_on_self(state.position, scene.garment_patches)
    return TimeStep(
        position=state.position,
        velocity=state.velocity,
        mass=character.mass,
        rest=character.rest,
        material=character.material,
        contact=planes,
        touching=near,
        timestep=jnp.asarray(timestep, state.position.dtype),
        edge_contact=at_edges,
        self_contact=on_self,
    )


def phi(model: dict, scene: Scene, character: Character, config: Config) -> Animator:
    """Phi, of `params` and `statistics`, as what moves a character's garment."""

    def animate(state: ClothState, _poses: Pose, window: Window, step: TimeStep, potential: Callable):
        return compact_latent.step(
            model["params"], model["statistics"], scene, character, state, window, step.contact,
            step.timestep, potential, config.model, config.material,
        )  # fmt: skip

    return animate


def peer(kept: np.ndarray) -> MakeAnimator:
    """The network of a peer, of `params`, as what moves a character's garment: on the joints `kept`."""

    def make(model: dict, scene: Scene, character: Character, config: Config) -> Animator:
        constants = latent_predictor.constant_inputs(character.betas, character.material, config.material)
        free = jnp.where(jnp.asarray(scene.garment.pinned), 0.0, 1.0)

        def animate(state: ClothState, poses: Pose, window: Window, _step: TimeStep, _potential: Callable):
            displaced, memory = peers.displacement(
                model["params"], state.latent, poses, character.joints, constants, scene.body.parents, kept, config
            )
            moved = character.template, window.following.garment
            return garment_model.vertices(displaced * free[:, None], *moved), memory, None

        return animate

    return make


def rest_energy(scene: Scene, config: Config) -> Callable[[Array], Array]:
    """The potential of displacements [V, 3] m of the configured cloth, in the canonical pose and touching nothing."""
    character = characters.dress(
        scene, jnp.zeros(scene.body.shapedirs.shape[-1]), configured_material(config), config.physics
    )
    rest = character.template
    step = TimeStep(
        position=rest,
        velocity=jnp.zeros_like(rest),
        mass=character.mass,
        rest=character.rest,
        material=character.material,
        contact=None,
        touching=None,
        timestep=jnp.float32(1.0 / config.fps),
    )
    return lambda displacement: losses.potential(rest + displacement, step, scene.mesh, config.physics)


def take(
    animate: Animator,
    scene: Scene,
    character: Character,
    state: ClothState,
    poses: Pose,
    timestep: Array,
    config: Config,
) -> tuple[ClothState, Taken]:
    """One frame; the state returned is still relative to the current root."""
    window = characters.window(scene, character, poses)
    step = time_step(scene, character, state, window, timestep, config)

    def potential(new):
        return losses.potential(new, step, scene.mesh, config.physics)

    new, latent, seen = animate(state, poses, window, step, potential)
    velocity = new - state.position
    taken = ClothState(new, velocity, velocity - state.velocity, latent, latent - state.latent)
    return taken, Taken(new, step, seen)


def follow(state: ClothState, advance: Array) -> ClothState:
    """The same state relative to the root of the next frame, which is `advance` [3] m further on."""
    return state._replace(position=state.position - advance[None])


def settle(animate: Animator, scene: Scene, character: Character, poses: Pose, config: Config) -> ClothState:
    """The state a motion starts from: skinned, then (HOOD) one long quasi-static step on the standing body."""
    state = start(character, characters.window(scene, character, poses), memory_size(scene, config))
    if config.stage1.start_timestep == 0:
        return state
    resting = state._replace(velocity=jnp.zeros_like(state.velocity))
    settled, _ = take(animate, scene, character, resting, motion.standing(poses), config.stage1.start_timestep, config)
    return settled._replace(velocity=state.velocity, acceleration=state.acceleration, change=state.change)


def training_rollout(
    animate: Animator,
    scene: Scene,
    character: Character,
    state: ClothState,
    clips: Clips,
    frame: Array,
    fresh: Array,
    training_step: Array,
    frames: int,
    config: Config,
) -> tuple[Array, tuple[ClothState, dict, Features]]:
    """Mean loss over `frames` frames from a state, with the last state, mean energies in J, and all features.

    A `fresh` state takes the quasi-static step first: the body stands, the step is long, and what it started with as
    velocity is given back after it. Gradients reach back over `config.stage1.gradient_frames` frames; those of
    a peer's memory over all.
    """

    def body(carry, index):
        state, frame, fresh = carry
        cut = index % config.stage1.gradient_frames == 0
        through = state.latent
        state = jax.tree.map(lambda x: jnp.where(cut, jax.lax.stop_gradient(x), x), state)
        if config.peer.network:
            state = state._replace(latent=through)
        poses = motion.poses(clips, frame)
        still = motion.standing(poses)
        chosen = jax.tree.map(lambda a, b: jnp.where(fresh, a, b), still, poses)
        velocity = jnp.where(fresh, 0.0, state.velocity)
        timestep = jnp.where(fresh, config.stage1.start_timestep, 1.0 / config.fps)
        taken, (new, step, seen) = take(
            animate, scene, character, state._replace(velocity=velocity), chosen, timestep, config
        )
        terms = losses.present(losses.energies(new, step, scene.mesh, config.physics), config.loss)
        loss = losses.weighted(terms, config.loss, training_step)
        taken = taken._replace(
            velocity=jnp.where(fresh, state.velocity, taken.velocity),
            acceleration=jnp.where(fresh, 0.0, taken.acceleration),
            change=jnp.where(fresh, 0.0, taken.change),
        )
        taken = follow(taken, chosen.translation[2])
        frame = jnp.where(fresh, frame, frame + 1)
        return (taken, frame, jnp.zeros_like(fresh)), (loss, terms, seen)

    (state, frame, fresh), (loss, terms, seen) = jax.lax.scan(body, (state, frame, fresh), jnp.arange(frames))
    terms = {name: jnp.mean(value) for name, value in terms.items()}
    return jnp.mean(loss), (jax.lax.stop_gradient(state), terms, jax.lax.stop_gradient(seen))


def play(model: dict, scene: Scene, character: Character, poses: Pose, config: Config, animator: MakeAnimator = phi):
    """Phi, or another animator, in closed loop over a motion.

    Args:
        model: `params` and `statistics`.
        poses: windows [T, 3, ...] of `clips.poses`.

    Returns:
        (new [T, V, 3] m relative to each window's current root, states before each step [T], latents [T, L]).
    """
    first = jax.tree.map(lambda x: x[0], poses)
    animate = animator(model, scene, character, config)
    state = settle(animate, scene, character, first, config)

    def body(state, poses):
        taken, (new, _, _) = take(animate, scene, character, state, poses, 1.0 / config.fps, config)
        return follow(taken, poses.translation[2]), (new, state, taken.latent)

    return jax.lax.scan(body, state, poses)[1]
