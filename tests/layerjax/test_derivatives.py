"""Derivatives of every transport by every parameter: inside ranges, exactly at their ends, at 0, 1 and equal indices.

Reverse mode equals forward mode, both equal differences of values, and single precision follows double precision.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.stack import simplify_and_name
from tests.helpers.derivatives import (
    STACKS,
    agrees,
    asked_to_be_known,
    fields_of,
    pairs,
    points_of,
    random_points,
    vector_and_build,
)

SOLVER = lj.AddingDoubling(nodes=6, modes=6, ordinates=(4, 6))
TRANSPORTS = {
    "SingleScattering": lj.SingleScattering(),
    "SpongeCake": lj.SpongeCake(),
    "WeidlichWilkie": lj.WeidlichWilkie(),
    "ENDF": lj.ENDF(),
    "AddingDoubling": SOLVER,
    "AddingDoubling, multiple": lj.AddingDoubling(nodes=6, modes=6, ordinates=(4, 6), facet_multiple_scattering=True),
    "Statistical": lj.Statistical(),
    "Statistical, forward": lj.Statistical(symmetric=False),
    "Statistical, single": lj.Statistical(facet_multiple_scattering=False),
}
SINGLE = 1e-2
"""Share of a slope that single precision may be off by, beside the rounding of values."""

ILL_CONDITIONED = ("AddingDoubling", "Statistical")
"""Transports not held against double precision where there is an `Interface`: they balance it on their nodes
by quotients of energies that nearly cancel. Slopes of `Statistical` over a hazy varnish are off by 2 to 5 %."""

TIED = {("two coats on paint", "layers[1].alpha", 1.0)}
"""Where ends of integrals coincide, and which of them moves depends on rounding: modes agree less well."""

JITTERY = {
    ("Statistical", "varnish"),
    ("Statistical", "brushed varnish"),
    ("Statistical", "dyed varnish"),
    ("Statistical", "hazy varnish"),
    ("Statistical", "two coats on paint"),
    ("Statistical", "hazy coat on metal"),
    ("Statistical", "plate"),
    ("Statistical", "clear plate"),
    ("Statistical, forward", "hazy varnish"),
    ("Statistical, forward", "plate"),
}
"""At equal indices caps of facets coincide, and tables go by a cube root: values jitter there by 3e-3 of the brightest
under a dyed varnish, by 3e-4 under two coats and 5e-5 elsewhere, or step by 2e-5 times the root of what the indices
differ by, and no difference converges to the derivative. How far values may leap there is tested in its stead."""

JITTER, NEAR = 5e-4, 1e-6
"""By how much of the brightest value any may leap there, and a step of the index that is so small that all that values
change by in it is a leap."""

JITTER_OF = {"dyed varnish": 3e-3}
"""The same where it is more: light that a dyed coat of an index below 1 lets in is off tables of its own."""

QUICK = {
    ("SingleScattering", "haze over metal"),
    ("SingleScattering", "flakes' transport"),
    ("WeidlichWilkie", "dyed varnish"),
    ("AddingDoubling", "haze over paint"),
}
"""Those whose derivatives compile fast."""


SOME = {
    "AddingDoubling, multiple": ("varnish", "coated metal", "plate", "hazy coat on metal"),
    "Statistical, forward": ("varnish on rough paint", "coated metal", "hazy varnish", "plate"),
    "Statistical, single": ("varnish", "coated metal"),
}
"""Structures of transports that are others but for one option."""


RANDOMLY = ("AddingDoubling",)
"""Transports whose derivatives are also tried on 17 random stacks of every structure, ends of ranges included."""


def carried():
    for name, transport in TRANSPORTS.items():
        for kind in SOME.get(name, STACKS):
            if not is_carried(transport, STACKS[kind]):
                continue
            slow = () if (name, kind) in QUICK else pytest.mark.slow
            yield pytest.param(name, kind, marks=slow, id=f"{name}: {kind}")


class Slopes(NamedTuple):
    """Compiled derivatives of the values along some pairs, for vectors of either precision. weight: (N,), of pairs.

    first: what values hold beside the sums that are cut off where they are negative.
    """

    first: Callable[..., Any]
    forward: Callable[..., Any]
    reverse: Callable[..., Any]
    weight: jax.Array

    def values(self, vector):
        return self.forward(vector, jnp.zeros_like(vector))[0]

    def along(self, vector, direction, place):
        """The slope of every pair by forward mode, that of their weighted sum by reverse mode, and whether all that
        reverse mode gives is finite."""
        slope, gradient = np.asarray(self.forward(vector, direction)[1]), np.asarray(self.reverse(vector))
        return slope, gradient[place], np.isfinite(slope).all() and np.isfinite(gradient).all()


def slopes_of(stack, build, transport):
    wi, wo = pairs(stack)
    # cast here, as constants: directions that are known while tracing
    directions = {np.dtype(dtype): (wi.astype(dtype), wo.astype(dtype)) for dtype in (jnp.float64, jnp.float32)}
    weight = jnp.asarray(np.random.default_rng(0).uniform(0.5, 1.0, len(wi)))

    def reflected(vector):
        return lj.evaluate(build(vector), *directions[vector.dtype], transport)[:, 0]

    def forward(vector, direction):
        return jax.jvp(reflected, (vector,), (direction,))

    def reverse(vector):
        return jax.grad(lambda v: jnp.vdot(weight.astype(v.dtype), reflected(v)))(vector)

    def first(vector):
        if isinstance(transport, lj.AddingDoubling) and not any(isinstance(one, lj.Interface) for one in stack.layers):
            return lj.evaluate(build(vector), *directions[vector.dtype], lj.SingleScattering())[:, 0]
        return 0.0

    return Slopes(first, jax.jit(forward), jax.jit(reverse), weight)


def wrong_in_double(slopes, vector, point, same, compared):
    """What is wrong with the derivative by the parameter of a point. same: share that both modes may differ by."""
    slope, back, finite = slopes.along(vector, unit(vector, point), point.place)
    if not finite:
        yield "not finite"
        return
    ahead = float(slopes.weight @ slope)
    rounding = 64 * np.finfo(float).eps * max(1.0, float(slopes.weight @ np.abs(slopes.values(vector)))) / point.length
    if abs(back - ahead) > same * float(slopes.weight @ np.abs(slope)) + 1e-12 + rounding:
        yield f"reverse {back:.6g}, forward {ahead:.6g}"
    if compared:
        good = agrees(slope, slopes.values, vector, point)
        yield from (f"pair {k} has {slope[k]:.4g}" for k in np.flatnonzero(~good))


def wrong_in_single(slopes, vector, point, drawn, compared):
    """The same in single precision. drawn: whether the point is one of random stacks."""
    direction = unit(vector, point)
    slope = np.asarray(slopes.forward(vector, direction)[1])
    ahead, back, finite = slopes.along(vector.astype(jnp.float32), direction.astype(jnp.float32), point.place)
    size = float(slopes.weight @ np.abs(slope))
    # rounding of values, or of energies that cancel to them, is divided by what a parameter is measured in
    eps = np.finfo(np.float32).eps
    rounding = 64 * eps * max(1.0, float(slopes.weight @ np.abs(slopes.values(vector)))) / point.length
    if drawn:
        # numbers that are rounded belong to another stack: where nothing is absorbed, thick media tell them apart
        rounding += 4 * float(slopes.weight @ np.abs(slopes.forward(vector * (1 - eps), direction)[1] - slope))
    # what ringing takes below 0 is cut off, and its slope with it, unless it may be rounding: more in single precision
    lit = np.asarray(slopes.values(vector)) > slopes.first(vector) * (1.0 + 1e-9)
    off = float(slopes.weight @ np.where(lit, np.abs(ahead - slope), 0.0))
    if not finite:
        yield "not finite in single precision"
    elif abs(back - float(slopes.weight @ ahead)) > 1e-3 * size + rounding:
        yield f"in single precision reverse {back:.4g}, forward {slopes.weight @ ahead:.4g}"
    elif compared and off > SINGLE * size + rounding:
        yield f"in single precision off by {off:.2g} of {size:.2g}"


def leaps(slopes, vector, point, most):
    """Where values leap about an index that equals another, by more than so much of the brightest."""
    here = np.asarray(slopes.values(vector))
    for side in point.sides:
        there = np.asarray(slopes.values(vector.at[point.place].add(side * NEAR)))
        leap = np.abs(there - here).max() / np.abs(here).max()
        if leap > most:
            yield f"values leap by {leap:.2g} of the brightest"


def is_carried(transport, stack):
    """Whether a stack is not refused, known as it is: `Statistical` takes steps of the index up to 4."""
    try:
        transport.check(*simplify_and_name(stack))
    except ValueError:
        return False
    return True


def unit(vector, point):
    return jnp.zeros_like(vector).at[point.place].set(1.0)


@pytest.mark.parametrize(("name", "kind"), list(carried()))
def test_derivatives(name, kind):
    stack = STACKS[kind]
    fixed = asked_to_be_known(name, kind)
    start, build = vector_and_build(stack, fixed)
    slopes = slopes_of(stack, build, TRANSPORTS[name])
    faces = [layer for layer in stack.layers if isinstance(layer, lj.Interface)]
    comparable = not (faces and name.startswith(ILL_CONDITIONED))
    widths = [field.place for field in fields_of(stack, fixed) if field.path.endswith(("alpha", "alpha_y"))]
    points = [(start.at[point.place].set(point.value), point) for point in points_of(stack, fixed)]
    points = [(vector, point) for vector, point in points if is_carried(TRANSPORTS[name], build(vector))]
    drawn = list(random_points(stack, fixed)) if name in RANDOMLY else []
    wrong = []
    for number, (vector, point) in enumerate(points + drawn):
        same = 1e-3 if (kind, point.name, point.value) in TIED else 1e-6
        jittery = point.kinked and (name, kind) in JITTERY
        found = list(wrong_in_double(slopes, vector, point, same, not (point.unbounded or jittery)))
        found += leaps(slopes, vector, point, JITTER_OF.get(kind, JITTER)) if jittery else []
        # the programs of single precision take as long to compile
        if (name, kind) != ("AddingDoubling", "haze over paint") and "not finite" not in found:
            is_drawn = number >= len(points)
            # of lobes narrower than directions are rounded to, values far off the peak are noise
            seen = not is_drawn or all(vector[place] ** 2 > 64 * np.finfo(np.float32).eps for place in widths)
            found += wrong_in_single(slopes, vector, point, is_drawn, comparable and seen)
        wrong += [f"{point.name} = {point.value:g} of {vector}: {what}" for what in found]
    assert not wrong, "\n".join(wrong)
