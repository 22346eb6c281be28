"""Adding-doubling: every order of scattering in a stack, without noise and with derivatives.

The stack is put on a grid of directions: media are solved by eigenvectors, or in single precision doubled up from a
slab thin enough to scatter at most twice (van de Hulst 1980, Ch. 4), interfaces and bases are added (Grant & Hunt
1969). Around the normal everything is a Fourier series in azimuth unless a medium has an axis of its own; then azimuths
are ordinates too. Paths with one event are evaluated in closed form at the very directions asked for; only the smooth
rest is read off tables, or, where directions are known and the stack lets them, followed along just these.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import ClassVar, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax.channels import Channels, pick, times, total
from layerjax.directions import Vector, direction, split
from layerjax.microsurface import Microfacets
from layerjax.stack import Stack
from layerjax.transport.adding_doubling.asked import Between, between, read_between
from layerjax.transport.adding_doubling.proposals import proposal_density, propose
from layerjax.transport.adding_doubling.solve import Plan, carries_asked, make_plan, solve
from layerjax.transport.adding_doubling.tables import Tables, make_tables, read_energy, read_rest
from layerjax.transport.contract import DeterministicTransport, Side, refuse_vmf
from layerjax.transport.first_order import FirstOrder, evaluate_first, first_order, interaction_probability
from layerjax.transport.known_directions import Known, KnownDirections
from layerjax.transport.single_scattering import SingleScattering

Orders = Literal["all", "first", "multiple"]

LADDER = ((8, 8), (12, 16), (16, 24), (24, 32), (32, 48), (48, 64), (64, 96))
"""Resolutions (nodes, modes) that `tolerance` climbs."""

ORDINATES_LADDER = ((6, 8), (8, 12), (10, 16), (12, 20), (14, 24), (16, 28))
"""The same for ordinates."""


MOST = 1024
"""Largest number of nodes, modes, cosines or azimuths; tables of more fit in no memory."""


class Solved(eqx.Module):
    """A solved stack: what is evaluated in closed form, and the rest: tables, or values between known directions.

    Both are None if there is no rest.
    """

    first: FirstOrder
    tables: Tables | None
    between: Between | None = None


class AddingDoubling(DeterministicTransport):
    """Deterministic solution of any stack, all orders of scattering, lit from above and from below.

    Carries everything that a `Stack` holds; von Mises-Fisher normals with ``microfacets="single"`` only. The work per
    stack is done in `prepare`; a pair then costs microseconds. `evaluate` of a stack that begins (and, if light passes
    it, ends) with an interface, along up to 256 distinct cosines that are known beforehand, reads nothing off tables:
    light along them is followed exactly, and half the nodes and modes give the same error or less.

    Args:
        nodes: cosines a hemisphere (and for each range of angles between critical angles), 2 to 1024.
        modes: Fourier modes in azimuth, 1 to 1024, where every medium is symmetric about the normal.
        ordinates: (cosines, azimuths) a hemisphere where some medium is not, up to 1024 each; azimuths even. Both are
            chosen while tracing: an axis that is traced counts as tilted.
        tolerance: relative error to aim at instead: `prepare` climbs through resolutions until two agree to it, which
            needs concrete parameters. The error of the result is then about a quarter of the tolerance or less.
        orders: ``"all"``, only paths with one event (``"first"``, nothing is solved), or those with more
            (``"multiple"``). An event is a collision, a reflection or refraction at an interface, or a reflection at
            the base.
        microfacets: ``"single"``, Walter 2007: light that a facet sends into another is lost; or ``"multiple"``: it is
            given back diffusely, so that interfaces conserve energy (after Kulla & Conty 2017): lossless stacks return
            what meets them to 1e-3, at the ends of the box (index 0.25 or 1.0001, light within a degree of grazing) to
            2 %.

    Raises:
        ValueError: an option is out of its range; or `tolerance` cannot be reached, or is used while tracing.
    """

    uses_known: ClassVar[bool] = True

    nodes: int = eqx.field(static=True, default=32)
    modes: int = eqx.field(static=True, default=48)
    ordinates: tuple[int, int] = eqx.field(static=True, default=(10, 24))
    tolerance: float | None = eqx.field(static=True, default=None)
    orders: Orders = eqx.field(static=True, default="all")
    microfacets: Microfacets = eqx.field(static=True, default="single")

    def __check_init__(self) -> None:
        for name, value, least in (("nodes", self.nodes, 2), ("modes", self.modes, 1)):
            if not (isinstance(value, int) and least <= value <= MOST):
                raise ValueError(f"AddingDoubling.{name}: {value!r:.60} is not a whole number from {least} to {MOST}")
        cosines, azimuths = self.ordinates if len(self.ordinates) == 2 else (0, 0)
        if not (2 <= cosines <= MOST and 4 <= azimuths <= MOST and azimuths % 2 == 0):
            raise ValueError(
                f"AddingDoubling.ordinates: {self.ordinates!r:.60} is not (cosines from 2 to {MOST}, an even number of "
                f"azimuths from 4 to {MOST})"
            )
        if self.tolerance is not None and not 0.0 < self.tolerance < 1.0:
            raise ValueError(f"AddingDoubling.tolerance: {self.tolerance!r} is outside (0, 1)")
        for name, choice, choices in (("orders", self.orders, Orders), ("microfacets", self.microfacets, Microfacets)):
            if choice not in get_args(choices):
                allowed = ", ".join(map(repr, get_args(choices)))
                raise ValueError(f"AddingDoubling.{name}: {choice!r} is not one of {allowed}")

    def check(self, stack: Stack, names: Sequence[str]) -> None:
        if self.microfacets == "multiple":
            refuse_vmf(stack, names, 'AddingDoubling(microfacets="multiple")')

    def prepare(self, stack: Stack) -> Solved:
        if self.tolerance is not None:
            return self._climb(stack)
        return self._solved(stack)

    def prepare_for(self, stack: Stack, known: Known) -> Solved:
        if self.tolerance is None and self.orders != "first":
            plan = make_plan(stack, self.nodes, self.modes, self.ordinates, self.microfacets)
            directions = known() if carries_asked(stack, plan) else None
            if directions is not None:
                return Solved(first_order(stack), None, _solve_between(stack, directions, plan))
        return self.prepare(stack)

    def measured(
        self, state: Solved, wi: Array, wo: Array, side: Side, channels: int, key: Array | None
    ) -> tuple[Array, None]:
        if state.between is None:
            return super().measured(state, wi, wo, side, channels, key)
        i, o = split(wi), split(wo)
        rest = read_between(state.between, i, o, side)
        parts = [rest] if self.orders == "multiple" else [evaluate_first(state.first, i, o, side), rest]
        values = total(parts, jnp.zeros_like(i[2] * o[2]))
        return jnp.stack([pick(values, c) for c in range(channels)], axis=-1), None

    def coarser(self) -> "AddingDoubling":
        """The same at about two thirds of the resolution, for an estimate of the error."""
        nodes, azimuths = self.ordinates
        return dataclasses.replace(
            self,
            nodes=max(2, 2 * self.nodes // 3),
            modes=max(1, 2 * self.modes // 3),
            ordinates=(max(2, 3 * nodes // 4), max(4, 3 * azimuths // 8 * 2)),
            tolerance=None,
        )

    def evaluate(self, state: Solved, wi: Vector, wo: Vector, side: Side) -> Channels:
        parts: list[Channels] = []
        if self.orders != "multiple":
            parts.append(evaluate_first(state.first, wi, wo, side))
        if state.tables is not None:
            parts.append(read_rest(state.tables, wi, wo, side))
        return total(parts, jnp.zeros_like(wi[2] * wo[2]))

    def sample(self, state: Solved, wi: Vector, uniforms: tuple[Array, Array, Array]) -> Vector:
        return propose(state.first, wi, uniforms)

    def pdf(self, state: Solved, wi: Vector, wo: Vector) -> Array:
        return proposal_density(state.first, wi, wo)

    def albedo(self, state: Solved, wi: Vector, nodes: int) -> tuple[Channels, Channels]:
        """From the flux at the nodes, as a share of what meets an event at all: lossless stacks lose nothing.

        Of single orders by quadrature with `nodes` points, where no interface is.
        """
        if state.tables is not None and self.orders == "all":
            met = interaction_probability(state.first, wi)
            near, far = read_energy(state.tables, wi)
            return (near, far) if met is None else (times(near, met), times(far, met))
        if state.first.layered:
            raise ValueError(
                f'AddingDoubling.orders: {self.orders!r} gives no albedo where there are interfaces, "all" does'
            )
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

    def _solved(self, stack: Stack) -> Solved:
        first = first_order(stack)
        if self.orders == "first" or not stack.layers:
            return Solved(first, None)
        plan = make_plan(stack, self.nodes, self.modes, self.ordinates, self.microfacets)
        return Solved(first, _solve(stack, first, plan))

    def _climb(self, stack: Stack) -> Solved:
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(stack)):
            raise ValueError(
                f"AddingDoubling.tolerance: {self.tolerance:g} needs concrete parameters: "
                "prepare the stack outside jit, grad and vmap, or give nodes and modes"
            )
        assert self.tolerance is not None
        wi, wo = _probes(stack.base is not None)
        before: Array | None = None
        tilted = make_plan(stack, 2, 1, (2, 4), self.microfacets).azimuths is not None
        change = np.inf
        for rung in ORDINATES_LADDER if tilted else LADDER:
            finer = {"ordinates": rung} if tilted else {"nodes": rung[0], "modes": rung[1]}
            options = dataclasses.replace(self, tolerance=None, **finer)
            state = options._solved(stack)
            values = _read(options, state, wi, wo)
            if before is not None:
                change = float(jnp.max(jnp.abs(values - before) / (jnp.abs(values) + 0.1 * jnp.mean(values))))
                if change <= self.tolerance:
                    return state
            before = values
        raise ValueError(
            f"AddingDoubling.tolerance: {self.tolerance:g} is not reached: "
            f"the last two resolutions differ by {change:.1g}"
        )


@eqx.filter_jit
def _solve(stack: Stack, first: FirstOrder, plan: Plan) -> Tables:
    grid, whole = solve(stack, plan)
    return make_tables(grid, whole, plan.azimuths, stack.base is not None, partial(interaction_probability, first))


@eqx.filter_jit
def _solve_between(stack: Stack, known: KnownDirections, plan: Plan) -> Between:
    grid, whole = solve(stack, plan, known)
    return between(whole, known, grid.regions[-1].ior, stack.base is not None)


@eqx.filter_jit
def _read(options: AddingDoubling, state: Solved, wi: Vector, wo: Vector) -> Array:
    return jnp.stack(options.evaluate(state, wi, wo, "all"))


def _probes(opaque: bool) -> tuple[Vector, Vector]:
    """Pairs at which two resolutions are compared: 0 to 80 degrees, in and out of the plane, all sides there are."""
    polar = jnp.deg2rad(jnp.asarray([3.0, 25.0, 50.0, 70.0, 80.0]))
    azimuth = jnp.deg2rad(jnp.asarray([0.0, 40.0, 90.0, 140.0, 180.0]))
    sides = (0.0,) if opaque else (0.0, np.pi)
    polar_o = jnp.concatenate([jnp.abs(side - polar) for side in sides])
    in_, out, phi = (array.ravel() for array in jnp.meshgrid(polar_o, polar_o, azimuth, indexing="ij"))
    return split(direction(in_, jnp.zeros_like(in_))), split(direction(out, phi))
