"""Diffuse light between layers by few streams, beside the solver with many and what is known in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.precompute.streams import diffuse_moments
from layerjax.stack import Stack, simplify
from layerjax.transport.statistical import stream_layers, streams
from layerjax.transport.statistical.diffuse_base import make_diffuse
from layerjax.transport.statistical.hazy_base import HazyBase, is_hazy, make_hazy
from layerjax.transport.statistical.streamed_base import StreamedBase, is_streamed, make_streamed
from tests.helpers.compiled import compiled

COAT, INNER, DYE = lj.Interface(1.5, 0.1), lj.Interface(1.9, 0.3), lj.Medium([0.3, 1.0], 0.0)
HAZE = lj.Medium([0.5, 2.0], 0.9, lj.HenyeyGreenstein(0.7))
BASE = lj.Lambertian([0.3, 0.9])
ERROR, FALLING = 1e-2, 5e-2
"""Of light from the base, as `streamed_base` states them: elsewhere, and where the index falls from layer to layer."""
STRUCTURES = {
    "two interfaces": [COAT, INNER],
    "dye between": [COAT, DYE, INNER],
    "down in index": [INNER, DYE, lj.Interface(1.3, 0.05)],
    "haze": [COAT, HAZE],
    "haze over an interface": [COAT, HAZE, INNER],
    "dye on top": [DYE, COAT, HAZE],
    "dye on a coat": [DYE, COAT],
    "dye alone": [DYE],
    "haze alone": [HAZE],
    "haze and dye": [HAZE, DYE],
    "haze on a coat": [HAZE, COAT],
    "haze on two": [HAZE, COAT, DYE, INNER],
    "haze on haze": [HAZE, COAT, HAZE],
    "thinner than air": [lj.Interface(0.8, 0.1), HAZE],
}


def made(stack: Stack) -> HazyBase | StreamedBase:
    return make_hazy(stack) if is_hazy(stack) else make_streamed(stack)


@pytest.mark.slow
@pytest.mark.parametrize("name", STRUCTURES)
def test_light_from_the_base_is_as_solved(name: str) -> None:
    stack = simplify(lj.Stack(STRUCTURES[name], BASE))
    assert is_hazy(stack) is isinstance(stack.layers[0], lj.Medium)
    assert is_streamed(stack) is not is_hazy(stack)
    angles = np.random.default_rng(0).uniform(0.05, 1.4, (2, 200))
    wi, wo = ((jnp.sin(t), 0.0 * t, jnp.cos(t)) for t in map(jnp.asarray, angles))

    @compiled
    def values_and_albedos(wi, wo):
        parts = made(stack), make_diffuse(stack, stack.base, True)
        return [(part.value(wi, wo), part.albedo(wi)) for part in parts]

    (values, albedos), (solved, solved_albedos) = values_and_albedos(wi, wo)
    error = FALLING if name == "down in index" else ERROR
    for found, wanted in zip(values, solved, strict=True):
        assert np.sqrt(np.sum((found - wanted) ** 2) / np.sum(wanted**2)) < error
    for found, wanted in zip(albedos, solved_albedos, strict=True):
        np.testing.assert_allclose(found, wanted, atol=error)


@pytest.mark.slow
def test_a_map_is_its_stacks() -> None:
    """Over a diffuse base texels go together, and each is as its stack by itself; the exact solve stays an option."""
    depths = np.asarray([[0.1, 0.4], [1.0, 2.0]])[..., None]  # one number for all channels
    alphas = np.asarray([[0.1, 0.2], [0.3, 0.02]])

    def stack(alpha, depth):
        return lj.Stack([lj.Interface(1.5, alpha), lj.Medium(depth, 0.8, lj.HenyeyGreenstein(0.5))], BASE)

    wi, wo = lj.direction(0.5, 0.0), lj.direction(0.9, 2.0)
    together = lj.evaluate(stack(alphas, depths), wi, wo, lj.Statistical())
    for place in np.ndindex(2, 2):
        alone = lj.evaluate(stack(alphas[place], depths[place]), wi, wo, lj.Statistical())
        np.testing.assert_allclose(together[place], alone, rtol=1e-9)
    exact = lj.evaluate(stack(0.1, 0.1), wi, wo, lj.Statistical(diffuse="exact"))
    np.testing.assert_allclose(together[0, 0], exact, rtol=ERROR)


MILK = lj.Medium(3.0, 1.0, lj.HenyeyGreenstein(0.8))


@pytest.mark.parametrize(
    "layers",
    [
        [MILK],
        *(
            pytest.param(layers, marks=pytest.mark.slow)
            for layers in ([COAT, MILK, INNER], [COAT, INNER], [MILK, COAT, MILK])
        ),
    ],
)
def test_nothing_is_lost(layers) -> None:
    """What diffuse light from the base does not return to it leaves: energy over a base that absorbs nothing is 1."""
    stack = simplify(lj.Stack(layers, lj.Lambertian(1.0)))
    (energy,) = jax.jit(lambda: made(stack).energy)()
    np.testing.assert_allclose(energy, 1.0, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_derivatives_of_haze_on_top(dtype: jnp.dtype) -> None:
    """Finite at the ends, along grazing light too, and as differences say, which at ends look inward."""

    def value(thickness, albedo, g, cosine):
        layers = [lj.Medium(thickness, albedo, lj.HenyeyGreenstein(g)), COAT]
        part = make_hazy(lj.Stack(layers, lj.Lambertian(0.7)))
        w = (jnp.sqrt((1.0 - cosine) * (1.0 + cosine)), 0.0 * cosine, cosine)
        return part.value(w, w)[0]

    ends = [0.0, 1e-6, 1.0, 1e4], [(0.5, 0.3), (0.0, 0.0), (1.0, 0.999), (1.0, -0.999)], [1e-6, 0.3, 1.0]
    places = jnp.asarray([(d, *scatters, cosine) for d in ends[0] for scatters in ends[1] for cosine in ends[2]], dtype)
    for mode in (jax.jacfwd, jax.jacrev):
        slopes = jax.jit(jax.vmap(mode(value, argnums=(0, 1, 2))))(*places.T)
        assert np.all(np.isfinite(np.stack(slopes)))
    if dtype == jnp.float64:
        at = jnp.asarray([(d, 0.5, 0.3, 0.6) for d in ends[0]])
        step = jnp.asarray([1e-6, 1e-6, 1e-6, -1e-2])
        values = jax.jit(jax.vmap(value))
        ahead = [values(at[:, 0] + k * step, *at[:, 1:].T) for k in (0, 1, 2)]
        slope = (-3.0 * ahead[0] + 4.0 * ahead[1] - ahead[2]) / (2.0 * step)
        np.testing.assert_allclose(jax.jit(jax.vmap(jax.grad(value)))(*at.T), slope, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("g", [-0.5, 0.0, 0.9])
@pytest.mark.parametrize("thickness", [1e-3, 1.0, 30.0])
def test_slabs_are_as_the_solver_has_them(g: float, thickness: float) -> None:
    """Diffuse reflectance and transmittance of a medium, beside 24 nodes and modes enough."""
    reflected, passed = stream_layers.slab(jnp.asarray([thickness]), jnp.asarray([0.95]), jnp.asarray([g]))
    x, w = (np.asarray(part) for part in np.polynomial.legendre.leggauss(24))
    cosine, weight = 0.5 * (x + 1.0), 0.5 * w * (x + 1.0)
    directions = np.stack([np.sqrt(1.0 - cosine**2), 0.0 * cosine, cosine], axis=-1)
    slab = lj.Stack([lj.Medium(thickness, 0.95, lj.HenyeyGreenstein(g))])
    near, far = lj.albedo(slab, directions, lj.AddingDoubling(nodes=24, modes=4))
    far = far + np.exp(-thickness / cosine)[:, None]
    for matrix, energy in ((reflected, near), (passed, far)):
        flux = float(streams.DIFFUSE @ matrix[0] @ streams.DIFFUSE)
        assert abs(flux - float(weight @ np.asarray(energy)[:, 0])) < 3e-4  # as stated


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_slabs_at_ends(dtype) -> None:
    """No thickness, all absorbed, and lossless to the thickest of the box.

    Of a lossless slab rounding takes about the root of the precision, by which light loses its way in 1e4.
    """
    rounding, lost = (float(power * jnp.finfo(dtype).eps ** root) for power, root in ((32, 1.0), (1.0, 0.5)))
    thickness = jnp.asarray([0.0, 1.0, 1.0, 1e4], dtype)
    albedo = jnp.asarray([0.7, 0.0, 1.0, 1.0], dtype)
    for g in (-0.999, 0.0, 0.999):
        reflected, passed = jax.jit(stream_layers.slab)(thickness, albedo, jnp.asarray([g], dtype))
        np.testing.assert_allclose(passed[0], np.eye(streams.STREAMS), atol=rounding)
        np.testing.assert_allclose(reflected[:2], 0.0, atol=rounding)
        # that the slab which doubling begins with is thin leaves (thickness / cosine / 2^19)^2 / 3
        wanted = np.diag(np.exp(-1.0 / streams.NODES))
        np.testing.assert_allclose(passed[1], wanted, atol=rounding + (2.0**-19 / streams.NODES[0]) ** 2 / 3.0)
        whole = streams.DIFFUSE @ np.asarray(reflected + passed, float)[2:]
        np.testing.assert_allclose(whole, [streams.DIFFUSE] * 2, atol=lost)


@pytest.mark.slow
def test_derivatives_of_slabs_at_ends() -> None:
    @jax.jit
    def energy(thickness, albedo, g):
        reflected, passed = stream_layers.slab(thickness[None], albedo[None], g[None])
        return jnp.stack([streams.DIFFUSE @ part[0] @ streams.DIFFUSE for part in (reflected, passed)])

    ahead, back = (jax.jit(mode(energy, argnums=(0, 1, 2))) for mode in (jax.jacfwd, jax.jacrev))
    for place in ((0.0, 0.5, 0.3), (1.0, 0.0, 0.0), (1e4, 1.0, 0.999), (2.0, 1.0, -0.999)):
        for derivatives in (ahead, back):
            assert np.all(np.isfinite(np.stack(derivatives(*map(jnp.asarray, place)))))
    step, at = 1e-5, [jnp.asarray(x) for x in (0.8, 0.6, 0.4)]
    slopes = ahead(*at)
    for k, slope in enumerate(slopes):
        above, below = ([x + s * step * (j == k) for j, x in enumerate(at)] for s in (1.0, -1.0))
        np.testing.assert_allclose(slope, (energy(*above) - energy(*below)) / (2.0 * step), rtol=1e-6, atol=1e-9)


def test_packing_keeps_the_matrices() -> None:
    """An interface is what the table has of it, and loses nothing whatever that says."""
    random = np.random.default_rng(1)
    entries = jnp.asarray(random.normal(size=(3, streams.ENTRIES)))
    dense = jnp.asarray([1.0, 1.5, 4.0])
    inward, outer, inner = map(np.asarray, streams.unpack(entries, dense))
    np.testing.assert_allclose(streams.pack(inward, outer, inner), entries, atol=1e-15)
    for reflected in (outer, inner):
        np.testing.assert_allclose(reflected, np.swapaxes(reflected, -1, -2), atol=1e-12)
    first = np.eye(streams.STREAMS)[0]
    np.testing.assert_allclose(inward[:, 0] + outer[:, 0], first[None].repeat(3, 0), atol=1e-12)
    outward = np.swapaxes(inward, -1, -2) / np.asarray(dense)[:, None, None] ** 2
    np.testing.assert_allclose(outward[:, 0] + inner[:, 0], first[None].repeat(3, 0), atol=1e-12)


@pytest.mark.slow
def test_interfaces_are_as_their_quadrature() -> None:
    """Between the points of the table. No entry is further off than is stated."""
    random = np.random.default_rng(0)
    alpha, ior = np.exp(random.uniform(np.log(1e-4), 0.0, 30)), np.exp(random.uniform(0.0, np.log(4.0), 30))
    inward, outward = diffuse_moments(alpha, ior), diffuse_moments(alpha, 1.0 / ior)
    found = streams.interface_matrices(jnp.asarray(alpha), jnp.asarray(ior))
    wanted = (
        (found.down, inward.through + _rest(outward.later, inward.later)),
        (found.top, inward.back + _rest(inward.returned, inward.returned)),
        (found.bottom, outward.back + _rest(outward.returned, outward.returned)),
    )
    for matrix, moments in wanted:
        apart = streams.AT_NODES.T @ np.asarray(matrix) @ streams.AT_NODES - moments
        assert np.sqrt(np.mean(apart**2)) < 3e-4
        assert np.max(np.abs(apart)) < 4e-3


def _rest(out: np.ndarray, into: np.ndarray) -> np.ndarray:
    """What first facets leave on the surface, t t' / <t>."""
    return (out / np.maximum(out[:, :1], 1e-12))[:, :, None] * into[:, None, :]


@pytest.mark.slow
def test_the_box_is_finite_and_smooth() -> None:
    """Values and gradients at corners of alpha and index, in float32, and slopes that do not jump across cells."""

    def value(alpha, ior, depth):
        stack = simplify(
            Stack((lj.Interface(ior, alpha), lj.Medium(depth, 0.0), lj.Interface(ior * ior, alpha)), lj.Lambertian(0.9))
        )
        wi = (jnp.asarray(0.6), jnp.asarray(0.0), jnp.asarray(0.8))
        return make_streamed(stack).value(wi, wi)[0]

    slopes = jax.jit(jax.vmap(jax.value_and_grad(value, argnums=(0, 1, 2))))
    corners = np.stack(np.meshgrid([1e-4, 0.3, 1.0], [0.5, 0.999, 1.0, 1.001, 2.0], [0.0, 1.0, 1e4]), -1).reshape(-1, 3)
    found = slopes(*jnp.asarray(corners, jnp.float32).T)
    assert all(np.all(np.isfinite(part)) for part in jax.tree.leaves(found))
    line = jnp.linspace(0.2, 0.4, 2001)
    along = slopes(line, jnp.full_like(line, 1.5), jnp.full_like(line, 0.3))[1][0]
    jumps = np.abs(np.diff(np.asarray(along), 2))
    assert np.max(jumps) < 20.0 * np.median(jumps) + 1e-6 * np.max(np.abs(along))
