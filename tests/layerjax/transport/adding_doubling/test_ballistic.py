"""Light that passes a slab by two refractions alone: against the walk, however narrow, and with its derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.directions import split
from layerjax.evaluate import evaluate_known
from layerjax.transport.adding_doubling.ballistic import ballistic_paths, evaluate_ballistic
from layerjax.transport.known_directions import known_directions

SOLVER = lj.AddingDoubling(nodes=6, modes=6)
THETA_I, THETA_O, PHI = (
    np.radians([0.0, 20.0, 0.0, 45.0, 150.0, 180.0]),
    np.radians([147.0, 152.0, 170.0, 128.0, 20.0, 33.0]),
    np.array([0.0, 0.1, 2.0, 0.0, 0.1, 1.0]),
)
WI, WO = lj.direction(THETA_I, 0.0), lj.direction(THETA_O, PHI)
KNOWN = known_directions(WI, WO)


def slab(ior, alpha, ior_below, alpha_below):
    dye = lj.Medium(0.5, [0.0, 0.6], lj.HenyeyGreenstein(0.3))
    return lj.Stack([lj.Interface(ior, alpha), dye, lj.Interface(ior_below, alpha_below)])


SLABS = [
    (1.5, 0.05, 1.2, 0.1),
    *(pytest.param(n, marks=pytest.mark.slow) for n in ((1.29, 0.24, 1.9, 0.75), (0.8, 0.3, 1.0, 0.02))),
]


@pytest.mark.slow
@pytest.mark.parametrize("numbers", SLABS)
def test_agrees_with_the_walk(numbers):
    """4 standard errors, and for the solver at 6 nodes 1e-3 of the values and of a tenth of the largest."""
    stack = slab(*numbers)
    values = np.asarray(lj.evaluate(stack, WI, WO, SOLVER))
    walked, errors = map(
        np.asarray, lj.evaluate_with_error(stack, WI, WO, lj.RandomWalk(paths=1 << 13), key=jax.random.key(1))
    )
    assert np.all(np.abs(values - walked) < 4.0 * errors + 1e-3 * (walked + 0.1 * np.max(walked)))


@pytest.mark.slow
@pytest.mark.parametrize("above", [(), (lj.Medium(0.4, 0.5),)], ids=["slab", "haze on it"])
def test_is_the_same_beside_tables(above):
    """Off tables of 12 nodes, to 2e-3 of the values and of a tenth of the largest: as along known directions at 24
    nodes; with haze outside light is never followed, and the walk tells what is true."""
    stack = lj.Stack([*above, *slab(1.5, 0.05, 1.2, 0.1).layers])
    read = np.asarray(lj.evaluate(lj.prepare(stack, lj.AddingDoubling(nodes=12)), WI, WO))
    if above:
        exact, errors = map(
            np.asarray, lj.evaluate_with_error(stack, WI, WO, lj.RandomWalk(paths=1 << 13), key=jax.random.key(1))
        )
    else:
        exact = np.asarray(lj.evaluate(stack, WI, WO, lj.AddingDoubling(nodes=24)))
        errors = np.zeros_like(exact)
    assert np.all(np.abs(read - exact) < 4.0 * errors + 2e-3 * (exact + 0.1 * np.max(exact)))


@pytest.mark.slow
@pytest.mark.parametrize("reverse", [False, True])
def test_pairs_on_one_side_are_zero_and_change_no_others(reverse):
    """Whatever they stand among, values and derivatives of the others stay; without any that cross there are zeros.
    Derivatives are those of differences."""
    wi, wo = jnp.tile(WI, (40, 1)), jnp.tile(WO, (40, 1))  # more than one chunk of pairs
    same_side = jnp.arange(len(wi)) < len(wi) // 2
    mixed = jnp.where(same_side[:, None], wi, wo)

    def values(alpha, wo):
        return evaluate_ballistic(ballistic_paths(slab(1.5, alpha, 1.2, 0.1))[0], split(wi), split(wo))[0]

    compiled = jax.jit(lambda alpha, wo: (values(alpha, wo), jax.jacfwd(values)(alpha, wo)))
    ahead, behind = (compiled(0.05 + step, wo)[0] for step in (1e-6, -1e-6))
    difference = (ahead - behind) / 2e-6
    np.testing.assert_allclose(compiled(0.05, wo)[1], difference, rtol=1e-5, atol=1e-6 * np.abs(difference).max())
    for crossing, some, none in zip(compiled(0.05, wo), compiled(0.05, mixed), compiled(0.05, wi), strict=True):
        np.testing.assert_allclose(some, jnp.where(same_side, 0.0, crossing), rtol=1e-12)
        np.testing.assert_array_equal(none, 0.0)
        assert np.any(np.asarray(some) != 0.0)
    if reverse:
        slope = jax.jit(jax.grad(lambda alpha: jnp.sum(values(alpha, mixed))))(0.05)
        np.testing.assert_allclose(slope, jnp.sum(compiled(0.05, mixed)[1]), rtol=1e-9)


def test_is_reciprocal_and_turns_upside_down():
    stack = slab(1.5, 0.05, 1.2, 0.1)
    forth, back = lj.evaluate(stack, WI, WO, SOLVER), lj.evaluate(stack, WO, WI, SOLVER)
    ratio = np.where(np.asarray(WI)[:, 2:] > 0, 1.2**2, 1.2**-2)
    np.testing.assert_allclose(forth, ratio * back, rtol=1e-9)


@pytest.mark.slow
def test_is_the_same_with_an_axis_that_is_the_normal():
    """Light that passes straight counts once however the flakes between say that they lie flat."""

    def values(axis):
        flakes = lj.Medium(0.5, [0.0, 0.6], lj.SGGX("surface", 0.4, axis))
        stack = lj.Stack([lj.Interface(1.5, 0.05), flakes, lj.Interface(1.2, 0.1)])
        return lj.evaluate(stack, WI, WO, lj.AddingDoubling(nodes=2, modes=1))

    np.testing.assert_allclose(values((0.0, 0.0, 1.0)), values(None), rtol=1e-9)


@pytest.mark.slow
def test_is_continuous_at_equal_indices():
    """An interface without effect refracts to one direction alone: nothing is lost or counted twice there.

    Values change by some 1e-6 of themselves over the steps of 1e-6. What is scattered besides steps by 6e-4 at normal
    incidence, where the solver's error at 6 nodes is 9e-3 (2e-5 at 12 nodes).
    """
    values = jax.jit(lambda ior, below: evaluate_known(slab(ior, 0.3, below, 0.2), WI, WO, SOLVER, known=KNOWN))
    for equal, near in (
        ((1.0, 1.4), (1.0 + 1e-6, 1.4)),
        ((1.4, 1.4), (1.4, 1.4 - 1e-6)),
        ((0.8, 0.8), (0.8, 0.8 + 1e-6)),
    ):
        np.testing.assert_allclose(values(*equal), values(*near), rtol=1e-3, atol=1e-9)


@pytest.mark.slow
def test_derivatives_are_those_of_differences():
    """Central differences of step 1e-5: 1e-10 of the curvature, and rounding of 1e-11."""
    start = jnp.asarray([1.5, 0.05, 1.2, 0.1])

    def values(numbers):
        return evaluate_known(slab(*numbers), WI, WO, SOLVER, known=KNOWN)

    slopes = jax.jit(jax.jacfwd(values))(start)
    compiled = jax.jit(values)
    for place in range(4):
        step = jnp.zeros(4).at[place].set(1e-5)
        difference = (compiled(start + step) - compiled(start - step)) / 2e-5
        np.testing.assert_allclose(slopes[..., place], difference, rtol=1e-5, atol=1e-5 * np.abs(difference).max())
