"""Smooth blend shapes from eigenvectors of a Laplacian, and the springs that set the scale of any blend shapes."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg

from clothjax.config import Config
from clothjax.geometry import topology
from clothjax.physics import energies, kernels
from clothjax.simulation.scene import Scene

MEMBRANE = 0.25 * energies.THICKNESS  # m, of the springs that model a membrane


class Springs(NamedTuple):
    """A garment at rest as springs along its edges, which tell how much energy a displacement costs.

    The n free vertices move along x, y and z independently and alike. A displacement d [n] m along one of these costs
    1/2 d^T `matrix` d in J.
    """

    free: np.ndarray  # [n] indices of the vertices that are not pinned
    stiffness: scipy.sparse.csc_array  # [n, n] N/m, the weighted Laplacian of the springs
    mass: np.ndarray  # [n] kg
    timestep: float  # s

    @property
    def matrix(self) -> scipy.sparse.csc_array:
        """Stiffness plus inertia, [n, n] N/m: stiffness + mass / timestep^2."""
        return (self.stiffness + scipy.sparse.diags_array(self.mass / self.timestep**2)).tocsc()

    def factor(self) -> kernels.Factor:
        """Factorise `matrix`."""
        symmetric = {"SymmetricMode": True}
        both = scipy.sparse.linalg.splu(self.matrix, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
        assert (both.perm_r == both.perm_c).all()  # no rows are exchanged, as the matrix is positive definite
        lower = scipy.sparse.tril(both.L, -1).tocsc()
        return kernels.Factor(
            self.free[np.argsort(both.perm_c)].astype(np.int32),
            lower.indptr.astype(np.int32),
            lower.indices.astype(np.int32),
            lower.data.astype(np.float32),
            (1.0 / both.U.diagonal()).astype(np.float32),
        )

    def inverse(self, count: int) -> np.ndarray:
        """Return the inverse of `matrix` among all `count` vertices, [V, V] m/N, zero for those that are pinned."""
        inverse = np.zeros((count, count), np.float32)
        inverse[np.ix_(self.free, self.free)] = np.linalg.inv(self.matrix.toarray())
        return inverse


def springs(scene: Scene, config: Config) -> Springs:
    """Build the springs of a garment of the configured cloth, without bending."""
    cloth, count = config.material, len(scene.garment.vertices)
    edges = topology.edges(np.asarray(scene.garment.faces))
    free = np.flatnonzero(~np.asarray(scene.garment.pinned))
    stiffness = MEMBRANE * (2 * cloth.mu + cloth.lam)
    ends = np.concatenate([edges, edges[:, ::-1]]).T
    joined = scipy.sparse.coo_array((np.full(2 * len(edges), stiffness), ends), shape=(count, count))
    laplacian = (scipy.sparse.diags_array(joined.sum(axis=1)) - joined).tocsc()[free][:, free]
    with jax.ensure_compile_time_eval():
        areas = np.asarray(energies.vertex_areas(jnp.asarray(scene.garment.vertices), scene.garment.faces), np.float64)
    return Springs(free, laplacian, cloth.density * areas[free], 1.0 / config.fps)


def laplacian(scene: Scene, config: Config) -> np.ndarray:
    """Compute smooth blend shapes [K, V, 3] m: eigenvectors of the springs' Laplacian, each along x, y and z.

    Mode i is divided by sqrt(w_i + 1 / dt^2), so that a unit weight costs about the same energy in every mode. Pinned
    vertices do not move.
    """
    count = config.model.blendshapes
    free, stiffness, mass, timestep = springs(scene, config)
    modes = min(-(-count // 3), len(free))
    if modes < len(free) // 2:
        values, vectors = scipy.sparse.linalg.eigsh(
            stiffness,
            modes,
            scipy.sparse.diags_array(mass).tocsc(),
            sigma=-1 / timestep**2,
            v0=np.random.default_rng(0).standard_normal(len(free)),
        )
    else:
        values, vectors = scipy.linalg.eigh(stiffness.toarray(), np.diag(mass), subset_by_index=[0, modes - 1])
    scaled = vectors / np.sqrt(np.maximum(values, 0) + 1 / timestep**2)
    basis = np.zeros((modes, 3, len(scene.garment.vertices), 3))
    for axis in range(3):
        basis[:, axis, free, axis] = scaled.T
    return pad_basis(basis.reshape(-1, *basis.shape[2:])[:count], count)


def pad_basis(basis: np.ndarray, count: int) -> np.ndarray:
    """Add shapes of zeros to blend shapes [K, V, 3] m until there are `count`."""
    missing = np.zeros((count - len(basis), *basis.shape[1:]))
    return np.concatenate([basis, missing]).astype(np.float32)
