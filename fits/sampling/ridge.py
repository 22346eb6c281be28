"""The ridge of a posterior along which parameters are unidentified: points all along it, however it bends.

Points are compared in log-odds of the box, which run on linearly next to a bound, so that there is a slope on it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from fits.data.geometry import Floats
from fits.optimise.uncertainty import local_information, square
from fits.problem.compilation import on_all_cores
from fits.problem.problem import Problem

OPEN = 0.1  # boxes: a posterior that is wider may bend
STEP = 0.5  # along a ridge, for every direction that is open
CLOSE = 0.5  # of a step: points that lie closer are the same
MOST_POINTS = 64
AS_HIGH = 12.0  # in the log-posterior: points that lie lower are omitted
NEXT_TO_BOUND = 0.02  # of the box
ROUNDS = 5
ON_RIDGE = 0.1  # standard deviations
TINY = 1e-300


class Ridge(NamedTuple):
    """Points of a ridge, (M, P), of the unit box; rows of information there, (M, R, P), in boxes^-1; and more of them,
    (M, D, P), which bound the D directions that are open at the next point."""

    points: Floats
    rows: Floats
    bounds: Floats


class _Known(NamedTuple):
    """A place, in log-odds, with rows of information there, and the gradient of the cost and itself."""

    place: Floats
    rows: Floats
    gradient: Floats
    cost: float

    @classmethod
    def at(cls, problem: Problem, place: Floats) -> "_Known":
        return cls(place, *local_information(problem, _unit(place)))


def ridge(problem: Problem, optimum: Floats, free: NDArray[np.bool_]) -> Ridge:
    """Points of the unit box that do nearly as well as the optimum (P,), which is the first, or alone without an open
    direction. free: (P,) bool, the others stay.

    From every point steps are taken along the directions that are open there, and brought back to where the data want
    them, until the ridge is full.
    """
    best = _Known.at(problem, _place(optimum))
    dimension = len(open_directions(best.rows[:, free]))
    step = STEP * dimension
    found, turn = [best], 0
    tangents = [_axes(best, free, dimension)[2]]
    while dimension and turn < len(found) < MOST_POINTS:
        moves = np.concatenate([tangents[turn], -tangents[turn]]) * step
        ahead = [_moved(found[turn].place, free, move) for move in moves]
        fresh = [place for place in ahead if _distance(place, found) >= CLOSE * step]
        back = on_all_cores(lambda place: _brought_back(problem, place, free, dimension, step), fresh)
        for reached, tangent in back:
            if _distance(reached.place, found) > CLOSE * step and reached.cost < best.cost + AS_HIGH:
                found.append(reached)
                tangents.append(tangent)
        turn += 1
    points = np.stack([optimum, *(_unit(known.place) for known in found[1:])])
    bounds = np.zeros((len(found), dimension, len(optimum)))
    if dimension:
        bounds[:, :, free] = np.stack(tangents) / (_stretch(points[:, free])[:, None] * step)
    return Ridge(points, np.stack([known.rows for known in found]), bounds)


def open_directions(rows: Floats) -> Floats:
    """Directions in the box, (number, F), in which a posterior with these rows of information (R, F) is wide."""
    _, values, directions = np.linalg.svd(square(rows))
    return directions[values * OPEN < 1.0]


def _brought_back(
    problem: Problem, place: Floats, free: NDArray[np.bool_], dimension: int, step: float
) -> tuple[_Known, Floats]:
    """The place of least cost across the ridge, by Gauss and Newton's steps; and the directions along it there."""
    known = _Known.at(problem, place)
    for _ in range(ROUNDS):
        if not np.isfinite(known.cost):
            break
        across, inverse_deviations, along = _axes(known, free, dimension)
        slope = across @ (known.gradient[free] * _stretch(_unit(known.place)[free]))
        deviations = slope / inverse_deviations  # from the least cost, in standard deviations
        if np.linalg.norm(deviations) < ON_RIDGE:
            return known, along
        move = -(deviations / inverse_deviations) @ across
        longest = step / max(float(np.linalg.norm(move)), TINY)
        known = _Known.at(problem, _moved(known.place, free, move * min(1.0, longest)))
    return known, _axes(known, free, dimension)[2] if np.isfinite(known.cost) else np.empty((0, int(free.sum())))


def _axes(known: _Known, free: NDArray[np.bool_], dimension: int) -> tuple[Floats, Floats, Floats]:
    """Directions across the ridge (., F), their inverse standard deviations (.,), and directions along it."""
    _, values, directions = np.linalg.svd(square(known.rows[:, free] * _stretch(_unit(known.place)[free])))
    open_from = len(values) - dimension
    return directions[:open_from], np.maximum(values[:open_from], TINY), directions[open_from:]


def _moved(place: Floats, free: NDArray[np.bool_], move: Floats) -> Floats:
    moved = place.copy()
    moved[free] += move
    return np.clip(moved, _place(np.zeros_like(place)), _place(np.ones_like(place)))


def _stretch(unit: Floats) -> Floats:
    """d box / d log-odds, which is the same all the way next to a bound."""
    inner = np.clip(unit, NEXT_TO_BOUND, 1.0 - NEXT_TO_BOUND)
    return inner * (1.0 - inner)


def _place(unit: Floats) -> Floats:
    inner = np.clip(unit, NEXT_TO_BOUND, 1.0 - NEXT_TO_BOUND)
    return logit(inner) + (unit - inner) / (inner * (1.0 - inner))


def _unit(place: Floats) -> Floats:
    edge = logit(NEXT_TO_BOUND)
    inner = np.clip(place, edge, -edge)
    return np.clip(expit(inner) + (place - inner) * NEXT_TO_BOUND * (1.0 - NEXT_TO_BOUND), 0.0, 1.0)


def _distance(place: Floats, points: list[_Known]) -> float:
    return float(min(np.linalg.norm(known.place - place) for known in points))
