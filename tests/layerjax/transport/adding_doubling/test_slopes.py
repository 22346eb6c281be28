"""Slopes of `AddingDoubling`, by every continuous parameter of random stacks of every structure.

Forward and reverse mode agree with each other and with differences of values at the same resolution: no point of a
quadrature crosses an edge of what it sums, so that values are no staircase. Slopes at the default resolution:
`test_traced_stacks` and, of von Mises-Fisher normals, `test_vmf_interfaces`.

Slopes are by the parameter itself, of widths and thicknesses by its share. They are compared relative to |f|, or to
`FLOOR` of the largest |f| of the pairs.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from tests.helpers.random_stacks import STRUCTURES, drawn, lengths

FLOOR = 1e-2
SHORT = lj.AddingDoubling(nodes=6, modes=8)
STEPS = (2e-4, 2e-5)
"""Central differences at a step and half of it, extrapolated (Richardson). Staircases show at the first; at the second,
rounding of values to 1e-13 leaves 1e-8."""

OTHERS = {
    "low coat on paint": (
        (0.7, 0.05, 0.5),
        lambda p: lj.Stack([lj.Interface(p[0], p[1])], lj.Lambertian(p[2])),
    ),
    "vmf coat on metal": (
        (1.5, 0.3, 0.3),
        lambda p: lj.Stack([lj.Interface(p[0], p[1], "vmf")], lj.Conductor(0.2, 3.5, p[2], "vmf")),
    ),
    "two coats on metal": (
        (1.5, 0.3, 1.2, 0.2),
        lambda p: lj.Stack([lj.Interface(p[0], p[1]), lj.Interface(p[2], p[3])], lj.Conductor(0.2, 3.5, 0.3)),
    ),
}
"""What meets critical angles and horizons otherwise: an index below 1, von Mises-Fisher normals, an inner interface."""


REVERSE = ("flakes", "haze on metal", "low coat on paint")
"""Whose gradients compile fast."""


def build_of(kind):
    return OTHERS[kind][1] if kind in OTHERS else STRUCTURES[kind][1]


def numbers_of(kind, seed):
    return jnp.asarray(OTHERS[kind][0]) if kind in OTHERS else drawn(kind, seed)


def pairs(kind):
    """Near the mirror direction, across, grazing, back; of slabs also through them."""
    theta_i = jnp.radians(jnp.array([20.0, 20.0, 50.0, 50.0, 70.0, 10.0]))
    theta_o = jnp.radians(jnp.array([3.0, 75.0, 45.0, 20.0, 68.0, 12.0]))
    phi = jnp.radians(jnp.array([180.0, 120.0, 90.0, 180.0, 170.0, 0.0]))
    wi, wo = lj.direction(theta_i, jnp.zeros_like(phi)), lj.direction(theta_o, phi)
    if kind != "slab":
        return wi, wo
    return jnp.concatenate([wi, wi]), jnp.concatenate([wo, wo * jnp.array([1.0, 1.0, -1.0])])


@cache
def program(kind, transport, known, reverse):
    """Of numbers and weights: values, their Jacobian, the gradient of their weighted sum; and of numbers: values alone.

    known: whether directions are, while tracing.
    """
    directions = pairs(kind)

    def values(numbers, wi, wo):
        wi, wo = directions if known else (wi, wo)
        return (lj.evaluate(build_of(kind)(numbers), wi, wo, transport)[..., 0],) * 2

    def all_of(numbers, weight, wi, wo):
        forward, f = jax.jacfwd(values, has_aux=True)(numbers, wi, wo)
        back = jax.grad(lambda numbers: weight @ values(numbers, wi, wo)[0])(numbers) if reverse else weight @ forward
        return f, forward, back

    compiled, alone = jax.jit(all_of), jax.jit(lambda *arguments: values(*arguments)[0])
    return (
        lambda numbers, weight: map(np.asarray, compiled(numbers, weight, *directions)),
        lambda numbers: np.asarray(alone(numbers, *directions)),
    )


def relative_to(f):
    return np.maximum(np.abs(f), FLOOR * np.max(np.abs(f)))


def wrong(kind, numbers, transport, known=True, reverse=False):
    """Where analytic slopes are not those of differences to 1e-4, or of the other mode to 1e-7."""
    run, values = program(kind, transport, known, reverse)
    f, forward, _ = run(numbers, np.ones(len(pairs(kind)[0])))
    scale = relative_to(f)
    back = list(run(numbers, 1.0 / scale))[2]
    size = (1.0 / scale) @ np.abs(forward)
    if np.any(np.abs(back - (1.0 / scale) @ forward) > 1e-7 * (size + 1.0)):
        yield f"reverse {back}, forward {(1.0 / scale) @ forward} at {numbers}"
    for k, length in enumerate(lengths(build_of(kind)(numbers), numbers)):

        def central(step, k=k):
            up, down = (values(numbers.at[k].add(sign * step)) for sign in (1, -1))
            return (up - down) / (2.0 * step)

        for share in STEPS:
            step = share * length
            difference = (4.0 * central(0.5 * step) - central(step)) / 3.0
            off = np.max(np.abs(difference - forward[:, k]) / scale) * length
            if not off <= 1e-4:
                yield f"{k}: off by {off:.1e} of |f| at steps of {share:g}, at {numbers}"


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*STRUCTURES, *OTHERS])
def test_slopes_are_those_of_differences(kind):
    """Of twenty stacks of a structure."""
    found = [
        line
        for seed in range(20 if kind in STRUCTURES else 1)
        for line in wrong(kind, numbers_of(kind, seed), SHORT, reverse=kind in REVERSE)
    ]
    assert not found, "\n".join(found)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["varnish", "haze on metal"])
def test_slopes_along_given_directions_are_those_of_differences(kind):
    """At twice the resolution, where directions are not known while tracing."""
    transport = lj.AddingDoubling(nodes=12, modes=16)
    found = [
        line
        for seed in range(4)
        for line in wrong(kind, numbers_of(kind, seed), transport, known=False, reverse=kind in REVERSE)
    ]
    assert not found, "\n".join(found)
