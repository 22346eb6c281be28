"""Coefficients C_ijk of VMF Diffuse (d'Eon & Weidlich 2024, Section 3.3 and Appendix A), functions of roughness r.

Order i of scattering, mode j in azimuth, term k. C_112 is an exponent.
"""

from jax import Array

from layerjax._numerics import safe_sqrt

Terms = tuple[Array, ...]


def first_order(r: Array) -> tuple[Terms, Terms, Terms]:
    """(C_100, ..., C_103), (C_110, C_111, C_112), (C_120, C_121)."""
    r2, r3, r4 = r**2, r**3, r**4
    mean = (
        1.0 + (0.84 * r4 - 0.1 * r) / (9.0 * r3 + 1.0),
        (-9.47 * r3 + 20.4 * r2 + 0.0173 * r) / (7.46 * r + 1.0),
        (2.37 * r2 - 0.927 * r) / (r2 + 1.24),
        (-1.54 * r2 - 0.11 * r) / (7.1 * r2 - 1.05 * r + 1.0),
    )
    once = (
        (0.54 * r - 0.182 * r3) / (1.32 * r2 + 1.0),
        (-0.375 * r3 + 0.62 * r2 - 0.097 * r) / (0.4 * r3 + 1.0),
        -0.681 * r2 + 0.862 * r + 0.283,
    )
    twice = (
        (5.1 * r2 + 2.25 * r) / (32.4 * r2 + 9.8 * r + 1.0),
        (6.0 * r3 - 4.32 * r) / (287.0 * r3 + 9.7 * r + 1.0),
    )
    return mean, once, twice


def second_order(r: Array) -> tuple[Terms, Terms]:
    """(C_200, ..., C_204), (C_210, C_211, C_212)."""
    r2, r3, r4 = r**2, r**3, r**4
    r25 = r2 * safe_sqrt(r)
    mean = (
        (0.226 * r2 + 0.00056 * r) / (7.07 * r2 + 1.0),
        (-12.04 * r3 + 4.57 * r2 - 0.268 * r) / (36.7 * r3 + 1.0),
        (-0.97 * r3 + 2.52 * r2 + 0.418 * r) / (10.0 * r2 + 1.0),
        (2.65 * r3 - 2.25 * r2 + 0.068 * r) / (21.4 * r3 + 1.0),
        (0.05 * r - 4.22 * r3) / (43.1 * r3 + 17.6 * r2 + 1.0),
    )
    once = (
        (-0.027 * r3 - 0.049 * r) / (3.36 * r2 + 1.0),
        (-8.332 * r25 + 6.073 * r3 + 2.77 * r2) / (50.0 * r4 + 1.0),
        (-0.295 * r3 - 0.431 * r2) / (23.9 * r3 + 1.0),
    )
    return mean, once


def third_order(r: Array) -> tuple[Terms, Terms]:
    """(C_300, ..., C_304), (C_310, C_311, C_312)."""
    r2, r3, r4, r5 = r**2, r**3, r**4, r**5
    root = safe_sqrt(r)
    r25, r45 = r2 * root, r4 * root
    mean = (
        (0.262 * r4 - 0.083 * r3) / (38.6 * r4 - 1.9 * r2 + 1.0),
        (4.95 * r25 - 2.44 * r3 - 0.627 * r2) / (31.5 * r4 + 1.0),
        (0.31 * r25 + 1.4 * r3 + 0.33 * r2) / (20.0 * r3 + 1.0),
        (1.77 * r25 - 4.06 * r3 - 0.74 * r2) / (215.0 * r5 + 1.0),
        -1.026 * r3 / (13.2 * r3 + 5.81 * r2 + 1.0),
    )
    once = (
        (0.028 * r2 - 0.0132 * r3) / (-3.315 * r4 + 7.46 * r2 + 1.0),
        (0.162 * r25 + 0.302 * r3 - 0.134 * r2) / (57.5 * r45 + 1.0),
        (0.5 * r25 - 0.207 * r3 - 0.119 * r2) / (18.7 * r3 + 1.0),
    )
    return mean, once
