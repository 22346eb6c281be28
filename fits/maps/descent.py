"""Texels side by side: their measurements, and bounded Levenberg-Marquardt of many of them in one compiled program.

A few lanes take their steps together, and a texel that has ended makes room for the next. Values and derivatives of the
model are found once for every trial, and carried from step to step: residuals, sigma and all that follows from them see
the model as linear there. Otherwise the program would compute the model again for each of these, which takes several
times as long. Of a start whose linearisation is known the model is not evaluated at all.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import Array
from jax.flatten_util import ravel_pytree
from numpy.typing import NDArray

from fits.optimise.levenberg_marquardt import COST_TOLERANCE, FIRST_DAMPING, NEARBY, BoxLevenbergMarquardt
from fits.optimise.multi_start import MOST_STEPS
from fits.problem.model import Model
from fits.problem.parameters import Box
from fits.problem.problem import Problem

Floats = NDArray[np.float64]

LEFT_OUT = 1e9
"""Standard deviation of a value that is omitted, in units of the largest: it weighs less than rounding."""

LANES = 4
"""Texels that take their steps side by side: more do not make the arithmetic of each cheaper."""

LAST = 0.01
"""Of the decrease that a full step may have left at the end: so much is left after a last step, not evaluated."""

_SOLVER = BoxLevenbergMarquardt()


class Texels(NamedTuple):
    """Measurements of M texels.

    values, variance, lowest: (M, N, C), BSDF in 1/sr, the measurement's own variance, enormous for what is omitted,
    and what sigma cannot fall below. used: (M, N, C) bool. wi, wo: (M, N, 3), None where all texels have the directions
    of the problem. centre, inverse_sd: (M, P), of Gaussian priors beside those of the problem, in the coordinate of
    `Box.centre`; None where there are none.
    """

    values: Any
    variance: Any
    lowest: Any
    used: Any
    wi: Any = None
    wo: Any = None
    centre: Any = None
    inverse_sd: Any = None

    @property
    def number(self) -> int:
        """How many there are, M."""
        return len(self.values)

    def rows(self, places: Any) -> "Texels":
        """Some of the texels."""
        return Texels(*(None if part is None else part[places] for part in self))

    @property
    def measurements(self) -> NDArray[np.int64]:
        """How many of each texel count, (M,)."""
        return np.sum(self.used, axis=(1, 2))


def make_texels(
    values: Floats,
    sigma: Floats | None = None,
    least: float = 0.0,
    wi: Floats | None = None,
    wo: Floats | None = None,
) -> Texels:
    """Values (M, N, C), with their standard deviations of that shape; what is not finite is omitted, in single
    precision also what is finite only in double.

    least: of the noise's floor.

    Raises:
        ValueError: a standard deviation is negative, or 0 where the value counts.
    """
    largest_number = float(jnp.finfo(jnp.result_type(float)).max)
    used = np.abs(values) <= largest_number
    variance = np.zeros(values.shape)
    if sigma is not None:
        used &= np.isfinite(sigma)
        wrong = used & (sigma <= 0.0)
        if wrong.any():
            raise ValueError(f"sigma is {sigma[wrong][0]:g} in a measurement that counts; it must be above 0")
        variance = _squared(np.where(used, sigma, 0.0), largest_number)
    largest = np.max(np.abs(values), initial=0.0, where=used, axis=(1, 2), keepdims=True)
    largest = np.minimum(np.where(largest > 0.0, largest, 1.0), largest_number / LEFT_OUT)
    ignored = _squared(LEFT_OUT * largest, largest_number)
    variance = np.where(used, variance, ignored)
    return with_floor(Texels(np.where(used, values, 0.0), variance, variance, used, wi, wo), least)


def blank_texel(shape: tuple[int, ...]) -> Texels:
    """One texel, for a model that is evaluated whatever the values: (N, C) zeros."""
    return make_texels(np.zeros((1, *shape)))


def _squared(numbers: Floats, largest: float) -> Floats:
    """Squares that can still be added to others."""
    with np.errstate(over="ignore"):
        return np.minimum(np.square(numbers), 0.25 * largest)


def with_floor(texels: Texels, least: float) -> Texels:
    """The texels with noise whose floor is at least so much, in 1/sr."""
    return texels._replace(lowest=np.sqrt(texels.variance + least**2))


def model_of(model: Model, row: Texels) -> Model:
    """The model with the values of one texel, (N, C)."""
    own = (row.values, row.variance, row.lowest)
    model = eqx.tree_at(lambda m: (m.values, m.variance, m.lowest), model, own)
    if row.centre is not None:
        model = eqx.tree_at(lambda m: m.box, model, _with_prior(model.box, row.centre, row.inverse_sd))
    return model if row.wi is None else eqx.tree_at(lambda m: (m.wi, m.wo), model, (row.wi, row.wo))


def _with_prior(box: Box, centre: Array, inverse_sd: Array) -> Box:
    """The box with Gaussian priors (P,) beside its own, one product of the two, up to a constant."""
    own, other = jnp.square(box.inverse_sd), jnp.square(inverse_sd)
    both = own + other
    mean = (own * box.centre + other * centre) / jnp.where(both > 0.0, both, 1.0)
    return replace(box, centre=mean, inverse_sd=jnp.sqrt(both))


def with_own_directions(problem: Problem) -> Problem:
    """The problem for texels that have directions of their own, of which nothing is known beforehand."""
    return problem.with_model(replace(problem.model, known=None, side="all"))


def chi_square(model: Model, row: Texels, vector: Array, predicted: Array) -> Array:
    """Chi-square of the values that count; for a named objective the sum of its squared residuals."""
    return jnp.sum(jnp.where(row.used, model.standardised_at(vector, predicted), 0.0) ** 2)


# ---- descents ----


class Linearisation(NamedTuple):
    """What a model says at a vector: values (N, C) in 1/sr, and derivatives (P, N, C) by the physical parameters."""

    values: Any
    slopes: Any


class Linear(Model):
    """A model near a vector `at` (P,), by what is known there."""

    near: Linearisation
    at: Array

    def predict(self, vector: Array) -> Array:
        """Scaled BSDF, (N, C), in 1/sr."""
        return self.near.values + jnp.tensordot(vector - self.at, self.near.slopes, 1)


class Ending(NamedTuple):
    """Where a texel ended: in the unit box (P,), the cost and its gradient there (P,), and what is known there."""

    unit: Any
    cost: Any
    gradient: Any
    converged: Any
    known: Linearisation


class _Lane(NamedTuple):
    """A texel on its way.

    texel: its number. rough: whether it goes by `sigma`, (N, C), which is held, as far from the data; NaN where not.
    unit: (P,), and the solver's state, whose auxiliary output is the linearisation at `unit`.
    """

    texel: Array
    rough: Array
    sigma: Array
    unit: Array
    state: Any


def linear(model: Model, known: Linearisation, vector: Array) -> Linear:
    """The model near a vector (P,)."""
    own = {one.name: getattr(model, one.name) for one in fields(Model)}
    return Linear(**own, near=known, at=vector)


def linearise(model: Model, vector: Array) -> Linearisation:
    """Values and derivatives at a vector (P,)."""
    steps = jnp.eye(vector.size, dtype=vector.dtype)[: model.moving]
    values, slopes = jax.vmap(lambda step: jax.jvp(model.predict, (vector,), (step,)), out_axes=(None, 0))(steps)
    rest = jnp.zeros((vector.size - model.moving, *values.shape), values.dtype)
    return Linearisation(values, jnp.concatenate([slopes, rest]))


def descents(
    model: Model,
    texels: Texels,
    number: Array,
    fresh: Array,
    only_evaluate: Array,
    units: Array,
    known: Linearisation | None,
    which: Array,
) -> Ending:
    """Ends of M texels, (M, ...), of which the first `number` count.

    Args:
        fresh: whether starts are far from minima.
        only_evaluate: whether each ends where it begins, with its linearisation.
        units: starts, (K, P) in the unit box. which: of each texel, (M,).
        known: what the model says at the starts, (K, ...), or with `only_evaluate` anything; None: that is to be found.
    """
    run = _Lanes(model, texels, fresh, units, known, which)
    lanes, _ = run.begun(jnp.full(LANES, texels.number))  # no texel's
    row, unravel = ravel_pytree(jax.tree.map(lambda part: part[0], _ends(lanes, lanes.texel < 0)))
    out = jnp.zeros((texels.number + 1, row.size), row.dtype)

    def stepped(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        """A step of lanes whose turn it is; of those that end and make room for a known start it is again."""
        following, lanes, trial, turn, out = carry
        after, ended, converged = run.stepped(lanes, trial)
        lanes = jax.tree.map(partial(_choose, turn), after, lanes)
        ended = ((ended | only_evaluate) & turn) | (following == 0)
        ends = _ends(lanes, converged)
        seen = jax.tree.map(partial(jnp.where, only_evaluate), trial, ends.known)
        rows = jax.vmap(lambda end: ravel_pytree(end)[0])(ends._replace(known=seen))
        kept = ended & (lanes.texel < number)
        for lane in range(LANES):  # of all others into a last row, which is no texel's
            to = jnp.where(kept[lane], lanes.texel[lane], texels.number)
            out = jax.lax.dynamic_update_slice(out, rows[lane][None], (to, jnp.zeros_like(to)))
        new, said = run.begun(following + jnp.cumsum(ended) - 1)
        lanes, trial = jax.tree.map(partial(_choose, ended), (new, said), (lanes, trial))
        turn = ended & (lanes.texel < number) & (known is not None) & ~only_evaluate
        return following + jnp.sum(ended), lanes, trial, turn, out

    def body(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        following, lanes, out = carry
        begin = following, lanes, run.tried(lanes), jnp.ones(LANES, bool), out
        following, lanes, _, _, out = jax.lax.while_loop(lambda carry: jnp.any(carry[3]), stepped, begin)
        return following, lanes, out

    def left(carry: tuple[Any, ...]) -> Array:
        return (carry[0] == 0) | jnp.any(carry[1].texel < number)

    # model and step stand in the program once each, as that takes its time and memory to compile
    *_, out = jax.lax.while_loop(left, body, (jnp.asarray(0), lanes, out))
    return jax.vmap(unravel)(out[:-1])


def first_mapped(one: Callable[[Any], Any], rows: Any, number: Array) -> Any:
    """What becomes of the first `number` of M rows, (M, ...), `LANES` at a time; zeros or whatever of the others."""
    blocks = jax.tree.map(lambda part: part.reshape(-1, LANES, *part.shape[1:]), rows)

    def block(index: Array) -> Any:
        return jax.vmap(one)(jax.tree.map(lambda part: part[index], blocks))

    count = len(jax.tree.leaves(blocks)[0])
    shapes = jax.eval_shape(block, jnp.asarray(0))
    empty = jax.tree.map(lambda part: jnp.zeros((count, *part.shape), part.dtype), shapes)

    def filled(index: Array, out: Any) -> Any:
        return jax.tree.map(lambda whole, part: whole.at[index].set(part), out, block(index))

    found = jax.lax.fori_loop(0, -(-number // LANES), filled, empty)
    return jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), found)


def _ends(lanes: _Lane, converged: Array) -> Ending:
    state = lanes.state
    return Ending(lanes.unit, state.cost, state.gradient, converged.astype(lanes.unit.dtype), state.auxiliary)


def _choose(where: Array, new: Array, old: Array) -> Array:
    return jnp.where(where.reshape(-1, *(1,) * (new.ndim - 1)), new, old)


class _Lanes:
    """What all lanes have in common; methods are of `LANES` lanes at once."""

    def __init__(
        self, model: Model, texels: Texels, fresh: Array, units: Array, known: Linearisation | None, which: Array
    ) -> None:
        self.model, self.texels, self.fresh, self.units, self.which = model, texels, fresh, units, which
        self.levels = model.objective == "likelihood" and model.varying
        self.known = known
        self.options: dict[str, Any] = {"damping": jnp.where(fresh, FIRST_DAMPING, NEARBY), "most_steps": MOST_STEPS}
        if model.objective == "likelihood":
            self.options["tolerance"] = COST_TOLERANCE
        if self.levels:
            self.options["logarithmic"] = model.logarithmic

    def begun(self, numbers: Array) -> tuple[_Lane, Linearisation]:
        """Places of texels of these numbers, (B,), at their starts, and what is known there; zeros where nothing is."""
        return jax.vmap(self._start)(numbers, jnp.minimum(numbers, self.texels.number - 1))

    def stepped(self, lanes: _Lane, trial: Linearisation) -> tuple[_Lane, Array, Array]:
        """Places after a step by what is known of their trials; which have ended there, and which converged."""
        return jax.vmap(self._step)(lanes, trial)

    def tried(self, lanes: _Lane) -> Linearisation:
        """What the model says at the trials of lanes."""

        def one(lane: _Lane) -> Linearisation:
            own = model_of(self.model, self._row(lane.texel))
            return linearise(own, self.model.box.from_unit(lane.state.trial))

        return jax.vmap(one)(lanes)

    def _row(self, number: Array) -> Texels:
        at = jnp.minimum(number, self.texels.number - 1)
        return jax.tree.map(lambda part: part[at], self.texels)

    def _start(self, number: Array, at: Array) -> tuple[_Lane, Linearisation]:
        unit = self.units[self.which[at]]
        own = model_of(self.model, self._row(at))
        sigma = own.initial_sigma(self.model.box.from_unit(unit))
        rough = self.fresh if self.levels else jnp.asarray(False)
        like = jnp.zeros((unit.size, *own.values.shape), unit.dtype)
        nothing = Linearisation(like[0], like)
        known = nothing if self.known is None else jax.tree.map(lambda part: part[self.which[at]], self.known)
        return _Lane(number, rough, sigma, unit, self._state(unit, nothing)), known

    def _state(self, unit: Array, auxiliary: Linearisation) -> Any:
        state = _SOLVER.init(None, unit, None, self.options, None, auxiliary, frozenset())
        return with_auxiliary(state, auxiliary)

    def _step(self, lane: _Lane, trial: Linearisation) -> tuple[_Lane, Array, Array]:
        row, at = self._row(lane.texel), self.model.box.from_unit(lane.state.trial)
        own = linear(model_of(self.model, row), trial, at)
        held = jnp.where(lane.rough, lane.sigma, jnp.nan)

        def residuals(unit: Array, _: None) -> tuple[Any, Linearisation]:
            first = (held, jnp.ones(())) if self.levels else None
            return own.linear_parts(self.model.box.from_unit(unit), first)[0], trial

        unit, state, _ = _SOLVER.step(residuals, lane.unit, None, self.options, lane.state, frozenset())
        stop, result = _SOLVER.terminate(residuals, unit, None, self.options, state, frozenset())
        last = ~stop & ~lane.rough & self._is_last(lane.state, state)
        unit, state = jax.tree.map(partial(jnp.where, last), self._stepped_last(unit, state), (unit, state))
        stop |= last
        again = stop & lane.rough
        state = jax.tree.map(partial(jnp.where, again), self._state(unit, state.auxiliary), state)
        converged = (result == optx.RESULTS.successful) & jnp.isfinite(state.cost)
        return _Lane(lane.texel, lane.rough & ~stop, lane.sigma, unit, state), stop & ~lane.rough, converged

    def _is_last(self, before: Any, state: Any) -> Array:
        """Whether the next step ends a descent: it is a full one, and the decrease of another is too small if
        decreases go on to shrink as they did (after Hairer and Wanner 1996, IV.8)."""
        followed = state.full_decrease**2 <= LAST * COST_TOLERANCE * before.full_decrease
        full = state.full_decrease - state.predicted <= LAST * COST_TOLERANCE
        return followed & full & jnp.isfinite(before.full_decrease) & (self.model.objective == "likelihood")

    def _stepped_last(self, unit: Array, state: Any) -> tuple[Array, Any]:
        """After a step so short that all is linear on the way."""
        step, known = state.trial - unit, state.auxiliary
        moved = self.model.box.from_unit(state.trial) - self.model.box.from_unit(unit)
        near = Linearisation(known.values + jnp.tensordot(moved, known.slopes, 1), known.slopes)
        state = replace(state, cost=state.cost - state.predicted, gradient=state.gradient + state.normal @ step)
        return state.trial, with_auxiliary(state, near)


def with_auxiliary(state: Any, auxiliary: Any) -> Any:
    """A solver's state with another auxiliary output."""
    return eqx.tree_at(lambda s: s.auxiliary, state, auxiliary, is_leaf=lambda part: part is None)
