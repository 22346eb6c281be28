"""Makes the tables of `layerjax.transport.statistical.diffuse`: energies of rough dielectric coats with absorption.

Light that leaves the facets after one collision is found by quadrature over those visible; what is left then, by a walk
on the microsurface (Heitz et al. 2016), which gives the shares that end up on either side and how much absorption they
meet there. The shares are smooth and what is left is small where facets are flat, so that a coarse grid of walks does.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from layerjax.microsurface.energy_tables import LARGEST_INDEX, index_variable
from layerjax.precompute.interface_walks import multiple_scattering
from layerjax.quadrature import gauss_legendre
from layerjax.transport.statistical import diffuse

Table = dict[str, np.ndarray]

SEED = 2022

SIZES: dict[bool, dict[str, Any]] = {
    False: {
        "cosines": 48,
        "indices": 20,
        "roughnesses": 24,
        "facets": 12,
        "walks": (17, 12, 13),
        "paths": 12288,
        "tests": 4096,
    },
    True: {"cosines": 20, "indices": 7, "roughnesses": 9, "facets": 6, "walks": (7, 6, 6), "paths": 2048, "tests": 256},
}
"""Nodes along each axis of the tables and in a panel of facets; walks along each axis (cosine, alpha, index), paths of
each; points between the nodes at which the error is measured. By whether the tables are coarse."""

RANKS = (8, 8)
"""Functions of tau, and functions of alpha for each of them (Eq. 8)."""

RETURNED_RANK = 6
"""Functions of tau for R10."""

TABULATED_RANKS = ((2, 4), (3, 4), (4, 4), (5, 5), (6, 6), RANKS)
"""Ranks whose errors are recorded."""

TAUS = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, 25) / 24)
"""Transmittances at which functions are known, the last 1; for the reduction they count equally."""

LEAST_WALKED = (1e-3, 0.01)
"""Cosine and alpha below which shares are taken to be constant: next to no light is concerned."""

POWERS = np.geomspace(1e-3, 1.0, 24)
"""Cosines c of the powers tau^(1/c) that functions of tau are sums of."""

SMALL = 1e-3
"""Weight that keeps the coefficients of those sums small, beside their error."""


def make(coarse: bool = False, report: Callable[[str], Any] = print) -> Table:
    """The tables, and a record of how they were made and of how exact they are.

    Returns:
        planes: (side, cosine, index, function of tau, function of alpha), coefficients of splines. side 0: index >= 1.
        roughnesses: (side, alpha, function of tau, function of alpha), coefficients of splines.
        absorption, returned_absorption: (side, function of tau, power). cosines: those of the powers.
        returned: (side, alpha, index, function of tau), coefficients of splines.
        widths, moments: coefficients of a spline of log(alpha) over the logarithm of the moment, and its ends.
        seed, ranks, returned_rank. rank_errors: (side, row) with rows (functions of tau, of alpha, root mean square of
        the error of T01 at the nodes, its largest). error, returned_error: (side, 2), the same two for T01 and R10
        between the nodes.
    """
    size = SIZES[coarse]
    shares = _walks(size, report)
    sides = []
    for side in (0, 1):
        report(f"diffuse_interface: facets, index {'below' if side else 'above'} 1")
        sides.append(_side(size, side, shares))
    table: Table = {name: np.stack([part[name] for part in sides]) for name in sides[0]}
    table |= _widths()
    table |= {"cosines": POWERS, "seed": np.asarray(SEED), "ranks": np.asarray(RANKS)}
    table["returned_rank"] = np.asarray(RETURNED_RANK)
    errors = [_errors(table, size, side, shares) for side in (0, 1)]
    table |= {name: np.stack([part[name] for part in errors]) for name in errors[0]}
    report(f"diffuse_interface: errors of T01 {table['error'].tolist()}, of R10 {table['returned_error'].tolist()}")
    return table


def _side(size: dict[str, Any], side: int, shares: np.ndarray) -> Table:
    """Reduced tables for the indices on one side of 1."""
    place = np.linspace(0.0, 1.0, size["cosines"])
    alpha = _alphas(np.linspace(0.0, 1.0, size["roughnesses"]))
    entering, returned, weight = [], [], []
    for n in _indices(np.linspace(0.0, 1.0, size["indices"]), side):
        cosine = _cosines(place, n)
        weight.append(np.gradient(cosine))
        entering.append(_entering(cosine[:, None], alpha, n, size, shares))
        returned.append(_returned(alpha, n, size, shares))
    table = _reduce(np.stack(entering, axis=2), np.stack(weight, axis=1))
    plane = np.stack(returned, axis=1)
    functions, powers = _absorption(plane, np.ones(1), RETURNED_RANK)
    coefficients = _coefficients(_coefficients(plane @ functions, 0), 1)
    return table | {"returned": coefficients.astype(np.float32), "returned_absorption": powers.astype(np.float32)}


def _reduce(values: np.ndarray, weight: np.ndarray) -> Table:
    """Separates T01 (cosine, alpha, index, tau): first tau, then alpha from the rest (Eqs. 6-8).

    weight: (cosine, index), what a node stands for.
    """
    functions, powers = _absorption(values, weight[:, None, :], RANKS[0])
    parts = np.moveaxis(values @ functions, 1, 0)  # (alpha, cosine, index, function)
    bases = []
    for k in range(RANKS[0]):
        left, _, _ = np.linalg.svd((parts[..., k] * np.sqrt(weight)).reshape(len(parts), -1), full_matrices=False)
        bases.append(left[:, : RANKS[1]])
    basis = np.stack(bases, axis=1)  # (alpha, function, function of alpha)
    plane = np.einsum("acik,akj->cikj", parts, basis)
    rows = []
    for n, m in TABULATED_RANKS:
        found = np.einsum("cikj,akj,tk->cait", plane[..., :n, :m], basis[..., :n, :m], functions[:, :n])
        error = np.abs(found - values)
        square = np.mean(error**2, axis=(1, 3))
        rows.append([n, m, np.sqrt(np.sum(square * weight) / np.sum(weight)), error.max()])
    return {
        "planes": _coefficients(_coefficients(plane, 0), 1).astype(np.float32),
        "roughnesses": _coefficients(basis, 0).astype(np.float32),
        "absorption": powers.astype(np.float32),
        "rank_errors": np.asarray(rows),
    }


def _absorption(values: np.ndarray, weight: np.ndarray, rank: int) -> tuple[np.ndarray, np.ndarray]:
    """The leading functions of tau: at the transmittances (tau, rank), and as sums of powers (rank, power)."""
    weighted = values * np.sqrt(weight)[..., None]
    _, _, right = np.linalg.svd(weighted.reshape(-1, len(TAUS)), full_matrices=False)
    functions = right[:rank].T
    power = TAUS[:, None] ** (1.0 / POWERS)
    normal = power.T @ power + SMALL**2 * np.eye(len(POWERS))
    return functions, np.linalg.solve(normal, power.T @ functions).T


def _widths() -> Table:
    """Inverse of `diffuse.normal_lobe` as a spline in logarithms."""
    alpha = np.geomspace(5e-3, 1.0, 2001)
    _, moment = (np.asarray(x, float) for x in diffuse.normal_lobe(jnp.asarray(alpha)))
    ends = moment[[0, -1]]
    low, high = np.log(ends)
    even = np.asarray(np.interp(np.linspace(low, high, 257), np.log(moment), np.log(alpha)))
    return {"widths": _coefficients(even, 0), "moments": ends}


def _errors(table: Table, size: dict[str, Any], side: int, shares: np.ndarray) -> Table:
    """Root mean square and largest error between the nodes, at random points."""
    random = np.random.default_rng(SEED + 1 + side)
    place, at = random.random((3, size["tests"])), jnp.asarray(TAUS)[:, None]
    cosine, alpha, n = place[0], _alphas(place[1]), _indices(place[2], side)
    exact = _entering(cosine, alpha, n, size, shares)
    found = diffuse.transmission(table, jnp.asarray(cosine), jnp.asarray(alpha), jnp.asarray(n), at)
    few = slice(size["tests"] // 32)
    returned = [_returned(a[None], i, size, shares)[0] for a, i in zip(alpha[few], n[few], strict=True)]
    returned_found = diffuse.reflection(table, jnp.asarray(alpha[few]), jnp.asarray(n[few]), at)
    error, returned_error = np.abs(found.T - exact), np.abs(returned_found.T - np.stack(returned))
    return {
        name: np.asarray([np.sqrt(np.mean(x**2)), x.max()])
        for name, x in (("error", error), ("returned_error", returned_error))
    }


def _alphas(place: np.ndarray) -> np.ndarray:
    """Inverse of `diffuse.roughness_variable`."""
    return np.maximum(diffuse.GRAIN * np.sinh(place * np.arcsinh(1.0 / diffuse.GRAIN)), 1e-4)


def _indices(place: np.ndarray, side: int) -> np.ndarray:
    """Inverse of `energy_tables.index_variable`."""
    return LARGEST_INDEX ** (place**3 * (1 - 2 * side))


def _cosines(place: np.ndarray, n: float) -> np.ndarray:
    """Inverse of `diffuse.cosine_variable`."""
    critical = np.sqrt(max(1.0 - n * n, 0.0))
    low, high = np.arcsinh(critical / diffuse.GRAIN), np.arcsinh((1.0 - critical) / diffuse.GRAIN)
    return np.clip(critical + diffuse.GRAIN * np.sinh(place * (low + high) - low), 1e-6, 1.0)


def _entering(
    cosine: np.ndarray, alpha: np.ndarray, n: np.ndarray | float, size: dict[str, Any], shares: np.ndarray
) -> np.ndarray:
    """T01 (..., tau) where nothing is interpolated but the shares of the walks."""
    c, a, ratio = (x.ravel() for x in np.broadcast_arrays(cosine, alpha, n))
    _, through, lost = _single_scattering(c, a, ratio, size["facets"])
    total = through + lost[:, None] * _walk_shares(shares, 1, c, a, ratio)
    return total.reshape(*np.broadcast_shapes(np.shape(cosine), np.shape(alpha), np.shape(n)), len(TAUS))


def _returned(alpha: np.ndarray, n: float, size: dict[str, Any], shares: np.ndarray) -> np.ndarray:
    """R10 (alpha, tau) by quadrature over the cosine in the coat."""
    ratio = 1.0 / n
    critical = np.sqrt(max(1.0 - ratio * ratio, 0.0))
    cosine, weight = _panels(np.asarray([0.0, critical, 1.0]), size["facets"])
    cosine = np.maximum(cosine, 1e-6)  # the first panel may be empty
    c, a, r = (x.ravel() for x in np.broadcast_arrays(cosine[:, None], alpha, ratio))
    back, _, lost = _single_scattering(c, a, r, size["facets"])
    energy = (back + lost[:, None] * _walk_shares(shares, 0, c, a, r)).reshape(len(cosine), len(alpha), -1)
    return np.einsum("c,ct,cat->at", 2.0 * weight * cosine, TAUS ** (1.0 / cosine[:, None]), energy)


def _single_scattering(
    cosine: np.ndarray, alpha: np.ndarray, n: np.ndarray, nodes: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Light that leaves after one collision, reflected and transmitted (points, tau), and what does not (points,).

    Facets visible along wi are, stretched by 1 / alpha, a cap around v = (sin(tilt), 0, cos(tilt)), seen as h = v + p
    (Dupuy & Benyoub 2023). On a circle of p around +z, those that reflect totally are an arc, which is split off.
    """
    sine = np.sqrt((1.0 - cosine) * (1.0 + cosine))
    tilt, angle = np.arctan2(alpha * sine, cosine), np.arctan2(sine, cosine)
    vx, vz, length = np.sin(tilt), np.cos(tilt), np.hypot(alpha * sine, cosine)
    critical = np.maximum(1.0 - n * n, 0.0)  # squared cosine at the facet
    cone = np.arccos(np.sqrt(critical))
    edges = [np.zeros_like(tilt), np.pi - tilt]
    for end in (np.minimum(angle + cone, 0.5 * np.pi), angle - cone):
        stretched = np.arctan2(np.sin(end), alpha * np.cos(end))
        edges.append(np.minimum(np.abs(2.0 * stretched - tilt), np.pi - tilt))
    t, weight = _panels(np.sort(np.stack(edges, axis=-1), axis=-1), nodes)
    weight = weight * np.sin(t) / (np.pi * (1.0 + vz[:, None]))
    cosine, alpha, length, vx, vz, critical = (x[:, None] for x in (cosine, alpha, length, vx, vz, critical))
    n = n[:, None, None]
    up = np.maximum(vz + np.cos(t), 0.0)  # h . z
    k = critical * (alpha / length) ** 2
    least = k + np.sqrt(k * k + critical * (1.0 - alpha**2) * (up / length) ** 2)  # |h|^2 / 2 at the critical angle
    middle, swing = 1.0 + vz * np.cos(t), np.maximum(vx * np.sin(t), 1e-300)
    arc = np.arccos(np.clip((least - middle) / swing, -1.0, 1.0))
    s, w = gauss_legendre(nodes)
    outside = (0.5 * (np.sqrt(1.0 + (alpha / cosine) ** 2 * (1.0 - cosine**2)) - 1.0))[..., None]

    def part(begin: np.ndarray, extent: np.ndarray) -> tuple[np.ndarray, ...]:
        half = middle[..., None] + swing[..., None] * np.cos(begin[..., None] + extent[..., None] * s)
        half = np.maximum(half, 1e-15)
        size = np.sqrt(2.0 * (alpha**2)[..., None] * half + ((1.0 - alpha**2) * up**2)[..., None])
        return length[..., None] * half / size, up[..., None] / size, (weight * extent)[..., None] * w

    def escaping(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cosine and Smith's Lambda of an outgoing direction; light below the horizon is masked for certain."""
        c = np.where(z > 1e-9, z, 1.0)
        lengthened = 0.5 * (np.sqrt(1.0 + (alpha[..., None] / c) ** 2 * (1.0 - c) * (1.0 + c)) - 1.0)
        return c, np.where(z > 1e-9, lengthened, np.inf)

    def absorbed(energy: np.ndarray, c: np.ndarray) -> np.ndarray:
        path = 1.0 / c
        return np.stack([np.sum(energy * np.exp(np.log(tau) * path), axis=(-1, -2)) for tau in TAUS], axis=-1)

    at_facet, mz, share = part(np.zeros_like(arc), arc)
    reflectance = _fresnel(at_facet, n)
    refracted = np.sqrt(np.maximum((n * n - 1.0) + at_facet**2, 0.0)) / n
    c, inside = escaping((cosine[..., None] - at_facet * mz) / n + refracted * mz)
    finite = np.minimum(inside, 1e6)
    passing = np.exp(_log_gamma(2.0 + outside) + _log_gamma(1.0 + finite) - _log_gamma(2.0 + outside + finite))
    energy = share * (1.0 - reflectance) * np.where(np.isinf(inside), 0.0, passing)
    through, kept = absorbed(energy, c), 1.0 - np.sum(energy, axis=(-1, -2))
    back = np.zeros_like(through)
    for level, facets in ((reflectance, (at_facet, mz, share)), (1.0, part(arc, np.pi - arc))):
        c, above = escaping(2.0 * facets[0] * facets[1] - cosine[..., None])
        energy = facets[2] * level * (1.0 + outside) / (1.0 + outside + above)
        back, kept = back + absorbed(energy, c), kept - np.sum(energy, axis=(-1, -2))
    return back, through, np.maximum(kept, 0.0)


def _walks(size: dict[str, Any], report: Callable[[str], Any]) -> np.ndarray:
    """Of light that does not leave after one collision: shares (side, cosine, alpha, index, way out, tau)."""
    along, rough, across = (np.linspace(0.0, 1.0, nodes) for nodes in size["walks"])
    alpha = np.maximum(_alphas(rough), LEAST_WALKED[1])
    sides = []
    for side in (0, 1):
        report(f"diffuse_interface: walks, index {'below' if side else 'above'} 1")
        n = _indices(across, side)
        cosine = np.maximum(np.stack([_cosines(along, i) for i in n], axis=-1), LEAST_WALKED[0])
        points = np.stack(np.broadcast_arrays(cosine[:, None], alpha[:, None], n), axis=-1)
        flat = jnp.asarray(points.reshape(-1, 3), jnp.float32)
        keys = jax.random.split(jax.random.fold_in(jax.random.key(SEED), side), len(flat))
        found = np.asarray(multiple_scattering(flat, keys, TAUS, size["paths"]), float)
        sides.append(found.reshape(*points.shape[:-1], 2, len(TAUS)))
    return np.stack(sides)


def _walk_shares(shares: np.ndarray, way: int, cosine: np.ndarray, alpha: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Shares of the walks at points (points, tau) on one side of index 1, cubic between the nodes."""
    side = int(np.min(n) < 1.0)
    c, a, i = (jnp.asarray(x) for x in (cosine, alpha, n))
    places = diffuse.cosine_variable(c, i), diffuse.roughness_variable(a), index_variable(i)
    weights = [_interpolation(np.asarray(place), nodes) for place, nodes in zip(places, shares.shape[1:4], strict=True)]
    found = np.einsum("pc,pa,pn,cant->pt", *weights, shares[side, :, :, :, way], optimize=True)
    return np.clip(found, 0.0, 1.0)


def _interpolation(place: np.ndarray, nodes: int) -> np.ndarray:
    """Weights (points, nodes) of values at uniform nodes on [0, 1] in the cubic spline through them."""
    coefficients = _coefficients(np.eye(nodes), 0)
    index, weights = (np.asarray(x) for x in diffuse.spline(jnp.asarray(place), nodes + 2))
    return np.einsum("pjn,pj->pn", coefficients[index], weights)


def _coefficients(values: np.ndarray, axis: int) -> np.ndarray:
    """Coefficients of the uniform cubic spline through values, two more than there are (not-a-knot ends)."""
    nodes = values.shape[axis]
    matrix = np.zeros((nodes + 2, nodes + 2))
    for i in range(nodes):
        matrix[i, i : i + 3] = np.asarray([1.0, 4.0, 1.0]) / 6.0
    matrix[nodes, :5] = matrix[nodes + 1, -5:] = [1.0, -4.0, 6.0, -4.0, 1.0]
    rows = np.moveaxis(values, axis, 0).reshape(nodes, -1)
    padded = np.concatenate([rows, np.zeros((2, rows.shape[1]))])
    solved = np.linalg.solve(matrix, padded).reshape(nodes + 2, *np.moveaxis(values, axis, 0).shape[1:])
    return np.moveaxis(solved, 0, axis)


def _panels(edges: np.ndarray, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """`layerjax.quadrature.panels` in double precision."""
    s, w = gauss_legendre(nodes)
    smooth, slope = s * s * (3.0 - 2.0 * s), 6.0 * s * (1.0 - s)
    begin, length = edges[..., :-1, None], np.diff(edges)[..., None]
    shape = (*edges.shape[:-1], -1)
    return (begin + length * smooth).reshape(shape), (length * slope * w).reshape(shape)


def _fresnel(cosine: np.ndarray, n: np.ndarray) -> np.ndarray:
    """`layerjax.fresnel.dielectric` in double precision, short of total reflection."""
    refracted = np.sqrt(np.maximum(n * n - 1.0 + cosine * cosine, 0.0)) / n
    perpendicular = (cosine - n * refracted) / (cosine + n * refracted + 1e-300)
    parallel = (n * cosine - refracted) / (n * cosine + refracted + 1e-300)
    return 0.5 * (perpendicular**2 + parallel**2)


def _log_gamma(x: np.ndarray) -> np.ndarray:
    """log Gamma(x) for x >= 1: Stirling's series at x + 6."""
    y, product = x + 6.0, x * (x + 1.0) * (x + 2.0) * (x + 3.0) * (x + 4.0) * (x + 5.0)
    inverse = 1.0 / y
    series = inverse * (1.0 / 12.0 - inverse**2 * (1.0 / 360.0 - inverse**2 / 1260.0))
    return (y - 0.5) * np.log(y) - y + 0.5 * np.log(2.0 * np.pi) + series - np.log(product)
