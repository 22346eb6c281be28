"""Fresnel reflectance of unpolarised light at smooth interfaces.

Arguments broadcast against each other; a reflectance has their common shape and lies in [0, 1].
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from layerjax._numerics import clamp_max, clamp_min, horner, safe_div, safe_sqrt
from layerjax.directions import squared_cosine_of_refraction

ROUNDED_ROOT = (308 / 1536, 1080 / 1536, 924 / 1536, -432 / 1536, -660 / 1536, 120 / 1536, 196 / 1536)
"""Coefficients of r^0 ... r^6 of what stands for the root of r on (-1, 1): with its value and two derivatives at 1, all
three 0 at -1, and with its mean."""

SERIES = 9
"""Terms of cos and sinc as series in the squared phase, where that is below 1/2: to 1e-16."""
COSINE = tuple((-1.0) ** k / math.factorial(2 * k) for k in range(SERIES))
SINC = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(SERIES))


class Film(NamedTuple):
    """Coherent transparent film on a dielectric interface, at one wavelength, as it is seen from one side.

    ior: index of the film relative to the medium on that side, > 0. phase: 2 pi thickness / wavelength in that medium,
    >= 0.
    """

    ior: Array
    phase: Array

    def seen_from(self, ior: Array) -> "Film":
        """The same from a medium of this index, relative to the one that it is counted in."""
        return Film(self.ior / ior, self.phase * ior)


def schlick(cosine: Array, f0: Array | float) -> Array:
    """Schlick's approximation f0 + (1 - f0) (1 - cosine)^5 (Schlick 1994).

    Args:
        cosine: cosine between the direction of incidence and the facet normal, in [0, 1].
        f0: reflectance along the normal, in [0, 1].
    """
    complement = clamp_min(1.0 - cosine, 0.0)  # a cosine may round to just above 1
    squared = complement * complement
    fifth = squared * squared * complement
    return f0 + (1.0 - f0) * fifth


def dielectric(cosine: Array, ior: Array, blur: Array | None = None, film: Film | None = None) -> Array:
    """Reflectance between two dielectrics, 1 under total internal reflection.

    Args:
        cosine: cosine between the direction of incidence and the facet normal, in [0, 1].
        ior: index on the far side over index on the side of incidence, > 0.
        blur: of the squared cosine of refraction, half the width about 0 over which the critical angle is rounded off,
            or less, so that grazing light keeps its reflectance.
        film: on the interface, as seen from the side of incidence.

    The two amplitudes are formed without a difference of squares, so that ior = 1 gives exactly 0 at every angle.
    Not differentiable at the critical angle (the derivative is infinite there; 0 is returned beyond it), unless that
    is rounded off.
    """
    return dielectric_towards(cosine, ior, *cosine_of_refraction(cosine, ior, blur), film)


def dielectric_towards(
    cosine: Array, ior: Array, refracted: Array, transmits: Array, film: Film | None = None
) -> Array:
    """`dielectric` where the cosine of refraction is known, and whether there is such light."""
    refracted = jnp.where(transmits, refracted, 0.5)
    c = jnp.where(transmits, cosine, 0.5)
    if film is not None:
        absent = (ior == 1.0) & (film.phase == 0.0) & ~transmits
        return jnp.where(transmits, _film_shares(c, ior, refracted, film)[0], jnp.where(absent, 0.0, 1.0))
    tiny = jnp.finfo(refracted.dtype).tiny
    perpendicular = (c - ior * refracted) / (c + ior * refracted + tiny)
    parallel = (ior * c - refracted) / (ior * c + refracted + tiny)
    reflectance = 0.5 * (perpendicular * perpendicular + parallel * parallel)
    matched = (ior == 1.0) & ~transmits  # grazing light on no interface at all
    return jnp.where(transmits, reflectance, jnp.where(matched, 0.0, 1.0))


def dielectric_transmittance(cosine: Array, ior: Array, refracted: Array, film: Film | None = None) -> Array:
    """1 - `dielectric` by both cosines > 0 in any unit that they share: no difference, no angle of total reflection.

    With a film the cosines are those of unit vectors.
    """
    if film is not None:
        return _film_shares(cosine, ior, refracted, film)[1]
    a, b = cosine, refracted
    return 2.0 * ior * a * b * (1.0 / (a + ior * b) ** 2 + 1.0 / (ior * a + b) ** 2)


def cosine_of_refraction(cosine: Array, ior: Array, blur: Array | None = None) -> tuple[Array, Array]:
    """Cosine of refraction at a smooth interface, and whether there is such light; arguments as of `dielectric`."""
    squared = squared_cosine_of_refraction(cosine, ior)
    transmits = squared > 0
    refracted = jnp.sqrt(jnp.where(transmits, squared, 1.0))
    if blur is None:
        return refracted, transmits
    blur = clamp_max(blur, 0.5 * clamp_min((1.0 - ior) * (1.0 + ior), 0.0) / (ior * ior))
    near = jnp.abs(squared) < blur
    width = jnp.where(near, blur, 1.0)
    rounded = jnp.sqrt(width) * horner(ROUNDED_ROOT, jnp.where(near, squared, 0.0) / width)
    return jnp.where(near, rounded, refracted), transmits | near


def conductor(cosine: Array, ior: Array, k: Array) -> Array:
    """Reflectance of a conductor with complex index ior + i k relative to the medium above it.

    Args:
        cosine: cosine between the direction of incidence and the facet normal, in [0, 1].
        ior: real part of the index, > 0.
        k: extinction coefficient, >= 0; k = 0 is a dielectric.
    """
    cos2 = cosine * cosine
    sin2 = 1.0 - cos2
    real = (ior - 1.0) * (ior + 1.0) - k * k + cos2  # ior^2 - k^2 - sin2: at a matched index cos2 to its own digits
    product = ior * k
    modulus = safe_sqrt(real * real + 4.0 * product * product)
    # a + i b = sqrt(n^2 - sin^2): the larger part by a sum, the other from their product, so that nothing cancels
    larger = 0.5 * (modulus + jnp.abs(real))
    smaller = product * safe_div(product, larger)
    # the root of a square is written as its base: at k = 0 under total reflection its derivative is not 0
    root = safe_sqrt(larger)
    a, b2 = jnp.where(real > 0, root, safe_div(product, root)), jnp.where(real > 0, smaller, larger)
    perpendicular, below = (a - cosine) ** 2 + b2, (a + cosine) ** 2 + b2
    ratio, under = (a * cosine - sin2) ** 2 + b2 * cos2, (a * cosine + sin2) ** 2 + b2 * cos2
    return safe_div(0.5 * perpendicular * (under + ratio), below * under)  # one division for both polarisations


def thin_film(cosine: Array, ior: Array, k: Array | float, film_ior: Array, phase: Array) -> Array:
    """Reflectance of a coherent film on a dielectric or conductor: all reflections within it, both polarisations.

    By the film's characteristic matrix (Abeles 1950; Born & Wolf, Principles of Optics, 1.6), whose elements are smooth
    functions of the squared cosine in the film, also through its critical angle; with phase = 0 as without the film.

    Args:
        cosine: cosine between the direction of incidence and the facet normal, in [0, 1].
        ior, k: index ior + i k of what lies below the film, relative to the medium above it, as of `conductor`.
        film_ior: index of the film relative to the medium above it, > 0.
        phase: 2 pi thickness / wavelength in the medium above, >= 0.
    """
    u, v = _normal_component(cosine, ior, k)  # q3, the normal component of the wave vector below
    q2 = (film_ior - 1.0) * (film_ior + 1.0) + cosine * cosine  # the squared one in the film
    c, s = _cos_and_sinc(phase * phase * q2)
    s = phase * s
    # fields at the top for q3 at the bottom, each r = (q1 E - H) / (q1 E + H) or, of the parallel one, (E - q1 H) / ...
    real, imaginary = ior * ior - k * k, 2.0 * ior * k
    a, b = s * q2 / (film_ior * film_ior), s * film_ior * film_ior
    perpendicular = _energy(cosine * (c + s * v), -cosine * s * u, c * u, c * v - s * q2)
    parallel = _energy(
        c * u + a * imaginary, c * v - a * real, cosine * (c * real + b * v), cosine * (c * imaginary - b * u)
    )
    return clamp_max(0.5 * (perpendicular + parallel), 1.0)


def _film_shares(cosine: Array, ior: Array, refracted: Array, film: Film) -> tuple[Array, Array]:
    """Reflectance and transmittance of a film between two dielectrics, by the cosines on either side of both.

    As `thin_film`, with the normal component below known: each is a quotient of sums of squares, so that their sum is 1
    and both keep their digits at grazing angles and where one of them vanishes.
    """
    q1, q3 = cosine, ior * refracted
    squared = film.ior * film.ior
    q2 = (film.ior - 1.0) * (film.ior + 1.0) + cosine * cosine
    phase2 = film.phase * film.phase * q2
    c, s = _cos_and_sinc(phase2)
    s = film.phase * s
    passed = 4.0 * q1 * q3 * _common_factor(phase2)
    product, below = q1 * q3, ior * ior
    perpendicular, parallel = product - q2, q2 * below / squared - product * squared
    perpendicular_sum = (c * (q1 + q3)) ** 2 + (s * (product + q2)) ** 2
    parallel_sum = (c * (q3 + q1 * below)) ** 2 + (s * (q2 * below / squared + product * squared)) ** 2
    reflected = safe_div((c * (q1 - q3)) ** 2 + (s * perpendicular) ** 2, perpendicular_sum)
    reflected = reflected + safe_div((c * (q3 - q1 * below)) ** 2 + (s * parallel) ** 2, parallel_sum)
    transmitted = safe_div(passed, perpendicular_sum) + safe_div(passed * below, parallel_sum)
    return clamp_max(0.5 * reflected, 1.0), clamp_max(0.5 * transmitted, 1.0)


def _energy(er: Array, ei: Array, hr: Array, hi: Array) -> Array:
    """|E - H|^2 / |E + H|^2."""
    return safe_div((er - hr) ** 2 + (ei - hi) ** 2, (er + hr) ** 2 + (ei + hi) ** 2)


def _normal_component(cosine: Array, ior: Array, k: Array | float) -> tuple[Array, Array]:
    """Real and imaginary part of the root of (ior + i k)^2 - sin^2, both >= 0: see `conductor`."""
    product = ior * k
    real = (ior - 1.0) * (ior + 1.0) - k * k + cosine * cosine
    larger = safe_sqrt(0.5 * (safe_sqrt(real * real + 4.0 * product * product) + jnp.abs(real)))
    smaller = safe_div(product, larger)
    return jnp.where(real > 0, larger, smaller), jnp.where(real > 0, smaller, larger)


def _cos_and_sinc(squared: Array) -> tuple[Array, Array]:
    """cos(x) and sin(x) / x of a squared x; of a negative one cosh and sinh, both divided by a common large factor."""
    small = jnp.abs(squared) < 0.5
    x = jnp.sqrt(jnp.where(small, 1.0, jnp.abs(squared)))
    decayed = jnp.exp(-2.0 * x)
    cosine = jnp.where(squared > 0, jnp.cos(x), 0.5 * (1.0 + decayed))
    sinc = jnp.where(squared > 0, jnp.sin(x), 0.5 * (1.0 - decayed)) / x
    near = jnp.where(small, squared, 0.0)
    return jnp.where(small, horner(COSINE, near), cosine), jnp.where(small, horner(SINC, near), sinc)


def _common_factor(squared: Array) -> Array:
    """cos^2 + sin^2 as `_cos_and_sinc` has them: 1, or the square of what it divides by, inverted."""
    evanescent = squared <= -0.5
    return jnp.where(evanescent, jnp.exp(-2.0 * jnp.sqrt(jnp.where(evanescent, -squared, 1.0))), 1.0)
