"""Derivatives of every transport by every parameter: inside ranges, exactly at their ends, at 0, 1 and equal indices.

Reverse mode equals forward mode, both equal differences of values, and single precision follows double precision.
"""

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
    "AddingDoubling, multiple": lj.AddingDoubling(nodes=6, modes=6, ordinates=(4, 6), microfacets="multiple"),
    "Statistical": lj.Statistical(),
    "Statistical, forward": lj.Statistical(symmetric=False),
    "Statistical, single": lj.Statistical(microfacets="single"),
}
SINGLE = 1e-2
"""Share of a slope that single precision may be off by, beside the rounding of values."""

ILL_CONDITIONED = ("AddingDoubling", "Statistical")
"""Transports not held against double precision where there is an `Interface`: they balance it on their nodes
by quotients of energies that nearly cancel. Slopes of `Statistical` over a hazy varnish are off by 2 to 5 %."""

TIED = {("two coats on paint", "layers[1].alpha", 1.0)}
"""Where ends of integrals coincide, and which of them moves depends on rounding: modes agree less well."""

JITTERY = {
    ("Statistical", "two coats on paint"),
    ("Statistical", "hazy varnish"),
    ("Statistical, forward", "hazy varnish"),
    ("Statistical, forward", "plate"),
}
"""At equal indices caps of facets coincide: values jitter there by 3e-4 under two coats and 2e-5 under haze, or step by
2e-5 times the root of what the indices differ by, and no difference converges to the derivative."""

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
    "Statistical, single": ("varnish", "coated metal", "two coats on paint"),
}
"""Structures of transports that are others but for one option."""


RANDOMLY = ("AddingDoubling",)
"""Transports whose derivatives are also tried on 17 random stacks of every structure, ends of ranges included."""


def carried():
    for name, transport in TRANSPORTS.items():
        for kind in SOME.get(name, STACKS):
            stack = STACKS[kind]
            try:
                transport.check(*simplify_and_name(stack))
            except ValueError:
                continue
            slow = () if (name, kind) in QUICK else pytest.mark.slow
            yield pytest.param(name, kind, marks=slow, id=f"{name}: {kind}")


@pytest.mark.parametrize(("name", "kind"), list(carried()))
def test_derivatives(name, kind):
    stack, transport = STACKS[kind], TRANSPORTS[name]
    fixed = asked_to_be_known(name, kind)
    start, build = vector_and_build(stack, fixed)
    wi, wo = pairs(stack)
    # cast here, as constants: directions that are known while tracing
    directions = {np.dtype(dtype): (wi.astype(dtype), wo.astype(dtype)) for dtype in (jnp.float64, jnp.float32)}
    weight = jnp.asarray(np.random.default_rng(0).uniform(0.5, 1.0, len(wi)))
    # the programs of single precision take as long to compile
    dtypes = (jnp.float64,) if (name, kind) == ("AddingDoubling", "haze over paint") else (jnp.float64, jnp.float32)

    def reflected(vector):
        return lj.evaluate(build(vector), *directions[vector.dtype], transport)[:, 0]

    @jax.jit
    def forward(vector, direction):
        return jax.jvp(reflected, (vector,), (direction,))

    def values(vector):
        return forward(vector, jnp.zeros_like(vector))[0]

    @jax.jit
    def reverse(vector):
        return jax.grad(lambda v: jnp.vdot(weight.astype(v.dtype), reflected(v)))(vector)

    faces = [layer for layer in stack.layers if isinstance(layer, lj.Interface)]
    compared = not (faces and name.startswith(ILL_CONDITIONED))
    wrong = []
    points = [(start.at[point.place].set(point.value), point) for point in points_of(stack, fixed)]
    drawn = list(random_points(stack, fixed)) if name in RANDOMLY else []
    widths = [field.place for field in fields_of(stack, fixed) if field.path.endswith("alpha")]
    for number, (vector, point) in enumerate(points + drawn):
        direction = jnp.zeros_like(start).at[point.place].set(1.0)
        slope, gradient = np.asarray(forward(vector, direction)[1]), np.asarray(reverse(vector))
        where = f"{point.name} = {point.value:g} of {vector}"
        if not np.isfinite(slope).all() or not np.isfinite(gradient).all():
            wrong.append(f"{where}: not finite")
            continue
        size = float(weight @ np.abs(slope))
        same = 1e-3 if (kind, point.name, point.value) in TIED else 1e-6
        if abs(gradient[point.place] - float(weight @ slope)) > same * size + 1e-12:
            wrong.append(f"{where}: reverse {gradient[point.place]:.6g}, forward {float(weight @ slope):.6g}")
        if not point.unbounded and not (point.kinked and (name, kind) in JITTERY):
            good = agrees(slope, values, vector, point)
            wrong += [f"{where}: pair {k} has {slope[k]:.4g}" for k in np.flatnonzero(~good)]
        if jnp.float32 not in dtypes:
            continue
        single, small = vector.astype(jnp.float32), direction.astype(jnp.float32)
        ahead, back = np.asarray(forward(single, small)[1]), np.asarray(reverse(single))
        # rounding of values, or of energies that cancel to them, is divided by what a parameter is measured in
        eps = np.finfo(np.float32).eps
        rounding = 64 * eps * max(1.0, float(weight @ np.abs(values(vector)))) / point.length
        seen = True
        if number >= len(points):
            # numbers that are rounded belong to another stack: where nothing is absorbed, thick media tell them apart
            rounding += 4 * float(weight @ np.abs(forward(vector * (1 - eps), direction)[1] - slope))
            # and of lobes narrower than directions are rounded to, values far off the peak are noise
            seen = all(vector[place] ** 2 > 64 * eps for place in widths)
        if not np.isfinite(ahead).all() or not np.isfinite(back).all():
            wrong.append(f"{where}: not finite in single precision")
        elif abs(back[point.place] - float(weight @ ahead)) > 1e-3 * size + rounding:
            wrong.append(f"{where}: in single precision reverse {back[point.place]:.4g}, forward {weight @ ahead:.4g}")
        elif compared and seen and weight @ np.abs(ahead - slope) > SINGLE * size + rounding:
            wrong.append(f"{where}: in single precision off by {weight @ np.abs(ahead - slope):.2g} of {size:.2g}")
    assert not wrong, "\n".join(wrong)
