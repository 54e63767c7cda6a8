"""Start of a time step: a garment as skinned, and the constants of the incremental potential."""

from collections.abc import Callable

import jax.numpy as jnp

from clothjax.config import Config
from clothjax.material import configured_material
from clothjax.physics import contact_search, incremental_potential
from clothjax.physics.incremental_potential import TimeStep
from clothjax.simulation import characters
from clothjax.simulation.characters import Character, Window
from clothjax.simulation.scene import Scene
from clothjax.types import Array, ClothState, Scalar


def start(character: Character, window: Window, memory_size: int) -> ClothState:
    """Return the state of a garment as skinned at the current frame, with the velocity of skinning.

    Args:
        memory_size: L, numbers of the code or memory, which starts as zeros.
    """
    now = characters.skinned(character, window.current)
    return ClothState(
        position=now,
        velocity=now - characters.skinned(character, window.previous),
        acceleration=jnp.zeros_like(now),
        latent=jnp.zeros(memory_size, now.dtype),
        change=jnp.zeros(memory_size, now.dtype),
    )


def time_step(
    scene: Scene,
    character: Character,
    state: ClothState,
    window: Window,
    timestep: Scalar,
    config: Config,
    external: Array | None = None,
) -> TimeStep:
    """Return the constants of the potential of a time step from `window.current` to `window.following`.

    Args:
        state: of the garment at the current frame.
        timestep: s, the duration.
        external: [3] m/s^2, an acceleration of the cloth beside gravity, such as wind or a frame that falls.
    """
    physics = config.physics
    body, body_next = window.current.body, window.following.body
    ahead = state.position + state.velocity
    planes = near = at_edges = on_self = None
    if scene.patches is not None:
        if physics.contact_surface == "triangles":
            planes = contact_search.find(state.position, body, body_next, scene.patches, ahead)
        else:
            planes = contact_search.find_at_centroids(state.position, body, body_next, scene.body.faces)
        if "friction" not in physics.without:
            near = incremental_potential.touching(state.position, planes)
        if physics.edge_contact:
            at_edges = contact_search.find_at_edges(
                state.position, planes, scene.mesh, body, body_next, scene.patches, ahead
            )
    if physics.self_contact:
        on_self = contact_search.find_on_self(state.position, scene.garment_patches)
    return TimeStep(
        position=state.position,
        velocity=incremental_potential.pushed(state.velocity, timestep, external),
        mass=character.mass,
        rest=character.rest,
        material=character.material,
        contact=planes,
        touching=near,
        timestep=jnp.asarray(timestep, state.position.dtype),
        edge_contact=at_edges,
        self_contact=on_self,
    )


def rest_energy(scene: Scene, config: Config) -> Callable[[Array], Array]:
    """Return the potential at rest: a function from displacements [V, 3] m to J.

    It is that of the configured cloth on the mean body, in the canonical pose, standing still and without contact.
    """
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
    return lambda displacement: incremental_potential.potential(rest + displacement, step, scene.mesh, config.physics)
