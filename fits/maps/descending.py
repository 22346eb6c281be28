"""Descents of many texels in one compiled program: a few side by side, and who ends makes room for the next.

Values and derivatives of the model are found once for every trial, and carried from step to step: residuals, sigma and
all that follows from them see the model as linear there. Otherwise the program would compute the model again for each
of these, which takes several times as long. Of a known start the model need not be asked at all.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax import Array
from jax.flatten_util import ravel_pytree

from fits.maps.texels import Texels, model_of
from fits.optimise.descent import COST_TOLERANCE, NEARBY
from fits.optimise.levenberg_marquardt import FIRST_DAMPING, BoxLevenbergMarquardt
from fits.optimise.multi_start import MOST_STEPS
from fits.problem.model import Model

BESIDE = 4
"""Texels that take their steps side by side: more do not make the arithmetic of each cheaper."""

LAST = 0.01
"""Of what a full step may promise at the end of a descent: so much is left after a last step that is not looked at."""

_SOLVER = BoxLevenbergMarquardt()


class Known(NamedTuple):
    """What a model says at a vector: values (N, C) in 1/sr, and derivatives (P, N, C) by the physical parameters."""

    values: Any
    slopes: Any


class Linear(Model):
    """A model near a vector `at` (P,), by what is known there."""

    near: Known
    at: Array

    def predict(self, vector: Array) -> Array:
        """Scaled BSDF, (N, C), in 1/sr."""
        return self.near.values + jnp.tensordot(vector - self.at, self.near.slopes, 1)


class End(NamedTuple):
    """Where a texel ended: in the unit box (P,), the cost and its gradient there (P,), and what is known there."""

    unit: Any
    cost: Any
    gradient: Any
    converged: Any
    known: Known


class _Place(NamedTuple):
    """A texel on its way.

    texel: its number. rough: whether it goes by `sigma`, (N, C), which is held, as far from the data; NaN where not.
    unit: (P,), and the solver's state, beside which stands what is known at `unit`.
    """

    texel: Array
    rough: Array
    sigma: Array
    unit: Array
    state: Any


def linear(model: Model, known: Known, vector: Array) -> Linear:
    """The model near a vector (P,)."""
    own = {one.name: getattr(model, one.name) for one in fields(Model)}
    return Linear(**own, near=known, at=vector)


def known_at(model: Model, vector: Array) -> Known:
    """Values and derivatives at a vector (P,)."""
    steps = jnp.eye(vector.size, dtype=vector.dtype)[: model.moving]
    values, slopes = jax.vmap(lambda step: jax.jvp(model.predict, (vector,), (step,)), out_axes=(None, 0))(steps)
    rest = jnp.zeros((vector.size - model.moving, *values.shape), values.dtype)
    return Known(values, jnp.concatenate([slopes, rest]))


def descents(
    model: Model,
    texels: Texels,
    number: Array,
    fresh: Array,
    look: Array,
    units: Array,
    known: Known | None,
    which: Array,
) -> End:
    """Ends of M texels, (M, ...), of which the first `number` count.

    Args:
        fresh: whether starts are far from minima. look: whether each ends where it begins, with what is known there.
        units: starts, (K, P) in the unit box. which: of each texel, (M,).
        known: what the model says at the starts, (K, ...), or with `look` anything; None: that is to be found.
    """
    run = _Run(model, texels, fresh, units, known, which)
    places, _ = run.begun(jnp.full(BESIDE, texels.number))  # no texel's
    row, unravel = ravel_pytree(jax.tree.map(lambda part: part[0], _ends(places, places.texel < 0)))
    out = jnp.zeros((texels.number + 1, row.size), row.dtype)

    def stepped(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        """A step of places whose turn it is; of those that end and make room for a known start it is again."""
        following, places, trial, turn, out = carry
        after, ended, converged = run.stepped(places, trial)
        places = jax.tree.map(partial(_choose, turn), after, places)
        ended = ((ended | look) & turn) | (following == 0)
        ends = _ends(places, converged)
        seen = jax.tree.map(partial(jnp.where, look), trial, ends.known)
        rows = jax.vmap(lambda end: ravel_pytree(end)[0])(ends._replace(known=seen))
        kept = ended & (places.texel < number)
        for place in range(BESIDE):  # of all others into a last row, which is no texel's
            to = jnp.where(kept[place], places.texel[place], texels.number)
            out = jax.lax.dynamic_update_slice(out, rows[place][None], (to, jnp.zeros_like(to)))
        new, said = run.begun(following + jnp.cumsum(ended) - 1)
        places, trial = jax.tree.map(partial(_choose, ended), (new, said), (places, trial))
        turn = ended & (places.texel < number) & (known is not None) & ~look
        return following + jnp.sum(ended), places, trial, turn, out

    def body(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        following, places, out = carry
        begin = following, places, run.tried(places), jnp.ones(BESIDE, bool), out
        following, places, _, _, out = jax.lax.while_loop(lambda carry: jnp.any(carry[3]), stepped, begin)
        return following, places, out

    def left(carry: tuple[Any, ...]) -> Array:
        return (carry[0] == 0) | jnp.any(carry[1].texel < number)

    # model and step stand in the program once each, as that takes its time and memory to compile
    *_, out = jax.lax.while_loop(left, body, (jnp.asarray(0), places, out))
    return jax.vmap(unravel)(out[:-1])


def first_mapped(one: Callable[[Any], Any], rows: Any, number: Array) -> Any:
    """What becomes of the first `number` of M rows, (M, ...), `BESIDE` at a time; zeros or whatever of the others."""
    blocks = jax.tree.map(lambda part: part.reshape(-1, BESIDE, *part.shape[1:]), rows)

    def block(index: Array) -> Any:
        return jax.vmap(one)(jax.tree.map(lambda part: part[index], blocks))

    count = len(jax.tree.leaves(blocks)[0])
    shapes = jax.eval_shape(block, jnp.asarray(0))
    empty = jax.tree.map(lambda part: jnp.zeros((count, *part.shape), part.dtype), shapes)

    def filled(index: Array, out: Any) -> Any:
        return jax.tree.map(lambda whole, part: whole.at[index].set(part), out, block(index))

    found = jax.lax.fori_loop(0, -(-number // BESIDE), filled, empty)
    return jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), found)


def _ends(places: _Place, converged: Array) -> End:
    state = places.state
    return End(places.unit, state.cost, state.gradient, converged.astype(places.unit.dtype), state.beside)


def _choose(where: Array, new: Array, old: Array) -> Array:
    return jnp.where(where.reshape(-1, *(1,) * (new.ndim - 1)), new, old)


class _Run:
    """What all places have in common; methods are of `BESIDE` places at once."""

    def __init__(
        self, model: Model, texels: Texels, fresh: Array, units: Array, known: Known | None, which: Array
    ) -> None:
        self.model, self.texels, self.fresh, self.units, self.which = model, texels, fresh, units, which
        self.levels = model.objective == "likelihood" and model.varying
        self.known = known
        self.options: dict[str, Any] = {"damping": jnp.where(fresh, FIRST_DAMPING, NEARBY), "most_steps": MOST_STEPS}
        if model.objective == "likelihood":
            self.options["tolerance"] = COST_TOLERANCE
        if self.levels:
            self.options["logarithmic"] = model.logarithmic

    def begun(self, numbers: Array) -> tuple[_Place, Known]:
        """Places of texels of these numbers, (B,), at their starts, and what is known there; zeros where nothing is."""
        return jax.vmap(self._start)(numbers, jnp.minimum(numbers, self.texels.number - 1))

    def stepped(self, places: _Place, trial: Known) -> tuple[_Place, Array, Array]:
        """Places after a step by what is known of their trials; which have ended there, and which converged."""
        return jax.vmap(self._step)(places, trial)

    def tried(self, places: _Place) -> Known:
        """What the model says at the trials of places."""

        def one(place: _Place) -> Known:
            own = model_of(self.model, self._row(place.texel))
            return known_at(own, self.model.box.from_unit(place.state.trial))

        return jax.vmap(one)(places)

    def _row(self, number: Array) -> Texels:
        at = jnp.minimum(number, self.texels.number - 1)
        return jax.tree.map(lambda part: part[at], self.texels)

    def _start(self, number: Array, at: Array) -> tuple[_Place, Known]:
        unit = self.units[self.which[at]]
        own = model_of(self.model, self._row(at))
        sigma = own.initial_sigma(self.model.box.from_unit(unit))
        rough = self.fresh if self.levels else jnp.asarray(False)
        like = jnp.zeros((unit.size, *own.values.shape), unit.dtype)
        nothing = Known(like[0], like)
        known = nothing if self.known is None else jax.tree.map(lambda part: part[self.which[at]], self.known)
        return _Place(number, rough, sigma, unit, self._state(unit, nothing)), known

    def _state(self, unit: Array, beside: Known) -> Any:
        state = _SOLVER.init(None, unit, None, self.options, None, beside, frozenset())
        return with_beside(state, beside)

    def _step(self, place: _Place, trial: Known) -> tuple[_Place, Array, Array]:
        row, at = self._row(place.texel), self.model.box.from_unit(place.state.trial)
        own = linear(model_of(self.model, row), trial, at)
        held = jnp.where(place.rough, place.sigma, jnp.nan)

        def residuals(unit: Array, _: None) -> tuple[Any, Known]:
            first = (held, jnp.ones(())) if self.levels else None
            return own.linear_parts(self.model.box.from_unit(unit), first)[0], trial

        unit, state, _ = _SOLVER.step(residuals, place.unit, None, self.options, place.state, frozenset())
        stop, result = _SOLVER.terminate(residuals, unit, None, self.options, state, frozenset())
        last = ~stop & ~place.rough & self._is_last(place.state, state)
        unit, state = jax.tree.map(partial(jnp.where, last), self._stepped_last(unit, state), (unit, state))
        stop |= last
        again = stop & place.rough
        state = jax.tree.map(partial(jnp.where, again), self._state(unit, state.beside), state)
        converged = (result == optx.RESULTS.successful) & jnp.isfinite(state.cost)
        return _Place(place.texel, place.rough & ~stop, place.sigma, unit, state), stop & ~place.rough, converged

    def _is_last(self, before: Any, state: Any) -> Array:
        """Whether the next step ends a descent: it is a full one, and another will promise too little if promises go on
        to fall as they did (after Hairer and Wanner 1996, IV.8)."""
        followed = state.full_decrease**2 <= LAST * COST_TOLERANCE * before.full_decrease
        full = state.full_decrease - state.predicted <= LAST * COST_TOLERANCE
        return followed & full & jnp.isfinite(before.full_decrease) & (self.model.objective == "likelihood")

    def _stepped_last(self, unit: Array, state: Any) -> tuple[Array, Any]:
        """After a step so short that all is linear on the way."""
        step, known = state.trial - unit, state.beside
        moved = self.model.box.from_unit(state.trial) - self.model.box.from_unit(unit)
        near = Known(known.values + jnp.tensordot(moved, known.slopes, 1), known.slopes)
        state = replace(state, cost=state.cost - state.predicted, gradient=state.gradient + state.normal @ step)
        return state.trial, with_beside(state, near)


def with_beside(state: Any, beside: Any) -> Any:
    """A solver's state with something else beside it."""
    return eqx.tree_at(lambda s: s.beside, state, beside, is_leaf=lambda part: part is None)
