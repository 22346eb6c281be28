"""A transport as a table over the box of its parameters: Chebyshev series in all of them at once, as a model.

What the exact transport says of the readings is smooth in every parameter. A table of it is worth its making where
thousands of texels are fitted with the same directions: a value with its derivatives then takes tens of microseconds.
Values are kept as logarithms, of which a few directions in the space of readings hold all (a singular value
decomposition), and each channel has the coordinates of the parameters that matter to it alone.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from fits.problem.model import Model


class Table(eqx.Module):
    """Series in D coordinates of the values of N readings in C channels.

    Attributes:
        orders: (M, D) int, of the polynomials whose products the M terms are.
        coefficients: (C, M, R), of R directions in the space of readings.
        directions: (C, R, N). mean: (C, N). offset: (C, N), in 1/sr: the table holds log(value + offset).
        logarithmic: (D,) bool, whether a coordinate is the logarithm of its parameter.
        low, high: (D,), ends of the coordinates.
        places: (C, D) where the parameters of each channel stand in the vector.
        highest: of the orders.
    """

    orders: Array
    coefficients: Array
    directions: Array
    mean: Array
    offset: Array
    logarithmic: Array
    low: Array
    high: Array
    places: Array
    highest: int = eqx.field(static=True)

    def values(self, vector: Array) -> Array:
        """BSDF of the readings, (N, C), in 1/sr, with these parameters (P,)."""
        return _values(vector, table=self)

    def with_slopes(self, vector: Array) -> tuple[Array, Array]:
        """`values`, and their derivatives by the coordinates' parameters, (N, C, D)."""
        channels = [self._channel(vector, index) for index in range(self.coefficients.shape[0])]
        values, slopes = zip(*channels, strict=True)
        return jnp.stack(values, axis=1), jnp.stack(slopes, axis=1)

    def _channel(self, vector: Array, channel: int) -> tuple[Array, Array]:
        at = vector[self.places[channel]]
        tame = jnp.where(self.logarithmic, jnp.clip(at, jnp.exp(self.low), jnp.exp(self.high)), 1.0)
        coordinate = jnp.where(self.logarithmic, jnp.log(tame), at)
        width = self.high - self.low
        x = jnp.clip(2.0 * (coordinate - self.low) / width - 1.0, -1.0, 1.0)
        rate = 2.0 / width * jnp.where(self.logarithmic, 1.0 / tame, 1.0)
        sums = self._products(x) @ self.coefficients[channel]
        of_readings = sums @ self.directions[channel]
        total = jnp.exp(of_readings[0] + self.mean[channel])
        return total - self.offset[channel], (of_readings[1:] * rate[:, None] * total).T

    def _products(self, x: Array) -> Array:
        """The M terms at x (D,), then their derivatives by each coordinate, (1 + D, M)."""
        count = self.highest + 1
        parts = [chebyshev(x[place], count) for place in range(x.size)]
        basis, slope = ([part[which][self.orders[:, place]] for place, part in enumerate(parts)] for which in (0, 1))
        before = [jnp.ones(len(self.orders), x.dtype)]
        for factor in basis:
            before.append(before[-1] * factor)
        rows, after = [], jnp.ones_like(before[0])
        for place in reversed(range(x.size)):
            rows.append(before[place] * slope[place] * after)
            after = after * basis[place]
        return jnp.stack([before[-1], *reversed(rows)])


def chebyshev(x: Array, count: int) -> tuple[Array, Array]:
    """The first polynomials at x in [-1, 1], and their derivatives, (count,) each."""
    basis, second = [jnp.ones_like(x), x], [jnp.ones_like(x), 2.0 * x]
    for _ in range(2, count):
        basis.append(2.0 * x * basis[-1] - basis[-2])
        second.append(2.0 * x * second[-1] - second[-2])
    slope = [jnp.zeros_like(x)] + [k * second[k - 1] for k in range(1, count)]
    return jnp.stack(basis[:count]), jnp.stack(slope[:count])


@eqx.filter_custom_jvp
def _values(vector: Array, *, table: Table) -> Array:
    """All derivatives come at once, and are little more than a value: a Jacobian takes its columns from them."""
    return table.with_slopes(vector)[0]


@_values.def_jvp
def _(primals: tuple[Array], tangents: tuple[Array], *, table: Table) -> tuple[Array, Array]:
    (vector,), (moved,) = primals, tangents
    values, slopes = table.with_slopes(vector)
    return values, jnp.einsum("ncd,cd->nc", slopes, moved[table.places])


class Tabulated(Model):
    """A model whose values come from a table in the place of its transport."""

    table: Table

    def predict(self, vector: Array) -> Array:
        """Scaled BSDF, (N, C), in 1/sr."""
        return self.build(vector).scale * self.table.values(vector)


def with_table(model: Model, table: Table) -> Tabulated:
    """The model with the table."""
    return Tabulated(**{name: getattr(model, name) for name in _fields(Model)}, table=table)


def coarser(table: Table) -> Table:
    """The table without the last terms of each series: how far it differs tells of its error."""
    last = jnp.max(table.orders, axis=0)
    kept = jnp.all(table.orders < jnp.maximum(last, 1), axis=1)
    return eqx.tree_at(lambda t: t.coefficients, table, jnp.where(kept[:, None], table.coefficients, 0.0))


def _fields(kind: Any) -> Sequence[str]:
    return tuple(kind.__dataclass_fields__)
