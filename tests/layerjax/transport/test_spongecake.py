"""SpongeCake with multiple scattering: what holds whatever the network has learned, and how exact it is."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from benchmarks.measuring.operations import count
from layerjax.tables import load
from layerjax.transport.spongecake.layers import pair_of
from tests.helpers.box import POINTS, draw
from tests.helpers.sampling import DRAWS, SIGNIFICANCE, chi_square

FLAKES = lj.Medium(2.0, [0.95, 0.8, 0.4], lj.SGGX("surface", 0.4, (0.3, 0.1, 0.9)), f0=0.6)
FIBERS = lj.Medium(1.5, 0.9, lj.SGGX("fiber", 0.3, (1.0, 0.2, 0.0)))
HAZE = lj.Medium([3.0, 2.0, 1.0], 1.0, lj.HenyeyGreenstein(0.5))
STACKS = {
    "flakes": lj.Stack([FLAKES]),
    "fibers": lj.Stack([FIBERS]),
    "haze": lj.Stack([HAZE]),
    "fibers over haze": lj.Stack([FIBERS, HAZE]),
    "flakes over fibers": lj.Stack([FLAKES, FIBERS]),
}
CAKE, FIRST, TRUTH = lj.SpongeCake(), lj.SingleScattering(), lj.AddingDoubling()
PAIRS = 600
"""Of directions, as many wherever it does not matter how many: a program serves every test of a stack."""

OFF = {1: 0.02, 2: 0.06}
"""By how much albedos of lossless slabs are off for 5 in 100 materials never seen, as SpongeCake's docstring has it."""


def pairs(n=PAIRS, seed=3):
    random = np.random.default_rng(seed)
    theta, phi = np.arccos(random.uniform(-1, 1, (2, n))), random.uniform(-np.pi, np.pi, (2, n))
    return lj.direction(theta[0], phi[0]), lj.direction(theta[1], phi[1])


@pytest.mark.parametrize("name", ["fibers", pytest.param("flakes over fibers", marks=pytest.mark.slow)])
def test_reciprocal_positive_and_by_sides(name):
    stack, (wi, wo) = STACKS[name], pairs()
    values = lj.evaluate(stack, wi, wo, CAKE)
    np.testing.assert_allclose(values, lj.evaluate(stack, wo, wi, CAKE), rtol=1e-10)
    assert (values > lj.evaluate(stack, wi, wo, FIRST)).all()
    same = wi[:, 2] * wo[:, 2] > 0
    for side, chosen in (("reflection", same & (wi[:, 2] > 0)), ("transmission", ~same)):
        found = lj.evaluate(stack, wi, wo, CAKE, side=side)
        np.testing.assert_allclose(found, np.where(chosen[:, None], values, 0.0), rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fibers over haze", "flakes"])
def test_upside_down_and_lit_from_below_is_the_same(name):
    def turned(medium):
        axis = getattr(medium.phase, "axis", None)
        if axis is None:
            return medium
        return eqx.tree_at(lambda m: m.phase.axis, medium, axis * jnp.array([1.0, 1.0, -1.0]))

    stack, (wi, wo) = STACKS[name], pairs()
    over = lj.Stack([turned(medium) for medium in reversed(stack.layers)])
    flip = np.array([1.0, 1.0, -1.0])
    np.testing.assert_allclose(
        lj.evaluate(stack, wi, wo, CAKE), lj.evaluate(over, wi * flip, wo * flip, CAKE), rtol=1e-9
    )


@pytest.mark.slow
def test_turned_about_the_normal_is_the_same():
    turn = np.array([[np.cos(1.1), -np.sin(1.1), 0.0], [np.sin(1.1), np.cos(1.1), 0.0], [0.0, 0.0, 1.0]])
    stack, (wi, wo) = STACKS["flakes over fibers"], pairs()
    rotated = eqx.tree_at(
        lambda s: [layer.phase.axis for layer in s.layers], stack, [turn @ layer.phase.axis for layer in stack.layers]
    )
    np.testing.assert_allclose(
        lj.evaluate(stack, wi, wo, CAKE), lj.evaluate(rotated, wi @ turn.T, wo @ turn.T, CAKE), rtol=1e-9
    )


@pytest.mark.parametrize("name", ["haze", pytest.param("flakes over fibers", marks=pytest.mark.slow)])
def test_white_where_nothing_absorbs(name):
    """As exact as 95 of 100 materials never seen; what absorbs much is left as it is learned."""
    medium = STACKS[name].layers
    white = lj.Stack([lj.Medium(jnp.mean(m.thickness), 1.0, m.phase) for m in medium])
    theta = np.deg2rad([0.0, 30.0, 50.0, 70.0, 80.0])
    for light in (lj.direction(theta, 0.4), lj.direction(np.pi - theta, 2.0)):
        energy = sum(lj.albedo(white, light, CAKE, nodes=16)) + lj.unscattered(white, light)
        np.testing.assert_allclose(energy, 1.0, atol=OFF[len(medium)])
    wi, wo = pairs()
    np.testing.assert_allclose(lj.evaluate(white, wi, wo, CAKE), lj.evaluate(white, wo, wi, CAKE), rtol=1e-10)
    ready = lj.prepare(lj.Stack([lj.Medium(m.thickness, 0.2, m.phase) for m in medium]), CAKE)
    lobes = eqx.tree_at(lambda ready: ready.state.second.energy_correction, ready, None)
    np.testing.assert_allclose(lj.evaluate(ready, wi, wo), lj.evaluate(lobes, wi, wo), rtol=5e-3)


@pytest.mark.slow
def test_upright_axes_are_no_axes():
    """Terms that turn with an axis vanish with its tilt: 1e-9 is its sine."""
    wi, wo = pairs()
    level, upright, tilted = (
        lj.evaluate(lj.Stack([lj.Medium(2.0, 0.9, lj.SGGX("fiber", 0.3, axis)), HAZE]), wi, wo, CAKE)
        for axis in (None, np.array([0.0, 0.0, 1.0]), np.array([1e-9, 0.0, 1.0]))
    )
    np.testing.assert_allclose(upright, level, rtol=1e-10)
    np.testing.assert_allclose(tilted, level, rtol=1e-7)


def test_energies_of_channels_are_apart():
    """Each channel's energy is right as if it were alone, but for the shape of the lobe, which follows their mean."""
    stack = lj.Stack([lj.Medium([6.0, 1.0], 1.0, lj.HenyeyGreenstein(0.5))])
    light = lj.direction(np.deg2rad([0.0, 30.0, 50.0, 70.0, 80.0]), 0.4)
    np.testing.assert_allclose(sum(lj.albedo(stack, light, CAKE)) + lj.unscattered(stack, light), 1.0, atol=OFF[1])


@pytest.mark.slow
def test_gray_channels_are_one():
    wi, wo = pairs()
    one = lj.evaluate(lj.Stack([lj.Medium(2.0, 0.8, FLAKES.phase, f0=0.6)]), wi, wo, CAKE)
    three = lj.evaluate(lj.Stack([lj.Medium([2.0] * 3, [0.8] * 3, FLAKES.phase, f0=[0.6] * 3)]), wi, wo, CAKE)
    np.testing.assert_allclose(np.broadcast_to(one, three.shape), three, rtol=1e-10)


def test_nothing_is_added_where_nothing_scatters_twice():
    wi, wo = pairs()
    black, base = lj.Stack([lj.Medium(2.0, 0.0)], lj.Lambertian(0.5)), lj.Stack([], lj.Lambertian(0.5))
    for stack in (black, base):
        np.testing.assert_array_equal(lj.evaluate(stack, wi, wo, CAKE), lj.evaluate(stack, wi, wo, FIRST))
    thin = lj.Stack([lj.Medium(1e-4, 1.0, lj.SGGX("surface", 0.5))])
    first = lj.evaluate(thin, wi, wo, FIRST)
    slanting = np.minimum(np.abs(wi[:, 2]), np.abs(wo[:, 2])) < 0.05  # where even this is thick
    added = np.asarray(lj.evaluate(thin, wi, wo, CAKE) - first) / np.asarray(first)
    assert np.max(added[~slanting]) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("name", ["flakes", "fibers over haze"])
def test_error_is_what_the_tables_say(name):
    """Within the 95th percentile of the held-out materials of the record, and well below the first order alone."""
    record = load("spongecake")[f"{len(STACKS[name].layers)}-error"]
    random = np.random.default_rng(1)
    cosines = np.sqrt(random.uniform(0.01, 1.0, (2, PAIRS)))
    theta, phi = np.arccos(cosines * np.where(np.arange(PAIRS) % 2, 1, [[1], [-1]])), random.uniform(0, 6.3, (2, PAIRS))
    wi, wo = lj.direction(theta[0], phi[0]), lj.direction(theta[1], phi[1])
    values, truth, first = (np.asarray(lj.evaluate(STACKS[name], wi, wo, how)) for how in (CAKE, TRUTH, FIRST))

    def norm(x):
        return np.sqrt(np.mean(x**2, axis=0))

    assert (norm(values - truth) < record[0, 1] * norm(truth)).all()
    assert (norm(values - truth) < 0.7 * norm(first - truth)).all()


@pytest.mark.parametrize(
    ("name", "theta", "proposal"),
    [
        ("flakes", 0.7, "first"),
        pytest.param("flakes", 2.3, "both", marks=pytest.mark.slow),
        pytest.param("haze", 0.7, "both", marks=pytest.mark.slow),
    ],
)
def test_samples(name, theta, proposal):
    stack, wi, how = STACKS[name], lj.direction(theta, 0.4), lj.SpongeCake(proposal=proposal)
    towards = jnp.broadcast_to(wi, (DRAWS, 3))
    wo, _, weight = lj.sample(stack, towards, jax.random.key(7), how)
    probability, total = chi_square(wo, lambda w: lj.pdf(stack, wi, w, how))
    assert probability > SIGNIFICANCE
    np.testing.assert_allclose(total, 1.0, atol=4e-3)
    mean, error = np.mean(weight, axis=0), np.std(weight, axis=0) / np.sqrt(DRAWS)
    # the albedo is the same however it is sampled
    np.testing.assert_array_less(np.abs(mean - sum(lj.albedo(stack, wi, CAKE))), 4.5 * error + 3e-3)


BOXES = {
    "flakes": lambda p: [lj.Medium(p["thickness"], p["albedo"], lj.SGGX("surface", p["alpha"], p["axis"]), p["f0"])],
    "fibers over haze": lambda p: [
        lj.Medium(1.0 + p["thickness"], p["f0"], lj.SGGX("fiber", p["alpha"], p["axis"])),
        lj.Medium(p["thickness"], p["albedo"], lj.HenyeyGreenstein(p["g"])),
    ],
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        ("fibers over haze", jnp.float32),
        ("flakes", jnp.float64),
    ],
)
def test_finite_over_the_box(name, dtype):
    parameters, wi, wo = draw(5)
    few = slice(None, None, 10)
    parameters = {key: jnp.asarray(value[few], dtype) for key, value in parameters.items()}
    parameters["thickness"] = (
        parameters["thickness"] * (1.0 - 1e-3) if name == "fibers over haze" else parameters["thickness"]
    )

    def value(p, wi, wo):
        return jnp.sum(lj.evaluate(lj.Stack(BOXES[name](p)), wi, wo, CAKE))

    found, slopes = jax.jit(jax.vmap(jax.value_and_grad(value)))(
        parameters, jnp.asarray(wi[few], dtype), jnp.asarray(wo[few], dtype)
    )
    assert found.dtype == dtype
    assert found.shape == (POINTS // 10,)
    assert np.isfinite(found).all()
    assert (np.asarray(found) >= 0).all()
    for key, slope in slopes.items():
        assert np.isfinite(slope).all(), key


def test_more_than_two_media_become_a_pair():
    coat, thick = lj.Medium(0.05, 1.0, lj.SGGX("surface", 0.1)), lj.Medium(4.0, 0.9, lj.HenyeyGreenstein(0.3))
    top, bottom = pair_of((coat, FIBERS, thick))
    assert eqx.tree_equal(top.phase, FIBERS.phase)
    assert bottom is thick
    assert float(top.thickness) > float(FIBERS.thickness)
    one = lj.Medium(1.0, 0.9, lj.HenyeyGreenstein(0.3))
    wi, wo = pairs()
    three = lj.evaluate(lj.Stack([one, one, FIBERS]), wi, wo, CAKE)
    two = lj.evaluate(lj.Stack([lj.Medium(2.0, 0.9, lj.HenyeyGreenstein(0.3)), FIBERS]), wi, wo, CAKE)
    np.testing.assert_allclose(three, two, rtol=1e-9)


def test_known_media_become_a_pair_while_a_program_is_traced_too():
    media = (HAZE, FIBERS, FLAKES)
    jax.make_jaxpr(lambda wi, wo: lj.evaluate(lj.Stack(media), wi, wo, CAKE))(*pairs())
    found = []
    jax.make_jaxpr(lambda _: found.extend(pair_of(media)))(1.0)
    assert eqx.tree_equal(tuple(found), pair_of(media))


def test_refusals():
    with pytest.raises(ValueError, match=r"layers\[0\]: SpongeCake carries no Interface.*AddingDoubling"):
        lj.prepare(lj.Stack([lj.Interface(1.5, 0.1), HAZE]), CAKE)
    with pytest.raises(ValueError, match="SpongeCake puts 3 media together to 2 by their numbers, which are traced"):
        jax.jit(lambda t: lj.evaluate(lj.Stack([lj.Medium(t), FIBERS, HAZE]), *pairs(2), CAKE))(1.0)
    with pytest.raises(ValueError, match=r"SpongeCake\.proposal: 'second' is not one of 'first', 'both'"):
        lj.SpongeCake(proposal="second")


@pytest.mark.parametrize("name", STACKS)
@pytest.mark.parametrize("side", ["all", "reflection"])
def test_costs_one_more_lobe_and_a_constant(name, side):
    """Twice the operations of single scattering, what picks weights by side and channel, and a polynomial of either
    direction: 3.4 times at most.

    The bar, 2.2, is one of time, which is not asserted.
    """
    wi, wo = pairs()

    def operations(how):
        prepared = lj.prepare(STACKS[name], how)
        return sum(count(lambda wi, wo: lj.evaluate(prepared, wi, wo, side=side), wi, wo).values())

    assert operations(CAKE) < 3.4 * operations(FIRST)


@pytest.mark.slow
def test_albedo_of_upright_fibers_at_normal_incidence_in_float32():
    """Whatever alpha rounds to, nodes find a frame around the normal; 1e-3 is the error of the rule at 16 nodes."""
    wi, alphas = jnp.asarray([0.0, 0.0, 1.0], jnp.float32), jnp.linspace(0.2, 0.9, 100, dtype=jnp.float32)

    def energy(alpha, dtype):
        stack = lj.Stack([lj.Medium(jnp.asarray(2.0, dtype), 1.0, lj.SGGX("fiber", alpha.astype(dtype)))])
        return jnp.stack(lj.albedo(stack, wi.astype(dtype), CAKE, nodes=16))[:, 0]

    single, double = (
        jax.jit(jax.vmap(lambda alpha, dtype=dtype: energy(alpha, dtype)))(alphas)
        for dtype in (jnp.float32, jnp.float64)
    )
    assert single.dtype == jnp.float32  # quadrature keeps the precision that it is asked in
    np.testing.assert_allclose(single, double, atol=1e-3)
