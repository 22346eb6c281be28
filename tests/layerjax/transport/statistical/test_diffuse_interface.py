"""Coats over diffuse light: against published values, smooth coats in closed form, and the walk on the microsurface."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax._numerics import safe_sqrt
from layerjax.precompute import diffuse_interface
from layerjax.tables import load
from layerjax.transport.statistical.diffuse import (
    Coat,
    closed_form,
    coat_means,
    coated_transmission,
    indirect_energy,
    indirect_lobe,
    normal_lobe,
    reflection,
    stack_lobe,
    transmission,
    width,
)
from tests.helpers.compiled import compiled
from tests.helpers.derivatives import with_slopes

SMOOTH = 1e-4
TABLE_ERROR = 1e-3

t01, means = compiled(coated_transmission), compiled(coat_means)
diffuse_light, lobe, lobe_width = compiled(indirect_lobe), compiled(normal_lobe), compiled(width)


def r10(alpha, n, tau):
    return means(alpha, n, tau).returned


def t10(alpha, n, tau):
    return means(alpha, n, tau).leaving


def alpha_2(alpha, n, tau):
    return means(alpha, n, tau).width


def gauss(nodes, *edges):
    x, w = np.polynomial.legendre.leggauss(nodes)
    parts = [(a + 0.5 * (b - a) * (x + 1), 0.5 * (b - a) * w) for a, b in pairwise(edges)]
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))


def fresnel(cosine, n):
    """Reflectance, and the cosine of refraction (1 under total reflection)."""
    squared = 1 - (1 - cosine**2) / n**2
    c = np.sqrt(np.where(squared > 0, squared, 1.0))
    s, p = (cosine - n * c) / (cosine + n * c), (n * cosine - c) / (n * cosine + c)
    return np.where(squared > 0, 0.5 * (s**2 + p**2), 1.0), c


def smooth_reflection(n, tau):
    """R10 of a smooth coat, by quadrature that ends at the critical angle."""
    critical = np.sqrt(max(1 - 1 / n**2, 0.0))
    c, w = gauss(200, *([0.0, critical, 1.0] if critical > 0 else [0.0, 1.0]))
    return np.sum(2 * w * c * tau ** (2 / c) * fresnel(c, 1 / n)[0])


def test_smooth_coats():
    for n, tau, back, out in (
        (1.5, 1.0, 0.5963458, 0.4036542),
        (2.0, 1.0, 0.7901492, None),
        (1 / 1.5, 1.0, 0.0917781, None),
        (1.5, 0.7, 0.1462663, 0.2691399),
    ):
        assert abs(smooth_reflection(n, tau) - back) < 5e-6
        assert abs(r10(SMOOTH, n, tau) - back) < TABLE_ERROR
        if out is not None:
            assert abs(t10(SMOOTH, n, tau) - out) < TABLE_ERROR


@pytest.mark.parametrize("n", [0.25, 0.6, 0.9, 1.0, 1.1, 1.33, 1.8, 3.0, 4.0])
def test_smooth_transmission(n):
    cosine = np.linspace(0.05, 1.0, 60)
    critical = np.sqrt(max(1 - n * n, 0.0))
    for tau in (1.0, 0.6, 0.1):
        reflectance, c = fresnel(cosine, n)
        error = np.abs(t01(cosine, SMOOTH, n, tau) - (1 - reflectance) * tau ** (1 / c))
        # the edge of total reflection is as sharp as the grid
        assert np.max(np.where(np.abs(cosine - critical) > 0.04, error, 0.0)) < 2e-3
        assert np.sqrt(np.mean(error**2)) < (5e-2 if n < 1 else 1e-3)


def test_rough_coat():
    # walks of the multiple-scattering microsurface, n = 1.5, alpha = 0.1, with their standard errors
    for tau, expected in (
        (1.0, [(0.96029, 1.0e-4), (0.91230, 1.4e-4), (0.40888, 2.5e-4), (0.59112, 2.5e-4)]),
        (0.7, [(0.67147, 0.7e-4), (0.58176, 0.9e-4), (0.26930, 1.6e-4), (0.14072, 0.7e-4)]),
    ):
        arguments = (0.1, 1.5, tau)
        found = [t01(1.0, *arguments), t01(0.5, *arguments), t10(*arguments), r10(*arguments)]
        for value, (mean, error) in zip(found, expected, strict=True):
            assert abs(value - mean) < 4 * error + 4e-4


PATHS = 60_000


def walked(stack, wi, bins=64):
    """Energy that leaves on each light's own side and on the other, by its path through the coat, 1 / cosine."""
    seen = lj.goniophotometer(
        stack, wi, key=jax.random.key(1), paths=PATHS, polar=bins, azimuth=1, orders=1, facet_multiple_scattering=True
    )
    cosines = np.asarray(seen.cosines)
    return np.asarray(seen.energy)[..., 0, 0], 2 / (cosines[1:] + cosines[:-1])


def absorbed(energy, path, tau):
    """Energy that is left after these paths, and its standard error."""
    left = energy @ tau**path
    return left, np.sqrt(left * (1 - left) / PATHS) + 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "alpha"),
    [
        (1.5, 0.6),
        (0.5, 0.9),
        (1 / 1.5, 0.3),
        (2.5, 0.2),
    ],
)
def test_rough_coats_against_the_walk(n, alpha):
    cosine = np.asarray([0.2, 0.5, 0.8, 1.0])
    stack = lj.Stack([lj.Interface(n, alpha)])
    inner, weight = gauss(8, 0.0, 1.0)
    down, path = walked(stack, lj.direction(np.arccos(cosine), 0.0))
    up, _ = walked(stack, lj.direction(np.pi - np.arccos(inner), 0.0))
    for tau in (1.0, 0.5):
        energy, error = absorbed(down[:, 1], path, tau)
        np.testing.assert_array_less(np.abs(t01(cosine, alpha, n, tau) - energy), 4 * error + 2e-3)
        back, error = absorbed(up[:, 0], path, tau)
        share = 2 * inner * weight * tau ** (1 / inner)
        slack = 4 * np.sqrt(np.sum((share * error) ** 2)) + 3e-3  # of eight cosines
        assert abs(r10(alpha, n, tau) - share @ back) < slack


def test_closed_form_and_energy():
    arguments = (SMOOTH, 1.5, 1.0)
    value = closed_form(t01(1.0, *arguments), t01(0.5, *arguments), r10(*arguments), 0.9, 1.5)
    assert abs(value / 0.2403028 - 1) < 2e-3
    assert abs(indirect_energy(t01(1.0, *arguments), t10(*arguments), r10(*arguments), 0.9) / 0.7527858 - 1) < 2e-3
    for cosine, mean in ((1.0, 0.75480), (0.5, 0.71707)):  # walks, +-2e-4
        arguments = (0.1, 1.5, 1.0)
        found = indirect_energy(t01(cosine, *arguments), t10(*arguments), r10(*arguments), 0.9)
        assert abs(found - mean) < 8e-4 + 1e-3


def test_closed_form_has_the_indirect_energy():
    c, w = gauss(40, 0.0, np.sqrt(1 - 0.7**2), 1.0)
    for n, tau in ((1.4, 0.8), (0.7, 0.6)):
        leaving, returned, into = t10(0.3, n, tau), r10(0.3, n, tau), t01(c, 0.3, n, tau)
        energy = np.sum(2 * np.pi * w * c * closed_form(t01(0.6, 0.3, n, tau), into, returned, 0.7, n))
        np.testing.assert_allclose(energy, indirect_energy(t01(0.6, 0.3, n, tau), leaving, returned, 0.7), rtol=1e-4)


def test_widths():
    for alpha, moment in ((0.05, 0.01920), (0.1, 0.05107), (0.3, 0.16387), (0.5, 0.22373), (1.0, 0.27157)):
        _, found = lobe(alpha)
        assert abs(found - moment) < 6e-6
        assert abs(lobe_width(found) - alpha) < 1e-4
    for alpha, energy in ((0.3, 0.87736), (0.7, 0.50372), (1.0, 1 - np.log(2))):
        assert abs(lobe(alpha)[0] - energy) < 6e-6
    # moments of walks: (.24250, .11892, .15373, .07623, .1014) and widths
    for n, alpha, tau, moment, expected in (
        (1.5, 0.1, 1.0, 0.24250, 0.612),
        (1 / 1.5, 0.1, 1.0, 0.11892, 0.2079),
        (1 / 1.5, 0.3, 1.0, 0.15373, 0.2767),
        (0.5, 0.1, 1.0, 0.07623, 0.1379),
        (1.5, 0.1, 0.3, 0.2225, None),
        (1 / 1.5, 0.1, 0.3, 0.0810, None),
    ):
        found = alpha_2(alpha, n, tau)
        assert abs(lobe(found)[1] - moment) < 1e-3
        assert expected is None or abs(found / expected - 1) < 0.01


def test_indirect_lobe_keeps_its_energy():
    c, w = gauss(60, 0.0, 0.9, 1.0)
    wo = (np.sqrt(1 - c**2), 0 * c, c)
    for alpha in (0.05, 0.3, 0.7, 1.0):
        np.testing.assert_allclose(np.sum(2 * np.pi * w * c * diffuse_light(wo, alpha, 0.8)), 0.8, rtol=1e-4)


def test_two_coats():
    # smooth n = 1.5 over n = 2, alpha = 0.1: walks, +-5e-4
    def found(albedo):
        coats = [Coat(jnp.asarray(a), jnp.asarray(n), jnp.asarray(1.0)) for a, n in ((SMOOTH, 1.5), (0.1, 2.0))]
        return stack_lobe(coats, albedo, jnp.asarray([1.0, 0.5]))

    stacked = compiled(found)
    for albedo, means in ((1.0, [0.9425, 0.8981]), (0.9, [0.6297, 0.5998])):
        energy, alpha = stacked(albedo)
        np.testing.assert_allclose(energy, means, rtol=0.01)  # a beam is not a lobe
        assert np.all(alpha > 0.55)
        assert np.all(alpha < 0.65)


def test_one_coat_is_a_stack():
    coat = Coat(np.asarray(0.3), np.asarray(1.5), np.asarray(0.7))
    energy, alpha = compiled(stack_lobe)([coat], 0.8, np.asarray(0.6))
    parts = t01(0.6, *coat), t10(*coat), r10(*coat)
    np.testing.assert_allclose(energy, indirect_energy(*parts, 0.8), rtol=1e-6)
    np.testing.assert_allclose(alpha, alpha_2(*coat), rtol=1e-6)


def test_nothing_is_lost_without_absorption():
    alpha, n = np.meshgrid([1e-4, 0.03, 0.2, 0.6, 1.0], [0.25, 0.7, 0.99, 1.0, 1.01, 1.3, 2.2, 4.0])
    total = t10(alpha, n, 1.0) + r10(alpha, n, 1.0)
    np.testing.assert_allclose(total, 1.0, atol=2e-5)
    # the two tables, of different walks and quadratures, say the same
    apart = t10(alpha, n, 1.0) + compiled(lambda a, n: reflection(load("diffuse_interface"), a, n, 1.0))(alpha, n)
    np.testing.assert_allclose(apart, 1.0, atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_finite_over_the_box(dtype):
    axes = [1e-6, 0.3, np.sqrt(1 - 0.7**2), 1.0], [1e-4, 0.1, 1.0], [0.25, 0.7, 0.999, 1.0, 1.5, 4.0], [0.0, 1e-3, 1.0]
    points = jnp.asarray(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 4), dtype)

    def everything(x):
        cosine, alpha, n, tau = x
        wo = safe_sqrt((1 - cosine) * (1 + cosine)), 0 * cosine, cosine
        coats = [Coat(alpha, n, tau), Coat(alpha, jnp.asarray(1.2, dtype), tau)]
        into = coated_transmission(cosine, alpha, n, tau)
        return jnp.stack(
            [into, *coat_means(alpha, n, tau), indirect_lobe(wo, alpha, 1.0), *stack_lobe(coats, 0.9, cosine)]
        )

    values, slopes = compiled(jax.vmap(with_slopes(everything, 0, "forward")))(points)
    assert values.dtype == dtype
    assert np.all(np.isfinite(values))
    assert np.all(np.isfinite(slopes))
    assert np.all(values[:, :4] >= 0)
    assert np.all(values[:, :4] <= 1 + TABLE_ERROR)


def test_slopes_are_those_of_the_values():
    at = np.asarray([0.6, 0.2, 1.5, 0.7])
    slopes_at = compiled(jax.grad(lambda x: coated_transmission(*x)))
    slopes = slopes_at(at)
    for i in range(4):
        step = 1e-5 * np.eye(4)[i]
        difference = (t01(*(at + step)) - t01(*(at - step))) / 2e-5
        np.testing.assert_allclose(slopes[i], difference, rtol=1e-5, atol=1e-8)
    # a physical slope: with the smooth limit's index
    c = 0.8

    def smooth(n):
        reflectance, refracted = fresnel(c, n)
        return (1 - reflectance) * 0.7 ** (1 / refracted)

    expected = (smooth(1.5 + 1e-4) - smooth(1.5 - 1e-4)) / 2e-4
    assert abs(slopes_at(np.asarray([c, SMOOTH, 1.5, 0.7]))[2] - expected) < 5e-3


def test_table_states_its_error():
    table = load("diffuse_interface")
    np.testing.assert_array_less(table["error"], [[1e-3, 0.05], [2e-3, 0.15]])
    np.testing.assert_array_less(table["returned_error"], [[1e-4, 2e-3], [1e-4, 1e-3]])
    for side in table["rank_errors"]:
        ranks = {(int(n), int(m)): rms for n, m, rms, _ in side}
        assert ranks[2, 4] < 2e-2
        assert ranks[4, 4] < 5e-3
        assert ranks[8, 8] < 5e-4


@pytest.mark.slow
def test_rebuilding():
    coarse, shipped = diffuse_interface.make(coarse=True, report=lambda line: None), load("diffuse_interface")
    assert set(coarse) == set(shipped)
    assert int(coarse["seed"]) == int(shipped["seed"])
    cosine, alpha = np.linspace(0.1, 1.0, 20)[:, None], np.asarray([0.05, 0.2, 0.5, 1.0])
    for n in (1 / 1.5, 1.5, 2.5):
        for tau in (1.0, 0.5):
            difference = transmission(coarse, cosine, alpha, n, tau) - transmission(shipped, cosine, alpha, n, tau)
            assert np.sqrt(np.mean(difference**2)) < 1e-2
            assert np.max(np.abs(reflection(coarse, alpha, n, tau) - reflection(shipped, alpha, n, tau))) < 5e-3
