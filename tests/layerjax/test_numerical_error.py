"""The error of a finite resolution: neither 0 nor far below what it is."""

import jax
import numpy as np
import pytest

import layerjax as lj
from layerjax.numerical_error import neighbours
from tests.helpers.random_stacks import OTHER_INTERFACES, STRUCTURES, drawn

POLAR, AZIMUTH = np.radians([5.0, 30.0, 55.0, 75.0]), np.radians([0.0, 60.0, 150.0, 180.0])
WI, WO = np.broadcast_arrays(
    np.asarray(lj.direction(POLAR[:, None, None], 0.0)), np.asarray(lj.direction(POLAR[:, None], AZIMUTH))
)


def in_errors(stack, transport, truth):
    """|value - truth| over the estimate, of all pairs."""
    values, errors = map(np.asarray, lj.evaluate_with_error(stack, WI, WO, transport))
    np.testing.assert_allclose(values, lj.evaluate(stack, WI, WO, transport), rtol=1e-9)
    assert np.all(errors > 0.0)
    return np.abs(values - np.asarray(lj.evaluate(stack, WI, WO, truth))) / errors


@pytest.mark.slow
def test_resolutions_that_agree_are_not_taken_for_exact():
    """Three resolutions agree to 1e-6, all 3e-5 and more away: what their facets have in common counts."""
    varnish = lj.Stack([lj.Interface(1.4439, 0.4771)], lj.Lambertian(0.3159))
    assert np.max(in_errors(varnish, lj.AddingDoubling(nodes=6, modes=8), lj.AddingDoubling(nodes=48, modes=64))) < 4.0


@pytest.mark.slow
def test_what_is_cut_off_counts():
    """Lobes far narrower than nodes ring, below 0 at all resolutions."""
    faces = [lj.Interface(ior, 0.01) for ior in (1.5, 1.2, 1.6, 1.3, 1.5)]
    stack = lj.Stack(faces, lj.Conductor(0.2, 3.5, 0.01))
    wi, wo = lj.direction(np.radians(20.0), 0.0), lj.direction(np.radians([18.0, 20.0, 22.0, 25.0]), np.pi)
    values, errors = lj.evaluate_with_error(stack, wi, wo, lj.AddingDoubling(nodes=16, modes=24))
    walked, noise = lj.evaluate_with_error(stack, wi, wo, lj.RandomWalk(paths=1 << 14), key=jax.random.key(0))
    assert np.all(np.abs(values - walked) < 4.0 * np.hypot(errors, noise))


@pytest.mark.slow
@pytest.mark.parametrize("part", range(4))
@pytest.mark.parametrize("kind", STRUCTURES)
def test_errors_cover_random_stacks(kind, part):
    """Of 140 stacks: in any part 99 % of the pairs lie within four errors, and all within 8."""
    found = []
    for seed in range(100 + part, 120, 4):
        stack = STRUCTURES[kind][1](drawn(kind, seed))
        chosen = lj.choose_transport(stack, WI, WO)
        found.append(in_errors(stack, chosen, chosen.finer().finer().finer()))
    assert np.mean(np.concatenate(found) <= 4.0) >= 0.99
    assert np.max(np.concatenate(found)) < 8.0


OTHERS = [(kind, seed) for kind in OTHER_INTERFACES for seed in (100, 101, 102)]
OTHERS.append(("smooth coat on metal", 201))  # narrow lobes at grazing light, which the coat reflects totally


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "seed"), OTHERS)
def test_errors_cover_random_stacks_of_other_interfaces(kind, seed):
    stack = OTHER_INTERFACES[kind][1](drawn(kind, seed))
    chosen = lj.choose_transport(stack, WI, WO)
    found = in_errors(stack, chosen, chosen.finer().finer().finer())
    assert np.mean(found <= 4.0) >= 0.99
    assert np.max(found) < 8.0


def test_neighbours_stay_on_their_side():
    theta = np.radians([0.0, 1.0, 45.0, 89.0, 89.99, 91.0, 135.0, 180.0])
    around_i, around_o = neighbours(lj.direction(theta, 0.3), lj.direction(theta[::-1], 2.0))
    for around, given in ((around_i, theta), (around_o, theta[::-1])):
        assert around.shape == (5, theta.size, 3)
        assert np.all((np.asarray(around)[..., 2] > 0) == (np.cos(given) > 0))
        np.testing.assert_allclose(np.linalg.norm(around, axis=-1), 1.0, rtol=1e-12)
        apart = np.arccos(np.clip(np.sum(np.asarray(around) * np.asarray(around[0]), axis=-1), -1.0, 1.0))
        assert np.max(apart) < np.radians(13.0)
