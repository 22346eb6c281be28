"""Priors of a free parameter: densities within its bounds, flat or Gaussian in the value or in its logarithm."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from fits.problem.values import shown

FARTHEST_MEAN = 37.0  # standard deviations from the bounds; farther out the density within them underflows in float64
NARROWEST = 1e-15  # standard deviation, as a share of the distances in the box: below, float64 has no numbers for it
SMALLEST = float(np.finfo(float).tiny)  # what is smaller is 0 in compiled programs
_FLAT = 1e-6  # width of the bounds in standard deviations below which a difference of two masses loses its digits


@dataclass(frozen=True)
class Uniform:
    """Constant density within the bounds."""

    logarithmic: ClassVar[bool] = False

    def gaussian(self) -> tuple[float, float]:
        """Centre and inverse standard deviation in the coordinate where the prior is Gaussian; 0: flat there."""
        return 0.0, 0.0


@dataclass(frozen=True)
class LogUniform:
    """Density proportional to 1 / value within the bounds, which must be positive."""

    logarithmic: ClassVar[bool] = True

    def gaussian(self) -> tuple[float, float]:
        """Centre and inverse standard deviation of the logarithm; 0: flat there."""
        return 0.0, 0.0


@dataclass(frozen=True)
class Normal:
    """Gaussian with `mean` and standard deviation `sd` > 0, cut off at the bounds and normalised within them."""

    mean: float
    sd: float
    logarithmic: ClassVar[bool] = False

    def __post_init__(self) -> None:
        _require_finite("Normal.mean", self.mean)
        _require_finite("Normal.sd", self.sd, above=0.0)

    def gaussian(self) -> tuple[float, float]:
        """Centre and inverse standard deviation."""
        return float(self.mean), 1.0 / float(self.sd)


@dataclass(frozen=True)
class LogNormal:
    """The logarithm is Gaussian about log(`median`) with standard deviation `sd`; cut off at the positive bounds."""

    median: float
    sd: float
    logarithmic: ClassVar[bool] = True

    def __post_init__(self) -> None:
        _require_finite("LogNormal.median", self.median, above=0.0)
        _require_finite("LogNormal.sd", self.sd, above=0.0)

    def gaussian(self) -> tuple[float, float]:
        """Centre and inverse standard deviation of the logarithm."""
        return math.log(self.median), 1.0 / float(self.sd)


Prior = Uniform | LogUniform | Normal | LogNormal


def require_computable(prior: Prior, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
    """ValueError for bounds, each () or (C,), and a prior whose density within them float64 cannot hold."""
    bounds = f"[{shown(low.tolist())}, {shown(high.tolist())}]"
    if prior.logarithmic:
        if np.any(low < SMALLEST):
            raise ValueError(
                f"Free.low is {shown(low.tolist())}; it must be above 0 for the prior {prior}, at least {SMALLEST:.2g}"
            )
        low, high = np.log(low), np.log(high)
    with np.errstate(over="ignore", invalid="ignore"):
        width = high - low
        if not np.all(np.isfinite(width) & (width >= SMALLEST)):
            raise ValueError(f"Free.low and Free.high are {bounds}; float64 must hold their difference")
        if prior.gaussian()[1] > 0.0:
            _require_within_reach(prior, low, high, bounds)


def _require_within_reach(prior: Prior, low: NDArray[np.float64], high: NDArray[np.float64], bounds: str) -> None:
    """Refuse a Gaussian prior (in its own coordinate) that is out of sight of the bounds, a needle or a plain."""
    centre, inverse_sd = prior.gaussian()
    outside = np.maximum(np.maximum(low - centre, centre - high), 0.0)
    if np.any((outside > 0.0) & (outside * inverse_sd > FARTHEST_MEAN)):
        raise ValueError(
            f"Free.prior is {prior}; its centre must lie within {FARTHEST_MEAN:g} standard deviations of {bounds}"
        )
    farthest = np.maximum(abs(low - centre), abs(high - centre))
    if not np.all(farthest * inverse_sd * NARROWEST < 1.0):
        raise ValueError(
            f"Free.prior is {prior}; its sd must be above {NARROWEST:g} of the distance from its centre to {bounds}"
        )
    if not np.all(np.minimum(high - low, 1.0) * inverse_sd >= SMALLEST):
        raise ValueError(
            f"Free.prior is {prior}; its sd must be at most {1 / SMALLEST:.2g} times the width of {bounds}"
        )


def log_normaliser(prior: Prior, low: float, high: float) -> float:
    """Log of the integral of the prior between two bounds, in the coordinate where it is Gaussian or flat."""
    centre, inverse_sd = prior.gaussian()
    a, b = (math.log(low), math.log(high)) if prior.logarithmic else (low, high)
    if inverse_sd == 0:
        return math.log(b - a)
    width = (b - a) * inverse_sd
    a, b = (a - centre) * inverse_sd, (b - centre) * inverse_sd
    if a > 0:  # both ends in the upper tail: mirror, so that the difference keeps its digits
        a, b = -b, -a
    if width < _FLAT:
        log_mass = math.log(width) + stats.norm.logpdf(0.5 * (a + b))
    else:
        log_mass = stats.norm.logcdf(b) + math.log(-math.expm1(stats.norm.logcdf(a) - stats.norm.logcdf(b)))
    return log_mass - math.log(inverse_sd) + 0.5 * math.log(2 * math.pi)


def steps(smooth: Any, channels: int) -> NDArray[np.float64]:
    """Differences between neighbouring channels over their standard deviations, (channels - 1, channels)."""
    inverse = 1.0 / np.broadcast_to(np.asarray(smooth, float), (channels - 1,))
    return inverse[:, None] * np.diff(np.eye(channels), axis=0)


def shared_normaliser(prior: Prior, steps: NDArray[np.float64], own: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of channels (C,) with these normalisers of their own, and steps between them: of all together, in the first.

    Flat priors count once, for the walk starts anywhere; Gaussian ones by their joint precision. Bounds cut off nothing
    of the steps.
    """
    channels = len(own)
    inverse_sd = prior.gaussian()[1]
    if inverse_sd > 0.0:
        cut = own.sum() - channels * (0.5 * math.log(2 * math.pi) - math.log(inverse_sd))
        precision = inverse_sd**2 * np.eye(channels) + steps.T @ steps
        whole = cut + 0.5 * channels * math.log(2 * math.pi) - 0.5 * np.linalg.slogdet(precision)[1]
    else:
        scales = -np.log(np.max(np.abs(steps), axis=1))
        whole = own[0] + np.sum(scales) + 0.5 * (channels - 1) * math.log(2 * math.pi)
    return np.array([whole] + [0.0] * (channels - 1))


def require_steps(smooth: NDArray[np.float64], shape: tuple[int, ...]) -> None:
    """ValueError for standard deviations between neighbours that are none."""
    if not shape or shape[0] < 2:
        raise ValueError("Free.random_walk_sd is given for a single number; start, low or high must have two channels")
    if smooth.shape not in ((), (shape[0] - 1,)):
        raise ValueError(f"Free.random_walk_sd has {smooth.size} entries; it must have 1 or {shape[0] - 1}, one a step")
    if not np.all(smooth > 0.0):
        raise ValueError(f"Free.random_walk_sd is {shown(smooth.tolist())}; it must be above 0")


def _require_finite(field: str, value: Any, above: float = -math.inf) -> None:
    try:
        allowed = math.isfinite(value) and value > above
    except (TypeError, OverflowError):  # no number, or several of them
        allowed = False
    if not allowed:
        least = "" if math.isinf(above) else f" and above {above:g}"
        raise ValueError(f"{field} is {shown(value)}; it must be one number, finite{least}")
