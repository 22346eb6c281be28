"""Rough coats and slabs by Monte Carlo: the truth that extended normals are an approximation to.

Facets of every surface are drawn from a von Mises-Fisher distribution, light is reflected or refracted at each of them
with its own Fresnel term, and a path weighs |o.m| G1 G1 / (|o.n| N) an event (single scattering at each rough surface,
separable Smith masking). Plain numpy, and no line shared with the package.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Array = NDArray[np.float64]
Reflectance = Callable[[Array], Array]

WINDOW = 0.5
"""Percent of the paths beyond the bins of a lobe at each end, in x and in y."""


@dataclass(frozen=True)
class Walked:
    """Paths of one order that left: horizontal components of their directions, and what they carry (0: lost)."""

    x: Array
    y: Array
    weight: Array

    @property
    def energy(self) -> tuple[float, float]:
        """Share of the light, and its standard error."""
        return float(np.mean(self.weight)), float(np.std(self.weight) / np.sqrt(self.weight.size))

    @property
    def unweighted(self) -> tuple[float, float]:
        """Mean resultant length of all directions that leave, each counted once, and its standard error."""
        left = self.weight > 0
        x, y = self.x[left], self.y[left]
        z = np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))
        mean = np.array([np.mean(x), np.mean(y), np.mean(z)])
        length = float(np.linalg.norm(mean))
        along = (mean[0] * x + mean[1] * y + mean[2] * z) / length
        return length, float(np.std(along) / np.sqrt(x.size))


@dataclass(frozen=True)
class Lobe:
    """Energy of a lobe in cells of the projected disk; floor: what noise makes of the distance of an exact model."""

    x: Array
    y: Array
    energies: Array
    floor: float

    def distance(self, brdf: Callable[[Array], Array], points: int = 4) -> float:
        """Sum of |model - truth| over the cells by the sum of the truth; brdf takes directions of shape (n, 3)."""
        inner = (np.arange(points) + 0.5) / points
        dx, dy = self.x[1] - self.x[0], self.y[1] - self.y[0]
        x = (self.x[:-1, None] + dx * inner).ravel()
        y = (self.y[:-1, None] + dy * inner).ravel()
        squared = x[:, None] ** 2 + y**2
        above = squared < 1.0
        z = np.sqrt(np.where(above, 1.0 - squared, 1.0))
        directions = np.stack(np.broadcast_arrays(x[:, None], y[None], z), axis=-1)
        directions = np.where(above[..., None], directions, [0.0, 0.0, 1.0]).reshape(-1, 3)
        values = np.where(above, np.asarray(brdf(directions)).reshape(squared.shape), 0.0)
        shape = len(self.x) - 1, points, len(self.y) - 1, points
        found = values.reshape(shape).mean(axis=(1, 3)) * dx * dy  # cos d omega = dx dy
        return float(np.sum(np.abs(found - self.energies)) / np.sum(self.energies))


def lobe(walked: Walked, cells: int = 41) -> Lobe:
    """The lobe in cells by cells that hold about 98 % of its paths."""
    left = walked.weight > 0
    ends = (np.percentile(values[left], [WINDOW, 100.0 - WINDOW]) for values in (walked.x, walked.y))
    edges = [np.linspace(first, last, cells + 1) for first, last in ends]
    sums, squares = (
        np.histogram2d(walked.x, walked.y, bins=edges, weights=walked.weight**power)[0] for power in (1, 2)
    )
    floor = float(np.sqrt(2.0 / np.pi) * np.sum(np.sqrt(squares)) / np.sum(sums))
    return Lobe(edges[0], edges[1], sums / walked.weight.size, floor)


def surface(ior: float, kappa: float, angle: float, paths: int, seed: int = 0) -> Walked:
    """Light at `angle` degrees that a rough interface reflects."""
    _, _, up, weight = _Surface(kappa, True).meet(np.random.default_rng(seed), _starting(angle, paths), ior)
    return Walked(up[0], up[1], weight)


def coat(
    ior: float,
    top: float,
    bottom: float,
    angle: float,
    paths: int,
    *,
    bounces: int = 1,
    depth: float = 0.0,
    reflectance: Reflectance | None = None,
    masked: bool = True,
    seed: int = 0,
) -> list[Walked]:
    """Light at `angle` degrees through a coat onto an opaque base, by the number of times it has met the base.

    Args:
        ior: index of the coat.
        top, bottom: concentrations of the facet normals of coat and base.
        bounces: orders to follow, from 1.
        depth: absorption across the coat, along the normal.
        reflectance: of the base, by the cosine inside the coat; None: 1.
        masked: with masking and shadowing, or without.
    """
    random = np.random.default_rng(seed)
    crossing, base = _Surface(top, masked), _Surface(bottom, masked)
    w = _starting(angle, paths)
    carried = np.ones(paths)
    inner, share, _, _ = crossing.meet(random, w, ior)
    carried = carried * share
    orders = []
    for order in range(1, bounces + 1):
        up = _across(inner)  # towards where the light comes from
        m, weight, cosine = base.facet(random, up)
        out = 2.0 * cosine * m - up
        weight = weight * base.masking(up) * base.masking(out) * (out[2] > 0)
        if reflectance is not None:
            weight = weight * reflectance(cosine)
        path = 1.0 / _upright(up[2]) + 1.0 / _upright(out[2])
        carried = carried * weight * np.exp(-depth * path)
        back = np.stack([-out[0], -out[1], _upright(out[2])])  # seen with the coat turned over
        left, passed, stays, kept = crossing.meet(random, back, 1.0 / ior)
        orders.append(Walked(left[0], left[1], carried * passed))
        if order < bounces:
            inner, carried = _mirrored(stays), carried * kept
    return orders


def slab(ior: float, top: float, bottom: float, angle: float, paths: int, *, seed: int = 0) -> Walked:
    """Light at `angle` degrees that a slab with two rough sides transmits without a reflection inside it."""
    random = np.random.default_rng(seed)
    inner, entered, _, _ = _Surface(top, True).meet(random, _starting(angle, paths), ior)
    left, passed, _, _ = _Surface(bottom, True).meet(random, _across(inner), 1.0 / ior)
    return Walked(left[0], left[1], entered * passed)


def warped(kind: str, cosine: float, beam: float, facets: float, ior: float, paths: int, seed: int = 0) -> float:
    """Mean resultant length of a vMF beam that vMF facets reflect or refract (Guo 2015, Figs. 6 and 7)."""
    random = np.random.default_rng(seed)
    sine = np.sqrt(1.0 - cosine * cosine)
    about = _normals(random, beam, paths)
    o = np.stack([cosine * about[0] + sine * about[2], about[1], cosine * about[2] - sine * about[0]])
    m = _normals(random, facets, paths)
    towards = np.sum(o * m, axis=0)
    if kind == "reflection":
        return float(np.linalg.norm(np.mean(2.0 * towards * m - o, axis=1)))
    t, exists = _refracted(o, m, towards, ior)
    return float(np.linalg.norm(np.mean(t[:, exists & (towards > 0)], axis=1)))


def peak(kind: str, cosine: float, beam: float, facets: float, ior: float, nodes: int = 200) -> float:
    """Density, 1/sr, in its mean direction of a vMF beam that vMF facets reflect or refract, by quadrature over the
    incoming light (Guo 2015, Eqs. 16 and 20)."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    drop, phi = 20.0 / beam * (x + 1.0), np.pi * (x + 1.0)  # 1 - cos from the mean of the beam
    sine = np.sqrt(drop * (2.0 - drop))[:, None]
    local = np.stack(np.broadcast_arrays(sine * np.cos(phi), sine * np.sin(phi), 1.0 - drop[:, None]))
    tilt = np.sqrt(1.0 - cosine * cosine)
    o = np.stack([cosine * local[0] + tilt * local[2], local[1], cosine * local[2] - tilt * local[0]])
    if kind == "reflection":
        out = np.array([-tilt, 0.0, cosine])[:, None, None]
        m = o + out
    else:
        out = np.array([-tilt / ior, 0.0, -np.sqrt(1.0 - (tilt / ior) ** 2)])[:, None, None]
        m = -(o + ior * out)
    m = m / np.sqrt(np.sum(m * m, axis=0))
    into, leaving = np.sum(o * m, axis=0), np.abs(np.sum(out * m, axis=0))
    jacobian = 1.0 / (4.0 * into) if kind == "reflection" else ior**2 * leaving / (into - ior * leaving) ** 2
    normals = facets / (2.0 * np.pi * -np.expm1(-2.0 * facets)) * np.exp(-facets * (1.0 - m[2]))
    light = beam / (2.0 * np.pi * -np.expm1(-2.0 * beam)) * np.exp(-beam * drop[:, None])
    weight = 20.0 / beam * w[:, None] * np.pi * w
    return float(np.sum(np.where(into > 0, jacobian * normals * light, 0.0) * weight))


def conductor(n: float, k: float) -> Reflectance:
    """Reflectance of a base of complex index n + i k relative to the coat."""

    def reflectance(cosine: Array) -> Array:
        inside = np.sqrt(1.0 - (1.0 - cosine**2) / (n + 1j * k) ** 2)
        across = (cosine - (n + 1j * k) * inside) / (cosine + (n + 1j * k) * inside)
        along = ((n + 1j * k) * cosine - inside) / ((n + 1j * k) * cosine + inside)
        return 0.5 * (np.abs(across) ** 2 + np.abs(along) ** 2)

    return reflectance


def dielectric(cosine: Array, ior: float) -> Array:
    """Fresnel reflectance of unpolarised light, 1 where it is totally reflected."""
    squared = 1.0 - (1.0 - cosine**2) / ior**2
    inside = np.sqrt(np.maximum(squared, 0.0))
    across = (cosine - ior * inside) / (cosine + ior * inside)
    along = (ior * cosine - inside) / (ior * cosine + inside)
    return np.where(squared > 0, 0.5 * (across**2 + along**2), 1.0)


class _Surface:
    """Rough surface whose facet normals follow a vMF distribution about +z."""

    def __init__(self, kappa: float, masked: bool):
        self.kappa, self.masked = kappa, masked
        decay = np.exp(-2.0 * kappa)
        self.norm = (kappa - 1.0 + np.exp(-kappa)) / (kappa * (1.0 - decay))
        self.length = (1.0 + decay) / (1.0 - decay) - 1.0 / kappa
        self.spread = 1.0 / kappa**2 - 4.0 * decay / (1.0 - decay) ** 2

    def masking(self, w: Array) -> Array:
        """Smith masking, <w, m> taken as normally distributed."""
        if not self.masked:
            return np.ones_like(w[2])
        c = np.clip(np.abs(w[2]), 1e-12, 1.0)
        mean = self.length * c
        deviation = np.sqrt(c * c * self.spread + (1.0 - c * c) * self.length / self.kappa)
        z = mean / deviation
        area = mean * ndtr(z) + deviation * np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
        return np.minimum(1.0, self.norm * c / area)

    def facet(self, random: np.random.Generator, w: Array) -> tuple[Array, Array, Array]:
        """Facets, what they weigh for light along w (above), and their cosines with it."""
        m = _normals(random, self.kappa, w.shape[1])
        cosine = np.sum(w * m, axis=0)
        weight = np.where((m[2] > 0) & (cosine > 0), cosine / (_upright(w[2]) * self.norm), 0.0)
        return m, weight, np.abs(cosine)

    def meet(self, random: np.random.Generator, w: Array, ior: float) -> tuple[Array, Array, Array, Array]:
        """Refracted directions (below) and their weights; reflected ones and theirs, for light along w (above)."""
        m, weight, cosine = self.facet(random, w)
        reflected = 2.0 * cosine * m - w
        refracted, exists = _refracted(w, m, cosine, ior)
        level = dielectric(cosine, ior)
        weight = weight * self.masking(w)
        passed = weight * (1.0 - level) * self.masking(refracted) * (exists & (refracted[2] < 0))
        kept = weight * level * self.masking(reflected) * (reflected[2] > 0)
        return refracted, passed, reflected, kept


def _normals(random: np.random.Generator, kappa: float, count: int) -> Array:
    u = random.random(count)
    z = 1.0 + np.log(u + (1.0 - u) * np.exp(-2.0 * kappa)) / kappa
    sine, phi = np.sqrt(np.maximum((1.0 - z) * (1.0 + z), 0.0)), 2.0 * np.pi * random.random(count)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), z])


def _refracted(w: Array, m: Array, cosine: Array, ior: float) -> tuple[Array, NDArray[np.bool_]]:
    squared = 1.0 - (1.0 - cosine**2) / ior**2
    return (cosine / ior - np.sqrt(np.maximum(squared, 0.0))) * m - w / ior, squared > 0


def _starting(angle: float, paths: int) -> Array:
    theta = np.radians(angle)
    return np.broadcast_to(np.array([[np.sin(theta)], [0.0], [np.cos(theta)]]), (3, paths))


def _across(w: Array) -> Array:
    return np.stack([-w[0], -w[1], _upright(-w[2])])


def _mirrored(w: Array) -> Array:
    return np.stack([w[0], w[1], -w[2]])


def _upright(z: Array) -> Array:
    return np.where(z > 1e-12, z, 0.5)  # lost light: it carries 0


TABLE: Sequence[tuple[float, float, float, float]] = (
    (1e6, 1e3, 60.0, 1.5),
    (1e4, 1e3, 0.0, 1.5),
    (1e4, 1e3, 30.0, 1.5),
    (1e4, 1e3, 60.0, 1.5),
    (1e4, 1e3, 75.0, 1.5),
    (1e4, 1e3, 85.0, 1.5),
    (1e3, 1e3, 75.0, 1.5),
    (1e3, 1e3, 85.0, 1.5),
    (1e4, 1e2, 0.0, 1.5),
    (1e4, 1e2, 60.0, 1.5),
    (1e2, 1e2, 30.0, 1.5),
    (1e2, 1e2, 60.0, 1.5),
    (1e2, 1e2, 75.0, 1.5),
    (1e3, 30.0, 0.0, 1.5),
    (1e3, 30.0, 60.0, 1.5),
    (30.0, 1e6, 30.0, 1.5),
    (30.0, 1e6, 60.0, 1.5),
    (10.0, 1e6, 0.0, 1.5),
    (10.0, 1e6, 60.0, 1.5),
    (1e4, 10.0, 0.0, 2.0),
    (1e4, 10.0, 60.0, 2.0),
)
"""Coats on a mirror: concentrations above and below, degrees, index."""
