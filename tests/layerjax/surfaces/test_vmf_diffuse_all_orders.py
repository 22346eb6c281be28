"""The rough diffuse surface by transport: its half-space, its table, and what a walk among the flakes says."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from layerjax.precompute.vmf_diffuse import maker as vmf_diffuse
from layerjax.precompute.vmf_diffuse.half_space import all_orders, half_space, orders
from layerjax.surfaces.vmf_diffuse import all_orders as tabulated
from layerjax.surfaces.vmf_diffuse.all_orders import all_orders_brdf
from layerjax.tables import load

brdf = jax.jit(all_orders_brdf)

# converged solutions of the half-space by another program, to their digits: roughness, cosines, azimuth between them;
# f1, f2, f3, and all further orders at albedo 0.9
POINTS = [
    (0.5, 0.8, 0.6, 0.0, (0.239053, 0.032278, 0.037884, 0.034071)),
    (0.5, 0.8, 0.6, np.pi, (0.108027, 0.060694, 0.029504, 0.035380)),
    (0.1, 0.8, 0.6, np.pi, (0.274309, 0.020602, 0.002023, 0.000170)),
    (0.7, 0.8, 0.6, 0.0, (0.192668, 0.024521, 0.036037, 0.047005)),
    (1.0, 0.8, 0.6, np.pi / 2, (0.090300, 0.026761, 0.024032, 0.041997)),
    (0.3, 0.8, 0.6, np.pi / 2, (0.234519, 0.047771, 0.020830, 0.009000)),
]

# directional albedos at cosines 1, 0.5, 0.2, to 1e-6, by that program: roughness, albedo
ALBEDOS = [
    (0.1, 0.5, (0.481828, 0.481619, 0.480514)),
    (0.3, 0.9, (0.863210, 0.861074, 0.862478)),
    (0.5, 0.5, (0.328711, 0.327149, 0.340838)),
    (0.5, 0.9, (0.788468, 0.793229, 0.808160)),
    (0.7, 0.9, (0.679625, 0.706675, 0.742175)),
    (1.0, 0.9, (0.492813, 0.560848, 0.627993)),
]


def width(roughness):
    return np.inf if roughness == 1 else -np.log1p(-np.sqrt(roughness))


def vector(cosine, azimuth):
    cosine, azimuth = jnp.broadcast_arrays(jnp.asarray(cosine), jnp.asarray(azimuth))
    sine = jnp.sqrt((1 - cosine) * (1 + cosine))
    return sine * jnp.cos(azimuth), sine * jnp.sin(azimuth), cosine


def channels(*albedo, dtype=jnp.float64):
    return tuple(jnp.asarray(c, dtype) for c in albedo)


@functools.cache
def grazing_rule(nodes=48, azimuths=16):
    """Cosines with weights du that resolve a layer at grazing of any width, and azimuths on half the circle."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    x, w = 0.5 * (x + 1), 0.5 * w
    return x**6, 6 * x**5 * w, (np.arange(azimuths) + 0.5) / azimuths * np.pi


def directional_albedo(roughness, cosine, *albedo):
    """(channel, cosine) integral of the BRDF over the outgoing cosine hemisphere."""
    u, w, phi = grazing_rule()
    f = brdf(vector(cosine[:, None, None], 0.0), vector(u[:, None], phi), channels(*albedo), jnp.asarray(roughness))
    return 2 * np.pi * np.mean(np.stack(f), axis=-1) @ (u * w)


@pytest.mark.parametrize(("roughness", "ui", "uo", "azimuth", "expected"), POINTS)
def test_values_of_the_half_space_and_of_the_table(roughness, ui, uo, azimuth, expected):
    space = half_space(width(roughness), 32, 16, (ui, uo))
    modes = np.arange(16)
    series = np.where(modes == 0, 1.0, 2.0) * np.cos(modes * azimuth)
    first = orders(space, 3)[:, :, -2, -1]
    total = np.array([all_orders(space, 0.9, m)[-2, -1] for m in modes[:6]])
    rest = total - 0.9 ** np.arange(1.0, 4.0) @ first[:, :6]
    np.testing.assert_allclose([*(first @ series), rest @ series[:6]], expected, atol=6e-7)  # half a digit and 1e-7
    (value,) = brdf(vector(ui, 0.3), vector(uo, 0.3 + azimuth), channels(0.9), jnp.asarray(roughness))
    # the table: root mean square over directions 0.23 %; here 0.13 % at most
    np.testing.assert_allclose(value, np.array([0.9, 0.81, 0.729, 1.0]) @ expected, rtol=2.5e-3)


@pytest.mark.parametrize(("roughness", "albedo", "expected"), ALBEDOS)
def test_directional_albedos(roughness, albedo, expected):
    cosines = (1.0, 0.5, 0.2)
    space = half_space(width(roughness), 32, cosines=cosines)
    np.testing.assert_allclose(space.albedo(all_orders(space, albedo))[-3:], expected, atol=1e-6)
    found = directional_albedo(roughness, np.array(cosines), albedo)[0]
    np.testing.assert_allclose(found, expected, rtol=2.5e-3)


@pytest.mark.parametrize("roughness", [1e-4, 0.01, 0.1, 0.5, 0.9, 0.999, 1.0])
def test_the_half_space_keeps_the_energy_at_albedo_1(roughness):
    cosines = (1e-6, 1e-3, 0.2, 1.0)
    space = half_space(width(roughness), 32, cosines=cosines)
    np.testing.assert_allclose(space.albedo(all_orders(space, 1.0)), 1.0, atol=1e-6)


def test_isotropic_flakes_scatter_once_as_in_closed_form():
    # r = 1: (sin p + (pi - p) cos p) 2 / (3 pi^2 (u_i + u_o)), p the angle between the directions
    cosines, azimuth = np.array([0.1, 0.35, 0.8, 1.0]), np.linspace(0.0, np.pi, 5)
    space = half_space(np.inf, 4, 24, tuple(cosines))
    series = np.where(np.arange(24) == 0, 1.0, 2.0)[:, None] * np.cos(np.outer(np.arange(24), azimuth))
    first = np.moveaxis(orders(space, 1)[0, :, 4:, 4:], 0, -1) @ series
    sine = np.sqrt(1 - cosines**2)
    between = np.outer(cosines, cosines)[..., None] + np.outer(sine, sine)[..., None] * np.cos(azimuth)
    p = np.arccos(np.clip(between, -1.0, 1.0))
    exact = 2 * (np.sin(p) + (np.pi - p) * between) / (3 * np.pi**2 * np.add.outer(cosines, cosines)[..., None])
    # what the modes past the 23rd add falls as m^-4
    np.testing.assert_allclose(first, exact, atol=2e-5)


@pytest.mark.parametrize("roughness", [0.0, 1e-8, 1e-3, 0.02, 0.1, 0.25, 0.4, 0.6, 0.8, 0.95, 0.999, 1.0])
def test_energy(roughness):
    cosines = np.array([1e-6, 1e-4, 1e-3, 0.01, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 1.0])
    lossless, most = directional_albedo(roughness, cosines, 1.0, 0.95)
    np.testing.assert_allclose(lossless, 1.0, atol=2.6e-3)  # the largest of a closer grid: 2.3e-3
    assert np.all(most < 0.955)
    u, w, _ = grazing_rule()
    white = 2 * np.sum(directional_albedo(roughness, u, 1.0)[0] * u * w)
    np.testing.assert_allclose(white, 1.0, atol=1.5e-3)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_roughness_0_is_lambertian(dtype):
    cosine = jnp.asarray([1e-6, 0.3, 1.0], dtype)
    albedo = channels(0.2, 1.0, dtype=dtype)
    values = brdf(vector(cosine, jnp.zeros((), dtype)), vector(cosine, jnp.asarray(2.0, dtype)), albedo, cosine[0] * 0)
    for value, c in zip(values, albedo, strict=True):
        assert value.dtype == dtype
        np.testing.assert_allclose(value, c / np.pi, rtol=4e-7)


def test_channels_and_shapes():
    wi, wo = vector(jnp.linspace(0.1, 1.0, 4)[:, None], 0.0), vector(jnp.linspace(0.1, 1.0, 3), 1.0)
    red, green = brdf(wi, wo, channels(0.3, 0.9), jnp.asarray(0.4))
    assert red.shape == (4, 3)
    black, swapped = brdf(wi, wo, channels(0.0, 0.3), jnp.asarray(0.4))
    np.testing.assert_allclose(swapped, red, rtol=1e-13)
    assert black.max() == 0.0
    dark, light = brdf(jax.tree.map(lambda x: x[2, 0], wi), wo, channels(0.3, 0.9), jnp.asarray(0.4))
    np.testing.assert_allclose(dark, red[2], rtol=1e-13)
    np.testing.assert_allclose(light, green[2], rtol=1e-13)


def random_directions(count, seed):
    random = np.random.default_rng(seed)
    cosine = np.concatenate([random.uniform(0, 1, count), 10 ** random.uniform(-6, 0, count), [1.0, 1e-6, 1e-3]])
    return vector(jnp.asarray(cosine), jnp.asarray(random.uniform(0, 2 * np.pi, cosine.size)))


def test_reciprocity():
    wi, wo = random_directions(100, 1), random_directions(100, 2)
    for roughness in (0.0, 0.03, 0.4, 1.0):
        (f,), (g,) = (brdf(a, b, channels(0.8), jnp.asarray(roughness)) for a, b in ((wi, wo), (wo, wi)))
        # modes cancel where light goes on forward, so rounding is that of their size, up to 1 / (u_i + u_o)
        np.testing.assert_allclose(f, g, rtol=1e-13, atol=1e-13 * float(jnp.max(1 / (wi[2] + wo[2]))))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_values_and_derivatives_are_finite(dtype):
    wi, wo = random_directions(60, 3), random_directions(60, 4)
    wi, wo = (jax.tree.map(lambda *x: jnp.concatenate(x).astype(dtype), a, b) for a, b in ((wi, wi), (wo, wi)))
    rough = jnp.asarray([0.0, 1e-30, 1e-12, 1e-6, 1e-3, 0.1, 0.5, 0.9, 0.999, 1 - 1e-6, 1.0], dtype)
    shades = jnp.asarray([0.0, 1e-6, 0.5, 0.999, 1 - 6e-8, 1.0], dtype)

    def one(wi, wo, albedo, roughness):
        return all_orders_brdf(wi, wo, (albedo,), roughness)[0]

    derivatives = jax.vmap(jax.value_and_grad(one, argnums=(0, 1, 2, 3)), in_axes=(0, 0, None, None))
    over = jax.jit(lambda r: jax.lax.map(lambda c: derivatives(wi, wo, c, r), shades))
    for roughness in rough:
        value, slopes = over(roughness)
        assert value.dtype == dtype
        assert bool(jnp.all(jnp.isfinite(value)) & jnp.all(value >= 0))
        for slope in jax.tree.leaves(slopes):
            assert bool(jnp.all(jnp.isfinite(slope))), roughness


def test_derivatives_agree_with_differences():
    wi, wo = vector(jnp.asarray([0.8, 0.3]), 0.2), vector(jnp.asarray([0.5, 0.1]), 2.0)

    def total(cosine, albedo, roughness):
        return jnp.sum(all_orders_brdf(vector(cosine, 0.2), wo, (albedo,), roughness)[0])

    slope, step = jax.jit(jax.grad(total, argnums=(1, 2))), 1e-6
    run = jax.jit(total)
    for c, r in ((0.6, 0.3), (0.98, 1e-4), (0.9, 0.97)):
        by_albedo, by_roughness = slope(wi[2], c, r)
        np.testing.assert_allclose(by_albedo, (run(wi[2], c + step, r) - run(wi[2], c - step, r)) / 2e-6, rtol=1e-6)
        np.testing.assert_allclose(by_roughness, (run(wi[2], c, r + step) - run(wi[2], c, r - step)) / 2e-6, rtol=1e-3)
    # dE/dr = -0.455 at albedo 0.9 as r -> 0 (half-spaces of r = 1e-5 and 1e-4), and so at r = 0 itself
    _, at_zero = slope(jnp.asarray([1.0, 1.0]), 0.9, 0.0)
    assert np.isfinite(at_zero)


def walk(roughness, cosine, paths, events, seed):
    """Light by order of scattering (order, path): whether it leaves then, and its direction.

    Flights cross the flakes at the rate 1; one is drawn from their density and scatters light that meets its face,
    in proportion to its projected area: neither sigma nor K is used.
    """
    random, k = np.random.default_rng(seed), 2.0 / width(roughness) ** 2
    travel = np.tile([[np.sqrt(1 - cosine**2)], [0.0], [-cosine]], paths)
    travel[0] *= -1  # light that comes from azimuth 0
    depth, order = np.zeros(paths), np.zeros(paths, int)
    left: list[tuple[np.ndarray, np.ndarray]] = []
    for _ in range(events):
        depth = depth - travel[2] * random.exponential(size=depth.size)
        outside = depth < 0
        left.append((order[outside], travel[:, outside]))
        inside = ~outside & (order < 120)
        travel, depth, order = travel[:, inside], depth[inside], order[inside]
        if depth.size == 0:
            break
        u, phi, face, v, psi = random.uniform(size=(5, depth.size))
        z = 2 * u - 1 if k < 1e-9 else 1 + np.log(u + (1 - u) * np.exp(-2 * k)) / k
        flat = np.sqrt(np.maximum(1 - z * z, 0))
        m = np.stack([flat * np.cos(2 * np.pi * phi), flat * np.sin(2 * np.pi * phi), z])
        hit = face < -np.sum(travel * m, axis=0)
        # Lambert: the normal plus a point of the unit sphere
        height, around = 2 * v - 1, 2 * np.pi * psi
        ball = np.stack([np.sqrt(1 - height**2) * np.cos(around), np.sqrt(1 - height**2) * np.sin(around), height])
        fresh = m + ball
        fresh = fresh / np.maximum(np.linalg.norm(fresh, axis=0), 1e-12)
        travel, order = np.where(hit, fresh, travel), order + hit
    return np.concatenate([o for o, _ in left]), np.concatenate([w for _, w in left], axis=1)


@pytest.mark.parametrize(
    ("roughness", "cosine", "paths"),
    [(0.5, 0.4, 200_000), (0.1, 0.8, 200_000), (1.0, 0.4, 100_000)],
)
def test_a_walk_among_the_flakes(roughness, cosine, paths):
    albedo = 0.8
    order, out = walk(roughness, cosine, paths, 4000, seed=7)
    # energy, and its first moment along the light's azimuth, which tells the sides apart
    space = half_space(width(roughness), 32, 2, (cosine,))
    sine, w = np.sqrt(1 - space.cosines**2), 2 * np.pi * space.weights * space.cosines
    scattered = orders(space, 3)[:, :, -1]
    total = np.stack([all_orders(space, albedo, m)[-1] for m in (0, 1)])
    for n in (1, 2, 3, None):
        weight = albedo**order if n is None else (order == n) * 1.0
        mean, once = total if n is None else scattered[n - 1]
        for exact, sample in ((mean @ w, weight), (once * sine @ w, weight * out[0])):
            square = np.sum(sample**2) / paths
            noise = np.sqrt((square - (np.sum(sample) / paths) ** 2) / paths)
            assert abs(np.sum(sample) / paths - exact) < 4 * noise, (n, exact)
            assert noise < 1.5e-3


@pytest.mark.slow
def test_a_coarse_table_equals_the_one_that_ships(monkeypatch):
    lines: list[str] = []
    coarse = vmf_diffuse.make(coarse=True, report=lines.append)
    assert len(lines) == vmf_diffuse.ROUGHNESSES
    fine = load("vmf_diffuse")
    assert coarse.keys() == fine.keys()
    assert coarse["forms"].shape == fine["forms"].shape
    assert coarse["forms"].dtype == fine["forms"].dtype == np.float32
    u, w, phi = grazing_rule(20, 6)
    wi, wo = vector(u[:, None, None], 0.0), vector(u[:, None], phi)
    weight = (u * w)[:, None, None] * (u * w)[:, None] * np.ones_like(phi)
    found = []
    for table in (fine, coarse):
        monkeypatch.setattr(tabulated, "load", {"vmf_diffuse": table}.get)
        tabulated._table.cache_clear()
        run = jax.jit(lambda r: all_orders_brdf(wi, wo, channels(0.9), r)[0])
        found.append([run(r) for r in (0.01, 0.2, 0.7, 1.0)])
    tabulated._table.cache_clear()
    for f, g in zip(*found, strict=True):
        # with half the cosines 1.2e-5
        difference = np.sqrt(np.sum(weight * (f - g) ** 2) / np.sum(weight * f**2))
        assert difference < 5e-5


@pytest.mark.slow
def test_the_table_is_made_again_to_rounding():
    made = vmf_diffuse.make(report=lambda line: None)["forms"]
    np.testing.assert_allclose(made, load("vmf_diffuse")["forms"], atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("roughness", [1e-3, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0])
def test_error_over_the_hemispheres_beside_the_paper_s_fit(roughness):
    # the fit's error by an independent program: 1 to 8 %
    from layerjax.surfaces import VMFDiffuse

    space, modes = half_space(width(roughness), 32, 12), np.arange(12)
    u, phi = space.cosines, (np.arange(24) + 0.5) / 24 * np.pi
    series = np.where(modes == 0, 1.0, 2.0)[:, None] * np.cos(np.outer(modes, phi))
    wi, wo = vector(u[:, None, None], 0.0), vector(u[:, None], phi)
    weight = (np.outer(space.weights * u, space.weights * u))[..., None] * np.ones_like(phi)
    scattered = orders(space, 3)
    for albedo in (0.5, 0.9, 1.0):
        start = np.tensordot(albedo ** np.arange(1.0, 4.0), scattered, 1)
        total = np.stack([all_orders(space, albedo, m) if m < 4 else start[m] for m in modes])
        exact = np.moveaxis(total, 0, -1) @ series

        def error(f, exact=exact):
            return np.sqrt(np.sum(weight * (f - exact) ** 2) / np.sum(weight * exact**2))

        ours = error(brdf(wi, wo, channels(albedo), jnp.asarray(roughness))[0])
        fit = error(VMFDiffuse(albedo, roughness).evaluate(wi, wo)[0])
        print(f"r {roughness} c {albedo}: table {ours:.2e} fit {fit:.2e}")
        assert ours < 2.5e-3
        assert fit > 2 * ours
