"""GGX normals by a matrix of widths: as those of two widths and a tangent, and smooth where the widths are equal."""

import jax
import jax.numpy as jnp
import numpy as np

import layerjax as lj
from layerjax.directions import split
from layerjax.normals import facets
from layerjax.normals.width_matrix import (
    WidthMatrix,
    matrix_area,
    matrix_density,
    matrix_pdf,
    matrix_sample,
    width_matrix,
)
from layerjax.normals.widths import Widths
from tests.helpers.compiled import compiled
from tests.helpers.interfaces import sphere

WIDTHS = Widths(jnp.asarray(0.3), jnp.asarray(0.7), jnp.asarray(0.4))
MATRIX = compiled(width_matrix)(WIDTHS)


def test_eigenvalues_are_the_widths_along_the_tangent_and_across():
    matrix = np.array([[MATRIX.xx, MATRIX.xy], [MATRIX.xy, MATRIX.yy]])
    along, across = np.array([np.cos(0.4), np.sin(0.4)]), np.array([-np.sin(0.4), np.cos(0.4)])
    np.testing.assert_allclose(matrix @ along, 0.3 * along, rtol=1e-14)
    np.testing.assert_allclose(matrix @ across, 0.7 * across, rtol=1e-14)
    np.testing.assert_allclose(compiled(lambda widths: widths.mean_square)(MATRIX), (0.09 + 0.49) / 2, rtol=1e-14)


def test_densities_and_areas_are_those_of_two_widths():
    m, _ = sphere(20)
    up, wi = split(m[m[..., 2] > 0.01]), split(np.asarray(lj.direction(1.2, 0.3)))

    def by_matrix(m, wi):
        return matrix_density(m, MATRIX), m[2] + matrix_area(m, MATRIX), matrix_pdf(m, wi, MATRIX)

    def by_widths(m, wi):
        area = facets.twice_projected_area(m[2], m, WIDTHS, "ggx")
        return facets.density(m, WIDTHS, "ggx"), area, facets.reflection_pdf(m, wi, WIDTHS)

    for found, expected in zip(compiled(by_matrix)(up, wi), compiled(by_widths)(up, wi), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_draws_have_the_moments_of_what_is_seen():
    """Means of the slopes of 200,000 normals beside a quadrature of D <wi, m> G1 / cos: 4.5 standard errors."""
    wi, (u1, u2) = np.asarray(lj.direction(1.1, 0.9)), np.random.default_rng(2).random((2, 200_000))
    drawn = np.stack(compiled(matrix_sample)(split(wi), MATRIX, u1, u2))
    m, weight = sphere(600)
    density = np.where(m[..., 2] > 0, compiled(matrix_density)(split(m), MATRIX), 0.0)
    seen = density * np.maximum(m @ wi, 0.0) * weight
    for k in range(3):
        expected, mean = np.sum(seen * m[..., k]) / np.sum(seen), drawn[k].mean()
        assert abs(mean - expected) < 4.5 * drawn[k].std() / 200_000**0.5 + 1e-6


def test_derivatives_where_the_widths_are_equal():
    """By each entry, beside differences of the density."""
    m = split(np.asarray(lj.direction(0.4, 0.9)))

    def density(entries):
        return matrix_density(m, WidthMatrix(*entries))

    at, step = np.array([0.3, 0.0, 0.3]), 1e-6
    value = compiled(density)
    expected = [(value(at + unit) - value(at - unit)) / (2 * step) for unit in step * np.eye(3)]
    np.testing.assert_allclose(compiled(jax.grad(density))(at), expected, rtol=1e-7)


def test_width_seen_is_that_along_grazing_light():
    """And the root mean square of the widths where light comes along the normal."""
    seen = compiled(lambda x, y: MATRIX.width_seen(x, y))
    np.testing.assert_allclose(seen(np.cos(0.4), np.sin(0.4)), 0.3, rtol=1e-14)
    np.testing.assert_allclose(seen(-np.sin(0.4), np.cos(0.4)), 0.7, rtol=1e-14)
    np.testing.assert_allclose(seen(0.0, 0.0), 0.29**0.5, rtol=1e-14)
