"""Light from a diffuse base under one coat, from tables, beside the solve of all layers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.stack import simplify
from layerjax.transport.statistical.coated_base import is_coated, make_coated
from layerjax.transport.statistical.diffuse_base import make_diffuse

COAT, DYE = lj.Interface(1.5, 0.05), lj.Medium([0.3, 2.0], 0.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "layers",
    [[COAT], [COAT, DYE], [lj.Interface(0.8, 0.05)]],
)
def test_smooth_coats_are_as_solved(layers) -> None:
    """Where facets are met once. Of rough ones the solver takes all light that others send on to enter."""
    stack = simplify(lj.Stack(layers, lj.Lambertian([0.3, 0.9])))
    assert is_coated(stack)
    angles = np.random.default_rng(0).uniform(0.05, 1.4, (2, 200))
    wi, wo = ((jnp.sin(t), 0.0 * t, jnp.cos(t)) for t in map(jnp.asarray, angles))

    @jax.jit
    def values_and_albedos(wi, wo):
        parts = make_coated(stack), make_diffuse(stack, stack.base, True)
        return [(part.value(wi, wo), part.albedo(wi)) for part in parts]

    (values, albedos), (solved, solved_albedos) = values_and_albedos(wi, wo)
    for found, wanted in zip(values, solved, strict=True):
        assert np.sqrt(np.sum((found - wanted) ** 2) / np.sum(wanted**2)) < 4e-3
    for found, wanted in zip(albedos, solved_albedos, strict=True):
        np.testing.assert_allclose(found, wanted, atol=4e-3)


def test_what_needs_a_solve() -> None:
    base, haze = lj.Lambertian(0.5), lj.Medium(0.7, 0.9, lj.HenyeyGreenstein(0.6))
    others = (
        ([COAT, lj.Interface(1.8, 0.1)], base),
        ([COAT, haze], base),
        ([DYE], base),
        ([COAT], lj.OrenNayar(0.5, 0.3)),
    )
    assert not any(is_coated(simplify(lj.Stack(layers, below))) for layers, below in others)
