"""Layers as operators on the flux at the nodes, and the two ways of joining them: adding and doubling.

An operator F takes the diffuse flux that falls on a layer to the flux that leaves it, (..., out, in). Azimuths are
those of *travel* on both sides, so that operators chain by plain products. The light that passes without an event is a
diagonal of its own, and paths of one event are kept apart from those of more: nothing large is ever subtracted.

Leading axes: (channels or 1, Fourier modes or 1). With Fourier modes the last two axes run over cosines, and every mode
is on its own; with ordinates they run over cosines x azimuths, the azimuth fastest. What is None is not there.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from layerjax.transport.adding_doubling.inverse import inverse_of_one_minus

Operator = Array | None


class Parts(eqx.Module):
    """An operator in two parts: paths with exactly one event, and paths with more."""

    first: Operator
    rest: Operator = None

    @property
    def total(self) -> Operator:
        return add_operators(self.first, self.rest)


class Layer(eqx.Module):
    """A slab by its four operators, and what it passes untouched; an opaque one has only its upper face."""

    reflect_top: Parts
    reflect_bottom: Parts = Parts(None)
    transmit_down: Parts = Parts(None)
    transmit_up: Parts = Parts(None)
    direct_down: Operator = None
    """Share that passes without an event, (channels or 1, 1, nodes)."""
    direct_up: Operator = None

    def map(self, function: Callable[[Array], Array], diagonal: Callable[[Array], Array]) -> "Layer":
        """The same layer with `function` applied to every operator and `diagonal` to the direct part."""

        def apply(parts: Parts) -> Parts:
            return Parts(*(None if part is None else function(part) for part in (parts.first, parts.rest)))

        return Layer(
            apply(self.reflect_top),
            apply(self.reflect_bottom),
            apply(self.transmit_down),
            apply(self.transmit_up),
            *(None if direct is None else diagonal(direct) for direct in (self.direct_down, self.direct_up)),
        )


def add(upper: Layer, lower: Layer) -> Layer:
    """`upper` on top of `lower` (Grant & Hunt 1969); light from below only if `lower` lets any pass."""
    down, up = (upper.direct_down, lower.direct_down), (lower.direct_up, upper.direct_up)
    falling, extra = _incident_flux(upper.reflect_bottom, lower.reflect_top, upper.transmit_down, down[0])
    reflect_top = _add_reflection(upper.reflect_top, upper.transmit_up, lower.reflect_top, (down[0], up[1]), falling)
    if lower.transmit_down.total is None and down[1] is None:
        return Layer(reflect_top)
    transmit_down = _add_transmission(upper.transmit_down, lower.transmit_down, down, falling, extra)
    rising, extra = _incident_flux(lower.reflect_top, upper.reflect_bottom, lower.transmit_up, up[0])
    reflect_bottom = _add_reflection(
        lower.reflect_bottom, lower.transmit_down, upper.reflect_bottom, (up[0], down[1]), rising
    )
    transmit_up = _add_transmission(lower.transmit_up, upper.transmit_up, up, rising, extra)
    return Layer(reflect_top, reflect_bottom, transmit_down, transmit_up, multiply(*down), multiply(*up))


def double(
    reflect: Parts, transmit: Parts, direct: tuple[Array, Array], turn: Callable[[Operator], Operator]
) -> tuple[Operator, Operator]:
    """Paths of several events in two equal layers on each other: reflection from above, transmission down.

    Args:
        reflect: reflection of one layer, lit from above.
        transmit: transmission of one layer, downward.
        direct: shares that pass one layer untouched, downward and upward.
        turn: an operator lit from above to the same lit from below.
    """
    down, up = direct
    back = Parts(turn(reflect.first), turn(reflect.rest))
    falling, extra = _incident_flux(back, reflect, transmit, down)
    rising = Parts(turn(transmit.first), turn(transmit.rest))
    both = _add_reflection(reflect, rising, reflect, (down, up), falling)
    return both.rest, _add_transmission(transmit, transmit, (down, down), falling, extra).rest


def _incident_flux(back: Parts, base: Parts, transmit: Parts, direct: Operator) -> tuple[Operator, Operator]:
    """Diffuse flux that falls on the far layer, and the part of it that was reflected at least once."""
    loop = matmul(back.total, base.total)
    if loop is None:
        return transmit.total, None
    turned = add_operators(matmul(loop, transmit.total), scale_columns(loop, direct))
    assert turned is not None
    extra = inverse_of_one_minus(loop) @ turned
    return add_operators(transmit.total, extra), extra


def _add_reflection(
    near: Parts, out: Parts, base: Parts, direct: tuple[Operator, Operator], falling: Operator
) -> Parts:
    """Reflection: off the near layer, and off the far one and out through the near one (direct: in, out)."""
    into, back = direct
    first = add_operators(near.first, scale_rows(back, scale_columns(base.first, into)))
    diffuse = matmul(base.total, falling)
    rest = add_operators(
        near.rest,
        scale_rows(back, add_operators(scale_columns(base.rest, into), diffuse)),
        matmul(out.total, add_operators(scale_columns(base.total, into), diffuse)),
    )
    return Parts(first, rest)


def _add_transmission(
    near: Parts, far: Parts, direct: tuple[Operator, Operator], falling: Operator, extra: Operator
) -> Parts:
    """Transmission through the near layer and then the far one (direct: near, far)."""
    into, out = direct
    first = add_operators(scale_rows(out, near.first), scale_columns(far.first, into))
    rest = add_operators(
        scale_rows(out, add_operators(near.rest, extra)), scale_columns(far.rest, into), matmul(far.total, falling)
    )
    return Parts(first, rest)


def rotate(operator: Operator, azimuths: int | None) -> Operator:
    """The operator with both its directions turned by half a turn about the normal; modes (None) do not change."""
    if azimuths is None or operator is None:
        return operator
    nodes, half = operator.shape[-1] // azimuths, azimuths // 2
    shape = (*operator.shape[:-2], nodes, azimuths, nodes, azimuths)
    return jnp.roll(operator.reshape(shape), (half, half), (-3, -1)).reshape(operator.shape)


def add_operators(*terms: Operator) -> Operator:
    """Sum of what is there."""
    total: Operator = None
    for term in terms:
        if term is not None:
            total = term if total is None else total + term
    return total


def multiply(a: Operator, b: Operator) -> Operator:
    """Product number by number, None if a factor is not there."""
    return None if a is None or b is None else a * b


def scale_rows(diagonal: Operator, operator: Operator) -> Operator:
    """diag(d) F."""
    return None if diagonal is None else multiply(diagonal[..., :, None], operator)


def scale_columns(operator: Operator, diagonal: Operator) -> Operator:
    """F diag(d)."""
    return None if diagonal is None else multiply(operator, diagonal[..., None, :])


def matmul(a: Operator, b: Operator) -> Operator:
    """Product of operators."""
    return None if a is None or b is None else a @ b
