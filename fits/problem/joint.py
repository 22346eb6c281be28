"""Several data sets with parameters in common: one likelihood, the product of theirs."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from fits.names import Objective
from fits.problem.model import Density, Model
from fits.problem.parameters import Box
from fits.problem.problem import Assembled, FittingProblem, Floats, Problem

OF_EACH = tuple(field for field in Box.__dataclass_fields__ if field != "between")
"""What a box holds of each parameter."""


class JointParts(NamedTuple):
    """What a vector makes of each data set, by its name: stacks, and calibration factors."""

    stack: dict[str, Any]
    scale: dict[str, Any]


class JointModel(Density):
    """The density of several data sets, one after the other, (N, 1): the product of theirs.

    Attributes:
        parts: the densities of the data sets.
        own: for each of them, the places of its parameters in the vector.
        box: bounds and priors of the P parameters.
    """

    parts: tuple[Model, ...]
    box: Box
    own: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    varying: bool = eqx.field(static=True)

    @property
    def objective(self) -> Objective:
        """Data sets are weighed against each other by their noise."""
        return "likelihood"

    @property
    def values(self) -> Array:
        """BSDF of all measurements, (N, 1), in 1/sr."""
        return _column([part.values for part in self.parts])

    @property
    def logarithmic(self) -> tuple[int, ...]:
        """See `Density`."""
        return (2,) if any(part.logarithmic for part in self.parts) else ()

    def vectors(self, vector: Array) -> list[Array]:
        """The parameters of each data set."""
        return [vector[np.array(own)] for own in self.own]

    def predict(self, vector: Array) -> Array:
        """See `Density`."""
        return _column([part.predict(own) for part, own in zip(self.parts, self.vectors(vector), strict=True)])

    def initial_sigma(self, vector: Array) -> Array:
        """See `Density`."""
        return _column([part.initial_sigma(own) for part, own in zip(self.parts, self.vectors(vector), strict=True)])

    def sigma_at(self, vector: Array, predicted: Array) -> Array:
        """See `Density`."""
        return _column(self._each(Model.sigma_at, vector, predicted))

    def offsets_at(self, vector: Array, predicted: Array) -> Array:
        """See `Density`."""
        return _column(self._each(Model.offsets_at, vector, predicted))

    def offsets_after_discrepancy_at(self, vector: Array, predicted: Array) -> Array:
        """See `Density`."""
        return _column(self._each(Model.offsets_after_discrepancy_at, vector, predicted))

    def whitened_residuals_at(self, vector: Array, predicted: Array) -> Array:
        """See `Density`."""
        return _column(self._each(Model.whitened_residuals_at, vector, predicted))

    def log_likelihood_per_datum_at(self, vector: Array, predicted: Array) -> Array:
        """See `Density`."""
        return _column(self._each(Model.log_likelihood_per_datum_at, vector, predicted))

    def chi_square_at(self, vector: Array, predicted: Array) -> Array:
        """See `Density`."""
        return jnp.sum(jnp.stack(self._each(Model.chi_square_at, vector, predicted)))

    def log_likelihood_at(self, vector: Array, predicted: Array) -> Array:
        """See `Density`."""
        return jnp.sum(jnp.stack(self._each(Model.log_likelihood_at, vector, predicted)))

    def residuals_at(self, vector: Array, predicted: Array) -> tuple[Array, ...]:
        """See `Density`."""
        return self._together(vector, self._each(Model.residuals_at, vector, predicted))

    def linear_parts(
        self, vector: Array, first_step: tuple[Array, Array] | None = None
    ) -> tuple[tuple[Array, ...], tuple[Array, Array]]:
        """See `Density`; each data set is differentiated by its own parameters alone."""
        steps: Sequence[tuple[Array, Array] | None] = [None] * len(self.parts)
        if first_step is not None:
            held, shared = first_step
            sigmas = [held] * len(self.parts) if held.size == 1 else self._split(held)
            steps = [(sigma, shared) for sigma in sigmas]
        residuals, predicted, rows = [], [], []
        for part, own, step in zip(self.parts, self.vectors(vector), steps, strict=True):
            found, (values, information) = part.linear_parts(own, step, others=True)
            residuals.append(found)
            predicted.append(values)
            rows.append(information)
        return self._together(vector, residuals), (_column(predicted), jnp.concatenate(rows))

    def _together(self, vector: Array, found: Sequence[tuple[Array, ...]]) -> tuple[Array, ...]:
        """Residuals of the data sets as those of all: data, prior, levels of noise."""
        levels = [level.reshape(-1) for _, _, *levels in found for level in levels]
        data = jnp.concatenate([residuals[0].reshape(-1) for residuals in found])
        return (data, self.box.prior_residuals(vector), *([jnp.concatenate(levels)] if levels else []))

    def _split(self, column: Array) -> list[Array]:
        """What of a column (N, 1) belongs to each data set, in the shape of its values."""
        shapes = [part.values.shape for part in self.parts]
        split = jnp.split(column[:, 0], np.cumsum([math.prod(shape) for shape in shapes])[:-1])
        return [share.reshape(shape) for share, shape in zip(split, shapes, strict=True)]

    def _each(self, function: Callable[[Model, Array, Array], Any], vector: Array, predicted: Array) -> list[Any]:
        """What a function says of each data set."""
        return [
            function(part, own, share)
            for part, own, share in zip(self.parts, self.vectors(vector), self._split(predicted), strict=True)
        ]


class Joint(FittingProblem):
    """Data sets that are fitted together, each a `Problem` of its own, with parameters in common.

    It stands in the place of a stack and its data: `fits.fit(fits.Joint({...}, shared=[...]))`. What is found of one
    data set is `Fit.part(name)`, and `Posterior.part(name)`.

    Args:
        parts: the problems by name, two or more, each with a likelihood.
        shared: names of parameters that are one in all problems: ``layers[0].ior``, or how names begin, such as
            ``layers[0]`` for all that is free in that layer. Bounds and priors must agree; they start as in the first.
            The others are named after their problem, ``plane.scale``.

    Raises:
        ValueError: fewer than two problems, a named objective, a shared name that is not in every problem, or free
            parameters of one name that differ.
    """

    objective: Objective = "likelihood"

    def __init__(self, parts: Mapping[str, Problem], shared: Sequence[str] = ()):
        self.parts, self.shared = dict(parts), tuple([shared] if isinstance(shared, str) else shared)
        if len(self.parts) < 2:
            raise ValueError(f"Joint.parts is {list(self.parts)}; it must name at least two problems")
        for name, problem in self.parts.items():
            if problem.objective != "likelihood":
                raise ValueError(f"Joint.parts[{name!r}].objective is {problem.objective!r}; it must be 'likelihood'")
        _ = self._assembled

    @cached_property
    def _assembled(self) -> Assembled:
        self._require_common()
        names, own = self._common, []
        for part, problem in self.parts.items():
            places = []
            for name in problem.names:
                if not self._is_shared(name):
                    names.append(f"{part}.{name}")
                places.append(names.index(name) if self._is_shared(name) else len(names) - 1)
            own.append(tuple(places))
        models = tuple(problem.model for problem in self.parts.values())
        varying = any(one.varying for one in models)
        start, low, high = (
            _gathered(len(names), own, [getattr(problem, bound) for problem in self.parts.values()])
            for bound in ("start", "low", "high")
        )
        box = Box(
            **{
                field: jnp.asarray(_gathered(len(names), own, [np.asarray(getattr(m.box, field)) for m in models]))
                for field in OF_EACH
            },
            between=jnp.asarray(_steps(len(names), own, [np.asarray(m.box.between) for m in models])),
        )
        return Assembled(
            tuple(names), start, low, high, JointModel(parts=models, box=box, own=tuple(own), varying=varying)
        )

    @property
    def model(self) -> JointModel:
        """All data sets as pure functions of the physical vector (P,)."""
        return self._assembled.model

    @property
    def units(self) -> dict[str, str]:
        """Unit of each parameter; "1" for plain ratios."""
        found = dict.fromkeys(self.names, "1")
        for part, problem in self.parts.items():
            for place, unit in zip(self.places(part), problem.units.values(), strict=True):
                found[self.names[place]] = unit
        return found

    def places(self, part: str) -> tuple[int, ...]:
        """Where the parameters of one data set stand in the vector."""
        if part not in self.parts:
            raise ValueError(f"part {part!r} is not one of {', '.join(self.parts)}")
        return self.model.own[list(self.parts).index(part)]

    def build(self, vector: ArrayLike) -> JointParts:
        """Stacks and scales with the physical vector (P,)."""
        vector = np.asarray(vector)
        built = {name: problem.build(vector[list(self.places(name))]) for name, problem in self.parts.items()}
        stacks, scales = ({name: one[k] for name, one in built.items()} for k in range(2))
        return JointParts(stacks, scales)

    @property
    def problems(self) -> dict[str, Problem]:
        """`parts`."""
        return self.parts

    def shares(self, predicted: Floats) -> dict[str, Floats]:
        """What `predict` gives of each data set, in the shape of its data."""
        shapes = [problem.model.values.shape for problem in self.parts.values()]
        split = np.split(predicted[:, 0], np.cumsum([math.prod(shape) for shape in shapes])[:-1])
        return {name: part.reshape(shape) for name, part, shape in zip(self.parts, split, shapes, strict=True)}

    def with_problems(self, changed: Mapping[str, Problem]) -> "Joint":
        """The same with other problems in the place of those of the same names; what is new in them is not shared."""
        return Joint({**self.parts, **changed}, self._common) if changed else self

    def __getattr__(self, name: str) -> Any:
        if name in {one.name for one in fields(Problem)}:
            raise AttributeError(f"Joint has no {name}: each of its parts has one; ask of Fit.part(name)")
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    @property
    def _common(self) -> list[str]:
        return [name for name in next(iter(self.parts.values())).names if self._is_shared(name)]

    def _is_shared(self, name: str) -> bool:
        return any(_begins(name, one) for one in self.shared)

    def _require_common(self) -> None:
        """Refuse shared names that are not in every problem, or not the same there."""
        for one in self.shared:
            sets = {
                part: {name for name in problem.names if _begins(name, one)} for part, problem in self.parts.items()
            }
            every = set.union(*sets.values())
            if not every:
                raise ValueError(f"Joint.shared: no problem has a free parameter {one!r}")
            for part, names in sets.items():
                if names != every:
                    missing = ", ".join(sorted(every - names))
                    raise ValueError(f"Joint.shared: {missing} is not free in {part!r}; it must be in every problem")
        first, *others = self.parts.items()
        for name in filter(self._is_shared, first[1].names):
            for part, problem in others:
                if not _same(first[1], problem, name):
                    raise ValueError(
                        f"Joint.shared: {name} has other bounds or another prior in {part!r} than in {first[0]!r}"
                    )


def _begins(name: str, with_: str) -> bool:
    """Whether a parameter's name is this, or that of a part of it."""
    return name == with_ or name.startswith((f"{with_}.", f"{with_}["))


def _same(one: Problem, other: Problem, name: str) -> bool:
    """Whether a parameter has the same bounds and prior in both."""
    i, j = one.names.index(name), other.names.index(name)
    mine, theirs = one.model.box, other.model.box
    first, second = (np.asarray(box.between[:, place]) for box, place in ((mine, i), (theirs, j)))
    return np.array_equal(first[first != 0.0], second[second != 0.0]) and all(
        math.isclose(float(getattr(mine, field)[i]), float(getattr(theirs, field)[j]), rel_tol=1e-12)
        for field in OF_EACH
    )


def _gathered(count: int, own: Sequence[Sequence[int]], parts: Sequence[np.ndarray]) -> Floats:
    """What each data set has of its parameters, at their places in the vector; of shared ones, of the first."""
    found = np.zeros(count, parts[0].dtype)
    for places, values in reversed(list(zip(own, parts, strict=True))):
        found[list(places)] = values
    return found


def _steps(count: int, own: Sequence[Sequence[int]], parts: Sequence[np.ndarray]) -> Floats:
    """Differences between neighbouring channels of all data sets, (Q, count); of shared ones once."""
    found: list[Floats] = []
    for places, rows in zip(own, parts, strict=True):
        for row in rows:
            whole = np.zeros(count)
            whole[list(places)] = row
            if not any(np.array_equal(whole, one) for one in found):
                found.append(whole)
    return np.array(found).reshape(-1, count)


def _column(parts: Sequence[Array]) -> Array:
    return jnp.concatenate([part.reshape(-1) for part in parts])[:, None]
