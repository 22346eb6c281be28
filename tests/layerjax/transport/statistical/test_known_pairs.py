"""Lobes once for each angle to the half vector: the same values and slopes as pair by pair, from fewer operations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fits
import layerjax as lj
from layerjax.evaluate import evaluate_known
from layerjax.transport.known_directions import MOST_PAIRS_AT_ONCE, known_pairs

SCANS = fits.slices(incidence=(10.0, 30.0, 50.0, 70.0), outgoing=np.arange(-70.0, 81.0, 10.0))
WI, WO = np.asarray(SCANS.wi), np.asarray(SCANS.wo)
HAZE = lj.Medium([0.5, 0.2, 0.0], 0.8, lj.HenyeyGreenstein(0.9))
STACKS = {
    "hazy coat on metal": lj.Stack([lj.Interface(1.5, 0.2), HAZE], lj.Conductor(0.2, 3.9, 0.3)),
    "slab": lj.Stack([lj.Interface(1.5, 0.2), HAZE, lj.Interface(1.1, 0.1)]),
    "paint": lj.Stack([lj.Interface(1.5, 0.2), lj.Medium(0.5, 0.0)], lj.Lambertian(0.6)),
    "brushed metal": lj.Stack([lj.Interface(1.5, 0.2)], lj.Conductor(0.2, 3.9, 0.3, alpha_y=0.1)),
}


def values(stack, pairs, side="all"):
    return evaluate_known(stack, jnp.asarray(WI), jnp.asarray(WO), lj.Statistical(), side=side, pairs=pairs)


@pytest.mark.parametrize("name", STACKS)
def test_values_and_slopes_are_those_of_every_pair(name):
    """Cosines that count as one differ by 64 roundings of 1, which lobes of alpha 0.1 magnify a hundredfold at most."""

    def along(scale, pairs):
        return values(jax.tree.map(lambda leaf: scale * leaf, STACKS[name]), pairs)

    both = jax.jit(lambda pairs: jax.jvp(lambda scale: along(scale, pairs), (0.99,), (1.0,)))
    for found, expected in zip(both(known_pairs(WI, WO)), both(None), strict=True):
        np.testing.assert_allclose(found, expected, rtol=6400 * np.finfo(float).eps, atol=1e-14)


def test_lobes_are_computed_once_for_each_angle():
    """Loops over taps and facets count as one turn of each here, so that less is saved than in a run."""
    pairs, stack = known_pairs(WI, WO), STACKS["hazy coat on metal"]
    assert pairs.cosines.size == 16
    sparing, whole = (jax.jit(values).lower(stack, known).cost_analysis()["flops"] for known in (pairs, None))
    assert sparing < 0.7 * whole


def test_where_it_does_not_pay():
    rng = np.random.default_rng(0)
    scattered = np.asarray(lj.direction(rng.uniform(0.0, 1.4, 64), rng.uniform(0.0, 6.0, 64)))
    assert known_pairs(scattered, WO) is None
    assert known_pairs(WI, -WO) is None
    assert known_pairs(WI[:0], WO[:0]) is None
    many = np.resize(WI, (MOST_PAIRS_AT_ONCE + 1, 3))
    assert known_pairs(many, many) is None


def test_fits_know_their_pairs():
    data = fits.Measurements(WI, WO, np.ones((64, 1)), None, np.ones(64, bool), ("value",))
    stack = lj.Stack([lj.Interface(1.5, fits.Free(0.2, 0.05, 0.5))], lj.Conductor(0.2, 3.9, 0.3))
    model = fits.Problem(stack, data, transport=lj.Statistical()).model
    assert model.known.cosines.size == 16
    expected = lj.evaluate(lj.Stack([lj.Interface(1.5, 0.2)], stack.base), WI, WO, lj.Statistical())
    np.testing.assert_allclose(model.predict(jnp.array([0.2])), expected, rtol=1e-12)
