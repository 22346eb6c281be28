"""The readings of many texels as a model takes them, and what is found of each."""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits.problem.model import Model
from fits.problem.parameters import Box
from fits.problem.problem import Problem

Floats = NDArray[np.float64]

UNHEARD = 1e9
"""Standard deviation of a reading that is left out, in units of the largest: it weighs less than rounding."""


class Texels(NamedTuple):
    """Readings of M texels.

    values, variance, lowest: (M, N, C), BSDF in 1/sr, the measurement's own variance, enormous for what is left out,
    and what sigma cannot fall below. used: (M, N, C) bool. wi, wo: (M, N, 3), None where all texels have the directions
    of the problem. centre, inverse_sd: (M, P), of Gaussian priors beside those of the problem, in the coordinate of
    `Box.centre`; None where there are none.
    """

    values: Any
    variance: Any
    lowest: Any
    used: Any
    wi: Any = None
    wo: Any = None
    centre: Any = None
    inverse_sd: Any = None

    @property
    def number(self) -> int:
        """How many there are, M."""
        return len(self.values)

    def rows(self, places: Any) -> "Texels":
        """Some of the texels."""
        return Texels(*(None if part is None else part[places] for part in self))

    @property
    def readings(self) -> NDArray[np.int64]:
        """How many of each texel count, (M,)."""
        return np.sum(self.used, axis=(1, 2))


def texels(
    values: Floats,
    sigma: Floats | None = None,
    least: float = 0.0,
    wi: Floats | None = None,
    wo: Floats | None = None,
) -> Texels:
    """Readings (M, N, C), with their standard deviations of that shape; what is not finite is left out, in single
    precision too what is so only in double.

    least: of the noise's floor.

    Raises:
        ValueError: a standard deviation is negative, or 0 where the reading counts.
    """
    largest_number = float(jnp.finfo(jnp.result_type(float)).max)
    used = np.abs(values) <= largest_number
    variance = np.zeros(values.shape)
    if sigma is not None:
        used &= np.isfinite(sigma)
        wrong = used & (sigma <= 0.0)
        if wrong.any():
            raise ValueError(f"sigma is {sigma[wrong][0]:g} in a reading that counts; it must be above 0")
        variance = _squared(np.where(used, sigma, 0.0), largest_number)
    largest = np.max(np.abs(values), initial=0.0, where=used, axis=(1, 2), keepdims=True)
    largest = np.minimum(np.where(largest > 0.0, largest, 1.0), largest_number / UNHEARD)
    silent = _squared(UNHEARD * largest, largest_number)
    variance = np.where(used, variance, silent)
    return with_floor(Texels(np.where(used, values, 0.0), variance, variance, used, wi, wo), least)


def blank(shape: tuple[int, ...]) -> Texels:
    """One texel, for a model that is asked what it says whatever the readings: (N, C) zeros."""
    return texels(np.zeros((1, *shape)))


def _squared(numbers: Floats, largest: float) -> Floats:
    """Squares that can still be added to others."""
    with np.errstate(over="ignore"):
        return np.minimum(np.square(numbers), 0.25 * largest)


def with_floor(texels: Texels, least: float) -> Texels:
    """The texels with noise whose floor is at least so much, in 1/sr."""
    return texels._replace(lowest=np.sqrt(texels.variance + least**2))


def model_of(model: Model, row: Texels) -> Model:
    """The model with the readings of one texel, (N, C)."""
    own = (row.values, row.variance, row.lowest)
    model = eqx.tree_at(lambda m: (m.values, m.variance, m.lowest), model, own)
    if row.centre is not None:
        model = eqx.tree_at(lambda m: m.box, model, _with_prior(model.box, row.centre, row.inverse_sd))
    return model if row.wi is None else eqx.tree_at(lambda m: (m.wi, m.wo), model, (row.wi, row.wo))


def _with_prior(box: Box, centre: Array, inverse_sd: Array) -> Box:
    """The box with Gaussian priors (P,) beside its own, one product of the two, up to a constant."""
    own, other = jnp.square(box.inverse_sd), jnp.square(inverse_sd)
    both = own + other
    mean = (own * box.centre + other * centre) / jnp.where(both > 0.0, both, 1.0)
    return replace(box, centre=mean, inverse_sd=jnp.sqrt(both))


def with_own_directions(problem: Problem) -> Problem:
    """The problem for texels that have directions of their own, of which nothing is known beforehand."""
    return problem.with_model(replace(problem.model, known=None, side="all"))


def chi_square(model: Model, row: Texels, vector: Array, predicted: Array) -> Array:
    """Of the readings that count; for a named objective the sum of its squared residuals."""
    return jnp.sum(jnp.where(row.used, model.standardised_at(vector, predicted), 0.0) ** 2)
