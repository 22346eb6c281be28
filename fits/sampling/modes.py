"""Minima of a fit that may be modes of its posterior: how much each holds of it is for `Mixture.of` to say."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from fits.optimise.multi_start import least_squares_descent, unit_of
from fits.optimise.result import Fit, Minimum
from fits.optimise.uncertainty import uncertainty

WITHIN = 5.0
"""In the logarithm of the share of the posterior that a mode holds, beside that of the largest."""

LOOKED_AT = 8.0
"""In the log-posterior, from the best minimum down: what lies lower holds next to nothing, however broad it is."""

MOST_MODES = 8

Floats = NDArray[np.float64]


class Place(NamedTuple):
    """A minimum with P parameters: the point of the unit box, (P,), and which parameters a bound holds there, (P,)."""

    unit: Floats
    held: NDArray[np.bool_]


def other_minima(fit: Fit) -> list[Minimum]:
    """Minima of a likelihood's fit, beside the best, that its posterior may have a mode at."""
    if not fit.is_posterior:
        return []
    return [one for one in fit.minima[1:] if one.cost < fit.cost + LOOKED_AT][: MOST_MODES - 1]


def places(fit: Fit) -> list[Place]:
    """The best minimum of a fit, and the others of `other_minima`, followed to where they end."""
    problem = fit.problem
    best = np.asarray(problem.model.box.to_unit(jnp.asarray(fit.vector)), float)
    found = [Place(best, np.isin(problem.names, fit.at_bound))]
    for minimum in other_minima(fit):
        vector = np.array([minimum.values[name] for name in problem.names])
        end = least_squares_descent(problem, unit_of(problem, vector), fresh=False)
        if end.cost < fit.cost + LOOKED_AT:
            found.append(Place(unit_of(problem, end.vector), uncertainty(problem, end.vector, end.cost).at_bound))
    return found
