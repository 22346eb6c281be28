"""Which combinations of parameters the data cannot separate, from their Fisher information A'A at an optimum.

With one column of A a parameter in units of its box, a singular value s of A says that the parameters can move by 1 / s
of their boxes along its direction before the fit worsens by one standard deviation. Neither priors nor bounds count
here: they may hold a parameter that the data do not. It is a statement about small changes: along a curved valley the
direction turns.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

UNIDENTIFIED_BEYOND = 0.1  # boxes: a direction with a larger standard error is not resolved
UNCONSTRAINED_BEYOND = 1.0  # boxes: nor is this one held within its bounds
UNKNOWN_BEYOND = 1e3  # boxes: a larger error is reported as infinite
LARGEST_ERROR = 1e9  # boxes: stands for all larger ones, so that squares of it can be formed
CERTAIN_MEMBER = 0.05  # weight from which a parameter belongs to a direction
MEMBER, OWED = 0.01, 0.25  # weight from which it does so if it owes the direction this share of its variance

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Direction:
    """A direction in the space of parameters that the data do not identify: only its members' other combinations are.

    Attributes:
        error: standard error along the direction from the data alone, in boxes; infinite where they say nothing.
        weights: of its members by name, in units of their boxes, largest first; their squares add up to about 1.
        conditional_errors: of each member, with all other parameters known, in physical units.
    """

    error: float
    weights: dict[str, float]
    conditional_errors: dict[str, float]

    def error_of(self, name: str) -> float:
        """Standard error that one parameter has along it, in boxes; 0 where it is no member."""
        return abs(self.weights[name]) * self.error if name in self.weights else 0.0

    def renamed(self, names: Mapping[str, str]) -> "Direction":
        """The same direction with those of its members that have other names, under these."""
        weights, errors = (
            {names[name]: value for name, value in part.items() if name in names}
            for part in (self.weights, self.conditional_errors)
        )
        return replace(self, weights=weights, conditional_errors=errors)

    @property
    def unconstrained(self) -> bool:
        """Whether one standard error along it crosses the whole box: only bounds and priors decide there."""
        return self.error > UNCONSTRAINED_BEYOND


def unidentified_directions(root: Floats, names: tuple[str, ...], width: Floats) -> tuple[Direction, ...]:
    """Directions known to no better than a tenth of the box, worst first.

    root: rows A of the data alone, (rows, P), in units of the boxes. width: of the boxes, (P,), in physical units.
    Members are the parameters that move along a direction by more than a twentieth of its length, or a hundredth where
    they owe it a quarter of their variance (Belsley, Kuh and Welsch 1980, variance proportions).
    """
    _, values, directions = np.linalg.svd(square(root))
    errors = 1.0 / floored(values)
    variance = (directions * errors[:, None]) ** 2
    share = variance / np.sum(variance, axis=0)
    lengths = np.linalg.norm(root, axis=0)
    alone = np.divide(width, lengths, out=np.full(len(names), math.inf), where=lengths > 0)
    found = []
    for error, direction, owed in zip(errors[::-1], directions[::-1], share[::-1], strict=True):
        if error <= UNIDENTIFIED_BEYOND:
            break
        direction = direction * np.sign(direction[np.argmax(np.abs(direction))])
        members = [
            index
            for index in np.argsort(-np.abs(direction), kind="stable")
            if abs(direction[index]) > (MEMBER if owed[index] > OWED else CERTAIN_MEMBER)
        ]
        found.append(
            Direction(
                error=float(error) if error < UNKNOWN_BEYOND else math.inf,
                weights={names[index]: float(direction[index]) for index in members},
                conditional_errors={names[index]: float(alone[index]) for index in members},
            )
        )
    return tuple(found)


def floored(values: Floats) -> Floats:
    """Singular values, those lost in rounding as the smallest that are not: their inverses are large, never wrong."""
    return np.maximum(values, np.maximum(np.finfo(float).eps * len(values) * values[0], 1.0 / LARGEST_ERROR))


def insensitive(root: Floats, names: tuple[str, ...]) -> tuple[str, ...]:
    """Parameters that the data say nothing about, whatever is known of the others: their columns of A are all but 0."""
    lengths = np.linalg.norm(root, axis=0)
    return tuple(name for name, length in zip(names, lengths, strict=True) if length * UNKNOWN_BEYOND < 1.0)


def square(root: Floats) -> Floats:
    """Zero rows below a matrix with fewer rows than columns, so that every direction has its singular value."""
    missing = max(root.shape[1] - root.shape[0], 0)
    return np.vstack([root, np.zeros((missing, root.shape[1]))])
