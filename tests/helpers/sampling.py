"""Draws against the density that is claimed for them: chi-square over cells of the sphere."""

import jax.numpy as jnp
import numpy as np
import scipy.stats

import layerjax as lj

DRAWS = 200_000
CELLS, POINTS = 40, 8  # cells along either axis, and points of the rule along either side of a cell
SIGNIFICANCE = 1e-4  # with 18 cases a correct sampler fails a file once in 500 seeds


def cell_probabilities(density, cosines, azimuths):
    """Integral of the density over cells of a (cos theta, phi) grid, by Gauss quadrature in each."""
    x, w = np.polynomial.legendre.leggauss(POINTS)

    def spread(edges):
        width = np.diff(edges)[:, None]
        return edges[:-1, None] + width * 0.5 * (x + 1), width * 0.5 * w

    (z, wz), (phi, wp) = spread(cosines), spread(azimuths)
    wo = lj.direction(jnp.arccos(z)[:, None, :, None], jnp.asarray(phi)[None, :, None, :])
    values = density(wo)
    return np.einsum("ijkl,ik,jl->ij", np.asarray(values), wz, wp)


def chi_square(drawn, density):
    """Probability of so large a distance between draws and their density, and the integral of the density."""
    cosines, azimuths = np.linspace(-1, 1, CELLS + 1), np.linspace(-np.pi, np.pi, CELLS + 1)
    expected = cell_probabilities(density, cosines, azimuths)
    theta, phi = lj.angles(drawn)
    counts, _, _ = np.histogram2d(np.cos(theta), np.asarray(phi), bins=(cosines, azimuths))
    expected, counts = expected.ravel() * DRAWS, counts.ravel()
    order = np.argsort(-expected)
    large = order[expected[order] >= 10]
    statistic = np.sum((counts[large] - expected[large]) ** 2 / expected[large])
    rest = DRAWS - expected[large].sum()  # all other cells, and directions without a density, pooled
    if rest > 10:
        statistic += (DRAWS - counts[large].sum() - rest) ** 2 / rest
    return scipy.stats.chi2.sf(statistic, len(large)), expected.sum() / DRAWS


def density_of(drawn, density):
    """The density at the first draws, asked for in the shape that `chi_square` asks in: it is compiled already."""
    shape = CELLS, CELLS, POINTS, POINTS
    return np.ravel(density(drawn[: np.prod(shape)].reshape(*shape, 3)))
