"""Light in a half-space of Lambertian flakes with von Mises-Fisher normals, by invariant imbedding: the truth for
`layerjax.surfaces.vmf_diffuse.all_orders`.

The flakes of d'Eon & Weidlich 2024 ("VMF Diffuse: A unified rough diffuse BRDF") are one-sided. Their projected area
along w is sigma(w) = int D <w.m> dm, and light that comes from a is sent to b at the rate
K(a, b) = (1/pi) int D <a.m><b.m> dm times their albedo. Directions are counted away from the surface or, inside, away
from the flake, so light that travels along d comes from -d. Functions of the azimuth between two directions are their
means times cos(m phi). Negating a direction turns its azimuth by pi: kernels between the two sides carry (-1)^m.
"""

from dataclasses import dataclass, replace

import numpy as np

from layerjax.quadrature import gauss_legendre

PANELS = 40
"""Panels, of 32 nodes, of the integral over the flakes' tilt, which kinks where flakes begin to be seen edge on."""

LEAST_AVERTED = 1e-9
"""Below this sigma(-1) the Riccati equation is too stiff, and few orders are all there is."""

FEW = 24
"""Orders summed there."""


@dataclass(frozen=True)
class HalfSpace:
    """Discrete half-space of one roughness.

    Attributes:
        cosines: (nodes,) cosines u > 0: Gauss nodes, then the requested ones.
        weights: (nodes,) weights of an integral du, 0 for the requested ones.
        facing, averted: (nodes,) sigma(u) and sigma(-u).
        up, mixed, down: (modes, nodes, nodes) K_m(u, u'), (-1)^m K_m(u, -u') and K_m(-u, -u').
    """

    cosines: np.ndarray
    weights: np.ndarray
    facing: np.ndarray
    averted: np.ndarray
    up: np.ndarray
    mixed: np.ndarray
    down: np.ndarray

    @property
    def denominator(self) -> np.ndarray:
        """(nodes, nodes) u_i sigma(-u_o) + u_o sigma(u_i), in its symmetric form."""
        mean = 0.5 * (self.facing + self.averted)
        return self.cosines[:, None] * mean + self.cosines * mean[:, None]

    def only(self, mode: int) -> "HalfSpace":
        """The half space with one Fourier mode in azimuth alone."""
        one = slice(mode, mode + 1)
        return replace(self, up=self.up[one], mixed=self.mixed[one], down=self.down[one])

    def albedo(self, mode_0: np.ndarray) -> np.ndarray:
        """Directional albedo (..., nodes) of the azimuthal mean (..., nodes, nodes) of a BRDF."""
        return 2.0 * np.pi * mode_0 @ (self.weights * self.cosines)


def half_space(width: float, nodes: int = 40, modes: int = 1, cosines: tuple[float, ...] = ()) -> HalfSpace:
    """The half-space of flakes of width alpha in (0, inf], on Gauss nodes and at further cosines in (0, 1].

    With 40 nodes its directional albedos, and its values at cosines above 0.1, are exact to 1e-7; at albedo 1 to 1e-6.
    """
    x, w = gauss_legendre(nodes)
    scale = 1.0 if np.isinf(width) else width / (1.0 + width)
    decades = np.log1p(1.0 / scale)
    u = scale * np.expm1(decades * x**2)  # evenly in log(cosine) above the layer of width alpha, crowded at grazing
    w = w * 2.0 * x * decades * (scale + u)
    u, weights = np.append(u, cosines), np.append(w, np.zeros(len(cosines)))
    k = 2.0 / width**2
    # exp(-2 k sin^2(t/2)) is below rounding past the last tilt
    last = np.pi if k < 20.0 else 2.0 * np.arcsin(np.sqrt(min(20.0 / k, 1.0)))
    t, dt = gauss_legendre(32)
    t = (last / PANELS * (np.arange(PANELS)[:, None] + t)).ravel()
    dt = np.tile(last / PANELS * dt, PANELS)
    norm = 0.5 if k < 1e-12 else k / -np.expm1(-2.0 * k)
    density = norm * np.exp(-2.0 * k * np.sin(0.5 * t) ** 2) * np.sin(t) * dt  # azimuth integrated
    seen, hidden = _facing_means(u, t, modes), _facing_means(-u, t, modes)
    sign = (-1.0) ** np.arange(modes)[:, None, None]
    weighted = density / np.pi * seen
    return HalfSpace(
        cosines=u,
        weights=weights,
        facing=seen[0] @ density,
        averted=hidden[0] @ density,
        up=weighted @ seen.swapaxes(1, 2),
        mixed=sign * (weighted @ hidden.swapaxes(1, 2)),
        down=(density / np.pi * hidden) @ hidden.swapaxes(1, 2),
    )


def _facing_means(cosine: np.ndarray, tilt: np.ndarray, modes: int) -> np.ndarray:
    """Means (mode, cosine, tilt) over the azimuth of max(w.m, 0) cos(m phi), in closed form."""
    along = cosine[:, None] * np.cos(tilt)
    across = np.sqrt((1.0 - cosine) * (1.0 + cosine))[:, None] * np.sin(tilt)
    edge = np.arccos(np.clip(-along / np.maximum(across, 1e-300), -1.0, 1.0))  # facing for |phi| < edge
    sines = [np.zeros_like(edge)] + [np.sin(m * edge) / m for m in range(1, modes + 1)]
    means = [along * edge + across * sines[1]]
    for m in range(1, modes):
        before = edge if m == 1 else sines[m - 1]
        means.append(along * sines[m] + 0.5 * across * (sines[m + 1] + before))
    return np.stack(means) / np.pi


def orders(space: HalfSpace, count: int) -> np.ndarray:
    """f_1 to f_count (count, modes, nodes, nodes): the BRDF is the sum of albedo^n f_n, in modes of the azimuth."""
    u, w = space.cosines, 2.0 * np.pi * space.weights
    into = w * space.mixed
    turned = w[:, None] * space.down * w
    found = [space.up / space.denominator]
    turning: list[np.ndarray] = []  # those before the last, after going up and being turned down
    for n in range(2, count + 1):
        last = found[-1]
        beside = u * (into @ last)
        total = beside + beside.swapaxes(1, 2)
        turning.append(last @ turned)
        for k in range(n - 2):
            total = total + np.outer(u, u) * (turning[k] @ found[n - 3 - k])
        found.append(total / space.denominator)
    return np.stack(found)


def all_orders(space: HalfSpace, albedo: float, mode: int = 0) -> np.ndarray:
    """The sum of all orders (nodes, nodes) of one mode, at an albedo in [0, 1]."""
    inner = np.flatnonzero(space.weights)
    if space.averted.min() < LEAST_AVERTED:
        powers = albedo ** np.arange(1.0, FEW + 1)
        return np.tensordot(powers, orders(space.only(mode), FEW)[:, 0], 1)
    if albedo == 1.0 and np.max(space.facing - space.averted) < 1e-6:
        # light that drifts nowhere and is never absorbed: the equation has a double root; extrapolate in sqrt(1 - c)
        extrapolation = zip((5.0, -10.0, 10.0, -5.0, 1.0), 0.01 * np.arange(1.0, 6.0), strict=True)
        return np.sum([weight * all_orders(space, 1.0 - x * x, mode) for weight, x in extrapolation], axis=0)
    u, w = space.cosines, 2.0 * np.pi * space.weights
    mixing, turning = albedo * space.mixed[mode] * w, albedo * w[:, None] * space.down[mode] * w
    up, den = albedo * space.up[mode], space.denominator
    square = np.ix_(inner, inner)
    inside, across = u[inner], mixing[square]
    solved = _riccati(
        np.diag(space.facing[inner] / inside) - across / inside[:, None],
        up[square] / np.outer(inside, inside),
        turning[square],
        np.diag(space.averted[inner] / inside) - across.T / inside,
    )
    if len(inner) == len(u):
        return solved
    # at further cosines: a linear equation for the row of each, then the equation itself for pairs of them
    back = across + inside[:, None] * (turning[square] @ solved).T
    rows = np.stack(
        [
            np.linalg.solve(np.diag(den[n, inner]) - u[n] * back, up[n, inner] + inside * (mixing[n, inner] @ solved))
            for n in range(len(u))
        ]
    )
    beside = u * (mixing[:, inner] @ rows.T)
    return (up + beside + beside.T + np.outer(u, u) * (rows @ turning[square] @ rows.T)) / den


def _riccati(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """The smallest solution X >= 0 of X C X - X D - A X + B = 0, by alternating-directional doubling (Wang, Wang & Li
    2012, "Alternating-directional doubling algorithm for M-matrix algebraic Riccati equations")."""
    one, most_a, most_d = np.eye(len(a)), np.max(np.diag(a)), np.max(np.diag(d))
    both, inverse_d = most_a + most_d, np.linalg.inv(d + most_a * one)
    shifted = a + most_d * one
    inverse = np.linalg.inv(shifted - b @ inverse_d @ c)
    e = one - both * np.linalg.inv(d + most_a * one - c @ np.linalg.solve(shifted, b))
    f = one - both * inverse
    g, h = both * inverse_d @ c @ inverse, both * inverse @ b @ inverse_d
    for _ in range(80):
        left, right = np.linalg.inv(one - g @ h), np.linalg.inv(one - h @ g)
        step = f @ right @ h @ e
        g, h = g + e @ left @ g @ f, h + step
        e, f = e @ left @ e, f @ right @ f
        if np.max(np.abs(step)) < 1e-14 * np.max(np.abs(h)):
            break
    return h
