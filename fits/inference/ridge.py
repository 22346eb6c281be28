"""The ridge of a posterior along which the data leave parameters open: points all along it, however it bends.

Points are compared in log-odds of the box, which run on linearly next to a bound, so that there is a slope on it.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from fits.inference.identifiability import square
from fits.inference.uncertainty import local_information
from fits.problem.problem import Problem

OPEN = 0.1  # boxes: a posterior that is wider may bend
STEP = 0.5  # along a ridge, for every direction that is open
CLOSE = 0.5  # of a step: points that lie closer are the same
MOST_POINTS = 128
AS_HIGH = 12.0  # in the log-posterior: points that lie lower are left out
NEXT_TO_BOUND = 0.02  # of the box
ROUNDS = 5
ON_RIDGE = 0.1  # standard deviations
TINY = 1e-300

Floats = NDArray[np.float64]


def ridge(problem: Problem, optimum: Floats, free: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Points (M, P) of the unit box that do nearly as well as the optimum (P,), itself the first.

    That one alone where no direction is open. From every point steps are taken along the directions that are open
    there, and brought back to where the data want them, until the ridge is full. free: (P,) bool, the others stay. Also
    rows of information (M, rows, P), which keep what is open at a point from reaching beyond the next.
    """
    dimension = len(open_directions(problem, optimum, free))
    if not dimension:
        return optimum[None], np.zeros((1, 0, len(optimum)))
    step, lowest = STEP * dimension, height(problem, optimum) - AS_HIGH
    found, turn = [_place(optimum)], 0
    tangents = [_across(problem, found[0], free, dimension)[2]]
    while turn < len(found) < MOST_POINTS:
        for move in np.concatenate([tangents[turn], -tangents[turn]]) * step:
            ahead = _moved(found[turn], free, move)
            if _distance(ahead, found) < CLOSE * step:
                continue
            reached, tangent = _brought_back(problem, ahead, free, dimension, step)
            if _distance(reached, found) > CLOSE * step and height(problem, _unit(reached)) > lowest:
                found.append(reached)
                tangents.append(tangent)
        turn += 1
    points, bounds = np.stack([_unit(place) for place in found]), np.zeros((len(found), dimension, len(optimum)))
    bounds[:, :, free] = np.stack([rows / _stretch(point[free]) for rows, point in zip(tangents, points, strict=True)])
    return points, bounds / step


def open_directions(problem: Problem, optimum: Floats, free: NDArray[np.bool_]) -> Floats:
    """Directions in the box, (number, F), in which the posterior is wide at the optimum (P,)."""
    rows = local_information(problem, optimum)[0][:, free]
    _, values, directions = np.linalg.svd(square(rows))
    return directions[values * OPEN < 1.0]


def _brought_back(
    problem: Problem, place: Floats, free: NDArray[np.bool_], dimension: int, step: float
) -> tuple[Floats, Floats]:
    """The place of least cost across the ridge, by Gauss and Newton's steps; and the directions along it there."""
    for _ in range(ROUNDS):
        across, values, tangent, slope = _across(problem, place, free, dimension)
        deviations = slope / values  # from the least cost, in standard deviations
        move = -(deviations / values) @ across
        place = _moved(place, free, move * min(1.0, step / max(float(np.linalg.norm(move)), TINY)))
        if np.linalg.norm(deviations) < ON_RIDGE:
            break
    return place, tangent


def _across(
    problem: Problem, place: Floats, free: NDArray[np.bool_], dimension: int
) -> tuple[Floats, Floats, Floats, Floats]:
    """Directions across the ridge (F - dimension, F), inverse deviations along them, directions along it, slopes."""
    unit = _unit(place)
    rows, gradient, _ = local_information(problem, unit)
    along = _stretch(unit[free])
    _, values, directions = np.linalg.svd(square(rows[:, free] * along))
    across = directions[:-dimension]
    return across, np.maximum(values[:-dimension], TINY), directions[-dimension:], across @ (gradient[free] * along)


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


def height(problem: Problem, unit: Floats) -> float:
    """Log-posterior at a point of the unit box."""
    return -local_information(problem, unit)[2]


def _distance(place: Floats, places: list[Floats]) -> float:
    return float(np.min(np.linalg.norm(np.stack(places) - place, axis=-1)))
