"""The resolution that a stack gets when none is given, and what error it leaves."""

import jax
import numpy as np
import pytest

import layerjax as lj
from layerjax.transport.adding_doubling.resolution import ORDINATES, Resolution, choose_resolution, resolutions

FACE, PAINT = lj.Interface(1.5, 0.05), lj.Lambertian(0.5)
HAZE = lj.Medium(1.0, 0.9, lj.HenyeyGreenstein(0.9))
SLAB = lj.Stack([lj.Interface(1.5, 0.3), lj.Medium(1.0, 0.9, lj.HenyeyGreenstein(0.4)), lj.Interface(1.0, 0.3)])
FIBERS = lj.Medium(1.0, 0.9, lj.SGGX("fiber", 0.3, (1.0, 0.0, 0.0)))


def flakes(alpha):
    return lj.Medium(1.0, 0.9, lj.SGGX("surface", alpha))


@pytest.mark.parametrize(
    ("stack", "followed", "least"),
    [
        (lj.Stack([FACE, HAZE], PAINT), True, 24),
        (lj.Stack([FACE, HAZE], PAINT), False, 24),
        (lj.Stack([FACE], lj.Conductor(0.4, 3.0, 0.5)), True, 6),
        (lj.Stack([FACE], lj.Conductor(0.4, 3.0, 0.12)), True, 20),
        (lj.Stack([FACE, flakes(0.1)], PAINT), True, 24),
        (lj.Stack([FACE, lj.Medium(1.0, 0.0, lj.SGGX("surface", 0.1))], PAINT), True, 6),
        (lj.Stack([FACE], lj.Conductor(0.4, 3.0, 1e-3)), True, 96),
        (lj.Stack([lj.Interface(1.1, 0.05)], lj.Conductor(0.4, 3.0, 0.5)), True, 12),
        (lj.Stack([lj.Interface(1.1, 0.05), lj.Medium(1.0, 0.9)], PAINT), True, 6),
        (lj.Stack([FACE, HAZE, lj.Interface(1.6, 0.2)], PAINT), True, 24),
        (lj.Stack([FACE, HAZE, lj.Interface(1.0, 0.6)]), True, 32),
        (lj.Stack([FACE, lj.Medium(1.0, 0.9, lj.HenyeyGreenstein(-0.9))], PAINT), True, 64),
        (lj.Stack([*SLAB.layers, lj.Medium(1.0, 0.9)]), False, 32),
        (lj.Stack([*SLAB.layers, lj.Medium(1.0, 0.9), lj.Interface(1.5, 0.3)]), True, 32),
    ],
)
def test_narrow_lobes_behind_others_decide(stack, followed, least):
    found = choose_resolution(lj.stack.simplify(stack), followed)
    assert least <= found.nodes <= max(least, 4 * least // 3)
    assert found.modes >= found.nodes // 2


def test_bare_media_need_modes_rather_than_nodes():
    """Light inclined to grazing sees lobes that are narrow in azimuth; a varnish keeps it away from there."""
    bare, coated = (
        choose_resolution(lj.Stack([*above, flakes(0.2)], PAINT), directions_known=False) for above in ((), (FACE,))
    )
    assert bare.nodes == coated.nodes
    assert bare.modes > 2 * coated.modes


def test_traced_lobes_count_as_rather_narrow():
    def nodes(alpha):
        return choose_resolution(lj.Stack([FACE], lj.Conductor(0.4, 3.0, alpha)), directions_known=True).nodes

    seen = []
    jax.eval_shape(lambda alpha: seen.append(nodes(alpha)) or alpha, 0.5)
    assert nodes(0.5) < seen[0] < nodes(0.03)


def test_what_is_chosen_is_told_and_what_is_given_stays():
    stack = lj.Stack([FACE, HAZE], PAINT)
    told = lj.choose_transport(stack)
    assert (told.nodes, told.modes) == (24, 32)
    haze = lj.Stack([HAZE], PAINT)
    assert lj.prepare(haze).transport == lj.choose_transport(haze)
    assert lj.choose_transport(stack, transport=lj.AddingDoubling(nodes=10)).modes == 15
    assert lj.choose_transport(stack, transport=lj.AddingDoubling(modes=10)).modes == 10
    wi, wo, varnish = lj.direction([0.2, 0.3], 0.0), lj.direction(0.4, 1.0), lj.Stack([FACE], PAINT)
    assert lj.choose_transport(varnish).nodes == 12
    assert lj.choose_transport(varnish, wi, wo).nodes == 6
    with pytest.raises(ValueError, match=r"AddingDoubling.nodes: none are given; choose_transport"):
        lj.AddingDoubling().finer()


def test_neighbours_are_coarser_and_finer():
    for resolution in resolutions(lj.Stack([FACE, HAZE], PAINT)):
        coarse, fine = resolution.coarser(), resolution.finer()
        assert coarse.nodes < resolution.nodes < fine.nodes
        assert coarse.modes < resolution.modes < fine.modes
    ordinates = [resolution.ordinates for resolution in resolutions(lj.Stack([FIBERS]))]
    assert tuple(ordinates) == ORDINATES
    assert Resolution(2, 1, (2, 4)).coarser() == Resolution(2, 1, (2, 4))


BARE = ("haze on metal", "bare flakes")
"""Whose light comes from any inclination: 14 of 133 ordinary stacks had broken 1e-3, most of them of these kinds."""


def random_stack(kind, seed):
    random = np.random.default_rng(seed)
    face = lj.Interface(random.uniform(1.2, 1.9), np.exp(random.uniform(np.log(0.02), np.log(0.8))))
    haze = lj.Medium(
        np.exp(random.uniform(-2.0, 2.0)), random.uniform(0.3, 1.0), lj.HenyeyGreenstein(random.uniform(-0.5, 0.9))
    )
    below = lj.Interface(random.uniform(1.2, 1.9), random.uniform(0.15, 0.8))
    alpha = random.uniform(0.12, 0.8)
    return {
        "paint": lj.Stack([face, haze], lj.Lambertian(random.uniform(0.1, 0.95))),
        "coated metal": lj.Stack([face], lj.Conductor(random.uniform(0.2, 2.0), random.uniform(1.5, 5.0), alpha)),
        "flakes": lj.Stack([face, flakes(alpha)], lj.Lambertian(random.uniform(0.1, 0.95))),
        "slab": lj.Stack([face, haze, below]),
        "haze on metal": lj.Stack([haze], lj.Conductor(random.uniform(0.2, 2.0), random.uniform(1.5, 5.0), alpha)),
        "bare flakes": lj.Stack([flakes(max(alpha, 0.2))], lj.Lambertian(random.uniform(0.1, 0.95))),
    }[kind]


def test_lying_fibers_that_are_too_narrow_are_told():
    with pytest.warns(lj.ResolutionWarning, match="24 x 44 ordinates, where about 50 cosines are needed"):
        lj.choose_transport(lj.Stack([lj.Medium(1.0, 0.9, lj.SGGX("fiber", 0.1, (1.0, 0.0, 0.0)))], PAINT))


@pytest.mark.slow
def test_narrow_flakes_at_grazing_light():
    """They were off by 12 %; to 5e-3 of a finer solution, at which it stays where values are small."""
    grazing = lj.direction(np.radians([78.0, 80.0])[:, None, None], 0.0)
    wo = lj.direction(np.radians([30.0, 60.0, 78.0, 80.0])[:, None], np.radians([0.0, 60.0, 150.0, 180.0]))
    stack = lj.Stack([flakes(0.1)], PAINT)
    exact = lj.evaluate(stack, grazing, wo, lj.AddingDoubling(nodes=32, modes=256))
    np.testing.assert_allclose(lj.evaluate(stack, grazing, wo), exact, rtol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["paint", "coated metal", "flakes", "slab", "haze on metal", "bare flakes"])
def test_errors_of_random_stacks(kind):
    """1e-3 is what is aimed at: half of the stacks are below it, and none is beyond five times that."""
    theta, phi = np.radians([5.0, 30.0, 55.0, 75.0]), np.radians([0.0, 60.0, 150.0])
    errors = []
    for seed in range(8):
        stack = random_stack(kind, seed)
        outgoing = theta if stack.base is not None else np.concatenate([theta, np.pi - theta])
        wi, wo = lj.direction(theta[:, None, None], 0.0), lj.direction(outgoing[:, None], phi)
        found, exact = (
            np.asarray(lj.evaluate(stack, wi, wo, transport))
            for transport in (lj.AddingDoubling(), lj.AddingDoubling(nodes=40, modes=160 if kind in BARE else 56))
        )
        errors.append(np.max(np.abs(found - exact) / (exact + 0.1 * np.mean(exact))))
    assert np.median(errors) < 1e-3
    assert np.max(errors) < 5e-3
