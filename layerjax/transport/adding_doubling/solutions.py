"""What a solved stack is read off: its tables, or values at requested directions.

Under ``jit`` all of it is one program. Outside each element has a program of its own, and so has their assembly: the
next stack that holds such an element finds it compiled.
"""

from functools import partial
from typing import Any

from layerjax._devices import exact_products
from layerjax.compiling import filter_jit, is_outermost
from layerjax.stack import Stack
from layerjax.transport.adding_doubling.elements import compile_element
from layerjax.transport.adding_doubling.requested_directions import RequestedValues, requested_values
from layerjax.transport.adding_doubling.solve import Layers, Plan, assemble, can_be_split, make_elements, without_base
from layerjax.transport.adding_doubling.tables import Tables, make_tables
from layerjax.transport.first_order import FirstOrder, SmoothOrder, interaction_probability, peak_probability
from layerjax.transport.known_directions import KnownDirections
from layerjax.transport.specular import smooth_turns, smooth_window


def solve_tables(
    stack: Stack, first: FirstOrder | SmoothOrder, once: FirstOrder | SmoothOrder | None, plan: Plan
) -> Tables:
    """Tables of a simplified stack. first, once: paths with one event, in the stack and in what the grid carries."""
    if not _is_split(stack, first, once):
        return _solve_at_once(stack, first, once, plan)
    elements = make_elements(stack, plan, None, compile_element)
    return _tables_of_elements(without_base(stack), elements, first, once, plan)


def solve_requested(stack: Stack, known: KnownDirections, plan: Plan) -> RequestedValues:
    """Values at the requested directions, of a stack from `requested_stack`."""
    if not _is_split(stack, known):
        return _solve_requested_at_once(stack, known, plan)
    elements = make_elements(stack, plan, known, compile_element)
    return _requested_of_elements(without_base(stack), elements, known, plan)


def _is_split(stack: Stack, *inputs: Any) -> bool:
    """Whether elements have programs of their own, which the next stack finds compiled."""
    return can_be_split(stack) and is_outermost(stack, inputs)


@filter_jit
@exact_products
def _solve_at_once(
    stack: Stack, first: FirstOrder | SmoothOrder, once: FirstOrder | SmoothOrder | None, plan: Plan
) -> Tables:
    return tables_of(stack, make_elements(stack, plan, None), first, once, plan)


@filter_jit
@exact_products
def _solve_requested_at_once(stack: Stack, known: KnownDirections, plan: Plan) -> RequestedValues:
    return requested_values_of(stack, make_elements(stack, plan, known), known, plan)


@filter_jit
@exact_products
def _tables_of_elements(
    layers: Layers,
    elements: list[Any],
    first: FirstOrder | SmoothOrder,
    once: FirstOrder | SmoothOrder | None,
    plan: Plan,
) -> Tables:
    return tables_of(layers.stack(), elements, first, once, plan)


@filter_jit
@exact_products
def _requested_of_elements(layers: Layers, elements: list[Any], known: KnownDirections, plan: Plan) -> RequestedValues:
    return requested_values_of(layers.stack(), elements, known, plan)


def tables_of(
    stack: Stack,
    elements: list[Any],
    first: FirstOrder | SmoothOrder,
    once: FirstOrder | SmoothOrder | None,
    plan: Plan,
) -> Tables:
    """`solve_tables` from the elements of `make_elements`, within a program."""
    grid, whole, rest, faces = assemble(stack, plan, elements)
    met = partial(interaction_probability, first)
    onward = None if once is None else partial(peak_probability, first, once)
    outer = faces if first.layered else None
    windows = smooth_window(stack, upward=False), smooth_window(stack, upward=True)
    above, below = (smooth_turns(stack, upward=up) if plan.azimuths is None else None for up in (False, True))
    return make_tables(
        grid, whole, rest, plan.azimuths, stack.base is not None, met, outer, onward, windows, (above, below)
    )


def requested_values_of(stack: Stack, elements: list[Any], known: KnownDirections, plan: Plan) -> RequestedValues:
    """`solve_requested` from the elements of `make_elements`, within a program."""
    grid, _, rest, _ = assemble(stack, plan, elements)
    return requested_values(rest, known, grid.regions[-1].ior, stack.base is not None)
