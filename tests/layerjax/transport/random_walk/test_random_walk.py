"""Values of the walk: unbiased, with honest errors, for all that a stack can hold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

import layerjax as lj
from layerjax.directions import split
from layerjax.surfaces.interface import interface_reflection, interface_transmission
from layerjax.transport.random_walk.batches import follow
from layerjax.transport.random_walk.random_numbers import key_words
from layerjax.transport.random_walk.scene import Scene
from layerjax.transport.random_walk.walk import Walk
from tests.helpers.cases import flakes, haze, tilt3

KEY = jax.random.key(11)
WI, ABOVE, BELOW = lj.direction(0.5, 0.0), lj.direction(0.7, 2.6), lj.direction(2.5, 3.3)
REPEATS = 256
EXTREME = flakes("surface", 1e-4, None, 1e4, 0.5, 0.0)


def repeated(stack, wi, wo, **options):
    """Values and errors of many independent estimates of one value, shape (REPEATS, C)."""
    walk = lj.RandomWalk(**{"paths": 1024, "batch_size": 2048, **options})
    found = lj.evaluate_with_error(stack, wi, jnp.broadcast_to(wo, (REPEATS, 3)), walk, key=KEY)
    return tuple(np.asarray(x) for x in found)


def assert_mean(values, expected):
    error = values.std(axis=0) / np.sqrt(len(values))
    np.testing.assert_array_less(np.abs(values.mean(axis=0) - expected), 4 * error + 1e-12)


COLORED = [
    haze(0.3, [1.0, 0.3, 3.0], [0.9, 0.5, 0.8]),
    flakes("fiber", 0.3, (1.0, 0.0, 0.4), [0.5, 1.0, 0.2], 0.9, 0.04),
]


@pytest.mark.parametrize(
    ("stack", "pairs"),
    [
        (lj.Stack(tilt3()), [(WI, ABOVE), (WI, BELOW), (BELOW, ABOVE)]),
        (lj.Stack(COLORED, lj.Lambertian([0.5, 0.2, 0.1])), [(WI, ABOVE)]),
        (lj.Stack([haze(0.3, 0.5, 0.9)], lj.OrenNayar(0.7, 0.6)), [(WI, ABOVE)]),
        (lj.Stack([haze(0.3, 0.5, 0.9)], lj.Conductor(0.2, 3.9, 0.4)), [(WI, ABOVE)]),
    ],
)
def test_first_order(stack, pairs):
    for wi, wo in pairs:
        assert_mean(repeated(stack, wi, wo, orders="first")[0], lj.evaluate(stack, wi, wo, lj.SingleScattering()))


def test_energies_of_the_first_order():
    stack = lj.Stack([haze(0.3, 0.8, 0.9)])
    found = lj.albedo(stack, WI, lj.RandomWalk(paths=1 << 14, orders="first"), key=KEY)
    for share, expected in zip(found, lj.albedo(stack, WI, lj.SingleScattering()), strict=True):
        np.testing.assert_allclose(share, expected, atol=4 * np.sqrt(0.25 / (1 << 14)))  # what a path brings is 0 to 1
        assert expected > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("base", [lj.Lambertian(0.6), lj.Conductor(0.2, 3.9, 0.05)])
def test_orders_add_up(base):
    stack = lj.Stack([lj.Interface(1.5, 0.3), haze(0.3, 0.8, 0.9)], base)
    every, first, rest = (repeated(stack, WI, ABOVE, orders=orders)[0] for orders in ("all", "first", "multiple"))
    assert_mean(every - first - rest, 0.0)
    np.testing.assert_allclose(first, interface_reflection(split(WI), split(ABOVE), 1.5, 0.3), rtol=1e-9)


@pytest.mark.parametrize("ior", [1.5, 1 / 1.5])
def test_one_interface(ior):
    alpha = jnp.asarray(0.3)
    stack = lj.Stack([lj.Interface(ior, alpha)])
    walk = lj.RandomWalk(paths=64)
    inside = lj.direction(2.8, 3.3)
    reflected = lj.evaluate(stack, WI, ABOVE, walk, key=KEY)[0]
    passed = lj.evaluate(stack, WI, inside, walk, key=KEY)[0]
    back = lj.evaluate(stack, inside, WI, walk, key=KEY)[0]
    np.testing.assert_allclose(reflected, interface_reflection(split(WI), split(ABOVE), ior, alpha), rtol=1e-9)
    np.testing.assert_allclose(passed, interface_transmission(split(WI), split(inside), ior, alpha), rtol=1e-9)
    np.testing.assert_allclose(back, passed / ior**2, rtol=1e-9)  # f / ior_o^2 is reciprocal


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stack", "options"),
    [
        (lj.Stack([haze(0.7, 2.0, 0.95), flakes("fiber", 0.3, (1.0, 0.0, 0.0), 0.5, 0.9)]), {}),
        (lj.Stack(COLORED, lj.Lambertian([0.5, 0.2, 0.1])), {}),
        (lj.Stack([lj.Interface(1.5, 0.4)], lj.Conductor(0.2, 3.9, 0.4)), {"facet_multiple_scattering": True}),
        (lj.Stack([lj.Interface(1.5, 0.2), haze(0.5, 1.0, 0.9)], lj.Lambertian(0.8)), {}),
        (lj.Stack([lj.Interface(1.5, 0.2), haze(0.5, 1.0, 0.9)], lj.Conductor(0.2, 3.9, 0.01)), {}),
    ],
)
def test_standard_errors_are_honest(stack, options):
    values, errors = repeated(stack, WI, ABOVE, paths=256, **options)
    z = (values - values.mean(axis=0)) / errors
    np.testing.assert_allclose(z.std(axis=0), 1.0, atol=0.25)  # 1 +- 4 / sqrt(2 REPEATS)


@pytest.mark.slow
def test_reciprocity():
    # between media of different index: lit from above and seen from below the last interface, and the other way round
    stack = lj.Stack([lj.Interface(1.5, 0.3), haze(0.6, 0.7, 0.9), lj.Interface(1.3, 0.4)])
    walk = lj.RandomWalk(paths=8000, facet_multiple_scattering=True)
    wi = jnp.stack([WI, WI, BELOW])
    wo = jnp.stack([ABOVE, BELOW, lj.direction(2.2, 1.0)])
    scale = np.where(np.asarray([wi[:, 2], wo[:, 2]]) > 0, 1.0, 1.3**2)
    forth, forth_error = (x[:, 0] / scale[1] for x in lj.evaluate_with_error(stack, wi, wo, walk, key=KEY))
    back, back_error = (x[:, 0] / scale[0] for x in lj.evaluate_with_error(stack, wo, wi, walk, key=KEY))
    np.testing.assert_array_less(np.abs(forth - back), 4 * np.hypot(forth_error, back_error))


def test_a_narrow_interface_is_found():
    # nothing but aiming through the interface keeps the variance finite: a thousandth of a radian, over diffuse light
    stack = lj.Stack([lj.Interface(1.5, 1e-3)], lj.Lambertian(0.5))
    values, errors = lj.evaluate_with_error(stack, WI, ABOVE, lj.RandomWalk(paths=4000), key=KEY)
    assert errors[0] < 0.01 * values[0]
    # a smooth coat: t(i) t(o) / n^2 rho / (pi (1 - rho F)) with F the diffuse reflectance from inside
    x, w = np.polynomial.legendre.leggauss(400)
    z = 0.5 * (x + 1)

    def passes(cosine):  # Fresnel transmittance at the outer cosine
        inner = np.sqrt(1 - (1 - cosine**2) / 1.5**2)
        s = (cosine - 1.5 * inner) / (cosine + 1.5 * inner)
        p = (1.5 * cosine - inner) / (1.5 * cosine + inner)
        return 1 - 0.5 * (s**2 + p**2)

    trapped = 1 - np.sum(0.5 * w * 2 * z * passes(z)) / 1.5**2
    expected = passes(float(WI[2])) * passes(float(ABOVE[2])) / 1.5**2 * 0.5 / np.pi / (1 - 0.5 * trapped)
    assert abs(values[0] - expected) < 4 * errors[0] + 1e-4 * expected


@pytest.mark.slow
@pytest.mark.parametrize("coated", [False, True])
def test_a_narrow_metal_is_found(coated):
    # a perfect mirror shows its surroundings once more: half of a stack that is the same from both sides
    half, whole = haze(0.3, 0.7, 0.8), haze(0.3, 1.4, 0.8)
    coats = [lj.Interface(1.5, 0.3), lj.Interface(1.0, 0.3)] if coated else []
    mirror = lj.Stack([*coats[:1], half], lj.Conductor(0.01, 10.0, 1e-3))  # loses 4e-4
    walk = lj.RandomWalk(paths=8192)
    values, errors = lj.evaluate_with_error(mirror, WI, ABOVE, walk, key=KEY)
    assert errors[0] < 0.02 * values[0]
    both = jnp.stack([ABOVE, ABOVE * jnp.asarray([1.0, 1.0, -1.0])])
    unfolded = lj.Stack([*coats[:1], whole, *coats[1:]])
    halves, spreads = lj.evaluate_with_error(unfolded, WI, both, walk, key=KEY)
    assert abs(values[0] - halves.sum()) < 4 * np.hypot(errors[0], np.hypot(*spreads[:, 0])) + 2e-3 * values[0]


def test_a_metal_is_indexed_against_what_surrounds_the_stack():
    # at normal incidence on smooth surfaces, R = F + (1 - F)^2 M / (1 - F M), M of (n + i k) / 1.5
    n, k, f = 0.2 / 1.5, 3.9 / 1.5, 0.04
    metal = ((n - 1) ** 2 + k**2) / ((n + 1) ** 2 + k**2)
    stack = lj.Stack([lj.Interface(1.5, 1e-3)], lj.Conductor(0.2, 3.9, 1e-3))
    near, _ = lj.albedo(stack, lj.direction(0.0, 0.0), lj.RandomWalk(paths=50_000), key=KEY)
    assert abs(float(near[0]) - (f + (1 - f) ** 2 * metal / (1 - f * metal))) < 1e-3


def transmittance_of_isotropic_slab(thickness, cells=1000):
    """Transmitted share of normally incident light, unscattered light included, of a lossless isotropic slab.

    Density c of collisions in depth: c(t) = exp(-t) + integral of E1(|t - s|) c(s) / 2 (Milne), by collocation.
    """
    edges = np.linspace(0, thickness, cells + 1)
    middle = 0.5 * (edges[1:] + edges[:-1])
    distance = edges - middle[:, None]
    # the integral of E1(|x|) over a cell, from its antiderivative
    primitive = np.sign(distance) * (1 - scipy.special.expn(2, np.abs(distance)))
    collisions = np.linalg.solve(np.eye(cells) - 0.5 * np.diff(primitive, axis=1), np.exp(-middle))
    out = scipy.special.expn(3, thickness - edges)
    return np.exp(-thickness) + 0.5 * np.sum(collisions * np.diff(out))


@pytest.mark.slow
def test_a_naive_stop_is_biased_and_this_one_is_not():
    # what takes long gets lost if the walk stops after a number of steps and counts what is done
    assert abs(transmittance_of_isotropic_slab(1.0) - 0.65867) < 1e-5  # van de Hulst 1980
    stack, walkers, paths = lj.Stack([haze(0.0, 10.0)]), 4096, 16
    scene = Scene(stack, 1, jnp.dtype(jnp.float64))
    wi = tuple(jnp.full(walkers, component) for component in lj.direction(0.0, 0.0))
    words, index = key_words(KEY), jnp.arange(walkers, dtype=jnp.uint32)

    def record(total, step, owes):
        full, naive, steps = total
        ended = jnp.stack([step.ends, step.ends & step.escapes & (step.direction[2] < 0)])
        full = full + jnp.sum(ended & owes, axis=1)
        return full, naive + jnp.where(steps < 100, jnp.sum(ended, axis=1), 0), steps + 1

    zero = jnp.zeros(2, jnp.int64)
    start = (zero, zero, jnp.int32(0))
    walk = Walk(scene, wi, None, False)
    full, naive, _ = follow(walk, record, start, index, jnp.full(walkers, paths), words, jnp.dtype(jnp.float64))
    assert full[0] == walkers * paths  # each path that was owed, no other
    expected = transmittance_of_isotropic_slab(10.0)

    def z(counts):
        share = counts[1] / counts[0]
        return float((share - expected) / np.sqrt(share * (1 - share) / counts[0]))

    assert abs(z(full)) < 4
    assert z(naive) < -4


def test_sums_in_single_precision_do_not_drift():
    """Every path brings the same: the mean of many is that to rounding, whose error in a plain sum is 1e-5."""
    with jax.enable_x64(False):
        walk = lj.RandomWalk(paths=1 << 14, batch_size=1)
        found, _ = lj.albedo(lj.Stack([], lj.Lambertian(0.3)), WI.astype(jnp.float32), walk, key=KEY)
    np.testing.assert_allclose(found, np.float32(0.3), rtol=1e-6)


@pytest.mark.slow
def test_keys():
    stack = lj.Stack([lj.Interface(1.4, 0.3), haze(0.2, 1.0, 0.8)], lj.Lambertian(0.5))
    walk = lj.RandomWalk(paths=100)
    for function in (lj.evaluate, lj.evaluate_with_error):
        with pytest.raises(ValueError, match="key"):
            function(stack, WI, ABOVE, walk)
    with pytest.raises(ValueError, match="key"):
        lj.albedo(stack, WI, walk)
    first, again = (lj.evaluate(stack, WI, ABOVE, walk, key=jax.random.key(1)) for _ in range(2))
    assert first == again
    assert lj.evaluate(lj.prepare(stack, walk), WI, ABOVE, key=jax.random.key(1)) == first
    assert lj.evaluate(stack, WI, ABOVE, walk, key=jax.random.key(2)) != first
    assert (lj.evaluate(stack, jnp.stack([WI] * 2), ABOVE, walk, key=KEY)[0] != first).all()
    plain = lj.SingleScattering()
    np.testing.assert_array_equal(
        lj.evaluate(stack := lj.Stack(COLORED), WI, ABOVE, plain, key=KEY), lj.evaluate(stack, WI, ABOVE, plain)
    )


def test_errors_of_transports_that_have_none():
    with pytest.raises(ValueError, match="SingleScattering"):
        lj.evaluate_with_error(lj.Stack(tilt3()), WI, ABOVE, lj.SingleScattering())


def test_sides():
    walk = lj.RandomWalk(paths=50)
    opaque, open_stack = lj.Stack([haze(0.2, 1.0, 0.8)], lj.Lambertian(0.5)), lj.Stack([haze(0.2, 1.0, 0.8)])
    wi, wo = jnp.stack([WI, WI, BELOW, BELOW]), jnp.stack([ABOVE, BELOW, ABOVE, BELOW])

    def lit(stack, side):
        return (np.asarray(lj.evaluate(stack, wi, wo, walk, side=side, key=KEY))[:, 0] > 0).tolist()

    assert lit(opaque, "all") == lit(open_stack, "reflection") == [True, False, False, False]
    assert lit(open_stack, "transmission") == [False, True, True, False]
    assert lit(open_stack, "all") == [True] * 4
    flat = jnp.asarray([1.0, 0.0, 0.0])
    assert lj.evaluate(open_stack, flat, wo, walk, key=KEY).tolist() == [[0.0]] * 4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dtype", "stack", "facet_multiple_scattering"),
    [
        (
            np.float32,
            lj.Stack([lj.Interface(4.0, 1e-4), haze(0.999, 5.0, 0.5)], lj.Conductor(0.01, 20.0, 1e-4)),
            False,
        ),
        (np.float32, lj.Stack([haze(-0.999, 1e-6), lj.Interface(1.0, 1.0), EXTREME]), True),
        (np.float64, lj.Stack([haze(-0.999, 1e-6), lj.Interface(0.25, 1e-4), EXTREME]), False),
    ],
)
def test_the_edges_of_the_box_are_finite(dtype, stack, facet_multiple_scattering):
    grazing = lj.direction(jnp.asarray([np.pi / 2 - 1e-6, 0.0, 0.5]), 0.3).astype(dtype)
    walk = lj.RandomWalk(paths=200, facet_multiple_scattering=facet_multiple_scattering)
    for wo in (grazing, grazing * jnp.asarray([-1, -1, 1], dtype)):
        values, errors = lj.evaluate_with_error(stack, grazing, wo, walk, key=KEY)
        assert values.dtype == dtype
        assert np.isfinite(values).all()
        assert np.isfinite(errors).all()
        assert (values >= 0).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "stack",
    [
        lj.Stack([haze(0.5, 1.0, 0.9)]),
        lj.Stack([lj.Interface(1.5, 0.4)], lj.Lambertian(0.5)),
    ],
)
def test_samples_weigh_the_albedo(stack):
    walk = lj.RandomWalk(paths=16)
    wo, density, weight = lj.sample(stack, jnp.broadcast_to(WI, (20_000, 3)), KEY, walk)
    np.testing.assert_allclose(density[:50], lj.pdf(stack, WI, wo[:50], walk), rtol=1e-9)
    x, w = np.polynomial.legendre.leggauss(100)
    phi = 2 * np.pi * (np.arange(100) + 0.5) / 100
    grid = lj.direction(np.arccos(x)[:, None], phi)
    total = np.sum(np.asarray(lj.pdf(stack, WI, grid, walk)) * w[:, None] * 2 * np.pi / 100)
    np.testing.assert_allclose(total, 1.0, atol=2e-3)
    near, far = lj.albedo(stack, WI, lj.RandomWalk(paths=100_000), key=KEY)
    mean, error = np.mean(weight), np.std(weight) / np.sqrt(len(weight))
    assert abs(mean - float(near[0] + far[0])) < 4 * np.hypot(error, 0.5 / np.sqrt(100_000))


def test_refusals():
    for bad in ({"paths": 1}, {"batch_size": 0}, {"facet_multiple_scattering": "none"}, {"orders": "second"}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            lj.RandomWalk(**bad)
