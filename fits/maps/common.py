"""Parameters that all texels of a map have in common: found from the pilot texels together, and held from then on.

The information of all texels about all parameters has the form of an arrow: what is a texel's own is eliminated texel
by texel (a Schur complement), and a Gauss-Newton step of what is common solves a system of its size (variable
projection, Golub and Pereyra 1973).
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fits.data.geometry import Floats, Integers
from fits.maps.options import MapOptions
from fits.maps.search import fit_first, fit_pilot_texels
from fits.maps.texels import Fits, Texels, fit_texels, widths, with_own_directions
from fits.optimise.multi_start import start_points
from fits.optimise.uncertainty import LARGEST_ERROR, UNKNOWN_BEYOND, held_by_bounds
from fits.problem.parameters import is_free
from fits.problem.problem import Problem, unit

MOST_ROUNDS, HALVINGS = 30, 8  # Gauss-Newton steps, and how often one that does not help is halved

CLOSE = 0.01  # standard errors that a last step may be long


def with_common(problem: Problem, values: Mapping[str, float]) -> Problem:
    """The problem with its common parameters held at these values, an array where a number a channel was free."""
    parts = (problem.stack, problem.scale, problem.noise.relative, problem.noise.floor)
    leaves, structure = jax.tree.flatten(parts, is_leaf=is_free)
    names = iter(name for name in problem.names if not name.startswith("instrument."))
    for place, leaf in enumerate(leaves):
        if is_free(leaf):
            own = [next(names) for _ in range(leaf.arrays()[0].size)]
            if leaf.same_for_all_texels:
                leaves[place] = jnp.asarray(np.reshape([values[name] for name in own], leaf.shape))
    stack, *rest = jax.tree.unflatten(structure, leaves)
    scale, relative, floor = (one if one is None or is_free(one) else float(one) for one in rest)
    return replace(problem, stack=stack, scale=scale, noise=replace(problem.noise, relative=relative, floor=floor))


def fit_common(problem: Problem, pilot: Texels, options: MapOptions) -> dict[str, dict[str, Any]]:
    """The common parameters where they suit the whole pilot best: by name their `value`, `error` (NaN at a bound,
    infinite where the pilot says nothing), `unit`, and whether the joint fit `converged`.

    problem: with `Free` numbers that are common, and others that are not; with the model of a map.
    """
    size, is_common = options.chunk_size, np.isin(problem.names, problem.common_names)
    places, own = np.flatnonzero(is_common), np.flatnonzero(~is_common)

    def vector_at(at: Floats) -> Floats:
        unit = np.full(len(problem.names), 0.5)
        unit[places] = at
        return np.asarray(problem.model.box.from_unit(jnp.asarray(unit)), float)

    def held_at(at: Floats) -> Problem:
        vector = vector_at(at)
        held = with_common(problem, {problem.names[place]: float(vector[place]) for place in places})
        return with_own_directions(held) if pilot.wi is not None else held

    # begin at the mean of what a few texels say of them, weighted by their information
    points = start_points(problem, options.starts, options.seed)
    first = fit_first(problem, points, pilot, size)
    information = np.sum(np.square(first.root), axis=1)[:, places]
    at = np.average(first.unit[:, places], axis=0, weights=information + np.finfo(float).tiny)
    held = held_at(at)
    fits = fit_pilot_texels(held, points[:, own], pilot, options)
    pilot, units = pilot.rows(fits.finite), fits.unit[fits.finite]

    def joint_at(at: Floats, units: Floats) -> tuple[float, Floats, Floats]:
        whole = np.empty((pilot.number, len(problem.names)))
        whole[:, places], whole[:, own] = at, units
        found = fit_texels(problem, whole, pilot, size, fresh=False, most_steps=1)
        cost, gradient, information = eliminated(problem, places, own, found)
        return cost, *newton_step(at, gradient, information)

    # Gauss-Newton steps, the texels following each of them
    (cost, step, error), converged = joint_at(at, units), False
    for _ in range(MOST_ROUNDS):
        if converged := bool(np.all(np.abs(step) <= np.nan_to_num(CLOSE * error))):
            break
        for halving in range(HALVINGS):
            trial = np.clip(at + 0.5**halving * step, 0.0, 1.0)
            followed = fit_texels(held_at(trial), units, pilot, size, fresh=False).unit
            tried = joint_at(trial, followed)
            if tried[0] < cost:
                break
        else:
            converged = bool(np.all(np.abs(step) <= np.nan_to_num(error)))  # rounding ends all progress
            break
        at, units, (cost, step, error) = trial, followed, tried
    vector = vector_at(at)
    errors = error * widths(problem, vector)[places]
    return {
        name: {"value": float(vector[place]), "error": float(one), "unit": unit(name), "converged": converged}
        for name, place, one in zip(problem.common_names, places, errors, strict=True)
    }


def newton_step(at: Floats, gradient: Floats, information: Floats) -> tuple[Floats, Floats]:
    """A Gauss-Newton step of S common parameters and their standard errors, in boxes: 0 and NaN for what a bound holds,
    0 and infinite for what the data do not know."""
    free = np.flatnonzero(~held_by_bounds(at, gradient))
    step, error = np.zeros(len(at)), np.full(len(at), np.nan)
    if free.size:
        sizes, directions = np.linalg.eigh(information[np.ix_(free, free)])
        known = sizes > np.finfo(float).eps * free.size * max(sizes[-1], 0.0)
        spread = np.where(known, 1.0 / np.sqrt(np.where(known, sizes, 1.0)), LARGEST_ERROR)
        step[free] = -directions @ (np.where(known, spread**2, 0.0) * (directions.T @ gradient[free]))
        lengths = np.linalg.norm(directions * spread, axis=1)
        error[free] = np.where(lengths > UNKNOWN_BEYOND, np.inf, lengths)
    return step, error


def eliminated(problem: Problem, places: Integers, rest: Integers, fits: Fits) -> tuple[float, Floats, Floats]:
    """What M texels say together of S common parameters, with those that are a texel's own free: cost, gradient (S,)
    and information (S, S), in the unit box."""
    box, count, gradient = problem.model.box, len(fits.cost), np.array(fits.gradient)
    # a prior of common parameters counts once in all, and not once a texel
    slopes = np.array(box.prior_slopes(), float)
    residual = np.asarray(box.prior_residuals(jnp.asarray(fits.vector[0])), float)
    of_common = np.abs(slopes[:, places]).sum(axis=1) > 0
    gradient[:, places] -= (count - 1) / count * slopes[of_common][:, places].T @ residual[of_common]
    cost = float(fits.cost.sum()) - (count - 1) * 0.5 * float(residual[of_common] @ residual[of_common])
    slopes[of_common] /= np.sqrt(count)
    information = np.einsum("mki,mkj->mij", fits.root, fits.root) + slopes.T @ slopes
    # the Schur complement, texel by texel
    held = held_by_bounds(fits.unit[:, rest], gradient[:, rest])
    inner = np.where(held[:, :, None] | held[:, None, :], 0.0, information[:, rest[:, None], rest])
    across = np.where(held[:, :, None], 0.0, information[:, rest[:, None], places])
    slope = np.where(held, 0.0, gradient[:, rest])
    solved = np.linalg.pinv(inner, hermitian=True) @ np.concatenate([across, slope[:, :, None]], axis=2)
    reduced = np.einsum("mis,mit->st", across, solved[:, :, :-1])
    whole = information[:, places[:, None], places].sum(axis=0)
    return cost, gradient[:, places].sum(axis=0) - np.einsum("mis,mi->s", across, solved[:, :, -1]), whole - reduced
