"""Cosine nodes that suit every region of a stack at once.

Between smooth interfaces s = n sin(theta) does not change (Snell), and neither does the measure of flux
n^2 mu dmu = -s ds. One set of nodes in s therefore serves all regions, with one set of weights: refraction sends nodes
to nodes, and a rough interface spreads light around them. Regions of other index end at other s, so the range of s is
cut into panels at the indices that occur, 0 = n_0 < n_1 < n_2 < ..., where functions kink (the critical angles). Panel
k has the coordinate x in (0, 1), the cosine in the region of index n_k over its largest value there:

    s^2 = n_k^2 - x^2 (n_k^2 - n_{k-1}^2),   n^2 mu dmu = (n_k^2 - n_{k-1}^2) x dx.

A stack without interfaces has one panel, on which x is the cosine itself: Gauss nodes on (0, 1).
"""

import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import clamp_max, clamp_min, horner, safe_sqrt, smooth_step
from layerjax.quadrature import gauss_legendre
from layerjax.transport.adding_doubling.interpolate import cubic

COSINE_FLOOR = 1e-7
"""Stands for the cosines of a panel without extent (two equal indices), whose nodes have no weight."""

LEAST_COSINE = 1e-6
"""Stands for the cosine 0 at the end of a table."""

MERGE_SHARE = 0.5
"""Of the first node of a panel: indices whose squares differ by less than its square share one panel."""

UNROLLED = 8
"""Polynomials of up to so many degrees are written out, of more a loop."""

EDGE_SHARE = 0.3
"""Largest share of a panel around its edge."""

ROUNDED_ROOT = (367 / 928, 151 / 232, 23 / 464, -31 / 232, 35 / 928)
"""Coefficients of r^0 ... r^4 of what stands for the root of r on (-1, 1): with its value and two derivatives at 1,
level at -1, and with its mean where directions beyond 0 count by a smooth step."""

DISTANT = 1e6
"""Of s^2, over the extent of a panel: stands for the distance to the end of another region where there is none."""

LEAST_ROOT = 1e-6
"""Stands for the roots at the end of a table, which are divided by."""

TABLE_DENSITY = 2
"""Points of the table of a panel for each of its nodes."""


class Region(eqx.Module):
    """The nodes as one region sees them, each (panels * nodes,).

    cosine and sine of theta there (stand-ins where no such direction exists), the weight of the measure n^2 mu dmu (0
    where no such direction exists), that of dmu, and whether the direction exists.
    """

    ior: Array
    cosine: Array
    sine: Array
    weight: Array
    solid: Array
    exists: Array


class Grid(eqx.Module):
    """Nodes of all panels in s, and the regions from top to bottom. common: whether all regions have the same nodes,
    also in a panel that regions of slightly different indices share. mirrored: whether light that an interface passes
    comes back to it as it is, and not in closed form."""

    edges: Array
    least_width: Array
    regions: tuple[Region, ...]
    nodes: int = eqx.field(static=True)
    common: bool = eqx.field(static=True, default=False)
    mirrored: bool = eqx.field(static=True, default=False)

    @property
    def interfaces(self) -> int:
        """Between the regions."""
        return len(self.regions) - 1

    @property
    def size(self) -> int:
        """Number of nodes of all panels."""
        return self.edges.shape[0] * self.nodes

    def bounds(self, panel: Array | np.ndarray, squared_index: Array) -> tuple[Array, Array]:
        """Lower and upper end in s^2 of panels, in regions of this squared index.

        A panel that regions share ends for each of them where its own directions do, unless nodes are common.
        """
        low, high = jnp.concatenate([jnp.zeros(1, self.edges.dtype), self.edges[:-1]])[panel], self.edges[panel]
        if self.common:
            return low, high
        return low, jnp.where(jnp.abs(high - squared_index) < self.least_width, squared_index, high)

    @property
    def panels(self) -> np.ndarray:
        """Numbers of the panels, (panels, 1)."""
        return np.arange(self.edges.shape[0])[:, None]


def join_regions(first: Region, second: Region) -> Region:
    """The directions of two regions of one index, one after the other."""
    parts = jax.tree.map(lambda a, b: jnp.concatenate([jnp.atleast_1d(a), jnp.atleast_1d(b)]), first, second)
    return eqx.tree_at(lambda region: region.ior, parts, first.ior)


def make_grid(
    indices: Sequence[Any],
    ranks: tuple[int, ...] | None,
    nodes: int,
    dtype: Any,
    *,
    common: bool = False,
    mirrored: bool = False,
) -> Grid:
    """Grid for regions of these refractive indices.

    Args:
        indices: index of each region, from top to bottom, relative to the surroundings.
        ranks: the place of each region's index among the distinct ones, if that is known; None: found by sorting.
        nodes: nodes a panel.
        common: see `Grid`; for smooth interfaces, which refract nodes to nodes.
        mirrored: see `Grid`.
    """
    squares = jnp.stack([jnp.asarray(n, dtype) ** 2 for n in indices])
    if ranks is None:
        edges = jnp.sort(squares)
    else:
        edges = jnp.stack([squares[ranks.index(rank)] for rank in range(max(ranks) + 1)])
    x, w = (jnp.asarray(array, dtype) for array in gauss_legendre(nodes))
    least_width = (MERGE_SHARE * x[0]) ** 2
    grid = Grid(_merge_edges(edges, least_width), least_width, (), nodes, common, mirrored)
    beyond = least_width if common else 0.0
    x2 = (x * x)[None]
    regions = []
    for n2 in squares:
        low, high = grid.bounds(grid.panels, n2)
        width = high - low
        exists = (high <= n2 + beyond) & (width > 0)
        cosine2 = jnp.where(exists, (n2 - high + x2 * width) / n2, 0.25)
        cosine = jnp.sqrt(clamp_min(cosine2, COSINE_FLOOR**2))
        sine = jnp.sqrt(jnp.where(exists, (high - x2 * width) / n2, 0.75))
        here = jnp.where(exists, (x * w)[None] * width, 0.0)
        flat = (cosine.ravel(), sine.ravel(), here.ravel(), (here / (n2 * cosine)).ravel(), here.ravel() > 0)
        regions.append(Region(jnp.sqrt(n2), *flat))
    return eqx.tree_at(lambda g: g.regions, grid, tuple(regions))


def _merge_edges(edges: Array, least_width: Array) -> Array:
    """The edges, each moved up to the next one if that is nearer than `least_width`.

    Between indices that nearly agree a panel of its own would hold no node that counts, and the values would change
    like the root of their difference: the derivative at equal indices would be lost.
    """
    merged = [edges[-1]]
    for k in range(edges.shape[0] - 2, -1, -1):
        merged.insert(0, jnp.where(merged[0] - edges[k] < least_width, merged[0], edges[k]))
    return jnp.stack(merged)


def interpolation_weights(grid: Grid, ior: Array, cosine: Array, sine2: Array, blur: Array) -> Array:
    """Interpolation weights of directions on all nodes, shape ``cosine.shape + (grid.size,)``, which sum to 1.

    Polynomials of the panel's coordinate. Summed against a distribution of directions they *deposit* it on the nodes,
    with its total and its moments kept. Around the edge between two panels both have a share, so that the weights of
    a direction that moves from one to the other change smoothly.

    Args:
        ior: index of the region in which the directions are.
        cosine: their |cos theta|.
        sine2: their sin(theta)^2.
        blur: half the width in s^2 of what is around each edge, of the order of the distance between directions.
    """
    squared_index = ior * ior
    squared = squared_index * sine2
    reached = [jnp.ones_like(squared)]
    placed = []
    below = jnp.zeros_like(squared_index)
    for k in range(grid.edges.shape[0]):
        low, high = grid.bounds(np.asarray(k), squared_index)
        width = jnp.where(high > low, high - low, 1.0)
        above = _edge_width(grid, squared_index, k, blur)
        x2 = ((high - squared_index) + squared_index * cosine * cosine) / width
        x = _coordinate_between(x2, (squared - low) / width, below / width, above / width)
        reached.append(_step(squared - grid.edges[k], above, grid.edges[k] < squared_index - grid.least_width))
        share = jnp.where(high > low, reached[-2] - reached[-1], 0.0)
        placed.append(share[..., None] * lagrange(x, grid.nodes))
        below = above
    return jnp.concatenate(placed, axis=-1)


def _edge_width(grid: Grid, squared_index: Array, k: int, blur: Array) -> Array:
    """Half the width of what is around the upper edge of a panel; 0 where there is none in the region."""
    if k + 1 == grid.edges.shape[0]:
        return jnp.zeros_like(squared_index)
    edge, after, before = grid.edges[k], squared_index, jnp.zeros_like(squared_index)
    for other in range(grid.edges.shape[0] - 2, k, -1):  # panels of equal indices have no extent
        after = jnp.where((edge < grid.edges[other]) & (grid.edges[other] < squared_index), grid.edges[other], after)
    for other in range(k):
        before = jnp.where(grid.edges[other] < edge, grid.edges[other], before)
    return jnp.where(
        edge < squared_index - grid.least_width,
        clamp_max(clamp_max(blur[k], EDGE_SHARE * (edge - before)), EDGE_SHARE * (after - edge)),
        0.0,
    )


def _step(distance: Array, around: Array, inner: Array) -> Array:
    """How much of a direction lies beyond an edge: 0 to 1 over what is around it."""
    wide = around > 0
    smooth = smooth_step(distance / jnp.where(wide, around, 1.0))
    return jnp.where(inner, jnp.where(wide, smooth, distance >= 0), 0.0)


def _coordinate_between(x2: Array, rest2: Array, below: Array, above: Array) -> Array:
    """x of a panel; at its two ends what is smooth in s^2, and the same in the mean, over these widths.

    At the lower end, x = 1, it rests there; at the upper one x is a root, and is rounded off.
    """
    wide, t = below > 0, rest2 / jnp.where(below > 0, below, 1.0)
    near = wide & (t < 1.0)
    t = jnp.where(near, clamp_min(t, -1.0), 0.0)
    x2 = jnp.where(near, 1.0 - below * (1.0 + t) ** 3 * (3.0 - t) / 16.0, x2)
    wide, r = above > 0, x2 / jnp.where(above > 0, above, 1.0)
    near = wide & (r < 1.0)
    rounded = jnp.sqrt(jnp.where(wide, above, 1.0)) * horner(ROUNDED_ROOT, jnp.where(near, clamp_min(r, -1.0), 0.0))
    return jnp.where(near, rounded, safe_sqrt(jnp.where(near, 1.0, clamp_max(clamp_min(x2, 0.0), 1.0))))


def _panel(grid: Grid, squared: Array) -> Array:
    inner = grid.edges[:-1]
    return jnp.sum(squared[..., None] >= inner, axis=-1)


def _coordinate(ior: Array, cosine: Array, sine2: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """x^2 and 1 - x^2, each from what it vanishes with."""
    n2 = ior * ior
    width = jnp.where(high > low, high - low, 1.0)
    x2 = ((high - n2) + n2 * cosine * cosine) / width
    return clamp_max(clamp_min(x2, 0.0), 1.0), clamp_max(clamp_min((n2 * sine2 - low) / width, 0.0), 1.0)


def lagrange(x: Array, nodes: int) -> Array:
    """Lagrange polynomials of the Gauss nodes on [0, 1] at x, along a new last axis."""
    basis = legendre(x, nodes)
    return basis @ jnp.asarray(_projection(nodes), basis.dtype)


def legendre(x: Array, count: int) -> Array:
    """Legendre polynomials P_0 ... P_(count-1) shifted to [0, 1], along a new last axis."""
    y = 2.0 * x - 1.0
    if count <= UNROLLED:
        values = [jnp.ones_like(y), y]
        for n in range(1, count - 1):
            values.append(((2 * n + 1) / (n + 1)) * y * values[-1] - (n / (n + 1)) * values[-2])
        return jnp.stack(values[:count], axis=-1)

    def step(pair: tuple[Array, Array], factors: tuple[Array, ...]) -> tuple[tuple[Array, Array], Array]:
        before, last = pair
        rise, fall = factors
        return (last, rise * y * last - fall * before), before

    degree = np.arange(count)
    factors = tuple(jnp.asarray(f, y.dtype) for f in ((2 * degree + 3) / (degree + 2), (degree + 1) / (degree + 2)))
    _, polynomials = jax.lax.scan(step, (jnp.ones_like(y), y), factors)
    return jnp.moveaxis(polynomials, 0, -1)


@functools.cache
def _projection(nodes: int) -> np.ndarray:
    """Values at the nodes to Legendre coefficients, (degree, node): exact, by discrete orthogonality."""
    x, w = gauss_legendre(nodes)
    polynomials = np.polynomial.legendre.legvander(2.0 * x - 1.0, nodes - 1)
    return ((2.0 * np.arange(nodes) + 1.0)[:, None] * polynomials.T) * w


@functools.cache
def table_matrix(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Points x of a panel's table, (points,), and the matrix from values at the nodes to values there.

    The points are uniform in t, x = (1 + cos(pi t)) / 2: crowded at both ends like the nodes themselves.
    """
    points = TABLE_DENSITY * nodes
    x = 0.5 * (1.0 + np.cos(np.pi * np.arange(points) / (points - 1)))
    vander = np.polynomial.legendre.legvander(2.0 * x - 1.0, nodes - 1)
    return x, vander @ _projection(nodes)


def stencil(grid: Grid, ior: Array, cosine: Array, sine2: Array) -> tuple[Array, Array]:
    """Where a table (panel by panel) is read at directions: the first of four points, and the place from there."""
    points = TABLE_DENSITY * grid.nodes
    panel = _panel(grid, ior * ior * sine2)
    low, high = grid.bounds(panel, ior * ior)
    x2, rest2 = _coordinate(ior, cosine, sine2, low, high)
    x = safe_sqrt(x2)
    # t by a half-angle tangent: steep at neither end, as arccos would be
    t = (2.0 / jnp.pi) * jnp.arctan2(safe_sqrt(rest2 / (1.0 + x)), safe_sqrt(x))
    place = t * (points - 1)
    first = jnp.clip(jax.lax.stop_gradient(jnp.floor(place)) - 1.0, 0.0, points - 4.0)
    return first.astype(jnp.int32) + panel * points, place - first


def root_along(grid: Grid, ior: Array, cosine: Array, sine2: Array) -> Array:
    """`root_beyond` along directions."""
    panel = _panel(grid, ior * ior * sine2)
    return root_beyond(grid, panel, _coordinate(ior, cosine, sine2, *grid.bounds(panel, ior * ior))[0])


def root_beyond(grid: Grid, panel: Array | np.ndarray, x2: Array) -> Array:
    """The cosine, over its largest in a panel, in the second region whose directions end at its end or beyond.

    Where nodes are common, derivatives by indices have the pole of its inverse: with another index that cosine is
    another at the same node. It is about 1 where no second region ends nearby. x2: squared coordinate in the panel.
    """
    squares = jnp.stack([region.ior**2 for region in grid.regions])
    low, high = grid.bounds(grid.panels, squares)
    reach = jnp.where(squares >= high - grid.least_width, clamp_min(squares - high, 0.0), jnp.inf)
    width = jnp.where(high > low, high - low, 1.0)
    gap = clamp_max(jnp.sort(reach / width, axis=-1)[:, 1], DISTANT)[panel]
    return jax.lax.stop_gradient(clamp_min(jnp.sqrt((x2 + gap) / (1.0 + gap)), LEAST_ROOT))


def interpolate_rows(grid: Grid, rows: Array, ior: Array, cosine: Array, sine2: Array) -> Array:
    """Row of a table (points, columns) at directions, shape ``cosine.shape + (columns,)``; see `stencil`."""
    first, place = stencil(grid, ior, cosine, sine2)
    weights = cubic(place)
    return sum((weights[j][..., None] * rows[first + j] for j in range(1, 4)), weights[0][..., None] * rows[first])


def table_region(grid: Grid, region: Region) -> Region:
    """The points of a table in a region (panels * points,), all of weight 1; the normal where there is none."""
    x, _ = table_matrix(grid.nodes)
    squared_index = region.ior**2
    low, high = grid.bounds(grid.panels, squared_index)
    rest = jnp.asarray(x * x, high.dtype) * (high - low)
    exists = (high <= squared_index) & (high > low)
    cosine = jnp.sqrt(
        clamp_min(jnp.where(exists, (squared_index - high + rest) / squared_index, 1.0), LEAST_COSINE**2)
    ).ravel()
    one = jnp.ones_like(cosine)
    return Region(region.ior, cosine, safe_sqrt((1.0 - cosine) * (1.0 + cosine)), one, one, one > 0)


def table_values(grid: Grid, values: Array) -> Array:
    """Values (..., nodes) at the points of a table, by polynomials in each panel."""
    _, matrix = table_matrix(grid.nodes)
    split = values.reshape(*values.shape[:-1], -1, grid.nodes) @ jnp.asarray(matrix.T, values.dtype)
    return split.reshape(*values.shape[:-1], -1)
