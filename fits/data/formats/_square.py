"""Tables over the unit square, bilinear between their nodes, and densities among them, whose inverse draws points.

A density is drawn from by its rows first, by their integrals, and then along the row, as RGL's materials are drawn from
(Dupuy & Jakob 2018). Several tables form a stack, which is interpolated linearly, the integrals too.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fits.data.geometry import Floats

Whole = NDArray[np.int_]


@dataclass(frozen=True)
class Interpolation:
    """Tables that are interpolated at each of N points, (N, K), and their weights, (N, K)."""

    table: Whole
    weight: Floats


def bilinear(tables: Floats, x: Floats, y: Floats, interpolation: Interpolation | None = None) -> Floats:
    """Values (N,) of tables (S, h, w) at points of the unit square, x along a row, clamped to it."""
    row, v = _cell(y, tables.shape[1])
    column, u = _cell(x, tables.shape[2])
    return _mean(tables, interpolation, row, column, u, v)


def _cell(place: Floats, nodes: int) -> tuple[Whole, Floats]:
    """The cell that points of [0, 1] lie in, and where in it."""
    scaled = np.clip(place, 0.0, 1.0) * (nodes - 1)
    cell = np.minimum(scaled.astype(int), nodes - 2)
    return cell, scaled - cell


def _at(tables: Floats, interpolation: Interpolation | None, *index: Whole) -> Floats:
    """Entries (N,) of tables, interpolated if there are several."""
    if interpolation is None:
        return tables[(0, *index)]
    return np.sum(interpolation.weight * tables[(interpolation.table, *(one[:, None] for one in index))], axis=1)


def _mean(
    tables: Floats, interpolation: Interpolation | None, row: Whole, column: Whole, u: Floats, v: Floats
) -> Floats:
    low = (1 - u) * _at(tables, interpolation, row, column) + u * _at(tables, interpolation, row, column + 1)
    high = (1 - u) * _at(tables, interpolation, row + 1, column) + u * _at(tables, interpolation, row + 1, column + 1)
    return (1 - v) * low + v * high


class Density:
    """Densities on the unit square, (S, h, w), at least 0, each of which is scaled to an integral of 1."""

    def __init__(self, tables: Floats):
        tables = np.asarray(tables, float)
        along = _integrated(tables)
        down = _integrated(along[:, :, -1])
        total = down[:, -1]
        self.tables = tables / total[:, None, None]
        self.along = along / total[:, None, None]  # integral from the start of a row, in widths of a cell
        self.down = down / total[:, None]  # integral of whole rows

    def drawn(self, sx: Floats, sy: Floats) -> tuple[Floats, Floats]:
        """Points x and y, (S, B, A), that the grid of A numbers sx and B numbers sy of [0, 1] draws from each."""
        count, height, width = self.tables.shape
        row, rest = _invert(self.down, np.broadcast_to(sy, (count, len(sy))))
        whole = self.along[:, :, -1]
        v = _solved(np.take_along_axis(whole, row, 1), np.take_along_axis(whole, row + 1, 1), rest)
        each = np.arange(count)[:, None]
        along = (1 - v)[..., None] * self.along[each, row] + v[..., None] * self.along[each, row + 1]
        table = (1 - v)[..., None] * self.tables[each, row] + v[..., None] * self.tables[each, row + 1]
        flat, values = along.reshape(-1, width), table.reshape(-1, width)
        column, rest = _invert(flat, sx * flat[:, -1:])
        u = _solved(np.take_along_axis(values, column, 1), np.take_along_axis(values, column + 1, 1), rest)
        x = ((column + u) / (width - 1)).reshape(count, len(sy), len(sx))
        y = np.broadcast_to(((row + v) / (height - 1))[..., None], x.shape)
        return x, y

    def undrawn(
        self, x: Floats, y: Floats, interpolation: Interpolation | None = None
    ) -> tuple[Floats, Floats, Floats]:
        """The numbers sx and sy (N,) that draw points, and the density there: the inverse of drawing."""
        _, height, width = self.tables.shape
        row, v = _cell(y, height)
        column, u = _cell(x, width)
        whole, last = self.along[:, :, -1:], np.zeros_like(row)
        first, second = _at(whole, interpolation, row, last), _at(whole, interpolation, row + 1, last)
        sy = _at(self.down, interpolation, row) + v * (first + 0.5 * v * (second - first))

        def across(tables: Floats, column: Whole) -> Floats:
            return (1 - v) * _at(tables, interpolation, row, column) + v * _at(tables, interpolation, row + 1, column)

        start, end = across(self.tables, column), across(self.tables, column + 1)
        part = across(self.along, column) + u * (start + 0.5 * u * (end - start))
        of_row = (1 - v) * first + v * second
        density = ((1 - u) * start + u * end) * (height - 1) * (width - 1)
        return np.where(of_row > 0, part / np.where(of_row > 0, of_row, 1.0), u), sy, density


def _integrated(values: Floats) -> Floats:
    """Integral along the last axis from its start to each node, by trapezoids of width 1."""
    steps = 0.5 * (values[..., 1:] + values[..., :-1])
    return np.concatenate([np.zeros_like(steps[..., :1]), np.cumsum(steps, axis=-1)], axis=-1)


def _invert(integral: Floats, wanted: Floats) -> tuple[Whole, Floats]:
    """The cells (R, N) in which integrals (R, n) reach `wanted`, (R, N), and its remainder in them."""
    rows, nodes = integral.shape
    total = np.maximum(integral[:, -1:], np.finfo(float).tiny)
    # one search for all rows: each begins where the one before it ends
    before = 2.0 * np.arange(rows)[:, None]
    place = np.searchsorted((integral / total + before).ravel(), (wanted / total + before).ravel(), side="right")
    cell = np.clip(place.reshape(wanted.shape) - 1 - nodes * np.arange(rows)[:, None], 0, nodes - 2)
    return cell, np.maximum(wanted - np.take_along_axis(integral, cell, 1), 0.0)


def _solved(start: Floats, end: Floats, wanted: Floats) -> Floats:
    """Position in a cell at which the integral of a density, linear from `start` to `end`, is `wanted`."""
    root = np.sqrt(np.maximum(start * start + 2.0 * wanted * (end - start), 0.0))
    bottom = start + root
    return np.clip(np.where(bottom > 0, 2.0 * wanted / np.where(bottom > 0, bottom, 1.0), 0.0), 0.0, 1.0)
