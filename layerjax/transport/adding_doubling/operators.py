"""Layers as operators on the flux at the nodes, and the two ways of joining them: adding and doubling.

An operator F takes the diffuse flux that falls on a layer to the flux that leaves it, (..., out, in). Azimuths are
those of *travel* on both sides, so that operators chain by plain products. The light that passes without an event is a
diagonal of its own, and so is the light that smooth faces mirror, for nodes are where they refract nodes to. Paths of
one event are kept apart from all others: nothing large is ever subtracted. What mirrors do to light is no event, but
that makes a path one of the others.

Leading axes: (channels or 1, Fourier modes or 1). With Fourier modes the last two axes run over cosines, and every mode
is on its own; with ordinates they run over cosines x azimuths, the azimuth fastest. What is None is not there.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from layerjax.transport.adding_doubling.inverse import inverse_of_one_minus

Operator = Array | None


class Parts(eqx.Module):
    """An operator in two parts: paths with exactly one event and no mirror, and all others that are not mirrored
    alone."""

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
    mirror_top: Operator = None
    """Share that smooth faces alone reflect, (channels or 1, 1, nodes)."""
    mirror_bottom: Operator = None

    def map(self, function: Callable[[Array], Array], diagonal: Callable[[Array], Array]) -> "Layer":
        """The same layer with `function` applied to every operator and `diagonal` to what is one."""

        def apply(parts: Parts) -> Parts:
            return Parts(*(None if part is None else function(part) for part in (parts.first, parts.rest)))

        return Layer(
            apply(self.reflect_top),
            apply(self.reflect_bottom),
            apply(self.transmit_down),
            apply(self.transmit_up),
            *(
                None if share is None else diagonal(share)
                for share in (self.direct_down, self.direct_up, self.mirror_top, self.mirror_bottom)
            ),
        )


class Incident(NamedTuple):
    """Flux that falls on the far one of two layers: diffuse, and the part of it that is not as the near one sent it;
    what comes untouched, (once, and with all that was mirrored to and fro), and of it what was mirrored."""

    diffuse: Operator
    returned: Operator
    once: Operator
    direct: Operator
    mirrored: Operator


def add(upper: Layer, lower: Layer) -> Layer:
    """`upper` on top of `lower` (Grant & Hunt 1969); light from below only if `lower` lets any pass."""
    mirrors = upper.mirror_bottom, lower.mirror_top
    falling = _incident(upper.reflect_bottom, lower.reflect_top, upper.transmit_down, upper.direct_down, mirrors)
    reflect_top, mirror_top = _add_reflection(
        (upper.reflect_top, upper.mirror_top),
        (upper.transmit_up, upper.direct_up),
        (lower.reflect_top, lower.mirror_top),
        falling,
    )
    if lower.transmit_down.total is None and lower.direct_down is None:
        return Layer(reflect_top, mirror_top=mirror_top)
    transmit_down = _add_transmission(upper.transmit_down, lower.transmit_down, lower.direct_down, falling)
    rising = _incident(lower.reflect_top, upper.reflect_bottom, lower.transmit_up, lower.direct_up, mirrors[::-1])
    reflect_bottom, mirror_bottom = _add_reflection(
        (lower.reflect_bottom, lower.mirror_bottom),
        (lower.transmit_down, lower.direct_down),
        (upper.reflect_bottom, upper.mirror_bottom),
        rising,
    )
    transmit_up = _add_transmission(lower.transmit_up, upper.transmit_up, upper.direct_up, rising)
    return Layer(
        reflect_top,
        reflect_bottom,
        transmit_down,
        transmit_up,
        multiply(falling.direct, lower.direct_down),
        multiply(rising.direct, upper.direct_up),
        mirror_top,
        mirror_bottom,
    )


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
    falling = _incident(back, reflect, transmit, down)
    rising = Parts(turn(transmit.first), turn(transmit.rest))
    both, _ = _add_reflection((reflect, None), (rising, up), (reflect, None), falling)
    return both.rest, _add_transmission(transmit, transmit, down, falling).rest


def _incident(
    back: Parts, base: Parts, transmit: Parts, direct: Operator, mirrors: tuple[Operator, Operator] = (None, None)
) -> Incident:
    """What falls on the far layer; mirrors: what smooth faces of the near and of the far one reflect between them."""
    to_and_fro = multiply(*mirrors)
    again = None if to_and_fro is None else 1.0 / (1.0 - to_and_fro)  # of all times that light is mirrored
    # paths that meet an event between the layers, whatever is mirrored before
    loop = add_operators(
        matmul(back.total, base.total), scale_columns(back.total, mirrors[1]), scale_rows(mirrors[0], base.total)
    )
    passed, ballistic, mirrored = transmit.total, direct, None
    returned: Operator = None
    if again is not None:
        loop, ballistic, mirrored = scale_rows(again, loop), multiply(again, direct), multiply(again - 1.0, direct)
        returned = scale_rows(again - 1.0, passed)
        passed = scale_rows(again, passed)
    if loop is not None:
        turned = add_operators(matmul(loop, passed), scale_columns(loop, ballistic))
        if turned is not None:
            returned = add_operators(returned, inverse_of_one_minus(loop) @ turned)
    return Incident(add_operators(transmit.total, returned), returned, direct, ballistic, mirrored)


def _add_reflection(
    near: tuple[Parts, Operator], out: tuple[Parts, Operator], base: tuple[Parts, Operator], falling: Incident
) -> tuple[Parts, Operator]:
    """Reflection off the near layer, and off the far one and out through the near one; each with the diagonal of what
    has no event."""
    (reflected, mirrored), (through, back), (far, mirror) = near, out, base
    first = add_operators(reflected.first, scale_rows(back, scale_columns(far.first, falling.once)))
    diffuse = add_operators(matmul(far.total, falling.diffuse), scale_rows(mirror, falling.diffuse))
    rest = add_operators(
        reflected.rest,
        scale_rows(
            back,
            add_operators(scale_columns(far.rest, falling.direct), scale_columns(far.first, falling.mirrored), diffuse),
        ),
        matmul(through.total, add_operators(scale_columns(far.total, falling.direct), diffuse)),
        scale_columns(through.total, multiply(mirror, falling.direct)),
    )
    return Parts(first, rest), add_operators(mirrored, multiply(multiply(back, mirror), falling.direct))


def _add_transmission(near: Parts, far: Parts, out: Operator, falling: Incident) -> Parts:
    """Transmission through the near layer and then the far one, which passes `out` untouched."""
    first = add_operators(scale_rows(out, near.first), scale_columns(far.first, falling.once))
    rest = add_operators(
        scale_rows(out, add_operators(near.rest, falling.returned)),
        scale_columns(far.rest, falling.direct),
        scale_columns(far.first, falling.mirrored),
        matmul(far.total, falling.diffuse),
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
