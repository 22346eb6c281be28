"""No public call compiles anything at its second time, with other numbers of the same structure."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from tests.helpers.compilations import compiled_by

KEY = jax.random.key(0)


def stacks(thickness, factor):
    """Stacks of one structure for all numbers; the thickness may differ by a large factor."""
    interface = lj.Interface(1.5 * factor, 0.2 * factor)
    haze = lj.Medium(thickness, 0.9 * factor, lj.HenyeyGreenstein(0.5 * factor))
    dye = lj.Medium(thickness, 0.0)
    flakes = lj.Medium(thickness, 0.9 * factor, lj.SGGX("surface", 0.3 * factor))
    paint = lj.Lambertian(0.5 * factor)
    return {
        "coat": lj.Stack([interface], paint),
        "hazy coat": lj.Stack([interface, haze], paint),
        "haze": lj.Stack([haze], paint),
        "dyed metal": lj.Stack([interface, dye], lj.Conductor(0.2 * factor, 3.0 * factor, 0.3 * factor)),
        "slab": lj.Stack([interface, haze, lj.Interface(1.0, 0.3 * factor)]),
        "flakes": lj.Stack([flakes], paint),
        "rough paint": lj.Stack([interface], lj.OrenNayar(0.5 * factor, 0.3 * factor)),
        "map": lj.Stack([lj.Interface(1.5 * factor, factor * jnp.linspace(0.2, 0.3, 3))], paint),
    }


ONE, OTHER = stacks(0.5, 1.0), stacks(3.0, 1.03)
"""For both the default chooses as many nodes and modes: a resolution that it takes for the first time is compiled."""

RESOLUTION = {"nodes": 3, "modes": 2, "ordinates": (2, 4)}
TRANSPORTS = {
    "single": lj.SingleScattering(),
    "spongecake": lj.SpongeCake(),
    "statistical": lj.Statistical(),
    "statistical exact": lj.Statistical(diffuse="exact"),
    "statistical lobe": lj.Statistical(diffuse="lobe"),
    "endf": lj.ENDF(),
    "weidlich wilkie": lj.WeidlichWilkie(),
    "adding": lj.AddingDoubling(**RESOLUTION),
    "adding multiple": lj.AddingDoubling(**RESOLUTION, facet_multiple_scattering=True),
    "walk": lj.RandomWalk(paths=64),
    "auto": "auto",
}


def directions(dtype):
    theta = np.linspace(0.1, 1.2, 3)
    wo = np.stack([np.sin(theta), 0.0 * theta, np.cos(theta)], axis=-1)[:, None]
    return jnp.asarray([0.6, 0.0, 0.8], dtype), jnp.asarray(wo, dtype)


def total(stack, transport, wi, wo):
    return jnp.sum(lj.evaluate(stack, wi, wo, transport, key=KEY))


CALLS = {
    "evaluate": lambda stack, transport, wi, wo: lj.evaluate(stack, wi, wo, transport, key=KEY),
    "gradient": eqx.filter_grad(total),
    "sample": lambda stack, transport, wi, wo: lj.sample(stack, wo, KEY, transport),
    "pdf": lambda stack, transport, wi, wo: lj.pdf(stack, wi, wo, transport),
    "albedo": lambda stack, transport, wi, wo: lj.albedo(stack, wo, transport, nodes=4, key=KEY),
    "prepare": lambda stack, transport, wi, wo: eqx.filter(lj.prepare(stack, transport), eqx.is_array),
    "error": lambda stack, transport, wi, wo: lj.evaluate_with_error(stack, wi, wo, transport, key=KEY),
    "unscattered": lambda stack, transport, wi, wo: lj.unscattered(stack, wo),
}


def check(name, transport, call, dtype):
    one, other = (jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), stacks[name]) for stacks in (ONE, OTHER))
    arguments = TRANSPORTS[transport], *directions(dtype)
    CALLS[call](one, *arguments)
    assert compiled_by(lambda: CALLS[call](other, *arguments)) == []


def carried(name, transport, call):
    try:
        jax.eval_shape(lambda: CALLS[call](ONE[name], TRANSPORTS[transport], *directions(np.float32)))
    except ValueError:  # the transport does not carry it, or has no errors to tell
        return False
    return True


@pytest.mark.parametrize(
    ("name", "transport", "call"),
    [
        ("haze", "statistical", "prepare"),
        ("haze", "statistical", "evaluate"),
        ("hazy coat", "adding", "prepare"),
        ("hazy coat", "adding", "gradient"),
        ("dyed metal", "endf", "evaluate"),
        ("flakes", "spongecake", "evaluate"),
        ("flakes", "single", "albedo"),
    ],
)
def test_second_call_compiles_nothing(name, transport, call):
    check(name, transport, call, np.float32)


@pytest.mark.parametrize("name", ONE)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_same_transport_is_chosen(name, dtype):
    one, other = (lj.choose_transport(each[name], *directions(dtype)) for each in (ONE, OTHER))
    assert one == other


CASES = {
    "single": ("flakes", "haze"),
    "spongecake": ("haze", "flakes"),
    "statistical": ("hazy coat", "slab", "dyed metal"),
    "statistical exact": ("coat",),
    "statistical lobe": ("coat",),
    "endf": ("dyed metal", "map"),
    "weidlich wilkie": ("map", "rough paint"),
    "adding": ("slab", "map", "flakes", "rough paint"),
    "adding multiple": ("dyed metal", "coat"),
    "walk": ("slab", "hazy coat"),
    "auto": ("coat", "slab", "flakes"),
}
"""Structures that each transport handles by different code: every call of the first, values of the others."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "transport", "calls", "dtype"),
    [
        pytest.param(name, transport, ("evaluate",) if place else tuple(CALLS), dtype, id=f"{transport}: {name}")
        for row, (transport, names) in enumerate(CASES.items())
        for place, name in enumerate(names)
        for dtype in [(np.float32, np.float64)[(row + place) % 2]]
    ],
)
def test_no_second_call_compiles_anything(name, transport, calls, dtype):
    for call in calls:
        if carried(name, transport, call):
            check(name, transport, call, dtype)
