"""Texels side by side, and the best fits of many of them from a start each: the optimiser of `fits.fit`, batched.

One compiled program takes a few lanes through their steps together, and a texel that has ended makes room for the next.
Values and derivatives of the model are computed once for every trial and carried from step to step: residuals, sigma
and all that follows from them see the model as linear there. Otherwise the program would compute the model again for
each of these, which takes several times as long. At a start whose linearisation is known the model is not evaluated.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from fits.data.geometry import Booleans, Floats, Integers
from fits.optimise.levenberg_marquardt import COST_TOLERANCE, FIRST_DAMPING, NEARBY, State, first_state
from fits.optimise.levenberg_marquardt import step as step_of
from fits.optimise.multi_start import MOST_STEPS
from fits.optimise.uncertainty import LEAST_GRADIENT, UNIDENTIFIED_BEYOND, errors_in_boxes, scatter
from fits.problem.model import Linearisation, Model, linearise
from fits.problem.problem import Problem

OMITTED = 1e9  # standard deviation of a value that is omitted, in units of the largest: it weighs less than rounding

LANES = 8  # texels that take their steps side by side: with more, dear models leave the cache

LAST = 0.01
"""Of the decrease that a full step may have left at the end: so much is left after a last step, not evaluated."""

KNOWN = 64  # starts whose linearisation a program takes, or a multiple of that, so that there are few programs


# ---- measurements of texels ----


class Texels(NamedTuple):
    """Measurements of M texels.

    values, variance: (M, N, C), BSDF in 1/sr and the measurement's own variance, enormous for what is omitted. used:
    (M, N, C) bool. wi, wo: (M, N, 3), None where all texels have the directions of the problem. centre, inverse_sd:
    (M, P), of Gaussian priors beside those of the problem, in the unit box; None where there are none.
    """

    values: Any
    variance: Any
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
    def measurements(self) -> Integers:
        """How many of each texel count, (M,)."""
        return np.sum(self.used, axis=(1, 2))


def make_texels(
    values: Floats,
    sigma: Floats | None = None,
    wi: Floats | None = None,
    wo: Floats | None = None,
) -> Texels:
    """Values (M, N, C), with their standard deviations of that shape; what is not finite is omitted, in single
    precision also what is finite only in double.
    """
    largest_number = float(jnp.finfo(jnp.result_type(float)).max)
    used, variance = np.abs(values) <= largest_number, np.zeros(values.shape)
    with np.errstate(over="ignore"):  # squares that can still be added to others
        if sigma is not None:
            used &= np.isfinite(sigma)
            variance = np.minimum(np.square(np.where(used, sigma, 0.0)), 0.25 * largest_number)
        largest = np.max(np.abs(values), initial=0.0, where=used, axis=(1, 2), keepdims=True)
        ignored = np.minimum(np.square(OMITTED * np.where(largest > 0.0, largest, 1.0)), 0.25 * largest_number)
    variance = np.where(used, variance, ignored)
    return Texels(np.where(used, values, 0.0), variance, used, wi, wo)


def model_of(model: Model, row: Texels) -> Model:
    """The model with the measurements of one texel, (N, C), and the priors that it has beside those of the problem."""
    model = eqx.tree_at(lambda m: (m.values, m.variance), model, (row.values, row.variance))
    if row.wi is not None:
        model = eqx.tree_at(lambda m: (m.wi, m.wo), model, (row.wi, row.wo))
    if row.centre is None:
        return model
    # the product of two Gaussians, up to a constant, in the coordinate of `Box.centre`
    box, vector = model.box, model.box.from_unit(row.centre)
    centre = jnp.where(box.logarithmic, jnp.log(jnp.where(box.logarithmic, vector, 1.0)), vector)
    own, other = jnp.square(box.inverse_sd), jnp.square(row.inverse_sd / box.slope(jnp.ones_like(vector)))
    mean = (own * box.centre + other * centre) / jnp.where(own + other > 0.0, own + other, 1.0)
    box = replace(box, centre=mean, inverse_sd=jnp.sqrt(own + other))
    return eqx.tree_at(lambda m: m.box, model, box)


def with_own_directions(problem: Problem) -> Problem:
    """The problem for texels that have directions of their own, of which nothing is known beforehand."""
    return problem.with_model(replace(problem.model, known=None, side="all"))


# ---- fits from a start each ----


class Fits(NamedTuple):
    """What is found of M texels with P parameters.

    vector, unit: physical and in the unit box, (M, P). cost, chi_square: (M,); an infinite cost where there is no
    finite value. converged: (M,) bool. gradient: of the cost in the unit box, (M, P). root: (M, P, P), its root' root
    is the information in the data, in boxes^-2. predicted: (M, N, C), in 1/sr.
    """

    vector: Any
    unit: Any
    cost: Any
    chi_square: Any
    converged: Any
    gradient: Any
    root: Any
    predicted: Any

    @property
    def finite(self) -> Booleans:
        """Which have a value."""
        return np.isfinite(self.cost) & np.all(np.isfinite(self.vector), axis=1)

    def rows(self, places: Any) -> "Fits":
        """Some of the texels."""
        return Fits(*(part[places] for part in self))

    def distinct(self) -> Floats:
        """Where they ended that can be begun from, (K, P): converged ones, or if there are none all that are finite."""
        good = self.finite & self.converged
        vectors = self.vector[good if good.any() else self.finite]
        if not len(vectors):
            raise ValueError("values: no texel of the pilot has a finite fit; are they in 1/sr?")
        return np.unique(vectors, axis=0)

    def improve(self, rows: Integers, other: "Fits") -> None:
        """Take over other fits of these rows where they are lower by more than is left to gain."""
        lower = np.asarray(other.cost < self.cost[rows] - 10.0 * COST_TOLERANCE)
        for mine, theirs in zip(self, other, strict=True):
            mine[rows[lower]] = theirs[lower]


def fit_texels(
    problem: Problem,
    units: Floats,
    texels: Texels,
    size: int,
    *,
    known: Linearisation | None = None,
    which: Integers | None = None,
    fresh: bool = True,
    most_steps: int = MOST_STEPS,
) -> Fits:
    """Fits of M texels by a program for up to `size` of them at a time.

    Args:
        units: where each starts, (M, P), in the unit box.
        known: what the model says at K starts, (K, ...). which: of these, for each texel, (M,).
        fresh: whether starts are far from minima.
        most_steps: with 1 each ends where it begins, and what is known there is found.
    """
    return _run(problem, units, texels, size, size, known, which, fresh, most_steps)[0]


def linearise_at(problem: Problem, units: Floats, size: int) -> Linearisation:
    """What the model says at K points (K, P) of the unit box, by the program that fits: it is compiled already."""
    nothing = make_texels(np.full((1, *problem.model.values.shape), np.nan)).rows(np.zeros(len(units), int))
    return _run(problem, units, nothing, size, min(KNOWN, size), None, None, False, 1)[1]


def to_units(problem: Problem, vectors: Floats) -> Floats:
    """Vectors (..., P) in the unit box."""
    return np.clip(np.asarray(problem.model.box.to_unit(jnp.asarray(vectors)), float), 0.0, 1.0)


def widths(problem: Problem, vectors: Floats) -> Floats:
    """The width of the box in physical units at vectors (..., P)."""
    return np.asarray(problem.model.box.slope(jnp.asarray(vectors)), float)


def standard_errors(problem: Problem, fits: Fits, texels: Texels) -> tuple[Floats, Booleans, Booleans]:
    """As `fits.optimise.uncertainty`, of M fits: standard errors (M, P), NaN where a bound holds the parameter and
    infinite where nothing does; which are at a bound, (M, P); in which texels the data leave a parameter unidentified,
    (M,)."""
    known = (fits.finite & np.isfinite(fits.root).all((1, 2)))[:, None]
    unit_cost = scatter(problem, fits.cost, texels.measurements)[:, None].astype(fits.root.dtype)
    root = np.where(known[..., None], fits.root, 0.0) / np.sqrt(unit_cost)[..., None]
    unidentified = (np.linalg.svd(root, compute_uv=False)[:, -1:] < 1.0 / UNIDENTIFIED_BEYOND) | ~known
    prior = np.asarray(problem.model.box.prior_slopes())
    prior = prior[prior.any(axis=1)]
    prior = np.broadcast_to(prior, (len(root), *prior.shape))
    if texels.inverse_sd is not None:
        prior = np.concatenate([prior, texels.inverse_sd[:, :, None] * np.eye(root.shape[2])], axis=1)
    _, at_bound, _, errors = errors_in_boxes(root, prior, fits.unit, fits.gradient, LEAST_GRADIENT * unit_cost)
    return np.where(known, errors * widths(problem, fits.vector), np.inf), at_bound, unidentified[:, 0]


# ---- the program ----


def _run(
    problem: Problem,
    units: Floats,
    texels: Texels,
    size: int,
    share: int,
    known: Linearisation | None,
    which: Integers | None,
    fresh: bool,
    most_steps: int,
) -> tuple[Fits, Linearisation]:
    """Fits of M texels, so many at a time; and the model where the first `KNOWN` of each share ended."""
    shape, moving, parts = problem.model.values.shape, problem.model.moving, []
    if known is None and texels.wi is None:
        known = Linearisation(np.zeros((1, *shape)), np.zeros((1, moving, *shape)), np.zeros((1, moving)))
    if known is not None:  # few numbers of starts, and of programs for them
        known = Linearisation(*(np.concatenate([one, np.repeat(one[-1:], -len(one) % KNOWN, axis=0)]) for one in known))
    for first in range(0, texels.number, share):
        count = min(share, texels.number - first)
        rows = first + np.minimum(np.arange(-(-size // LANES) * LANES), count - 1)  # the last again is not computed
        number_known, of = (0, np.zeros_like(rows)) if which is None else (count, which[rows])
        numbers = [np.asarray(one) for one in (count, number_known, fresh, most_steps)]
        found = problem.call(_program, units[rows], known, of, texels.rows(rows), *numbers)
        parts.append(jax.tree.map(lambda part, count=count: np.asarray(part)[:count], found))
    return jax.tree.map(lambda *some: np.concatenate(some), *parts)


class _Descent(NamedTuple):
    """A texel on its way.

    rough: whether it goes by `sigma`, (N, C), which is held, as far from the data where levels of noise are free.
    state: of the optimiser, whose auxiliary output is the linearisation at its point. stopped, converged: bool.
    """

    rough: Any
    sigma: Any
    state: State
    stopped: Any
    converged: Any


def _program(
    model: Model,
    units: Array,
    known: Linearisation | None,
    which: Array,
    texels: Texels,
    number: Array,
    number_known: Array,
    fresh: Array,
    most_steps: Array,
) -> tuple[Fits, Linearisation]:
    """Fits of the first `number` of M texels, from starts (M, P), of which so many are known at `which` of `known`."""
    begin, step = partial(_begin, model, fresh), partial(_step, model, fresh, most_steps)
    _, unravel = ravel_pytree(jax.tree.map(jnp.zeros_like, jax.eval_shape(begin, (units[0], texels.rows(0)))))

    def flat(run: _Descent) -> Array:
        return ravel_pytree(run)[0]

    # a row a texel: its start, after the first step where the model is known there
    rows = jax.vmap(lambda row: flat(begin(row)))((units, texels))
    if known is not None:

        def first(row: tuple[Array, Array, Texels]) -> Array:
            there = jax.tree.map(lambda part: part[row[1]], known)
            return flat(step(unravel(row[0]), row[2], there))

        rows = first_mapped(first, (rows, which, texels), number_known, rows)
    rows = jnp.concatenate([rows, rows[-1:]])  # the last is of lanes that have no texel

    # lanes take their steps, and one whose texel has ended the next texel
    def tried(run: _Descent, row: Texels) -> Linearisation:
        return linearise(model_of(model, row), model.box.from_unit(run.state.trial))

    def body(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        following, lanes, runs, rows = carry
        own = jax.tree.map(lambda part: part[jnp.minimum(lanes, len(units) - 1)], texels)
        # as a loop of one turn: all that follows would else compute the model again where it needs a part of it
        said = jax.lax.fori_loop(0, jnp.minimum(number, 1), lambda *_: jax.vmap(tried)(runs, own), nothing)
        runs = jax.vmap(step)(runs, own, said)
        new = jax.vmap(flat)(runs)
        for lane in range(LANES):
            rows = jax.lax.dynamic_update_slice(rows, new[lane][None], (lanes[lane], jnp.zeros_like(lanes[lane])))
        after = following + jnp.cumsum(runs.stopped) - 1
        lanes = jnp.where(runs.stopped, jnp.where(after < number, after, len(units)), lanes)
        next_runs = jax.vmap(unravel)(rows[lanes])  # where a lane resumes, what it has just written
        return following + jnp.sum(runs.stopped), lanes, next_runs, rows

    lanes = jnp.where(jnp.arange(LANES) < number, jnp.arange(LANES), len(units))
    runs = jax.vmap(unravel)(rows[lanes])
    nothing = jax.tree.map(jnp.zeros_like, runs.state.auxiliary)
    carry = jnp.asarray(LANES), lanes, runs, rows
    *_, rows = jax.lax.while_loop(lambda carry: jnp.any(carry[1] < number), body, carry)

    # what is known where they ended
    def result(row: tuple[Array, Texels]) -> Fits:
        return _results(model, unravel(row[0]), row[1])

    ends = (rows[:-1], texels)
    empty = jax.tree.map(jnp.zeros_like, jax.eval_shape(jax.vmap(result), ends))
    return first_mapped(result, ends, number, empty), jax.vmap(lambda row: unravel(row).state.auxiliary)(
        rows[: min(KNOWN, len(units))]
    )


def first_mapped(one: Callable[[Any], Any], rows: Any, number: Array, otherwise: Any) -> Any:
    """What becomes of the first `number` of M rows, (M, ...), `LANES` at a time, and what is `otherwise`, (M, ...)."""
    blocks, out = (jax.tree.map(lambda part: part.reshape(-1, LANES, *part.shape[1:]), of) for of in (rows, otherwise))

    def filled(index: Array, out: Any) -> Any:
        new = jax.vmap(one)(jax.tree.map(lambda part: part[index], blocks))
        return jax.tree.map(lambda whole, part: whole.at[index].set(part), out, new)

    found = jax.lax.fori_loop(0, -(-number // LANES), filled, out)
    return jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), found)


def _begin(model: Model, fresh: Array, start: tuple[Array, Texels]) -> _Descent:
    """A texel at its start (P,), before the first step."""
    unit, own = start[0], model_of(model, start[1])
    levels = model.objective == "likelihood" and model.varying
    state = first_state(unit, jnp.where(fresh, FIRST_DAMPING, NEARBY), own.nothing_known[0])
    sigma, no = own.initial_sigma(model.box.from_unit(unit)) if levels else jnp.zeros(0), jnp.asarray(False)
    return _Descent(fresh & levels, sigma, state, no, no)


def _step(model: Model, fresh: Array, most_steps: Array, run: _Descent, row: Texels, trial: Linearisation) -> _Descent:
    """A texel after a step by what is known of its trial."""
    own = model_of(model, row).linearised([trial])
    likelihood = model.objective == "likelihood"
    levels = likelihood and model.varying
    first_step = (jnp.where(run.rough, run.sigma, jnp.nan), jnp.ones(())) if levels else None

    def residuals(unit: Array) -> tuple[Any, Linearisation, None]:
        return own.linear_parts(model.box.from_unit(unit), first_step)[0], trial, None

    first = run.state.steps == 0
    tolerance, logarithmic = COST_TOLERANCE if likelihood else None, model.logarithmic if levels else ()
    state = step_of(residuals, run.state, tolerance, logarithmic)
    state = replace(state, auxiliary=jax.tree.map(partial(jnp.where, first), trial, state.auxiliary))
    stop = state.ended | (state.steps >= most_steps)
    converged = ~state.failed & (state.ended | ~stop)  # it may still end below

    # the next step is the last if it is a full one, and the decrease of another is too small where decreases go on to
    # shrink as they did (after Hairer and Wanner 1996, IV.8): all is linear on such a short way
    followed = state.full_decrease**2 <= LAST * COST_TOLERANCE * run.state.full_decrease
    full = state.full_decrease - state.predicted <= LAST * COST_TOLERANCE
    last = ~stop & ~run.rough & followed & full & jnp.isfinite(run.state.full_decrease)
    last &= likelihood
    vector = model.box.from_unit(state.trial)
    values = state.auxiliary.predict(model, vector)
    near = state.auxiliary._replace(values=values, at=vector[: model.moving])
    gradient, cost = state.gradient + state.normal @ (state.trial - state.point), state.cost - state.predicted
    after = replace(state, point=state.trial, cost=cost, gradient=gradient, auxiliary=near)
    state = jax.tree.map(partial(jnp.where, last), after, state)
    stop |= last

    if levels:  # near the data with sigma held: the same again with the levels of noise free
        begun = first_state(state.point, jnp.where(fresh, FIRST_DAMPING, NEARBY), state.auxiliary)
        state = jax.tree.map(partial(jnp.where, stop & run.rough), begun, state)
    return _Descent(run.rough & ~stop, run.sigma, state, stop & ~run.rough, converged & jnp.isfinite(state.cost))


def _results(model: Model, run: _Descent, row: Texels) -> Fits:
    """What is known where a texel ended."""
    own, unit, cost = model_of(model, row), run.state.point, run.state.cost
    vector, predicted, finite = model.box.from_unit(unit), run.state.auxiliary.values, jnp.isfinite(cost)
    near = own.linearised([run.state.auxiliary])
    rows = jax.jacfwd(lambda unit: near.linear_parts(model.box.from_unit(unit))[1][1])(unit)
    misfit = jnp.where(row.used, own.standardised_at(vector, predicted), 0.0)
    return Fits(
        vector=vector,
        unit=unit,
        cost=jnp.where(finite, cost, jnp.inf),
        chi_square=jnp.sum(misfit**2),
        converged=run.converged & finite,
        gradient=run.state.gradient,
        # R of the QR decomposition has its singular values without squaring its condition number
        root=jnp.linalg.qr(rows, mode="r"),
        predicted=jnp.where(finite, predicted, jnp.nan),
    )
