"""Directions drawn for stacks with interfaces: by the density that is stated, also behind the first face, evenly."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.directions import split
from tests.helpers.random_stacks import STRUCTURES, drawn
from tests.helpers.sampling import DRAWS, SIGNIFICANCE, chi_square

FACE, METAL = lj.Interface(1.5, 0.2), lj.Conductor(0.2, 3.9, 0.25)
HAZE = lj.Medium(0.5, 0.9, lj.HenyeyGreenstein(0.7))
STACKS = {
    "coated metal": lj.Stack([FACE], METAL),
    "slab": lj.Stack([FACE, HAZE, lj.Interface(1.0, 0.2)]),
    "clear slab": lj.Stack([lj.Interface(1.5, 0.1), lj.Interface(1.0, 0.1)]),
    "face": lj.Stack([FACE]),
    "dusty varnish": lj.Stack([HAZE, FACE, HAZE], lj.Lambertian([0.7, 0.3, 0.1])),
    "fibers in varnish": lj.Stack(
        [FACE, lj.Medium(0.7, 0.8, lj.SGGX("fiber", 0.3, (0.5, 0.3, 0.7)))], lj.Lambertian(0.5)
    ),
    "vmf": lj.Stack([lj.Interface(1.5, 0.2, "vmf")], lj.Conductor(0.2, 3.9, 0.3, "vmf")),
    "beckmann": lj.Stack([lj.Interface(1.5, 0.2, "beckmann")], lj.Conductor(0.2, 3.9, 0.3, "beckmann")),
    "tinted metal": lj.Stack([FACE], lj.Conductor(0.4, 2.0, 0.3, film=lj.ThinFilm(1.8, 150.0, 550.0))),
}
LAYERED = [kind for kind in STRUCTURES if kind not in ("flakes", "haze on metal")]
RANDOM = {f"{kind} {seed}": STRUCTURES[kind][1](drawn(kind, seed)) for kind in LAYERED for seed in range(6)}
QUICK = ("coated metal", 1.2)
CASES = [
    pytest.param(*case, marks=() if case == QUICK else pytest.mark.slow)
    for case in itertools.product(STACKS | RANDOM, (0.4, 1.2))
]
KEY, WEIGHTS = jax.random.key(3), 20_000

LARGEST = 30.0
"""Weight over its mean, at most; before lobes behind the first face were drawn it was up to 1,564."""

EXCESS, SMALL = 1.5, 0.3
"""Standard deviation of the weight over its mean: at most so many times that of `Statistical`, which evaluates what it
draws, or so much."""


def spread(stack, wi, transport):
    """Mean of the weights and its error, their standard deviation and maximum over that, and the albedo."""
    weight = np.mean(lj.sample(lj.prepare(stack, transport), jnp.broadcast_to(wi, (WEIGHTS, 3)), KEY)[2], axis=1)
    mean, deviation = weight.mean(), weight.std()
    albedo = np.mean(sum(lj.albedo(stack, wi, transport)))
    return mean, deviation / np.sqrt(WEIGHTS), deviation / mean, weight.max() / mean, albedo


@partial(jax.jit, static_argnums=1)
def directions(prepared, count, wi):
    """Directions alone: values of slabs cost more."""
    towards = split(jnp.broadcast_to(wi, (count, 3)))
    return jnp.stack(prepared.transport.sample(prepared.state, towards, jax.random.uniform(KEY, (3, count))), axis=-1)


@pytest.mark.parametrize(("name", "theta"), CASES)
def test_directions_are_drawn_by_their_density_and_evenly(name, theta):
    """From above, and where light passes from below at the steeper angle."""
    stack = (STACKS | RANDOM)[name]
    wi = lj.direction(np.pi - theta if stack.base is None and theta < 1.0 else theta, 0.3)
    prepared = lj.prepare(stack, lj.AddingDoubling())
    mean, error, deviation, largest, albedo = spread(stack, wi, lj.AddingDoubling())
    # values between the points of tables are those of the solution to 1e-3; where lobes are narrow a few times that
    assert abs(mean - albedo) < 4.5 * error + 4e-3 * albedo
    assert largest < LARGEST
    wo = np.asarray(directions(prepared, DRAWS, wi))
    kept = wo[np.abs(wo[:, 2]) > 1e-9]  # others are lost to masking

    def density(w):
        return lj.pdf(prepared, wi, w)

    probability, total = chi_square(jnp.asarray(kept), density)
    assert probability > SIGNIFICANCE / 10.0  # of a hundred cases
    np.testing.assert_allclose(total, len(kept) / DRAWS, atol=0.01)  # narrow lobes are missed between points of cells
    statistical = lj.Statistical(facet_multiple_scattering=False)
    try:
        _, _, reference, _, _ = spread(stack, wi, statistical)
    except ValueError:  # one that it does not carry
        return
    if not isinstance(stack.layers[0], lj.Interface):  # media on top are drawn besides
        return
    assert deviation < max(EXCESS * reference, SMALL)
