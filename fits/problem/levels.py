"""Levels of noise of the readings that a problem uses, with what a `Noise` leaves out filled in."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits.data.measurements import Measurements
from fits.problem.likelihood import DEFAULT_FLOOR, DEFAULT_RELATIVE, Noise, total_sigma
from fits.problem.logarithm import size, softness
from fits.problem.parameters import Free, is_free
from fits.problem.process import Process

Floats = NDArray[np.float64]


class Levels(NamedTuple):
    """Noise of the used samples: the measurement's own variance, (N, C) or (1,), and the levels of the noise model."""

    variance: Floats
    relative: float | Free
    floor: float | Free

    @property
    def smallest(self) -> Floats:
        """What sigma cannot fall below, (N, C) or (1,), in 1/sr."""
        return np.sqrt(self.variance + _lowest(self.floor) ** 2)

    @property
    def fitted(self) -> bool:
        """Whether a level is."""
        return isinstance(self.relative, Free) or isinstance(self.floor, Free)

    @property
    def varying(self) -> bool:
        """Whether sigma depends on the parameters, or on what they predict."""
        return isinstance(self.relative, Free) or isinstance(self.floor, Free) or self.relative > 0

    def softness(self, values: Floats) -> Floats:
        """Of the logarithms of readings (N, C), see `fits.problem.logarithm`."""
        return softness(values, np.sqrt(self.variance + _start(self.floor) ** 2))

    def gram(self, process: Process, values: Floats) -> Array | None:
        """What readings (N, C) tell of a process that they share; None where it depends on parameters."""
        if self.fitted:
            return None
        variance, relative, floor = (jnp.asarray(level) for level in self)
        sigma = total_sigma(jnp.asarray(values), variance, relative, floor)
        return process.gram_of(size(values, self.softness(values)) / sigma)


def is_assumed(noise: Noise, used: Measurements) -> bool:
    """Whether nothing is stated of the noise, neither by the data nor by `Noise`, so that `DEFAULT_RELATIVE` holds."""
    return noise.relative is None and noise.floor is None and (used.sigma is None or not noise.use_sigma)


def noise_levels(noise: Noise, used: Measurements) -> Levels:
    """The levels that `Noise` leaves out, filled in as it says."""
    sigma = used.sigma if noise.use_sigma else None
    relative, floor = noise.relative, noise.floor
    if relative is None:
        relative = DEFAULT_RELATIVE if is_assumed(noise, used) else 0.0
    if floor is None:
        alone = not is_free(relative) and relative == 0
        floor = 0.0 if alone else DEFAULT_FLOOR * float(np.median(np.abs(used.values)))
    return Levels(np.zeros(1) if sigma is None else np.square(sigma), relative, floor)


def _lowest(level: float | Free) -> float:
    return float(level.arrays()[1]) if isinstance(level, Free) else float(level)


def _start(level: float | Free) -> float:
    return float(level.arrays()[0]) if isinstance(level, Free) else float(level)
