"""Noise models and named residuals: one definition, used by the optimiser and by the sampler.

With model value f, datum d and z = (d - f) / sigma, the negative log-density of a datum is a sum of squares up to a
constant, so that a least-squares solver maximises the likelihood exactly:

- Gaussian: z^2 / 2 + log sigma;
- Student-t: (nu + 1) / 2 log(1 + z^2 / nu) + log sigma, half the square of z sqrt((nu + 1) / nu log1p(x) / x), x = z^2
  / nu;
- log sigma, where it depends on the parameters: half the square of sqrt(1 + 2 log(sigma / lowest)).
"""

import math
from dataclasses import dataclass
from numbers import Real
from typing import Any, Literal, NamedTuple, cast, get_args

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import gammaln

from fits._files import require_switch
from fits.data.geometry import Floats
from fits.data.measurements import LARGEST, Measurements
from fits.names import Objective
from fits.problem.discrepancy import Discrepancy, softness
from fits.problem.parameters import Free, is_free, require_number_or_free
from layerjax._checks import abbreviate, require_choice, require_number

Tails = Literal["gaussian", "student"]
DEFAULT_RELATIVE = 0.05
DEFAULT_FLOOR = 1e-4
CUBE_ROOT_OFFSET = 1e-6
TINY = 1e-30  # below, log1p(x) / x is 1
LEVELS = (1e-100, 1e100)  # of a floor, or a scale: their squares neither vanish nor overflow in float64
DEGREES_OF_FREEDOM = (0.01, 1e6)  # above, a Student-t is a Gaussian, and the terms of its constant cancel


@dataclass(frozen=True)
class Noise:
    """Noise model: variance = sigma^2 + (relative f)^2 + floor^2, with the predicted BSDF f.

    Relative noise refers to the prediction, because weights from noisy data bias the fit downwards by twice the
    relative variance.

    Args:
        relative: relative standard deviation, in [0, 1] (0.05 is 5 %), or `Free`. None: 0 if the data's sigma is used
            or `floor` is given, else 0.05.
        floor: in 1/sr, 0 or in [1e-100, 1e100], or `Free` with low > 0. None: 1e-4 of the median |value| with relative
            noise, else 0.
        use_sigma: whether the data's own sigma is used, where there is one.
        tails: "gaussian"; or "student", for which sigma is the scale, not the standard deviation.
        degrees_of_freedom: of Student's t, in [0.01, 1e6].
        discrepancy: a `Discrepancy`; True for one with free parameters; False for none. With None, a fit is first made
            with independent noise. If residuals of neighbours along a scan are correlated by more than 0.2 and by more
            than 3 standard errors, it is repeated with a discrepancy (`Fit.without_discrepancy` is the first); a
            `Problem` by itself then has none. Requires Gaussian tails.
    """

    relative: float | Free | None = None
    floor: float | Free | None = None
    use_sigma: bool = True
    tails: Tails = "gaussian"
    degrees_of_freedom: float = 4.0
    discrepancy: Discrepancy | bool | None = None

    def __post_init__(self) -> None:
        if self.relative is not None:
            require_number_or_free("Noise.relative", self.relative, 0.0, 1.0)
        require_floor("Noise.floor", self.floor)
        require_switch("Noise.use_sigma", self.use_sigma)
        require_choice("Noise.tails", self.tails, get_args(Tails))
        require_number("Noise.degrees_of_freedom", self.degrees_of_freedom, *DEGREES_OF_FREEDOM)
        if self.discrepancy is True:
            object.__setattr__(self, "discrepancy", Discrepancy())
        if not (self.discrepancy in (False, None) or isinstance(self.discrepancy, Discrepancy)):
            given = abbreviate(self.discrepancy)
            raise ValueError(f"Noise.discrepancy is {given}; it must be true, false or Discrepancy")
        if self.discrepancy and self.tails != "gaussian":
            raise ValueError(f"Noise.tails is {self.tails!r}; with model discrepancy it must be gaussian")


def require_floor(name: str, floor: Any) -> None:
    """ValueError for what is no floor: None, 0, or what has a square that neither vanishes nor overflows."""
    if floor is not None and not (isinstance(floor, Real) and floor == 0.0):
        require_number_or_free(name, floor, *LEVELS)


def total_sigma(predicted: Any, variance: Any, relative: Any, floor: Any) -> Any:
    """Scale of the noise at each datum, in 1/sr; `variance` is the measurement's own; of numpy or JAX."""
    return predicted.__array_namespace__().sqrt(variance + (relative * predicted) ** 2 + floor**2)


def log_density(z: Array, sigma: Array, tails: Tails, degrees_of_freedom: Array) -> Array:
    """Normalised log-density of each datum, z = (datum - model) / sigma."""
    if tails == "gaussian":
        return -0.5 * z**2 - jnp.log(sigma) - 0.5 * math.log(2 * math.pi)
    nu = degrees_of_freedom
    constant = gammaln(0.5 * (nu + 1)) - gammaln(0.5 * nu) - 0.5 * jnp.log(nu * math.pi)
    return constant - jnp.log(sigma) - 0.5 * (nu + 1) * jnp.log1p(z**2 / nu)


def tail_residual(z: Array, tails: Tails, degrees_of_freedom: Array) -> Array:
    """Smooth residual whose half square is the negative log-density of z, less its value at 0."""
    if tails == "gaussian":
        return z
    nu, x = degrees_of_freedom, z**2 / degrees_of_freedom
    tame = jnp.where(x > TINY, x, 1.0)
    return z * jnp.sqrt((nu + 1) / nu * jnp.where(x > TINY, jnp.log1p(tame) / tame, 1.0))


def level_residual(level: Array) -> Array:
    """Residual whose half square is a level of at least 0, + 1/2; at least 1, so that its slope is finite."""
    return jnp.sqrt(1.0 + 2.0 * level)


def information_weights(tails: Tails, degrees_of_freedom: Array) -> tuple[Array, Array]:
    """Fisher information of one datum about f / sigma and about log sigma: (1, 2) for a Gaussian."""
    if tails == "gaussian":
        return jnp.ones(()), jnp.asarray(2.0)
    nu = degrees_of_freedom
    return (nu + 1) / (nu + 3), 2 * nu / (nu + 3)


def named_residual(objective: Objective, predicted: Array, values: Array, cosine: Array) -> Array:
    """Model minus datum in measures of the literature: f cos (Ngan 2005), log(1 + f cos) with f cos above -1/2
    (Low 2012), or the cube root of f cos + 1e-6 (after Fores 2012); `cosine` is |cos theta_i|, (N, 1)."""
    if objective == "cosine_l2":
        return (predicted - values) * cosine
    if objective == "log1p_cos":
        return jnp.log1p(predicted * cosine) - jnp.log1p(jnp.maximum(values * cosine, -0.5))
    return jnp.cbrt(predicted * cosine + CUBE_ROOT_OFFSET) - jnp.cbrt(values * cosine + CUBE_ROOT_OFFSET)


class Levels(NamedTuple):
    """Noise of the used samples: the measurement's own variance, (N, C) or (1,), and the levels of the noise model."""

    variance: Floats
    relative: float | Free
    floor: float | Free

    @property
    def least_floor(self) -> float:
        """What the floor cannot fall below, in 1/sr."""
        return float(self.floor.arrays()[1]) if isinstance(self.floor, Free) else self.floor

    @property
    def fitted(self) -> bool:
        """Whether a level is."""
        return isinstance(self.relative, Free) or isinstance(self.floor, Free)

    @property
    def varying(self) -> bool:
        """Whether sigma depends on the parameters, or on what they predict."""
        return self.fitted or self.relative != 0

    def softness(self, values: Floats) -> Floats:
        """The softness of the logarithms of measurements (N, C), see `fits.problem.discrepancy`."""
        floor = self.floor.start if isinstance(self.floor, Free) else self.floor
        return softness(values, np.sqrt(self.variance + np.square(floor)))


def is_assumed(noise: Noise, used: Measurements) -> bool:
    """Whether nothing is stated of the noise, neither by the data nor by `Noise`, so that `DEFAULT_RELATIVE` holds."""
    return noise.relative is None and noise.floor is None and (used.sigma is None or not noise.use_sigma)


def noise_levels(noise: Noise, used: Measurements, values: Floats | None = None) -> Levels:
    """The levels of noise, with the defaults that `Noise` states; values: whose median the floor follows, if others."""
    sigma = used.sigma if noise.use_sigma else None
    relative, floor = noise.relative, noise.floor
    if relative is None:
        relative = DEFAULT_RELATIVE if is_assumed(noise, used) else 0.0
    if floor is None:
        alone = not is_free(relative) and relative == 0
        floor = 0.0 if alone else DEFAULT_FLOOR * float(np.median(np.abs(used.values if values is None else values)))
    return Levels(np.zeros(1) if sigma is None else np.square(sigma), relative, floor)


def require_size(levels: Levels) -> None:
    """ValueError for values of which a share, the floor by default, has a square that vanishes or overflows."""
    precision, median = jnp.finfo(jnp.result_type(float)), cast(float, levels.floor) / DEFAULT_FLOOR
    least, most = max(LEVELS[0], math.sqrt(precision.tiny)) / DEFAULT_FLOOR, min(LARGEST, math.sqrt(precision.max))
    if levels.floor and not least <= median <= most:
        words = f"for noise relative to them it must be in [{least:.2g}, {most:.2g}], or Noise.floor be given"
        raise ValueError(f"values: the median of |value| is {median:.3g} 1/sr; {words}")
