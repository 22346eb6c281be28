"""ENDF beside a Monte Carlo of the same facets, its limits, its sampler, and what it refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from benchmarks.measuring.operations import count
from benchmarks.peers import endf_walk as endf_truth
from layerjax.transport.endf.chains import Coat, LowerSide, Options, UpperSide, reflections
from tests.helpers.endf import OUTSIDE, PAPER, RECIPROCAL
from tests.helpers.sampling import DRAWS, SIGNIFICANCE, chi_square

SURFACE = lj.ENDF(bounces=0)
MIRROR = 0.01, 20.0  # reflects all but 1e-4
GLAZE = lj.Medium([0.1, 0.4, 1.0], 0.0)
METAL = lj.Conductor([0.2, 0.9, 1.1], [3.9, 2.5, 2.4], 0.25)
STACKS = {
    "coat": lj.Stack([lj.Interface(1.5, 0.3), GLAZE], METAL),
    "slab": lj.Stack([lj.Interface(1.5, 0.2), GLAZE, OUTSIDE]),
    "tilted flakes in a slab": lj.Stack(
        [lj.Interface(1.4, 0.3), lj.Medium(0.5, 0.0, lj.SGGX("fiber", 0.2, (1.0, 0.3, 0.5))), OUTSIDE]
    ),
    "interface": lj.Stack([lj.Interface(1.5, 0.4)]),
    "interface downward": lj.Stack([lj.Interface(0.7, 0.4)]),
    "conductor": lj.Stack([GLAZE], METAL),
}


def width(kappa):
    return np.sqrt(2.0 / kappa)


def on_mirror(above, below, ior):
    top = lj.Interface(ior, width(above), distribution="vmf")
    return lj.Stack([top], lj.Conductor(*MIRROR, width(below), distribution="vmf"))


def walked(above, below, degrees, ior, paths, **options):
    reflectance = endf_truth.conductor(MIRROR[0] / ior, MIRROR[1] / ior)
    return endf_truth.coat(ior, above, below, degrees, paths, reflectance=reflectance, **options)


def one_bounce(above, below, degrees, ior, transport):
    """Its energy, and its values for given directions."""
    stack, wi = on_mirror(above, below, ior), lj.direction(np.radians(degrees), 0.0)
    energy = lj.albedo(stack, wi, transport, nodes=24)[0][0] - lj.albedo(stack, wi, SURFACE, nodes=24)[0][0]
    return float(energy), lambda wo: lj.evaluate(stack, wi, wo, transport) - lj.evaluate(stack, wi, wo, SURFACE)


# no masking, a perfect mirror: kappa above and below, degrees, index; energy and mean resultant length (8e6 paths)
UNMASKED = {
    (1e4, 1e3, 60.0, 1.5): (0.773319, 0.9854599),
    (1e2, 1e2, 30.0, 1.5): (0.847674, 0.9056337),
    (1e3, 30.0, 0.0, 1.5): (0.780035, 0.7651488),
    (1e4, 10.0, 45.0, 2.0): (0.216190, 0.684762),
}


@pytest.mark.parametrize("case", UNMASKED)
def test_the_monte_carlo_itself(case):
    above, below, degrees, ior = case
    (found,) = endf_truth.coat(ior, above, below, degrees, 200_000, masked=False)
    for (value, error), expected in zip((found.energy, found.unweighted), UNMASKED[case], strict=True):
        assert abs(value - expected) < 4.5 * error + 1e-5


def test_the_monte_carlo_counts_bounces():
    smooth = endf_truth.coat(1.5, 1e6, 1e6, 45.0, 50_000, bounces=3)
    np.testing.assert_allclose([order.energy[0] for order in smooth], [0.9020, 0.0453, 0.0023], atol=6e-5)
    rough = endf_truth.coat(1.5, 1e3, 10.0, 0.0, 100_000, bounces=3)
    np.testing.assert_allclose([order.energy[0] for order in rough], [0.457, 0.148, 0.080], atol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("case", [(1e4, 1e3, 75.0, 1.5), (1e2, 1e2, 60.0, 1.5), (1e4, 10.0, 0.0, 2.0)])
def test_the_monte_carlo_is_what_the_walk_finds(case):
    """Bounce by bounce: a path has three events for the first, and two more for every other."""
    above, below, degrees, ior = case
    wi = lj.direction(np.radians(degrees), 0.0)
    seen = lj.goniophotometer(
        on_mirror(above, below, ior), wi, key=jax.random.key(0), paths=1 << 19, polar=1, azimuth=1
    )
    for bounce, order in enumerate(walked(*case, 500_000, bounces=3)):
        energy, error = order.energy
        place = 0, 2 + 2 * bounce, 0
        assert abs(seen.orders[place] - energy) < 4.5 * np.hypot(seen.orders_error[place], error)


# kappa above and below, degrees, index; energy by "paper" and "reciprocal"; distance of the shape of the latter
TABLE = {
    (1e4, 1e3, 75.0, 1.5): (0.535, 0.398, 0.033),
    (1e2, 1e2, 60.0, 1.5): (0.775, 0.547, 0.046),
    (1e4, 10.0, 0.0, 2.0): (0.563, 0.237, 0.057),
    (1e3, 30.0, 60.0, 1.5): (0.803, 0.477, 0.038),
}
MORE = {
    (1e6, 1e3, 60.0, 1.5): (0.829, 0.776, 0.028),
    (1e4, 1e3, 0.0, 1.5): (0.922, 0.922, 0.026),
    (1e4, 1e3, 30.0, 1.5): (0.919, 0.918, 0.027),
    (1e4, 1e3, 60.0, 1.5): (0.829, 0.774, 0.028),
    (1e4, 1e3, 85.0, 1.5): (0.395, 0.151, 0.041),
    (1e3, 1e3, 75.0, 1.5): (0.535, 0.386, 0.041),
    (1e3, 1e3, 85.0, 1.5): (0.450, 0.150, 0.151),
    (1e4, 1e2, 0.0, 1.5): (0.922, 0.918, 0.027),
    (1e4, 1e2, 60.0, 1.5): (0.788, 0.568, 0.033),
    (1e2, 1e2, 30.0, 1.5): (0.917, 0.864, 0.037),
    (1e2, 1e2, 75.0, 1.5): (0.755, 0.345, 0.13),
    (1e3, 30.0, 0.0, 1.5): (0.908, 0.781, 0.031),
    (30.0, 1e6, 30.0, 1.5): (0.919, 0.931, 0.086),
    (30.0, 1e6, 60.0, 1.5): (0.780, 0.563, 0.19),
    (10.0, 1e6, 0.0, 1.5): (0.922, 0.950, 0.14),
    (10.0, 1e6, 60.0, 1.5): (0.731, 0.455, 0.44),
    (1e4, 10.0, 60.0, 2.0): (0.704, 0.199, 0.061),
}
TOP_IS_ROUGH = 0.03  # energy that the reciprocal form makes up to 75 degrees and below kappa = 1e4 above


def reaches_the_table(case, expected, paths):
    (truth,) = walked(*case, paths)
    for transport, energy in zip((PAPER, RECIPROCAL), expected[:2], strict=True):
        found, values = one_bounce(*case, transport)
        np.testing.assert_allclose(found, energy, atol=1.5e-3)
    energy, error = truth.energy
    assert abs(found - energy) < (0.004 if case[0] >= 1e4 else TOP_IS_ROUGH if case[0] >= 1e2 else 0.12) + 4 * error
    lobe = endf_truth.lobe(truth)
    assert lobe.distance(values) < expected[2] + lobe.floor


@pytest.mark.parametrize("case", TABLE)
def test_energy_and_shape_of_one_bounce(case):
    reaches_the_table(case, TABLE[case], 100_000)


@pytest.mark.slow
@pytest.mark.parametrize("case", MORE)
def test_energy_and_shape_of_one_bounce_everywhere(case):
    reaches_the_table(case, MORE[case], 1_000_000)


@jax.jit
def chain_over_a_mirror(below, wi, wo):
    """One bounce under a smooth coat, without masking, over a mirror that reflects all."""
    ideal = LowerSide(below, (jnp.asarray(1e-3),), (jnp.asarray(1e9),))
    coat = Coat(UpperSide(jnp.asarray(1.5), jnp.asarray(1e15)), (), ideal)
    options = Options(1, "reciprocal", None)
    return reflections(coat, options, tuple(wi), tuple(jnp.moveaxis(wo, -1, 0)))[1][0]


# kappa below, degrees: energy under a smooth coat, and the value at the mirror direction
SMOOTH = {
    (1e3, 30.0): (0.91800196, 18.29483037),
    (1e3, 60.0): (0.77575539, 22.02734268),
    (1e2, 30.0): (0.87095218, 1.84611470),
    (1e2, 60.0): (0.56789520, 2.22275913),
}


@pytest.mark.parametrize("case", SMOOTH)
def test_a_smooth_coat_is_exact(case):
    kappa, degrees = case
    energy, value = SMOOTH[case]
    wi = lj.direction(np.radians(degrees), 0.0)
    x, w = np.polynomial.legendre.leggauss(400)
    theta, phi = 0.25 * np.pi * (x + 1), 2 * np.pi * (np.arange(400) + 0.5) / 400
    weight = (0.25 * np.pi * w * np.sin(theta) * np.cos(theta))[:, None] * 2 * np.pi / 400
    values = chain_over_a_mirror(kappa, wi, lj.direction(theta[:, None], phi))
    np.testing.assert_allclose(np.sum(values * weight), energy, atol=2e-8)
    at_mirror = chain_over_a_mirror(kappa, wi, np.array(wi * jnp.array([-1.0, -1.0, 1.0]))[None, None])
    np.testing.assert_allclose(at_mirror, value, atol=1e-8)


def anywhere(number, seed, least=0.02):
    random = np.random.default_rng(seed)
    z = random.uniform(least, 1, number) * random.choice([-1, 1], number)
    phi = random.uniform(-np.pi, np.pi, number)
    return np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=-1)


@pytest.mark.parametrize("name", ["coat", "slab", *(pytest.param(n, marks=pytest.mark.slow) for n in list(STACKS)[2:])])
def test_reciprocity_to_rounding(name):
    stack = STACKS[name]
    wi, wo = anywhere(500, 1), anywhere(500, 2)
    below = 1.0 if stack.base is not None or len(stack.layers) > 1 else float(stack.layers[-1].ior)
    prepared = lj.prepare(stack, lj.ENDF(bounces=2))

    def reduced(a, b):
        return np.asarray(lj.evaluate(prepared, a, b)) / np.where(b[:, 2:] > 0, 1.0, below) ** 2

    forward, backward = reduced(wi, wo), reduced(wo, wi)
    np.testing.assert_allclose(forward, backward, rtol=1e-9, atol=1e-13)
    sides = wi[:, 2] * wo[:, 2] > 0
    lit = forward[:, 0] > 0
    assert lit[(wi[:, 2] > 0) & (wo[:, 2] > 0)].all()
    assert lit[~sides].any() == lit[wi[:, 2] < 0].any() == (stack.base is None)


def test_the_form_of_the_paper_is_not_reciprocal():
    a, b = lj.direction(np.radians([30.0, 55.0, 70.0]), 0.0), lj.direction(np.radians([35.0, 65.0, 80.0]), np.pi)
    stack = on_mirror(1e4, 1e3, 1.5)
    there, back = (np.asarray(lj.evaluate(stack, *pair, PAPER)) for pair in ((a, b), (b, a)))
    apart = np.abs(there - back) / (0.5 * (there + back))
    np.testing.assert_allclose(apart[:, 0], [0.05, 0.31, 1.35], atol=0.03)


CASES = [("coat", RECIPROCAL, 0.6)]
MORE_CASES = [(n, t, a) for n in STACKS for t in (RECIPROCAL, lj.ENDF(2, "paper", "paper")) for a in (0.6, 1.45, 2.3)]
MORE_CASES = [(n, t, a) for n, t, a in MORE_CASES if a < 2 or STACKS[n].base is None]


def samples_weights_and_albedo(name, transport, theta):
    prepared = lj.prepare(STACKS[name], transport)
    wi = lj.direction(theta, 0.4)
    wo, density, weight = lj.sample(prepared, jnp.broadcast_to(wi, (DRAWS, 3)), jax.random.key(7))
    leaves = np.asarray(wo[:, 2] != 0)
    assert not density[~leaves].any()
    assert not weight[~leaves].any()
    probability, total = chi_square(wo[leaves], lambda w: lj.pdf(prepared, wi, w))
    assert probability > SIGNIFICANCE
    np.testing.assert_allclose(total, np.mean(leaves), atol=4e-3)
    reflected, transmitted = lj.albedo(prepared, wi, nodes=24)
    mean, error = np.mean(weight, axis=0), np.std(weight, axis=0) / np.sqrt(DRAWS)
    np.testing.assert_array_less(np.abs(mean - reflected - transmitted), 4.5 * error + 3e-3 * mean)
    assert np.max(weight) < 12.0
    assert (transmitted > 0).all() == (STACKS[name].base is None)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "transport", "theta"), CASES)
def test_samples_weights_and_albedo(name, transport, theta):
    samples_weights_and_albedo(name, transport, theta)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "transport", "theta"), MORE_CASES)
def test_samples_weights_and_albedo_everywhere(name, transport, theta):
    samples_weights_and_albedo(name, transport, theta)


def test_where_nothing_is_all_draws_follow_the_cosine():
    wo, density, weight = lj.sample(lj.Stack([GLAZE]), lj.direction(0.7, jnp.zeros(9)), jax.random.key(0), lj.ENDF())
    np.testing.assert_allclose(density, wo[:, 2] / np.pi, rtol=1e-12)
    assert not weight.any()


@pytest.mark.slow
def test_what_is_not_there_costs_nothing():
    wi, wo = lj.direction(jnp.linspace(0.1, 1.4, 50), 0.0), lj.direction(jnp.linspace(0.2, 1.3, 50), 2.0)

    def program(stack, transport=RECIPROCAL, **options):
        return count(lambda wi, wo: lj.evaluate(stack, wi, wo, transport, **options), wi, wo)

    coat, metal = lj.Interface(1.5, 0.2), lj.Conductor(0.2, 3.9, 0.1)
    bare, clear, tinted = (program(lj.Stack(layers, metal)) for layers in ([], [coat], [coat, lj.Medium(0.5, 0.0)]))
    assert program(lj.Stack([coat, lj.Medium(0.0, 0.5)], metal)) == clear
    assert program(lj.Stack([lj.Interface(1.0, 0.5), coat], metal)) == clear
    surface = program(lj.Stack([coat, lj.Medium(0.5, 0.0)], metal), SURFACE)
    assert surface["exponential"] == bare["exponential"] < clear["exponential"]
    assert sum(bare.values()) < sum(clear.values()) < sum(tinted.values())
    coloured = program(lj.Stack([coat, GLAZE], metal))
    assert coloured["exponential"] == tinted["exponential"] + 2
    assert sum(clear.values()) < sum(program(lj.Stack([coat], metal), lj.ENDF(2)).values())
    slab = lj.Stack([coat, OUTSIDE])
    parts = [program(slab, side=side) for side in ("reflection", "transmission", "all")]
    assert sum(parts[0].values()) < sum(parts[2].values())
    assert sum(parts[1].values()) < sum(parts[2].values())
    assert not any(program(lj.Stack([coat], metal), side="transmission").values())


COAT = lj.Interface(1.5, 0.1)
REFUSED = {
    r"layers\[1\]: ENDF carries no Medium that scatters.*AddingDoubling and RandomWalk do": lj.Stack(
        [COAT, lj.Medium(1.0, 0.5)], METAL
    ),
    r"layers\[0\]: ENDF carries a Medium only between": lj.Stack([lj.Medium(1.0, 0.0), COAT], METAL),
    r"layers\[2\]: ENDF carries a Medium only between": lj.Stack([COAT, OUTSIDE, lj.Medium(1.0, 0.0)]),
    r"layers\[1\]: ENDF carries one Interface over a base": lj.Stack([COAT, lj.Interface(1.2, 0.1)], METAL),
    r"layers\[3\]: ENDF carries one Interface over a base, and two": lj.Stack([COAT, COAT, OUTSIDE, COAT]),
    r"layers\[1\].ior: ENDF carries a slab only in one surrounding": lj.Stack([COAT, lj.Interface(1.2, 0.1)]),
    r"base: ENDF carries no Lambertian .*Statistical, AddingDoubling": lj.Stack([COAT], lj.Lambertian(0.5)),
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_it_cannot_carry_is_refused_by_name(message):
    with pytest.raises(ValueError, match=message):
        lj.prepare(REFUSED[message], RECIPROCAL)


@pytest.mark.parametrize("options", [{"bounces": -1}, {"bounces": 1.0}, {"form": "literal"}, {"masking": "none"}])
def test_options_are_checked(options):
    with pytest.raises(ValueError, match=f"ENDF.{next(iter(options))}"):
        lj.ENDF(**options)
