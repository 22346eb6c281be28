"""Directional statistics of what a stack does not hold leave no operations behind: counted in the lowered program."""

import jax.numpy as jnp
import pytest

import layerjax as lj
from benchmarks.measuring.operations import count

WI, WO = lj.direction(jnp.linspace(0.1, 1.4, 50), 0.0), lj.direction(jnp.linspace(0.2, 1.3, 50), 2.0)
METAL, DIFFUSE = lj.Conductor(0.2, 3.9, 0.3), lj.Lambertian(0.5)
COAT = lj.Interface(1.5, 0.2)
HAZE = lj.Medium(0.7, 0.9, lj.HenyeyGreenstein(0.6))


def program(layers, base=METAL, **options):
    """Operations by name, of the preparation and the values together."""
    stack = lj.Stack(layers, base)
    return count(lambda wi, wo: lj.evaluate(stack, wi, wo, lj.Statistical(**options)), WI, WO)


def operations(layers, base=METAL, **options):
    return sum(program(layers, base, **options).values())


def test_media():
    clear, dark = operations([COAT]), operations([COAT, lj.Medium(0.7, 0.0)])
    assert clear < dark < operations([COAT, HAZE])
    assert operations([COAT, HAZE], scattering="single") < operations([COAT, HAZE])
    assert program([COAT, lj.Medium(0.0, 0.9)]) == program([COAT])


@pytest.mark.slow
def test_interfaces():
    bare, one, two = (operations(layers) for layers in ([], [COAT], [COAT, lj.Interface(1.8, 0.1)]))
    assert bare < one < two
    assert program([lj.Interface(1.0, 0.2), COAT]) == program([COAT])  # nothing is there to see
    assert program([COAT, lj.Interface(1.5, 0.1)]) == program([COAT])


@pytest.mark.slow
@pytest.mark.parametrize("multiple", [False, True])
def test_smooth_interfaces(multiple):
    """Fresnel's formulas in place of a quadrature over facets."""
    smooth, rough = (
        operations([lj.Interface(1.5, alpha)], facet_multiple_scattering=multiple) for alpha in (1e-4, 0.2)
    )
    assert smooth < rough


@pytest.mark.slow
def test_bases():
    """No diffuse base asks for a solver unasked, but one that is not Lambertian; bare it is itself."""
    two = [COAT, lj.Interface(1.8, 0.1)]
    rough = lj.OrenNayar(0.5, 0.3)
    solved = program([HAZE], rough), program(two, DIFFUSE, diffuse="exact")
    read = (
        program([COAT], None),
        program([COAT]),
        program([COAT], DIFFUSE),
        program([COAT, lj.Medium(0.7, 0.0)], DIFFUSE),
        program(two, DIFFUSE),
        program([COAT, HAZE], DIFFUSE),
        program([HAZE], DIFFUSE),
        program([HAZE, COAT, HAZE], DIFFUSE),
    )
    assert all(found["dot_general"] > 10 for found in solved)
    assert all(found["dot_general"] < 10 for found in read)
    assert operations([], DIFFUSE) < 12 < operations([], METAL) < operations([COAT])


@pytest.mark.slow
def test_one_side():
    stack = lj.Stack([COAT])
    everything, reflection = (
        sum(count(lambda wi, wo, side=side: lj.evaluate(stack, wi, wo, lj.Statistical(), side=side), WI, WO).values())
        for side in ("all", "reflection")
    )
    assert reflection < everything


@pytest.mark.slow
def test_channels():
    one, three = operations([COAT, lj.Medium(0.7, 0.0)]), operations([COAT, lj.Medium([0.1, 0.7, 2.0], 0.0)])
    assert one < three < 1.5 * one
