"""Values and gradients of every transport stay what they were: a change of their code that should change none is seen.

``JAX_ENABLE_X64=1 python -m tests.layerjax.test_values_stay "NAME" ...`` writes these cases anew (all of them without a
name), where a change is meant: under the `XLA_FLAGS` of `tests/conftest.py`, as others round differently.
"""

import json
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from tests.helpers.derivatives import STACKS, asked_to_be_known, pairs, vector_and_build
from tests.helpers.places import STORED

FILE = STORED / "values.json"
ROUNDING = {"float64": 1e-9, "float32": 1e-3}
"""Of the largest value or slope: what another order of the same operations may change."""
CONDITIONED = ("Statistical: hazy varnish", "AddingDoubling, multiple: coated metal")
"""Slopes by index and roughness, through energies that nearly cancel: of another processor they differ by 4e-8."""

MEDIA = ("haze over paint", "flakes over rough paint", "haze over metal", "flakes' transport")
CASES = {
    "SingleScattering": (lj.SingleScattering(), (*MEDIA, "fibers", "metal, vmf")),
    "SpongeCake": (lj.SpongeCake(), (*MEDIA, "fibers")),
    "WeidlichWilkie": (lj.WeidlichWilkie(), ("varnish", "coated metal", "dyed varnish", "two coats on paint")),
    "ENDF": (lj.ENDF(), ("face", "coated metal", "coated metal, vmf", "slab, vmf")),
    "Statistical": (lj.Statistical(), ("haze over metal", "varnish", "coated metal", "hazy varnish", "plate")),
    "Statistical, single": (lj.Statistical(facet_multiple_scattering=False), ("varnish",)),
    "AddingDoubling": (
        lj.AddingDoubling(nodes=6, modes=6, ordinates=(4, 6)),
        ("haze over paint", "flakes over rough paint", "varnish, vmf", "hazy coat on metal", "clear plate"),
    ),
    "AddingDoubling, multiple": (
        lj.AddingDoubling(nodes=6, modes=6, facet_multiple_scattering=True),
        ("coated metal",),
    ),
}


def rounded(stack):
    """Parameters that single precision has too: both precisions are asked for the same material."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), stack)


DRAWN = {
    "SingleScattering": "haze over metal",
    "SpongeCake": "fibers",
    "WeidlichWilkie": "coated metal",
    "ENDF": "coated metal",
    "Statistical": "varnish",
    "AddingDoubling": "haze over paint",
}
WALKED = ("haze over metal", "fibers", "varnish, vmf", "plate")


def numbers(name, kind, dtype):
    """Values of the first channel at eight pairs, and the gradient of the sum of v / (1 + v) by all parameters."""
    stack, transport = rounded(STACKS[kind]), CASES[name][0]
    start, build = vector_and_build(stack, asked_to_be_known(name, kind))
    wi, wo = (w.astype(dtype) for w in pairs(stack))

    @jax.jit
    def both(vector):
        def total(vector):
            values = lj.evaluate(build(vector), wi, wo, transport)[:, 0]
            return jnp.sum(values / (1.0 + values)), values  # no single one outweighs the others

        (_, values), gradient = jax.value_and_grad(total, has_aux=True)(vector)
        return values, gradient

    return both(start.astype(dtype))


def drawn(name, kind, dtype):
    """Directions drawn, their densities and weights, and the albedo."""
    # a stack is solved in the precision of its numbers
    stack, transport = jax.tree.map(lambda leaf: leaf.astype(dtype), rounded(STACKS[kind])), CASES[name][0]
    wi = pairs(stack)[0].astype(dtype)
    return *lj.sample(stack, wi, jax.random.key(5), transport), *lj.albedo(stack, wi[:1], transport, nodes=8)


def walked(kind, dtype):
    """Values of the random walk, and their errors."""
    wi, wo = (w.astype(dtype) for w in pairs(STACKS[kind]))
    walk = lj.RandomWalk(paths=1 << 10)
    return lj.evaluate_with_error(rounded(STACKS[kind]), wi, wo, walk, key=jax.random.key(3))


ALL = {f"{name}: {kind}": partial(numbers, name, kind) for name, (_, kinds) in CASES.items() for kind in kinds}
ALL |= {f"{name}, drawn: {kind}": partial(drawn, name, kind) for name, kind in DRAWN.items()}
ALL |= {f"RandomWalk: {kind}": partial(walked, kind) for kind in WALKED}


def parts(name, dtype):
    return [np.asarray(part, float) for part in ALL[name](dtype)]


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ROUNDING)
@pytest.mark.parametrize("name", ALL)
def test_values_stay(name, dtype):
    key = f"{name}, {dtype}"
    stored = json.loads(FILE.read_text())[key]
    rounding = max(ROUNDING[dtype], 1e-7 if name in CONDITIONED else 0.0)
    for found, before in zip(parts(name, dtype), stored, strict=True):
        np.testing.assert_allclose(found, before, rtol=0, atol=rounding * np.abs(before).max())


def _write(names: list[str]) -> None:
    if not jax.config.jax_enable_x64:  # later than on import some of the numbers would be rounded
        sys.exit("set JAX_ENABLE_X64=1")
    before = json.loads(FILE.read_text()) if names else {}
    lines = []
    for name in ALL:
        for dtype in ROUNDING:
            key = f"{name}, {dtype}"
            if not names or name in names:
                before[key] = [part.tolist() for part in parts(name, dtype)]
                print(key, flush=True)
            lines.append(f"{json.dumps(key)}: {json.dumps(before[key])}")
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n")


if __name__ == "__main__":
    _write(sys.argv[1:])
