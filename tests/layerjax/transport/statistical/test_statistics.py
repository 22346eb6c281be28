"""Directional statistics: widths, and adding against a sum over paths."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from layerjax.transport.lobes.adding import (
    Element,
    Orders,
    add_element,
    add_orders,
    identity,
    limit_escape,
    multiply_orders,
    sum_orders,
)
from layerjax.transport.lobes.variance import (
    bounded_refracted_cosine,
    phase_variance,
    roughness,
    transmission_scale,
    variance,
)


def test_roughness_as_a_variance() -> None:
    """Belcour 2018, Eq. 6, to the digits given."""
    f = variance(jnp.array([0.1, 0.3, 0.2]))
    np.testing.assert_allclose(f[:2], [0.0862868, 0.3623430], atol=5e-8)
    np.testing.assert_allclose(roughness(jnp.stack([f[0] + f[1], 2 * f[2]])), [0.3445163, 0.3255488], atol=5e-8)
    alpha = jnp.geomspace(1e-4, 0.99, 50)
    np.testing.assert_allclose(roughness(variance(alpha)), alpha, rtol=1e-12)


def test_refraction_at_sixty_degrees() -> None:
    """n = 1.5: cosine, both scales (Eq. 10 with its sign put right), and the factors of variance."""
    cosine, ior = jnp.asarray(0.5), jnp.asarray(1.5)
    refracted, exists = bounded_refracted_cosine(cosine, ior, 0.999)
    assert exists
    found = [refracted, transmission_scale(cosine, ior, refracted), transmission_scale(refracted, 1 / ior, cosine)]
    np.testing.assert_allclose(found, [0.8164966, 0.2958759, 0.7247449], atol=5e-8)
    np.testing.assert_allclose(ior * refracted / cosine, 2.4494897, atol=5e-8)


def test_phase_function_as_a_variance() -> None:
    """Belcour 2018, Eq. 21."""
    sigma = phase_variance(jnp.array([0.7, 0.9]))
    np.testing.assert_allclose(sigma, [0.2986549, 0.0907512], atol=5e-8)
    np.testing.assert_allclose(roughness(sigma), [0.2628484, 0.1043030], atol=5e-8)


@pytest.mark.parametrize("function", [variance, roughness, phase_variance])
def test_widths_are_finite_with_finite_derivatives(function) -> None:
    for dtype in (jnp.float32, jnp.float64):
        for x in (-0.999, 0.0, 1e-30, 1e-4, 0.5, 0.999, 1.0, 1e4):
            value, slope = jax.value_and_grad(function)(
                jnp.asarray(min(x, 0.999) if function is phase_variance else x, dtype)
            )
            assert jnp.isfinite(value), (x, dtype)
            assert jnp.isfinite(slope), (x, dtype)


def by_orders(energies: Sequence[float]) -> Orders:
    return tuple((jnp.asarray(energy),) for energy in energies)


def total(energy: Orders) -> float:
    return float(sum_orders(energy)[0])


def random_elements(seed: int, count: int, orders: int = 1) -> list[Element]:
    rng = np.random.default_rng(seed)
    elements = []
    for _ in range(count):
        r12, r21 = rng.uniform(0.05, 0.6, 2)
        t12, t21 = (1.0 - r12) * rng.uniform(0.7, 1.0), (1.0 - r21) * rng.uniform(0.7, 1.0)
        energies = [[e, *([0.0] * (orders - 1))] for e in (r12, t12, r21, t21)]
        if orders > 1:
            energies[1][1:], energies[3][1:] = rng.uniform(0.0, 0.05, (2, orders - 1))
        widths = [(jnp.asarray(width),) for width in (*rng.uniform(0.05, 0.5, 3), rng.uniform(0.5, 2.0))]
        elements.append(Element(*map(by_orders, energies), *widths))
    return elements


def paths(elements: list[Element]) -> tuple[float, float, float, float]:
    """Energy and mean variance of all light reflected and transmitted, by following every path until it has left.

    State: the medium that light is in and where it goes. With each state goes the energy and energy times variance.
    """
    n = len(elements)
    down, up = np.zeros((n + 1, 2)), np.zeros((n + 1, 2))
    down[0, 0] = 1.0
    left = np.zeros((2, 2))
    for _ in range(2000):
        next_down, next_up = np.zeros_like(down), np.zeros_like(up)

        def move(to, state, share, factor, added):
            to[0] += share * state[0]
            to[1] += share * (factor * state[1] + added * state[0])

        for i, e in enumerate(elements):
            r12, t12, r21, t21 = (total(energy) for energy in e[:4])
            widening, s_down, s_up, jacobian = (float(width[0]) for width in e[4:])
            move(next_up[i], down[i], r12, 1.0, widening)
            move(next_down[i + 1], down[i], t12, 1.0 / jacobian, s_down)
            move(next_down[i + 1], up[i + 1], r21, 1.0, widening)
            move(next_up[i], up[i + 1], t21, jacobian, s_up)
        left[0] += next_up[0]
        left[1] += next_down[n]
        next_up[0], next_down[n] = 0.0, 0.0
        down, up = next_down, next_up
    return left[0, 0], left[0, 1] / left[0, 0], left[1, 0], left[1, 1] / left[1, 0]


@pytest.mark.parametrize("seed", [*(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2)), 3])
def test_adding_is_the_sum_over_paths(seed: int) -> None:
    elements = random_elements(seed, 4)
    above, lobes = identity(jnp.ones(())), []
    for element in elements:
        lobe, above = add_element(above, element)
        lobes.append(lobe)
    energy = sum(total(lobe.energy) for lobe in lobes)
    width = sum(total(lobe.energy) * float(lobe.variance[0]) for lobe in lobes) / energy
    found = energy, width, total(above.t0), float(above.s_t0[0])
    np.testing.assert_allclose(found, paths(elements), rtol=1e-12)


@pytest.mark.slow
def test_scattering_orders_sum_to_the_whole() -> None:
    """Whatever the orders are, their sums follow the same adding; and the first two are those of a power series."""
    elements = random_elements(4, 3, orders=3)
    above, reflected = identity(jnp.ones(())), 0.0
    for element in elements:
        lobe, above = add_element(above, element)
        reflected += total(lobe.energy)
    expected = paths(elements)
    np.testing.assert_allclose([reflected, total(above.t0)], [expected[0], expected[2]], rtol=1e-12)

    def at(eps: float) -> float:  # energy of the last lobe when every order counts with eps^k
        scaled = [
            e._replace(
                **{
                    name: by_orders([sum(order[0] * eps**k for k, order in enumerate(getattr(e, name)))])
                    for name in ("r12", "t12", "r21", "t21")
                }
            )
            for e in elements
        ]
        state = identity(jnp.ones(()))
        for element in scaled:
            found, state = add_element(state, element)
        return total(found.energy)

    step = 1e-4
    slope = (at(step) - at(-step)) / (2 * step)  # error step^2
    np.testing.assert_allclose([lobe.energy[0][0], lobe.energy[1][0]], [at(0.0), slope], rtol=1e-6)


def test_products_of_orders_keep_sums_and_padding() -> None:
    a, b = by_orders([0.5, 0.2, 0.1]), by_orders([0.3, 0.3, 0.4])
    np.testing.assert_allclose(np.ravel(multiply_orders(a, b)), [0.15, 0.21, 0.44])
    np.testing.assert_allclose(np.ravel(add_orders(a, b[:1])), [0.8, 0.2, 0.1])
    np.testing.assert_allclose(np.ravel(multiply_orders(a, b[:1])), 0.3 * np.ravel(a))


def test_total_reflection_keeps_the_energy() -> None:
    _, above = add_element(identity(jnp.ones(())), random_elements(5, 1)[0])
    kept = limit_escape(above, (jnp.asarray(0.7),))
    np.testing.assert_allclose(np.ravel(kept.ti), 0.7 * np.ravel(above.ti))
    np.testing.assert_allclose(np.ravel(add_orders(kept.ti, kept.ri)), np.ravel(add_orders(above.ti, above.ri)))
