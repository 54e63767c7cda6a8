"""The kernels in C++ compute what jax does."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from samples import icosphere, sheet, soup, time_step

from clothjax.config import ModelConfig, PhysicsConfig
from clothjax.geometry import proximity
from clothjax.networks import decoder, mlp
from clothjax.physics import compilers, contact_search, energies, incremental_potential, kernels, relaxation

needs_compilers = pytest.mark.skipif(
    None in map(compilers.compiler, compilers.PROGRAMS), reason="needs a C and a C++ compiler"
)
CONFIG = PhysicsConfig()
TERMS = ("stretching", "bending", "edge_collision")
OTHERS = ("gravity", "inertia", "collision", "friction")


def single(tree):
    return jax.tree.map(
        lambda leaf: np.asarray(leaf, np.float32) if np.asarray(leaf).dtype == np.float64 else leaf, tree
    )


@pytest.fixture(scope="module")
def crumpled():
    """A time step of a sheet of 400 vertices, half in the ground, bent at rest, and where its vertices go next."""
    vertices, mesh = sheet(20)
    random = np.random.default_rng(0)
    bent = vertices + 0.01 * random.normal(size=vertices.shape)
    step = time_step(bent, mesh, vertices, ground=0.0, edges=True)
    with jax.enable_x64(True):
        step = step._replace(rest=jax.device_get(energies.rest_measures(bent, mesh, flat=False)))
    assert np.abs(step.rest.hinge_angle).max() > 0.5
    x = vertices + 0.004 * random.normal(size=vertices.shape)
    x[5] = x[4]  # faces without area
    x[30:33] = x[30]  # in one point
    return x, mesh, step


def potential(mesh, config=CONFIG):
    return lambda x, step: incremental_potential.potential(x, step, mesh, config)


@needs_compilers
@pytest.mark.parametrize("term", [*TERMS, "all"])
def test_energies_and_their_gradients_are_those_of_jax(crumpled, term):
    x, mesh, step = crumpled
    config = CONFIG if term == "all" else PhysicsConfig(without=[each for each in (*TERMS, *OTHERS) if each != term])
    with jax.enable_x64(True):
        energy, gradient = jax.device_get(jax.value_and_grad(potential(mesh, config))(x, step))
    assert energy > 0 and np.abs(gradient).max() > 0
    x, step = single((x, step))
    of_kernels = jax.jit(kernels.in_kernels(jax.value_and_grad(potential(mesh, config))))
    assert "ffi_call" in str(jax.make_jaxpr(of_kernels)(x, step))
    of_a_mesh = jax.jit(kernels.in_kernels(lambda x, step, mesh: jax.value_and_grad(potential(mesh, config))(x, step)))
    assert "ffi_call" in str(jax.make_jaxpr(of_a_mesh)(x, step, mesh))
    for found, push in (of_kernels(x, step), of_a_mesh(x, step, mesh)):  # which is known or traced
        np.testing.assert_allclose(found, energy, rtol=2e-6)
        np.testing.assert_allclose(push, gradient, rtol=0, atol=1e-5 * np.abs(gradient).max())


@needs_compilers
def test_an_energy_that_a_scene_does_not_have_is_in_no_kernel(crumpled):
    x, mesh, step = single(crumpled)
    config = dataclasses.replace(CONFIG, without=("bending",))
    of_kernels = kernels.in_kernels(potential(mesh, config))
    np.testing.assert_allclose(of_kernels(x, step), potential(mesh, config)(x, step), rtol=1e-5)
    assert "ClothBending" in str(jax.make_jaxpr(kernels.in_kernels(potential(mesh)))(x, step))
    assert "ClothBending" not in str(jax.make_jaxpr(of_kernels)(x, step))


@needs_compilers
@pytest.mark.parametrize("momentum", [0.0, 0.6])
def test_relaxation_and_its_derivative_are_those_of_jax(crumpled, momentum):
    x, mesh, step = crumpled
    free = np.arange(len(x)) % 7 > 0
    cotangent = np.random.default_rng(1).normal(size=x.shape)

    def relaxed(x, step, cotangent):
        mobility = relaxation.mobility(step.rest, step.material, mesh, jnp.asarray(free, x.dtype))
        steps = 4, momentum
        new, pull = jax.vjp(lambda x: relaxation.relaxed(x, mobility, step.rest, step.material, mesh, *steps), x)
        return new, pull(cotangent)[0]

    with jax.enable_x64(True):
        new, back = jax.device_get(relaxed(jnp.asarray(x), jax.tree.map(jnp.asarray, step), cotangent))
    assert np.abs(new - x)[free].max() > 1e-3 and np.abs(back - cotangent)[free].max() > 0.1
    found, pulled = jax.jit(kernels.in_kernels(relaxed))(*single((x, step, cotangent)))
    np.testing.assert_allclose(found, new, atol=1e-6)
    np.testing.assert_allclose(pulled, back, rtol=0, atol=2e-5 * np.abs(back).max())
    np.testing.assert_array_equal(found[~free], single(x)[~free])


def of_relaxed(mesh):
    """The potential of a garment that is relaxed, its measures at rest, cloth and planes scaled; and its gradient."""

    def both(x, scale, step):
        rest, cloth, planes = jax.tree.map(lambda leaf: scale * leaf, (step.rest, step.material, step.edge_contact))
        own = step._replace(rest=rest, material=cloth, edge_contact=planes)
        mobility = relaxation.mobility(rest, cloth, mesh, jnp.ones(len(x)))

        def energy(x):
            return potential(mesh)(relaxation.relaxed(x, mobility, rest, cloth, mesh, 2, 0.3), own)

        return jax.value_and_grad(energy)(x)

    return kernels.in_kernels(both)


@needs_compilers
@pytest.mark.parametrize("axes, count", [((0, 0), 3), ((0, None), 8), ((None, 0), 5), ((0, 0), 9)])
def test_garments_of_a_batch_are_as_each_alone(crumpled, axes, count):
    """Positions, and all that energies read, of their own or shared; as many as are computed at once, fewer or more."""
    x, mesh, step = single(crumpled)
    step = jax.tree.map(jnp.asarray, step)
    noise = np.random.default_rng(2).normal(size=(count, *x.shape), scale=1e-3).astype(np.float32)
    arguments = [
        each if axis == 0 else each[0]
        for each, axis in zip((jnp.asarray(x[None] + noise), jnp.linspace(0.5, 2.0, count)), axes, strict=True)
    ]
    both = of_relaxed(mesh)
    together = jax.jit(jax.vmap(both, (*axes, None)))(*arguments, step)
    for i in range(count):
        one = [each[i] if axis == 0 else each for each, axis in zip(arguments, axes, strict=True)]
        for alone, found in zip(jax.jit(both)(*one, step), together, strict=True):
            np.testing.assert_allclose(alone, found[i], rtol=1e-5, atol=1e-5 * np.abs(alone).max())


@needs_compilers
@pytest.mark.parametrize("count, numbers", [(1, 5), (7, 1024), (24, 3047)])
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_sums_of_blend_shapes_and_their_derivative_are_those_of_jax(count, numbers, batch):
    random = np.random.default_rng(0)
    shapes = random.normal(size=(count, numbers)).astype(np.float32)
    weights, cotangent = random.normal(size=(*batch, count)), random.normal(size=(*batch, numbers))

    def both(weights, cotangent):
        found, pull = jax.vjp(lambda weights: kernels.blended(weights, shapes), weights)
        return found, pull(cotangent)[0]

    for _ in batch:
        both = jax.vmap(both)
    sums, products = jax.jit(kernels.in_kernels(both))(*single((weights, cotangent)))
    np.testing.assert_allclose(sums, weights @ shapes, rtol=0, atol=1e-5)
    np.testing.assert_allclose(products, cotangent @ shapes.T.astype(np.float64), rtol=0, atol=2e-6 * numbers**0.5 * 10)


@needs_compilers
@pytest.mark.parametrize("faces", [20, 700])
def test_the_nearest_face_is_that_of_brute_force(faces):
    """On faces, beside them and far away, of triangles of all shapes; two bodies at once."""
    random = np.random.default_rng(0)
    indices = np.arange(3 * faces, dtype=np.int32).reshape(faces, 3)

    def search(positions, body, groups):
        return kernels.nearest_face(positions, body, proximity.Patches(indices, indices, indices, groups, indices))

    search = jax.jit(kernels.in_kernels(jax.vmap(search, (0, 0, None))))
    for _ in range(100):
        (first, groups), (second, _) = soup(random, faces), soup(random, faces)
        corners, positions = np.stack([first, second]), random.normal(size=(2, 60, 3))
        weights, on = random.dirichlet(np.ones(3), (2, 20)), random.choice(faces, 20)
        positions[:, :20] = np.einsum("bvk,bvkc->bvc", weights, corners[:, on])
        positions[:, 20] = [30.0, -20.0, 10.0]
        positions = positions.astype(np.float32)
        positions[:, 21:23] = np.array([np.nan, np.inf])[:, None]
        found = np.asarray(search(positions, corners.reshape(2, -1, 3), groups))
        assert (0 <= found).all() and (found < faces).all()
        with jax.enable_x64(True):
            given = (positions[:, :, None].astype(np.float64), corners[:, None].astype(np.float64))
            apart = np.sqrt(proximity.closest_on_triangle(*given)[1])
        chosen = np.take_along_axis(apart, found[..., None], axis=2)[..., 0]
        finite = np.isfinite(positions).all(axis=2)
        np.testing.assert_allclose(chosen[finite], apart.min(axis=2)[finite], rtol=1e-6, atol=2e-6)


@needs_compilers
def test_contact_is_that_of_jax():
    """Of vertices and edges about two dented balls, some deep inside, some on the surface."""
    vertices, faces = icosphere(3)
    vertices = (vertices * (1.0 - 0.2 * np.abs(vertices[:, :1]) ** 3)).astype(np.float32)
    patches, random = proximity.patches(vertices, faces), np.random.default_rng(0)
    positions = random.normal(size=(2, 400, 3))
    positions *= random.uniform(0.7, 1.2, (2, 400, 1)) / np.linalg.norm(positions, axis=-1, keepdims=True)
    positions = positions.astype(np.float32)
    positions[:, :40] = vertices[:40]
    near = np.argsort(np.linalg.norm(positions[0, :, None] - positions[0], axis=-1), axis=1)[:, 1:4]
    edges = np.stack([np.repeat(np.arange(400), 3), near.reshape(-1)], axis=1).astype(np.int32)
    bodies = np.stack([vertices, np.float32(1.1) * vertices])
    mesh = sheet()[1]._replace(edges=edges)

    def contact(positions, body):
        planes = contact_search.find(positions, body, body, patches)
        at_edges = contact_search.find_at_edges(positions, planes, mesh, body, body, patches)
        ends = positions[edges]
        between = ends[:, 0] + at_edges.place[:, None] * (ends[:, 1] - ends[:, 0])
        return (
            contact_search.distance(positions, planes.point, planes.normal),
            contact_search.distance(between, at_edges.point_next, at_edges.normal_next),
        )

    wrapped = jax.jit(kernels.in_kernels(jax.vmap(contact)))
    assert str(jax.make_jaxpr(wrapped)(positions, bodies)).count("ffi_call") == 2
    expected = jax.jit(jax.vmap(contact))(positions, bodies)
    assert all((distances < -0.01).sum() > 50 for distances in expected)
    for distances, others in zip(wrapped(positions, bodies), expected, strict=True):
        np.testing.assert_allclose(distances, others, atol=1e-6)


@needs_compilers
@pytest.mark.parametrize("together", [(0, 0), (0, None), (None, 0)])
def test_a_walk_is_that_of_jax(together):
    """About vertices with more faces than a row has, of positions and bodies of their own or shared, from afar."""
    around = np.arange(40) * np.pi / 20
    rings = [[r * np.cos(around), np.full(40, y), r * np.sin(around)] for r, y in ((0.3, 0.2), (0.6, 0.0))]
    vertices = np.concatenate([[[0.0, 0.3, 0.0]], *(np.transpose(ring) for ring in rings)]).astype(np.float32)
    one, next_one = np.arange(40), (np.arange(40) + 1) % 40
    faces = np.concatenate([
        np.stack([np.zeros(40, int), next_one + 1, one + 1], 1),
        np.stack([one + 1, next_one + 1, one + 41], 1),
        np.stack([next_one + 1, next_one + 41, one + 41], 1),
    ])  # fmt: skip
    patches = jax.tree.map(jnp.asarray, proximity.patches(vertices, faces))
    assert patches.around.shape[1] == 40
    random = np.random.default_rng(0)
    positions = random.uniform(-0.6, 0.6, (2, 300, 3)).astype(np.float32) * np.float32([1, 0.3, 1])
    bodies = np.stack([vertices, vertices * np.float32([1, 2, 1])])
    starts = random.integers(0, len(vertices), (2, 300)).astype(np.int32)
    given = [each if axis == 0 else each[0] for each, axis in zip((positions, bodies), together, strict=True)]

    def search(form):
        def apart(x, body):
            face = form(x, body, patches, list(starts))
            return jnp.sqrt(proximity.closest_on_triangle(x, body[patches.faces][face])[1])

        return jax.jit(kernels.in_kernels(jax.vmap(apart, together)))(*given)

    found, expected = search(kernels.nearest_face_around), search(proximity.nearest_face_around)
    np.testing.assert_allclose(found, expected, atol=1e-6)


@needs_compilers
def test_a_decoder_is_that_of_jax():
    config = ModelConfig(latent=6, blendshapes=9)
    random = np.random.default_rng(0)
    basis = random.normal(size=(9, 50, 3)).astype(np.float32)
    garment = decoder.init(jax.random.key(0), 6, basis, config)
    code, cotangent = random.normal(size=(3, 6)).astype(np.float32), random.normal(size=(50, 3)).astype(np.float32)

    def both(code):
        displaced, pull = jax.vjp(lambda z: mlp.apply(decoder.of(garment, config), garment, z, jnp.ones(50)), code)
        return displaced, pull(cotangent)[0]

    wrapped = jax.jit(kernels.in_kernels(jax.vmap(both)))
    assert str(jax.make_jaxpr(wrapped)(code)).count("ffi_call") == 2
    for found, expected in zip(wrapped(code), jax.jit(jax.vmap(both))(code), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


@needs_compilers
def test_what_kernels_do_not_have_is_refused(crumpled):
    """Batches of batches or of tables, and derivatives by anything but positions and weights."""
    x, mesh, step = single(crumpled)
    step = jax.tree.map(jnp.asarray, step)
    both = jax.vmap(jax.vmap(of_relaxed(mesh), (0, None, None)), (None, 0, None))
    with pytest.raises(jax.errors.JaxRuntimeError, match="batches of one"):
        jax.block_until_ready(jax.jit(both)(jnp.stack([x, x]), jnp.ones(3), step))

    def by_stiffness(mu):
        return potential(mesh)(x, step._replace(material=step.material._replace(mu=mu)))

    vertices, faces = icosphere(1)
    patches = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), proximity.patches(vertices, faces))
    of_a_mesh = jax.jit(kernels.in_kernels(lambda mesh: potential(mesh)(x, step)))
    for wrong in (-1, len(x)):
        corners = mesh.faces.copy()
        corners[3, 1] = wrong
        with pytest.raises(jax.errors.JaxRuntimeError, match="operands do not fit"):
            jax.block_until_ready(of_a_mesh(mesh._replace(faces=corners)))
    more = mesh._replace(faces=np.concatenate([mesh.faces, mesh.faces[:, :1]], axis=1))
    with pytest.raises(jax.errors.JaxRuntimeError, match="operands do not fit"):
        jax.block_until_ready(kernels.stretching(jnp.asarray(x), step.rest, step.material, more))
    meshes = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), mesh)
    with pytest.raises(jax.errors.JaxRuntimeError, match="operands do not fit"):
        jax.block_until_ready(jax.vmap(of_a_mesh)(meshes))
    search = jax.jit(jax.vmap(kernels.nearest_face, (None, None, 0)))
    with pytest.raises(jax.errors.JaxRuntimeError, match="operands do not fit"):
        jax.block_until_ready(search(x, vertices.astype(np.float32), patches))
    with pytest.raises(NotImplementedError, match="derivatives by positions and weights alone"):
        jax.grad(lambda shapes: jnp.sum(kernels.blended(jnp.ones(2), shapes)))(jnp.ones((2, 3)))

    assert jax.grad(by_stiffness)(jnp.float32(1e4)) > 0
    with pytest.raises(NotImplementedError, match="derivatives by positions and weights alone"):
        jax.grad(kernels.in_kernels(by_stiffness))(jnp.float32(1e4))


@needs_compilers
def test_jax_computes_what_kernels_cannot(crumpled):
    x, mesh, step = crumpled
    with jax.enable_x64(True):  # in double precision
        assert "ffi_call" not in str(jax.make_jaxpr(kernels.in_kernels(potential(mesh)))(x, step))
    x, step = single((x, step))
    assert "ffi_call" in str(jax.make_jaxpr(kernels.in_kernels(potential(mesh)))(x, step))
    assert "ffi_call" not in str(jax.make_jaxpr(potential(mesh))(x, step))  # not wrapped


@pytest.mark.parametrize(
    "programs, told",
    [({"C": "cc", "C++": None}, "no compiler for C++ on the path: install gcc or clang"),
     ({"C": "cc", "C++": sys.executable}, "failed: ")],
)  # fmt: skip
def test_without_a_compiler_that_works_jax_computes_all(crumpled, monkeypatch, capsys, programs, told):
    x, mesh, step = single(crumpled)
    monkeypatch.setattr(compilers, "compiler", programs.get)
    monkeypatch.setattr(compilers, "_registered", set())
    kernels._compiled.cache_clear()
    try:
        for _ in range(2):
            assert "ffi_call" not in str(jax.make_jaxpr(kernels.in_kernels(potential(mesh)))(x, step))
    finally:
        kernels._compiled.cache_clear()
    out = capsys.readouterr().out
    assert out.count("descents are left to jax, which takes longer: ") == 1 and told in out and out.count("\n") == 1
