"""Where the several-event part of a solved stack is read off: tables over directions, cubic between their points.

What is tabulated is f / ior_o^2 (mu_i + mu_o), a smooth function down to grazing light on both sides, made reciprocal.
Where the outermost layer is a smooth interface it is f / ior_o^2 over what that passes either way, all turns between it
and the smooth interfaces behind counted.
A table is finer than the grid: polynomials in the cosine and Fourier series in azimuth carry the values over. Modes are
summed at its azimuths, 0 to pi, so that a pair reads 64 numbers however many modes there are.

Under smooth interfaces, whose regions have common nodes, derivatives by indices have poles at grazing light, which
polynomials do not follow. Tables therefore hold derivatives times the cosines, see `root_beyond`, and readers divide.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import allow_broadcasting, horizon, safe_div, scale_tangent
from layerjax.channels import Channels, multiply
from layerjax.channels import select as select_channels
from layerjax.directions import Vector, select
from layerjax.quadrature import gauss_legendre
from layerjax.transport.adding_doubling.energies import OuterFace, node_shares
from layerjax.transport.adding_doubling.grid import Grid, Region, root_along, root_beyond, stencil, table_matrix
from layerjax.transport.adding_doubling.interpolate import Axis, look_up
from layerjax.transport.adding_doubling.operators import Layer, Operator, rotate
from layerjax.transport.contract import Side
from layerjax.transport.specular import Turns, Window

AZIMUTH_DENSITY = 2
"""Azimuths of a table for each ordinate of the grid."""

MODE_DENSITY = 3
"""Steps of a table from azimuth 0 to pi for each Fourier mode."""


class Tables(eqx.Module):
    """The rest of the BSDF, and the energies of all of it.

    values: for each channel an array over (quadrant and direction out, direction in, azimuth), without the azimuth
    with ordinates and with one mode; quadrants: above to above, and with a stack that transmits below to below, and
    above to below. `steps`: of the azimuth from 0 to pi, with one more point beyond either end.

    energies: a row for light from above and one for light from below, per channel, for each direction in. Where there
    are interfaces, the shares of `node_shares`; else what is scattered to the same side and the other, as a share
    of what meets an event.
    """

    grid: Grid
    values: tuple[Array, ...] | None
    energies: tuple[Array, ...]
    windows: tuple[Window | None, Window | None]
    """Smooth interfaces that light from above meets first, and from below."""
    turns: tuple[Turns | None, Turns | None]
    """Between these and what lies behind them; None: in the values."""
    opaque: bool = eqx.field(static=True)
    azimuths: int | None = eqx.field(static=True)
    steps: int | None = eqx.field(static=True)


class _End(NamedTuple):
    """The medium above or below the stack: its nodes, matrices from values there to the points of a table, what a
    smooth interface passes of light along the nodes (None: there is none), the turns behind it, (channels, nodes), and
    `_roots`."""

    region: Region
    lift: Array
    passed: Array | None
    turns: Array | None
    roots: tuple[Array, Array] | None


def make_tables(
    grid: Grid,
    whole: Layer,
    rest: Layer,
    azimuths: int | None,
    opaque: bool,
    interaction_probability: Callable[[Vector], Channels | None],
    faces: tuple[OuterFace | None, OuterFace | None] | None,
    peak_probability: Callable[[Vector], Channels | None] | None,
    windows: tuple[Window | None, Window | None],
    turns: tuple[Turns | None, Turns | None],
) -> Tables:
    """Tables of a solved stack.

    Args:
        grid: the directions that it was solved at.
        whole: the operators of all its layers together, whose energies are kept.
        rest: of the same, what is read off the tables.
        azimuths: ordinates in azimuth; None: Fourier modes.
        opaque: only light from above, and what is reflected.
        interaction_probability: that light along a direction meets an event at all, per channel (None: 1).
        faces: see `outer_faces`; None, if there are no interfaces.
        onward_probability: of what does, that the layers have it as passing untouched (None: 0).
        windows, turns: see `Tables`.
    """
    modes = max(flux.shape[1] for flux in jax.tree.leaves(whole))
    steps = None if azimuths is not None or modes == 1 else MODE_DENSITY * modes
    top, bottom = (
        _End(
            region,
            _lift(grid, region, modes, azimuths),
            None if window is None else _passed(window, region),
            None if counted is None else _turns_along(counted, region),
            _roots(grid, azimuths),
        )
        for region, window, counted in zip((grid.regions[0], grid.regions[-1]), windows, turns, strict=True)
    )
    values = _values(rest, top, bottom, azimuths, steps, opaque)

    lit = [(top, OuterFace(whole.reflect_top, whole.transmit_down), 1.0)]
    if not opaque:
        lit.append((bottom, OuterFace(whole.reflect_bottom, whole.transmit_up), -1.0))
    rows = []
    for (end, found, side), face in zip(lit, faces or (None, None), strict=False):
        if faces is not None:
            weight = jnp.repeat(end.region.weight, azimuths or 1)
            shares = node_shares(found, face, weight)
            rows.append(list(_lift_energies(shares if end.turns is None else shares / end.turns, end)))
        else:
            directions = _node_directions(end.region, azimuths, side)
            share = interaction_probability(directions)
            onward = None if peak_probability is None else peak_probability(directions)
            rows.append(
                [_energy(found.reflect.total, None, share, end), _energy(found.transmit.total, onward, share, end)]
            )
    shape = (max(energy.shape[0] for row in rows for energy in row), rows[0][0].shape[-1])
    energies = tuple(jnp.stack([jnp.broadcast_to(e, shape) for e in each]) for each in zip(*rows, strict=True))
    return Tables(grid, values, energies, windows, turns, opaque, azimuths, steps)


def _passed(window: Window, region: Region) -> Array:
    """What a smooth interface passes of light along the nodes, (channels or 1, nodes)."""
    return jnp.stack(window.cross((region.sine, jnp.zeros_like(region.sine), region.cosine))[1])


def _turns_along(turns: Turns, region: Region) -> Array:
    """`Turns.count` along the nodes, (channels, nodes)."""
    counted = turns.count((region.sine, jnp.zeros_like(region.sine), region.cosine))
    return jnp.where(region.exists, jnp.stack(counted), 1.0)


def _values(
    whole: Layer, top: _End, bottom: _End, azimuths: int | None, steps: int | None, opaque: bool
) -> tuple[Array, ...] | None:
    """The quadrants one after the other, an array a channel; None where nothing scatters more than once."""

    def table(flux: Operator, back: Operator, out: _End, into: _End) -> Array | None:
        flux, back = (_per_weight(operator, end, azimuths) for operator, end in ((flux, out), (back, into)))
        return _quadrant(flux, rotate(back, azimuths), out, into, azimuths, steps)

    above = whole.reflect_top.rest
    quadrants = [table(above, above, top, top)]
    if not opaque:
        below = whole.reflect_bottom.rest
        quadrants.append(table(below, below, bottom, bottom))
        quadrants.append(table(whole.transmit_down.rest, whole.transmit_up.rest, bottom, top))
    present = [quadrant for quadrant in quadrants if quadrant is not None]
    if not present:
        return None
    shape = (max(quadrant.shape[0] for quadrant in present), *present[0].shape[1:])
    zero = jnp.zeros(shape, present[0].dtype)
    together = jnp.concatenate(
        [zero if quadrant is None else jnp.broadcast_to(quadrant, shape) for quadrant in quadrants], axis=1
    )
    return tuple(together[c] for c in range(together.shape[0]))


def _per_weight(flux: Operator, out: _End, azimuths: int | None) -> Operator:
    """f / ior_o^2 between nodes: the flux into each node over its share of the projected solid angle."""
    if flux is None:
        return None
    count = azimuths or 1
    weight = 2.0 * jnp.pi * jnp.repeat(out.region.weight, count) / count
    return safe_div(flux, jnp.broadcast_to(weight[:, None], flux.shape))


def _quadrant(
    flux: Operator, reverse: Operator, out: _End, into: _End, azimuths: int | None, steps: int | None
) -> Array | None:
    """A table of reciprocal values; back: the same light the other way round, turned to the directions of `there`."""
    if flux is None or reverse is None:
        return None
    count = azimuths or 1
    mean = 0.5 * (flux + jnp.swapaxes(reverse, -1, -2))
    if out.passed is None and into.passed is None:
        values = mean * (jnp.repeat(out.region.cosine, count)[:, None] + jnp.repeat(into.region.cosine, count))
    else:
        leaving, entering = (jnp.repeat(_share_passed(end), count, axis=-1) for end in (out, into))
        both = leaving[:, None, :, None] * entering[:, None, None, :]
        shape = jnp.broadcast_shapes(mean.shape, both.shape)
        values = safe_div(jnp.broadcast_to(mean, shape), jnp.broadcast_to(both, shape))
    fine = _lift_values(values, out, into)
    if steps is None:
        return fine[:, 0]
    return jnp.einsum("cmij,mp->cijp", fine, jnp.asarray(_waves(values.shape[1], steps), fine.dtype))


def _share_passed(end: _End) -> Array:
    """What a smooth interface passes along every node, all turns counted, (channels or 1, nodes); 1 where there is
    none."""
    if end.passed is None:
        return jnp.ones_like(end.region.cosine)[None]
    passed = jnp.where(end.region.exists, end.passed, 0.0)
    return passed if end.turns is None else passed * end.turns


def _energy(flux: Operator, onward: Channels | None, share: Channels | None, end: _End) -> Array:
    """Energy that leaves for light along each direction of a table, of what interacts: (channels or 1, points)."""
    lift = end.lift[0]
    leaving = jnp.zeros((1, lift.shape[-1]), lift.dtype) if flux is None else jnp.sum(flux[:, 0], axis=-2)
    if onward is not None:
        leaving = leaving + jnp.stack(onward)
    met = jnp.ones((1, lift.shape[-1]), lift.dtype) if share is None else jnp.stack(share)
    return _lift_energies(safe_div(leaving, jnp.broadcast_to(met, jnp.broadcast_shapes(leaving.shape, met.shape))), end)


def _roots(grid: Grid, azimuths: int | None) -> tuple[Array, Array] | None:
    """`root_beyond` at the nodes and at the points of a table, in proportion to the inverse of which derivatives by
    indices are; None where they are not."""
    if not grid.common:
        return None
    dtype, count = grid.edges.dtype, azimuths or 1
    nodes, points = gauss_legendre(grid.nodes)[0], table_matrix(grid.nodes)[0]
    at_nodes, at_points = (
        root_beyond(grid, grid.panels, jnp.asarray(x * x, dtype)[None]).ravel() for x in (nodes, points)
    )
    return jnp.repeat(at_nodes, count), jnp.repeat(at_points, count if azimuths is None else AZIMUTH_DENSITY * count)


def _lift_energies(values: Array, end: _End) -> Array:
    """Values (..., nodes) at the points of a table."""
    if end.roots is None:
        return values @ end.lift[0].T
    return _lift_weighted(values, (end.lift[0],), *end.roots)


def _lift_values(values: Array, out: _End, into: _End) -> Array:
    """Values (..., nodes, nodes) at the points of a table."""
    lifts = out.lift, into.lift
    if out.roots is None or into.roots is None:
        return _lift_axes(values, lifts)
    return _lift_weighted(values, lifts, *(jnp.outer(*pair) for pair in zip(out.roots, into.roots, strict=True)))


def _lift_axes(values: Array, lifts: tuple[Array, ...]) -> Array:
    """Matrices on the last axis, or on the last two."""
    *out, into = lifts
    return (out[0] @ values if out else values) @ jnp.swapaxes(into, -1, -2)


@jax.custom_jvp
def _lift_weighted(values: Array, lifts: tuple[Array, ...], at_nodes: Array, at_points: Array) -> Array:
    """`_lift_axes`, whose derivatives are those times `at_points`, see `_read`: polynomials carry them over weighted,
    for alone they have poles.

    at_nodes, at_points: products of roots along all axes, see `_roots`.
    """
    return _lift_axes(values, lifts)


@_lift_weighted.defjvp
@allow_broadcasting
def _lift_weighted_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    values, lifts, at_nodes, at_points = primals
    fine, moved = jax.jvp(partial(_lift_axes, values), (lifts,), (tangents[1],))
    return fine, at_points * moved + _lift_axes(at_nodes * tangents[0], lifts)


def _read(
    tables: Tables, values: Sequence[Array], start: Array, axes: list[Axis], along: list[tuple[Vector, Array]]
) -> Channels:
    """Values of tables along directions, each with its index; derivatives of what is in the tables are weighted by the
    roots there, and those by the place in them are not."""
    if not tables.grid.common:
        return look_up(values, start, axes)
    roots = [root_along(tables.grid, ior, w[2], w[0] * w[0] + w[1] * w[1]) for w, ior in along]
    weight = math.prod(roots[1:], start=roots[0])
    axes = [axis._replace(place=scale_tangent(axis.place, weight)) for axis in axes]
    return tuple(scale_tangent(value, 1.0 / weight) for value in look_up(values, start, axes))


def read_rest(tables: Tables, wi: Vector, wo: Vector, side: Side) -> Channels:
    """BSDF of the paths with more than one event, which ringing may take below 0."""
    zero = jnp.zeros_like(wi[2] * wo[2])
    if tables.values is None or (tables.opaque and side == "transmission"):
        return (zero,)
    edge = horizon(wi[2].dtype)
    top, bottom = tables.grid.regions[0].ior, tables.grid.regions[-1].ior
    if tables.opaque or side == "reflection":
        valid = (wi[2] > edge) & (wo[2] > edge)
        quadrant, scale = jnp.zeros((), jnp.int32), jnp.ones_like(top)
        out, into, ior_out, ior_into = wo, wi, top, top
    else:
        valid = (jnp.abs(wi[2]) > edge) & (jnp.abs(wo[2]) > edge)
        if side == "transmission":
            valid = valid & (wi[2] * wo[2] < 0)
        upward = (wi[2] < 0) & (wo[2] > 0)  # the table holds above to below
        out, into = select(upward, wi, wo), select(upward, wo, wi)
        ior_out, ior_into = jnp.where(out[2] < 0, bottom, top), jnp.where(into[2] < 0, bottom, top)
        scale = jnp.where(wo[2] < 0, bottom, top) ** 2
        quadrant = jnp.where(out[2] > 0, 0, jnp.where(into[2] > 0, 2, 1))
    out, into = _replace_invalid(out, valid), _replace_invalid(into, valid)
    shape = tables.values[0].shape
    start = quadrant * (shape[0] // (1 if tables.opaque else 3) * math.prod(shape[1:]))
    axes = [
        *_points(tables, out, ior_out, 0.0, math.prod(shape[1:])),
        *_points(tables, into, ior_into, np.pi, math.prod(shape[2:])),  # a table's azimuths are those of travel
    ]
    if tables.steps is not None:
        axes.append(_azimuth_points(into, out, tables.steps))
    factors = tuple(jnp.where(valid, scale * weight, 0.0) for weight in _weight(tables, out, into, quadrant))
    found = _read(tables, tables.values, start, axes, [(out, ior_out), (into, ior_into)])
    return multiply(factors, found)


def _weight(tables: Tables, out: Vector, into: Vector, quadrant: Array) -> Channels:
    """What values are in proportion to, of directions both turned to above; quadrants: see `Tables`."""
    sum_of_cosines = 1.0 / (out[2] + into[2])
    if all(window is None for window in tables.windows):
        return (sum_of_cosines,)
    top, bottom = (
        None if window is None else [_entering(window, turns, w) for w in (out, into)]
        for window, turns in zip(tables.windows, tables.turns, strict=True)
    )
    above = (sum_of_cosines,) if top is None else multiply(*top)
    if tables.opaque:
        return above
    below = (sum_of_cosines,) if bottom is None else multiply(*bottom)
    one = (jnp.ones_like(sum_of_cosines),)
    across = multiply(one if bottom is None else bottom[0], one if top is None else top[1])
    return select_channels(quadrant == 0, above, select_channels(quadrant == 1, below, across))


def _entering(window: Window, turns: Turns | None, w: Vector) -> Channels:
    """What a smooth interface passes of light along w, all turns counted."""
    passed = window.cross(w)[1]
    return passed if turns is None else multiply(passed, turns.count(w))


def read_energies(tables: Tables, wi: Vector) -> list[Channels]:
    """`Tables.energies` for light along wi."""
    above = wi[2] > 0
    valid = jnp.abs(wi[2]) > horizon(wi[2].dtype)
    if tables.opaque:
        valid = valid & above
    row = jnp.where(above | tables.opaque, 0, 1)
    ior = jnp.where(above, tables.grid.regions[0].ior, tables.grid.regions[-1].ior)
    wi = _replace_invalid(wi, valid)
    axes = _points(tables, wi, ior, np.pi, 1)
    found = [
        _read(tables, tuple(jnp.moveaxis(table, 1, 0)), row * table.shape[-1], axes, [(wi, ior)])
        for table in tables.energies
    ]
    for turns, lit in zip(tables.turns, (row == 0, row == 1), strict=True):
        if turns is not None:
            one = (jnp.ones_like(wi[2]),)
            found = [multiply(energies, select_channels(lit, turns.count(wi), one)) for energies in found]
    return [tuple(jnp.where(valid, energy, 0.0) for energy in energies) for energies in found]


def _node_directions(region: Region, azimuths: int | None, side: float) -> Vector:
    """Directions towards the light that travels along the nodes."""
    ordinates = np.zeros(1) if azimuths is None else 2.0 * np.pi * np.arange(azimuths) / azimuths
    sine = region.sine[:, None]
    x, y = -sine * jnp.asarray(np.cos(ordinates), sine.dtype), -sine * jnp.asarray(np.sin(ordinates), sine.dtype)
    return x.ravel(), y.ravel(), jnp.repeat(side * region.cosine, ordinates.size)


def _replace_invalid(w: Vector, valid: Array) -> Vector:
    """w above, or a stand-in where it is not to be read."""
    return (jnp.where(valid, w[0], 0.6), jnp.where(valid, w[1], 0.0), jnp.where(valid, jnp.abs(w[2]), 0.8))


def _points(tables: Tables, w: Vector, ior: Array, turn: float, stride: int) -> list[Axis]:
    """Where a direction lies in a table whose directions are `stride` apart: in cosine, and with ordinates azimuth."""
    first, polar = stencil(tables.grid, ior, w[2], w[0] * w[0] + w[1] * w[1])
    if tables.azimuths is None:
        return [Axis(first, polar, stride)]
    count = AZIMUTH_DENSITY * tables.azimuths
    at_pole = (w[0] == 0) & (w[1] == 0)
    phi = jnp.arctan2(jnp.where(at_pole, 0.0, w[1]), jnp.where(at_pole, 1.0, w[0])) + turn
    place = phi * (count / (2.0 * np.pi))
    corner = jax.lax.stop_gradient(jnp.floor(place))
    around = Axis(corner.astype(jnp.int32) - 1, place - corner + 1.0, stride, count)
    return [Axis(first, polar, stride * count), around]


def _azimuth_points(wi: Vector, wo: Vector, steps: int) -> Axis:
    """Where the azimuth between the directions of travel lies in a table."""
    sine, cosine = wi[1] * wo[0] - wi[0] * wo[1], -(wi[0] * wo[0] + wi[1] * wo[1])
    at_pole = (sine == 0) & (cosine == 0)
    place = (steps / np.pi) * jnp.arctan2(jnp.abs(jnp.where(at_pole, 0.0, sine)), jnp.where(at_pole, 1.0, cosine))
    first = jnp.clip(jax.lax.stop_gradient(jnp.floor(place)), 0, steps - 1)
    return Axis(first.astype(jnp.int32), place - first + 1.0, 1)


def _waves(modes: int, steps: int) -> np.ndarray:
    """Matrix from Fourier modes to the azimuths of a table, (modes, points)."""
    phi = np.pi / steps * np.arange(-1, steps + 2)
    return np.where(np.arange(modes) == 0, 1.0, 2.0)[:, None] * np.cos(np.outer(np.arange(modes), phi))


def _lift(grid: Grid, region: Region, modes: int, azimuths: int | None) -> Array:
    """Matrices from values at the nodes to the points of the table: (modes or 1, points, nodes)."""
    x, matrix = table_matrix(grid.nodes)
    panels = grid.edges.shape[0]
    even = jnp.asarray(np.kron(np.eye(panels), matrix), grid.edges.dtype)
    low, high = grid.bounds(grid.panels, region.ior**2)
    squared = (high - jnp.asarray(x * x, high.dtype) * (high - low)) / region.ior**2
    positive = squared > 0
    sine = jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0).ravel()
    # odd modes vanish at the pole like the sine: polynomials interpolate the quotient
    odd = sine[:, None] * even / region.sine
    if azimuths is None:
        return jnp.stack([even, odd])[np.arange(modes) % 2]
    # even ones but the mean vanish like its square, so that there is one value at the pole; with Fourier modes, whose
    # lobes may be narrow, the quotient by the square costs more than it gives
    turning = sine[:, None] * odd / region.sine
    ordinates, points = np.arange(azimuths), np.arange(AZIMUTH_DENSITY * azimuths) / AZIMUTH_DENSITY
    apart = 2.0 * np.pi * (points[:, None] - ordinates) / azimuths
    orders = np.arange(azimuths // 2 + 1)
    share = np.where((orders == 0) | (2 * orders == azimuths), 1.0, 2.0) / azimuths
    waves = np.cos(apart[..., None] * orders) * share
    parts = [
        jnp.asarray(waves[..., chosen].sum(-1), even.dtype)
        for chosen in (slice(1), slice(1, None, 2), slice(2, None, 2))
    ]
    return sum(map(jnp.kron, (even, odd, turning), parts), jnp.zeros((), even.dtype))[None]
