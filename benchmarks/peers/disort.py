"""PythonicDISORT on a Henyey-Greenstein slab: discrete ordinates in closed form, independent of layerjax.

Conventions: DISORT's azimuth is that of travel and its beam has unit irradiance across itself, so that the radiance of
the scattered light is f mu0, and the azimuth from the beam is phi_o - (phi_i + pi). Its cosines are those of travel:
positive ones leave at the top, negative ones at the bottom, as those of wo do.
"""

import warnings
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]

ROUNDING = 1e-15
"""Legendre coefficients of the phase function below this are omitted."""


def why_not() -> str | None:
    """Why PythonicDISORT cannot run here; None if it can."""
    try:
        import PythonicDISORT  # noqa: F401
    except ImportError:
        return "PythonicDISORT is not installed (pip install '.[peers]')"
    return None


def nodes(streams: int) -> Values:
    """The cosines at which the solver works, (streams,): half of them up, then the same ones down."""
    x, _ = np.polynomial.legendre.leggauss(streams // 2)
    return np.concatenate([0.5 * (x + 1), -0.5 * (x + 1)])


def bsdf(
    thickness: float,
    g: float,
    albedo: float,
    incidence: float,
    azimuths: Values,
    streams: int,
    cosines: Values | None = None,
    corrected: bool = True,
    modes: int | None = None,
    reflection_only: bool = False,
    base: float = 0.0,
) -> Values:
    """BSDF of the slab lit from above, without the unscattered light, 1/sr, (cosines, azimuths).

    Args:
        thickness, g, albedo: of the slab, whose index is that of its surroundings.
        incidence: cosine of the light's direction, in (0, 1].
        azimuths: phi_o - phi_i, radians.
        streams: cosines in both directions together, even.
        cosines: of the viewer, above 0 for reflection and below for transmission; None: the solver's `nodes`.
        corrected: delta-M scaling, and the corrections of Nakajima & Tanaka (1988) for it.
        modes: Fourier modes in azimuth; None: as many as streams.
        reflection_only: omit the transmission; `cosines` are then above 0 (None: the upper half of the nodes).
        base: albedo of a Lambertian base under the slab; 0 for none.
    """
    from PythonicDISORT.subroutines import interpolate

    solution = _solve(thickness, g, albedo, incidence, streams, corrected, modes, base)
    depths, travel = np.array([0.0] if reflection_only else [0.0, thickness]), np.asarray(azimuths) - np.pi
    if cosines is None:
        radiance = solution(depths, travel).reshape(streams, len(depths), -1)
        upper, lower = radiance[: streams // 2, 0], radiance[streams // 2 :, -1]
        leaving = upper if reflection_only else np.concatenate([upper, lower])
    else:
        radiance = interpolate(solution, NT_cor="eval" if corrected else None)(cosines, depths, travel)
        radiance = radiance.reshape(len(cosines), len(depths), -1)
        leaving = np.where(np.asarray(cosines)[:, None] > 0, radiance[:, 0], radiance[:, -1])
    return leaving / incidence


def _solve(
    thickness: float,
    g: float,
    albedo: float,
    incidence: float,
    streams: int,
    corrected: bool,
    modes: int | None,
    base: float,
) -> Callable[..., Values]:
    """The radiance as a function of depth and azimuth, as the solver returns it."""
    from PythonicDISORT import pydisort

    terms = int(np.log(ROUNDING) / np.log(abs(g))) if g else 1
    legendre = g ** np.arange(max(terms, streams + 1))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*NFourier.*", category=UserWarning)  # that they are many
        warnings.filterwarnings("ignore", message=".*NT.*", category=UserWarning)  # that nothing is left to correct
        solved = pydisort(
            thickness,
            albedo,
            streams,
            legendre,
            incidence,
            1.0,
            0.0,
            NLeg=streams,
            NFourier=streams if modes is None else modes,
            f_arr=legendre[streams] if corrected else 0,
            NT_cor=corrected,
            BDRF_Fourier_modes=[base] if base else [],
            cache_asso_leg="no_mu0",
        )
    return solved[-1]
