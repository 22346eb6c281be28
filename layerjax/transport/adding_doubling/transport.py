"""Adding-doubling: every order of scattering in a stack, without noise and with derivatives.

The stack is put on a grid of directions: media are solved by eigenvectors, or in single precision doubled up from a
slab thin enough to scatter at most twice (van de Hulst 1980, Ch. 4), interfaces and bases are added (Grant & Hunt
1969). Around the normal everything is a Fourier series in azimuth unless a medium has an axis of its own; then azimuths
are ordinates too. Paths with one event are evaluated in closed form at the very directions requested; only the smooth
rest is read off tables, or, where directions are known and the stack lets them, followed along just these.
"""

import dataclasses
import sys
import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial
from typing import Any, ClassVar, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._batching import map_direction_chunks
from layerjax._checks import require_choice
from layerjax._devices import exact_products
from layerjax._numerics import clamp_nonnegative, safe_div
from layerjax._shapes import channel_count, map_shape
from layerjax.channels import Channels, multiply, pick, total
from layerjax.compiling import filter_jit, is_outermost, is_traced
from layerjax.directions import Vector, direction, split
from layerjax.phase.henyey_greenstein import ASSUMED_BACKWARD, ASSUMED_FORWARD
from layerjax.stack import Stack
from layerjax.surfaces import Conductor
from layerjax.transport.adding_doubling.ballistic import Ballistic, ballistic_paths, evaluate_ballistic
from layerjax.transport.adding_doubling.elements import (
    LinearElement,
    linearize_element,
    record,
    replay,
)
from layerjax.transport.adding_doubling.energies import clip_negative, directional_albedo
from layerjax.transport.adding_doubling.moments import delta_scale
from layerjax.transport.adding_doubling.proposals import (
    LayeredState,
    layered_density,
    layered_specular_draws,
    proposal_density,
    propose,
    propose_layered,
)
from layerjax.transport.adding_doubling.requested_directions import RequestedValues, read_requested
from layerjax.transport.adding_doubling.resolution import (
    ASSUMED_WIDTH,
    ORDINATES,
    Resolution,
    choose_resolution,
    has_tilted,
    is_guessed,
    modes_for,
    resolutions,
    shortage,
)
from layerjax.transport.adding_doubling.solutions import (
    requested_values_of,
    solve_requested,
    solve_tables,
    tables_of,
)
from layerjax.transport.adding_doubling.solve import (
    Plan,
    can_be_split,
    make_elements,
    make_plan,
    ranks,
    requested_stack,
)
from layerjax.transport.adding_doubling.tables import Tables, read_energies, read_rest
from layerjax.transport.contract import DeterministicTransport, Side, refuse_interface_film, require_ggx
from layerjax.transport.first_order import (
    FirstOrder,
    SmoothOrder,
    evaluate_first,
    first_order,
    interaction_probability,
)
from layerjax.transport.known_directions import DirectionLookup, KnownDirections, known_directions
from layerjax.transport.single_scattering import SingleScattering
from layerjax.transport.specular import (
    density_with_deltas,
    has_specular,
    is_smooth,
    sample_with_deltas,
    specular_draws,
)

Orders = Literal["all", "first", "multiple"]

LARGEST_RESOLUTION = 1024
"""Largest number of nodes, modes, cosines or azimuths; tables of more fit in no memory."""

FACETS_ERROR = 6e-5
"""Relative, of sums over the facets of interfaces at any resolution: up to three times that was seen."""

PROBE_COSINES = 8
"""Known cosines along which a tolerance is checked, at most."""


class ResolutionWarning(UserWarning):
    """The resolution may be too low for an error of 1e-3: more would not fit into memory, or, under ``jit``, the widths
    of the lobes are not known."""


class AddingDoublingState(eqx.Module):
    """A solved stack: what is evaluated in closed form, and the rest: tables, or values between known directions.

    Both are None if there is no rest. ballistic: what passes two interfaces, in neither. scaled_first: what the rest
    lacks in the place of `first`, in media as the grid has them (see `moments`); None: `first` itself. stack: one by
    whose lobes directions are drawn (see `proposals`).
    """

    first: FirstOrder | SmoothOrder
    tables: Tables | None
    stack: Stack | None = None
    requested: RequestedValues | None = None
    ballistic: tuple[Ballistic, ...] = ()
    scaled_first: FirstOrder | SmoothOrder | None = None


class AddingDoubling(DeterministicTransport):
    """Adding-doubling: a deterministic solution with all orders of scattering, for light from both sides.

    Supports every layer and base; von Mises-Fisher normals only with ``facet_multiple_scattering=False``. The work per
    stack is done in `prepare`. A pair of directions then takes about a microsecond, or 20 to 65 through a slab between
    two interfaces, where light that is refracted at both and meets nothing else is integrated over their facets, and
    where a mirror sends light back through a rough interface (two to four times as long with facets of two widths).
    Where `evaluate` knows the directions beforehand (up to 256 distinct cosines), a stack that begins with an
    interface, and ends with one if it transmits, is solved along these directions without interpolation. Half the nodes
    and modes then give the same error or less.

    The part of a Henyey-Greenstein forward peak that the grid does not resolve counts as ballistic (delta-M, Wiscombe
    1977), with a correction for single scattering (TMS, Nakajima & Tanaka 1988). Through a bare slab of thickness 2,
    the largest error over all directions, which is along the beam, was 4e-4 at 24 nodes for g = 0.8 and 8e-4 at 48
    nodes for g = 0.9. At 17 degrees from the beam it was 6e-3 at 48 nodes and 3e-4 at 96 for g = 0.97, and 2e-2 at 96
    for g = 0.99. The reflection for g = -0.97 was accurate to 7e-3 at 48 nodes and to 1e-3 at 96.

    First derivatives are supported, forward and backward; second derivatives may be NaN. At the automatic resolution,
    derivatives by indices, albedos, g, and by the logarithms of widths and thicknesses were within 6e-3 of |f| +
    mean(f) / 10 on 28 random stacks of seven structures. The derivative by a width of 0.05 itself has 20 times this
    scale: for a coat on metal its error was 3e-2 at the 6 nodes chosen, and 3e-3 at 12.

    Args:
        nodes: cosines per hemisphere (and for each range of angles between critical angles), 2 to 1024. None: chosen
            from the stack for errors of about 1e-3. Under `jit` the roughness is not known, and lobes of width 0.05 are
            assumed; `choose_transport`, called outside, selects a cheaper resolution. A `ResolutionWarning` says where
            the resolution is a guess, and where memory does not allow the one that is needed.
        modes: Fourier modes in azimuth, 1 to 1024, for media that are symmetric about the normal. None: chosen with the
            nodes.
        ordinates: (cosines, azimuths) per hemisphere, for media that are not, up to 1024 each; an even number of
            azimuths. None: chosen like nodes. A traced axis counts as not symmetric.
        tolerance: relative error in place of a resolution: the resolution is increased until two agree to it, which
            requires concrete parameters. The error of the result is then about a quarter of the tolerance or less.
        orders: ``"all"``; ``"first"``, only paths with one event; ``"multiple"``, only paths with more. An event is a
            collision, a reflection or refraction at an interface, or a reflection at the base.
        facet_multiple_scattering: whether light that is blocked by masking is returned diffusely, so that interfaces
            conserve energy (after Kulla & Conty 2017); otherwise it is lost (Walter 2007). The energy of lossless
            stacks is then conserved to 1e-9 as a rule, and to 4e-3 with 6 nodes at an index of 0.25 or 1.05. Within 1 %
            of an index of 1 it is 4e-4 for slabs (1e-5 within 1e-5 of it), and light that meets a single interface at a
            cosine below 0.05 may lose or gain a quarter.

    Raises:
        ValueError: an option is out of its range, or `tolerance` cannot be reached, or is given for a traced stack.
    """

    uses_known_directions: ClassVar[bool] = True

    nodes: int | None = eqx.field(static=True, default=None)
    modes: int | None = eqx.field(static=True, default=None)
    ordinates: tuple[int, int] | None = eqx.field(static=True, default=None)
    tolerance: float | None = eqx.field(static=True, default=None)
    orders: Orders = eqx.field(static=True, default="all")
    facet_multiple_scattering: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        for name, value, least in (("nodes", self.nodes, 2), ("modes", self.modes, 1)):
            if value is not None and not (isinstance(value, int) and least <= value <= LARGEST_RESOLUTION):
                raise ValueError(
                    f"AddingDoubling.{name}: {value!r:.60} is not a whole number from {least} to {LARGEST_RESOLUTION}"
                )
        given = (2, 4) if self.ordinates is None else self.ordinates
        pair = isinstance(given, tuple | list) and len(given) == 2 and all(isinstance(one, int) for one in given)
        cosines, azimuths = given if pair else (0, 0)
        if not (2 <= cosines <= LARGEST_RESOLUTION and 4 <= azimuths <= LARGEST_RESOLUTION and azimuths % 2 == 0):
            raise ValueError(
                f"AddingDoubling.ordinates: {self.ordinates!r:.60} is not (cosines from 2 to {LARGEST_RESOLUTION}, an "
                f"even number of azimuths from 4 to {LARGEST_RESOLUTION})"
            )
        if self.tolerance is not None and not (
            isinstance(self.tolerance, float | np.floating) and 0.0 < self.tolerance < 1.0
        ):
            raise ValueError(f"AddingDoubling.tolerance: {self.tolerance!r} is outside (0, 1)")
        require_choice("AddingDoubling.orders", self.orders, get_args(Orders))
        require_choice("AddingDoubling.facet_multiple_scattering", self.facet_multiple_scattering, (False, True))

    def check(self, stack: Stack, names: Sequence[str]) -> None:
        if self.facet_multiple_scattering:
            require_ggx(stack, names, "AddingDoubling(facet_multiple_scattering=True)")
            name = "AddingDoubling(facet_multiple_scattering=True)"
            refuse_interface_film(stack, names, name, rough_only=True)

    def resolve_options(self, stack: Stack, known: DirectionLookup) -> "AddingDoubling":
        found = requested_stack(stack, known) if self.orders != "first" else None
        stack, directions = (stack, None) if found is None else found
        if self.tolerance is not None:
            if map_shape(stack):
                raise ValueError(
                    f"AddingDoubling.tolerance: {self.tolerance:g} is for one stack, not for a map of them: "
                    "give nodes and modes"
                )
            return self._refine(stack, directions)
        if self._chooses_resolution(stack):
            short = shortage(stack, directions is not None)
            if short is not None:
                _warn(
                    f"AddingDoubling: the lobes of this stack are too narrow for an error of 1e-3: {short}; "
                    "evaluate_with_error tells the error, and a resolution can be given"
                )
            elif is_guessed(stack, directions is not None):
                _warn(
                    f"AddingDoubling: under jit no lobe is taken to be narrower than {ASSUMED_WIDTH}, nor g above "
                    f"{ASSUMED_FORWARD} or below {-ASSUMED_BACKWARD}; transport=lj.choose_transport(stack, wi, wo), "
                    "called outside of jit, goes by the numbers"
                )
        return self._with_resolution(self._resolution(stack, directions is not None))

    def resolve_options_for_albedo(self, stack: Stack) -> "AddingDoubling":
        """Lobes too narrow for the nodes are no shortage: each node sends their light to itself, as mirrors do."""
        if self.tolerance is not None or has_tilted(stack) or shortage(stack, False) is None:
            return self.resolve_options(stack, lambda: None)
        return self._with_resolution(self._resolution(stack, False))

    def prepare(self, stack: Stack) -> AddingDoublingState:
        first = first_order(stack)
        if not self._is_solved(stack):
            return AddingDoublingState(first, None, stack if has_specular(stack) else None)
        plan = self._plan(stack, None)
        carried, once = _scale_stack(stack, plan)
        layered = stack if (first.layered and first.crossing is None) or is_smooth(stack.base) else None
        tables = self._solve(stack, first, once, plan)
        return AddingDoublingState(first, tables, layered, None, ballistic_paths(carried), once)

    def traceable_equivalent(self, stack: Stack, known: DirectionLookup) -> "AddingDoubling":
        found = requested_stack(stack, known) if self.orders != "first" else None
        whole, directions = (stack, None) if found is None else found
        elements: list[Any] = []
        if self._is_solved(stack) and can_be_split(stack):
            make_elements(whole, self._plan(whole, directions), directions, record(linearize_element, elements))
        options = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return _TraceableAddingDoubling(
            **options, ranks=ranks(stack), elements=elements if elements and None not in elements else None
        )

    def prepare_for_albedo(self, stack: Stack) -> AddingDoublingState:
        """Energies are means over azimuth: of Fourier modes the first is all they need."""
        return dataclasses.replace(self, modes=1).prepare(stack)

    def prepare_for_directions(self, stack: Stack, known: DirectionLookup) -> AddingDoublingState:
        found = requested_stack(stack, known) if self.orders != "first" else None
        if found is None:
            return self.prepare(stack)
        closed, directions = found
        plan = self._plan(closed, directions)
        rest = self._solve_requested(closed, directions, plan)
        carried, once = _scale_stack(closed, plan)
        return AddingDoublingState(first_order(closed), None, None, rest, ballistic_paths(carried), once)

    def evaluate_batch(
        self, state: AddingDoublingState, wi: Array, wo: Array, side: Side, channels: int, key: Array | None
    ) -> tuple[Array, None]:
        if state.requested is None:
            return super().evaluate_batch(state, wi, wo, side, channels, key)
        i, o = split(wi), split(wo)
        values = self.evaluate(state, i, o, side)
        return jnp.stack([pick(values, c) for c in range(channels)], axis=-1), None

    def common_error(
        self, state: AddingDoublingState, wi: Array, wo: Array, side: Side, channels: int
    ) -> Array | float:
        least = FACETS_ERROR if state.first.layered else 0.0

        def doubts(wi: Vector, wo: Vector) -> Channels:
            rest = self._rest(state, wi, wo, side)
            lowest = rest if state.scaled_first is None else self._sum(state, rest, wi, wo, side)
            return tuple(least * jnp.abs(pick(rest, c)) + clamp_nonnegative(-pick(lowest, c)) for c in range(channels))

        return map_direction_chunks(doubts, wi, wo)

    def coarser(self) -> "AddingDoubling":
        """This transport at about two thirds of the resolution, for an estimate of the error."""
        return self._with_resolution(self._as_resolution().coarser())

    def finer(self) -> "AddingDoubling":
        """This transport at about four thirds of the resolution."""
        return self._with_resolution(self._as_resolution().finer())

    def comparison_transports(self) -> tuple["AddingDoubling", ...]:
        return tuple(
            one for one in (self.coarser(), self.finer()) if one != self._with_resolution(self._as_resolution())
        )

    def evaluate(self, state: AddingDoublingState, wi: Vector, wo: Vector, side: Side) -> Channels:
        rest = self._rest(state, wi, wo, side)
        if state.scaled_first is None:
            return self._sum(state, tuple(map(clamp_nonnegative, rest)), wi, wo, side)
        return tuple(map(clamp_nonnegative, self._sum(state, rest, wi, wo, side)))

    def _rest(self, state: AddingDoublingState, wi: Vector, wo: Vector, side: Side) -> Channels:
        """What is read off: ringing may take it below 0, and where media are scaled what it lacks may, too."""
        if state.requested is not None:
            return read_requested(state.requested, wi, wo, side)
        if state.tables is not None:
            return read_rest(state.tables, wi, wo, side)
        return (jnp.zeros_like(wi[2] * wo[2]),)

    def _sum(self, state: AddingDoublingState, rest: Channels, wi: Vector, wo: Vector, side: Side) -> Channels:
        """The requested orders, of the rest and what is known in closed form."""
        parts = [rest, *_ballistic(state, wi, wo, side)]
        if self.orders == "multiple":
            if state.scaled_first is None:
                return total(parts)
            parts.append(tuple(-value for value in evaluate_first(state.first, wi, wo, side)))
        parts.append(evaluate_first(state.first if state.scaled_first is None else state.scaled_first, wi, wo, side))
        return total(parts)

    def sample(self, state: AddingDoublingState, wi: Vector, uniforms: tuple[Array, Array, Array]) -> Vector:
        layered = self._layered(state)
        if layered is not None:
            return propose_layered(layered, wi, uniforms)
        if state.stack is None:
            return propose(state.first, wi, uniforms)
        return sample_with_deltas(state.stack, wi, uniforms, partial(propose, state.first, wi))

    def pdf(self, state: AddingDoublingState, wi: Vector, wo: Vector) -> Array:
        layered = self._layered(state)
        if layered is not None:
            return layered_density(layered, wi, wo)
        density = proposal_density(state.first, wi, wo)
        return density if state.stack is None else density_with_deltas(state.stack, wi, density)

    def specular_draws(
        self, state: AddingDoublingState, wi: Vector, uniforms: tuple[Array, Array, Array]
    ) -> tuple[Array, Array, Channels] | None:
        """Of single orders the energy of deltas is 0: they are of none."""
        if state.stack is None or not has_specular(state.stack):
            return None
        layered = self._layered(state)
        if layered is None:
            drawn = specular_draws(state.stack, wi, uniforms[0])
        else:
            drawn = layered_specular_draws(layered, wi, uniforms)
        if drawn is None or self.orders == "all":
            return drawn
        along, probability, energies = drawn
        return along, probability, tuple(jnp.zeros_like(energy) for energy in energies)

    def _layered(self, state: AddingDoublingState) -> LayeredState | None:
        if state.stack is None or state.tables is None:
            return None
        return LayeredState(state.stack, state.first, state.tables, self.facet_multiple_scattering)

    def albedo(self, state: AddingDoublingState, wi: Vector, nodes: int) -> tuple[Channels, Channels]:
        """What the first face does by quadrature with `nodes` points, and of the rest what the nodes scatter: lossless
        stacks lose nothing. Of media alone all is from the nodes, as a share of what meets an event at all.

        Of single orders by quadrature, where no interface is.
        """
        if state.tables is not None and self.orders == "all":
            energies = read_energies(state.tables, wi)
            if state.first.layered:
                return directional_albedo(
                    state.scaled_first or state.first, energies, wi, nodes, self.facet_multiple_scattering
                )
            met = interaction_probability(state.first, wi)
            near, far = clip_negative(*energies)
            return (near, far) if met is None else (multiply(near, met), multiply(far, met))
        if state.first.layered:
            raise ValueError(
                f'AddingDoubling.orders: {self.orders!r} gives no albedo where there are interfaces, "all" does'
            )
        assert isinstance(state.first, FirstOrder)
        first = SingleScattering().albedo(state.first.upper, wi, nodes)
        if self.orders != "multiple":
            return first
        zero = jnp.zeros_like(wi[2])
        if state.tables is None:
            return (zero,), (zero,)
        whole = dataclasses.replace(self, orders="all").albedo(state, wi, nodes)
        less = [tuple(-value for value in part) for part in first]
        near, far = (total([w, part], zero) for w, part in zip(whole, less, strict=True))
        return near, far

    def _is_solved(self, stack: Stack) -> bool:
        gives_back = self.facet_multiple_scattering and isinstance(stack.base, Conductor)
        return self.orders != "first" and (len(stack.layers) > 0 or gives_back)

    def _solve(
        self, stack: Stack, first: FirstOrder | SmoothOrder, once: FirstOrder | SmoothOrder | None, plan: Plan
    ) -> Tables:
        return solve_tables(stack, first, once, plan)

    def _solve_requested(self, stack: Stack, known: KnownDirections, plan: Plan) -> RequestedValues:
        return solve_requested(stack, known, plan)

    def _with_resolution(self, resolution: Resolution) -> "AddingDoubling":
        return dataclasses.replace(self, **resolution._asdict(), tolerance=None)

    def _as_resolution(self) -> Resolution:
        if self.nodes is None:
            raise ValueError("AddingDoubling.nodes: none are given; choose_transport finds them for a stack")
        return Resolution(self.nodes, self.modes or modes_for(self.nodes), self.ordinates or ORDINATES[0])

    def _resolution(self, stack: Stack, directions_known: bool) -> Resolution:
        """What is given, and for the rest what is chosen."""
        if self.nodes and self.modes and self.ordinates:
            return Resolution(self.nodes, self.modes, self.ordinates)
        by_stack = choose_resolution(stack, directions_known)
        nodes = by_stack.nodes if self.nodes is None else self.nodes
        modes = by_stack.modes if self.nodes is None else modes_for(self.nodes)
        return Resolution(nodes, self.modes or modes, self.ordinates or by_stack.ordinates)

    def _chooses_resolution(self, stack: Stack) -> bool:
        if has_tilted(stack):
            return self.ordinates is None
        return self.nodes is None

    def _plan(self, stack: Stack, known: KnownDirections | None) -> Plan:
        return make_plan(stack, self._resolution(stack, known is not None), self.facet_multiple_scattering)

    def _refine(self, stack: Stack, known: KnownDirections | None) -> "AddingDoubling":
        """The coarsest resolution that agrees with the one before to `tolerance`, at the requested directions if
        light is followed along them, else all over the hemispheres."""
        if is_traced(stack):
            raise ValueError(
                f"AddingDoubling.tolerance: {self.tolerance:g} needs concrete parameters: "
                "prepare the stack outside jit, grad and vmap, or give nodes and modes"
            )
        # within a program that is traced its own are to be run; outside, their constants need none of their own
        with nullcontext() if is_outermost(stack) else jax.ensure_compile_time_eval():
            return self._refine_until_agreement(stack, None if is_traced(known) else known)

    def _refine_until_agreement(self, stack: Stack, known: KnownDirections | None) -> "AddingDoubling":
        assert self.tolerance is not None
        wi, wo = _probes(stack.base is not None, known)
        before: Array | None = None
        change = np.inf
        for resolution in resolutions(stack):
            options = self._with_resolution(resolution)
            state = options.prepare_for_directions(
                stack, partial(known_directions, wi, wo) if known is not None else lambda: None
            )
            values, found, rest = _probe_values(options, state, wi, wo, channel_count(stack))
            if before is not None:
                change = float(jnp.max(safe_div(jnp.abs(found - before), values + 0.1 * jnp.mean(rest))))
                if change <= self.tolerance:
                    return options
            before = found
        raise ValueError(
            f"AddingDoubling.tolerance: {self.tolerance:g} is not reached: "
            f"the last two resolutions differ by {change:.1g}"
        )


class _TraceableAddingDoubling(AddingDoubling):
    """Where the order of indices is known, though they are traced (None: it is not), and all elements, with their
    derivatives (None: they are not)."""

    ranks: tuple[int, ...] | None = eqx.field(static=True, default=None)
    elements: list[LinearElement] | None = None

    def _plan(self, stack: Stack, known: KnownDirections | None) -> Plan:
        return dataclasses.replace(super()._plan(stack, known), ranks=self.ranks)

    def _solve(
        self, stack: Stack, first: FirstOrder | SmoothOrder, once: FirstOrder | SmoothOrder | None, plan: Plan
    ) -> Tables:
        if self.elements is None:
            return super()._solve(stack, first, once, plan)
        return tables_of(stack, make_elements(stack, plan, None, replay(self.elements)), first, once, plan)

    def _solve_requested(self, stack: Stack, known: KnownDirections, plan: Plan) -> RequestedValues:
        if self.elements is None:
            return super()._solve_requested(stack, known, plan)
        return requested_values_of(stack, make_elements(stack, plan, known, replay(self.elements)), known, plan)


@filter_jit
@exact_products
def _probe_values(
    options: AddingDoubling, state: AddingDoublingState, wi: Array, wo: Array, channels: int
) -> tuple[Array, Array, Array]:
    """Values; what of them is solved; and that without what media that were scaled lack.

    What is known in closed form does not change, and where it is a narrow peak it must not set the scale.
    """
    solved, without = dataclasses.replace(options, orders="multiple"), dataclasses.replace(state, ballistic=())
    of = (options, state), (solved, without), (solved, dataclasses.replace(without, scaled_first=None))
    values, found, rest = (how.evaluate_batch(what, wi, wo, "all", channels, None)[0] for how, what in of)
    return values, found, rest


def _ballistic(state: AddingDoublingState, wi: Vector, wo: Vector, side: Side) -> list[Channels]:
    """BSDF of light that two refractions alone bring to the requested sides."""
    unwanted = {"all": None, "reflection": True, "transmission": False}[side]
    return [evaluate_ballistic(path, wi, wo) for path in state.ballistic if path.crosses is not unwanted]


def _warn(message: str) -> None:
    warnings.warn(message, ResolutionWarning, stacklevel=_caller_depth())


def _caller_depth() -> int:
    """How far up the call lies that a user wrote."""
    frame, count = sys._getframe(1), 1
    while frame.f_back is not None and frame.f_globals.get("__name__", "").split(".")[0] in ("layerjax", "equinox"):
        frame, count = frame.f_back, count + 1
    return count


def _scale_stack(stack: Stack, plan: Plan) -> tuple[Stack, FirstOrder | SmoothOrder | None]:
    """The stack as the grid has it, and paths with one event in that, where they differ from the stack's own."""
    carried = delta_scale(stack, plan.nodes)
    if carried is None:
        return stack, None
    once = first_order(carried)
    if isinstance(once, SmoothOrder):
        return carried, once
    media = once.upper.media if once.lower is None else once.upper.media + once.lower.media
    return carried, once if media else None


def _probes(opaque: bool, known: KnownDirections | None) -> tuple[Array, Array]:
    """Pairs at which two resolutions are compared: all over the hemispheres, or along some of the known cosines; in
    and out of the plane, all sides there are."""
    azimuth = jnp.deg2rad(jnp.asarray([0.0, 40.0, 90.0, 140.0, 180.0]))
    if known is None:
        above = below = jnp.deg2rad(jnp.asarray([3.0, 25.0, 50.0, 70.0, 80.0]))
    else:
        above, below = (jnp.arccos(side[:: -(-side.size // PROBE_COSINES)]) for side in (known.above, known.below))
    polar = above if opaque else jnp.concatenate([above, jnp.pi - below])
    theta_i, theta_o, phi = (array.ravel() for array in jnp.meshgrid(polar, polar, azimuth, indexing="ij"))
    return direction(theta_i, jnp.zeros_like(theta_i)), direction(theta_o, phi)
