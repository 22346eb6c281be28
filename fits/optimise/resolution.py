"""How finely a fit solves its stack and its instrument's cones: as finely as the noise of the data asks for.

A resolution that is left open is that of the start values where starts run, but no finer than is useful far away from
the data. At the optimum it is compared with finer ones, by values alone, until they agree to a tenth of the noise: only
then are the minima that may be the best, or as good as it, fitted again, as programs of a finer resolution take seconds
to compile. A resolution that is given is compared with a finer one, and stays. The rays of cones follow from the lobe.
"""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

import layerjax as lj
from fits.data.geometry import Floats
from fits.optimise.levenberg_marquardt import Descent
from fits.optimise.multi_start import Optimum, polish, rough_descent, unit_of
from fits.optimise.options import FitOptions
from fits.problem.apertures import ring_counts
from fits.problem.instrument import Instrument
from fits.problem.model import Model
from fits.problem.problem import FittingProblem, Problem
from fits.progress import Progress
from layerjax.mixture import stacks_of
from layerjax.preparation import transport_for
from layerjax.transport.adding_doubling.resolution import is_tilted

# the finest resolution of starts, and their most rings of a cone: finer ones cost more than they tell far from the data
FAR, FAR_RINGS = {"nodes": 12, "modes": 16, "ordinates": (8, 12)}, 2
FINEST_NODES, FINEST_MODES, FINEST_COSINES = 48, 96, 16  # what is chosen at most
MINOR_SHARE = 0.5  # of the numerical error that is allowed: left to nodes or modes where the other has to be finer
LEAST_SCATTER = 0.01  # of the data's root mean square: less scatter about a named objective counts as this
SAME_OUTCOME = 0.01  # of the box: ends that are closer in every parameter are fitted again as one
MOST_MINIMA = 8  # that are fitted again


# ---- of the transport ----


@dataclass(frozen=True, eq=False)
class Resolutions:
    """The resolutions that a transport may take for a problem.

    stated: the transport, as far as it is stated. chosen: the same with nothing left open, for the start values.
    tilted: whether the stack is solved by ordinates, not by nodes and modes, as is decided while tracing.
    """

    stated: lj.AddingDoubling
    chosen: lj.AddingDoubling
    tilted: bool

    @property
    def open(self) -> bool:
        """Whether a fit chooses the resolution."""
        return (self.stated.ordinates if self.tilted else self.stated.nodes) is None

    @property
    def far(self) -> lj.AddingDoubling:
        """The resolution that starts are fitted at: the chosen one, but no finer than is of use there."""
        least = {name: min(getattr(self.chosen, name), most) for name, most in FAR.items()}
        return self.as_stated(replace(self.chosen, **least))

    def finer(self, transport: lj.AddingDoubling) -> lj.AddingDoubling | None:
        """The transport at the next finer resolution; None beyond the finest that is chosen."""
        finer = self.as_stated(transport.finer())
        if self.open and not self.tilted:  # what is as fine as it gets stays, the other is refined
            nodes = max(transport.nodes or 0, min(finer.nodes or 0, FINEST_NODES))
            modes = max(transport.modes or 0, min(finer.modes or 0, FINEST_MODES))
            finer = replace(transport, nodes=nodes, modes=modes)
        elif ((finer.ordinates or (0, 0))[0] > FINEST_COSINES) if self.tilted else (finer.nodes or 0) > FINEST_NODES:
            return None
        return None if finer == transport else finer

    def in_words(self, transport: lj.AddingDoubling) -> str:
        """Such as "12 nodes, 16 modes"."""
        if self.tilted:
            return "{} cosines, {} azimuths".format(*transport.ordinates or ("?", "?"))
        return f"{transport.nodes} nodes, {transport.modes} modes"

    def as_stated(self, transport: lj.AddingDoubling) -> lj.AddingDoubling:
        """The transport with what the user gave put back in; unchanged where the user left nothing to choose."""
        if not self.open:
            return transport
        given = {name: value for name in FAR if (value := getattr(self.stated, name)) is not None}
        return replace(transport, **given)


def resolutions(problem: Problem) -> Resolutions | None:
    """Resolutions that the problem's transport may take; None if it has none.

    Which transport "auto" is, is decided while tracing: a fit that passes an index of 1 or albedo 0 stays with one.
    """
    transport, model = problem.transport, problem.model
    directions = model.known if model.optics is None else model.optics.known
    if not isinstance(transport, lj.AddingDoubling | str):
        return None

    def chosen(stack: Any, transport: Any) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", lj.ResolutionWarning)  # a fit tells the error that is left by itself
            return transport_for(stack, transport, directions)

    def traced(vector: Array) -> tuple[lj.Transport, bool]:
        stack = model.build(vector).stack
        layers = [layer for part in stacks_of(stack) for layer in part.layers]
        return chosen(stack, transport), any(map(is_tilted, layers))

    start = jnp.asarray(problem.start)
    kind, tilted = eqx.filter_eval_shape(traced, start)
    if not isinstance(kind, lj.AddingDoubling) or kind.orders == "first":
        return None
    given = replace(kind, nodes=None, modes=None, ordinates=None) if isinstance(transport, str) else transport
    return Resolutions(given, chosen(model.build(start).stack, given), tilted)


def error_between(
    problem: Problem, transport: lj.AddingDoubling, vector: Floats, predicted: Floats
) -> Callable[[lj.AddingDoubling, lj.AddingDoubling], float]:
    """Largest difference between two resolutions, in sigma of the data; `predicted` is at that of `transport`."""
    values, sd = {transport: predicted}, spread(problem, vector, predicted)

    def measured(one: lj.AddingDoubling) -> Floats:
        if one not in values:  # fits with and without discrepancy share a program
            other = replace(problem.without_discrepancy, transport=one)
            values[one] = np.asarray(other.predict(vector[: len(other.names)]), float)
        if problem.objective == "likelihood":
            return values[one]
        return np.asarray(problem.call(Model.standardised_at, vector, values[one]), float)

    return lambda one, other: float(np.max(np.abs(measured(one) - measured(other)) / sd))


def spread(problem: Problem, vector: Floats, predicted: Floats) -> Floats:
    """Standard deviations of the data, (N, C), with model discrepancy; of a named objective its scatter, a number."""
    if problem.objective == "likelihood":
        sigma = np.asarray(problem.call(Model.sigma_at, vector, predicted), float)
        correlation = problem.build(vector).correlation
        return sigma if correlation is None else np.hypot(sigma, float(correlation.amplitude) * predicted)
    residuals = np.asarray(problem.call(Model.standardised_at, vector, predicted), float)
    data = np.asarray(problem.call(Model.standardised_at, vector, np.zeros_like(predicted)), float)
    scatter = np.sqrt(np.sum(residuals**2) / max(problem.count - len(vector), 1))
    return np.maximum(scatter, LEAST_SCATTER * np.sqrt(np.mean(data**2)))


# ---- of an instrument's cones ----


def has_rays(problem: Problem) -> bool:
    """Whether measurements are means over cones."""
    return problem.model.optics is not None and problem.model.optics.row is not None


def leaves_rays_open(problem: Problem) -> bool:
    """Whether a fit chooses how many rays there are."""
    return has_rays(problem) and problem.instrument is not None and problem.instrument.rings is None


def with_rings(problem: Problem, vector: Floats, most: int | None = None) -> Problem:
    """The problem with as many rings of rays a cone as its lobes ask for at this vector (P,), and no fewer."""
    instrument, parts, data = cast(Instrument, problem.instrument), problem.build(vector), problem.data.used()
    tilt = 0.0 if parts.instrument.tilt is None else abs(float(parts.instrument.tilt))
    widths = instrument.source_aperture, instrument.detector_aperture
    rings = max(int(np.max(ring_counts(*widths, parts.stack, data.wi, data.wo, tilt))), 1)
    rings = rings if most is None else min(rings, most)
    if rings <= (instrument.rings or 0):
        return problem
    return replace(problem, instrument=replace(instrument, rings=rings))


# ---- refinement of an optimum ----


# what a fit may choose of a data set: among resolutions of its transport, if that has any; and how many rays
Choice = tuple[Resolutions | None, bool]


class Accuracy(NamedTuple):
    """The resolution of a fit in words, and the numerical error there in standard deviations of the data."""

    resolution: str
    error: float


def for_starts(problem: FittingProblem) -> tuple[FittingProblem, dict[str, Choice]]:
    """The problem as starts are fitted, coarsely where that is open, and the choices of its data sets by name."""
    choices = {name: (resolutions(one), leaves_rays_open(one)) for name, one in problem.problems.items()}
    coarse = {}
    for name, (known, rays) in choices.items():
        one = problem.problems[name]
        if known is not None and known.open:
            one = replace(one, transport=known.far)
        coarse[name] = with_rings(one, one.start, FAR_RINGS) if rays else one
    changed = {name: one for name, one in coarse.items() if one is not problem.problems[name]}
    return problem.with_problems(changed), choices


def refined(
    at: Optimum, choices: Mapping[str, Choice], options: FitOptions, progress: Progress
) -> tuple[Optimum, Accuracy | None]:
    """The optimum at the resolution that the noise of each data set asks for, and how accurate it is there."""
    while True:
        changed, accuracies = {}, {}
        for name, predicted in at.problem.shares(at.predicted).items():
            problem, vector = at.problem.problems[name], at.lowest.vector[list(at.problem.places(name))]
            needed, accuracy = _judged(problem, choices[name], vector, predicted, options, progress)
            if needed is not problem:
                changed[name] = needed
            if accuracy is not None:
                accuracies[name] = accuracy
        if not accuracies:
            return at, None
        if not changed:
            words = [f"{name}: {one.resolution}" if name else one.resolution for name, one in accuracies.items()]
            return at, Accuracy("; ".join(words), float(np.max([one.error for one in accuracies.values()])))
        whole = at.problem.with_problems(changed)
        again = polish(whole, _fitted_again(at, whole, options.equivalent_cost, progress), check=at.improved)
        at = again._replace(improved=again.improved or at.improved)


def _judged(
    problem: Problem, choice: Choice, vector: Floats, predicted: Floats, options: FitOptions, progress: Progress
) -> tuple[Problem, Accuracy | None]:
    """The data set at the resolution that its noise asks for, and how accurate it is now."""
    (known, rays), needed, errors, note = choice, problem, [], ""
    if known is not None:
        transport = own = transport_of(problem, known)
        progress("numerical error", 0, None, f"at {known.in_words(own)}")
        error_of, allowed = error_between(problem, own, vector, predicted), options.numerical_error
        note, finer = "" if known.open else ", as given", known.finer(own)
        error = error_of(known.as_stated(own.coarser()), own) if finer is None else error_of(own, finer)
        while finer is not None and known.open and error > allowed:
            # between the two: as fine in modes alone, which cost less, or in nodes alone
            parts = [replace(transport, modes=finer.modes), replace(transport, nodes=finer.nodes)]
            parts = [] if known.tilted else parts
            transport = next((part for part in parts if error_of(part, finer) <= MINOR_SHARE * allowed), finer)
            finer = known.finer(transport)
            error = error if finer is None else error_of(transport, finer)
        if finer is None and known.open:
            note = ", the finest tried"
        if transport != own:
            needed = replace(needed, transport=transport)
        errors.append(error)
    if has_rays(problem):
        needed = with_rings(needed, vector) if rays else needed
        other = problem.with_other_rays().predict(vector) if needed is problem else np.nan
        errors.append(float(np.max(np.abs(predicted - np.asarray(other)) / spread(problem, vector, predicted))))
    if not errors:
        return problem, None
    return needed, Accuracy(resolution_in_words(problem, known) + note, float(np.sum(errors)))  # errors add up


def transport_of(problem: Problem, known: Resolutions) -> lj.AddingDoubling:
    """The transport that a problem is solved by, with its resolution."""
    return cast(lj.AddingDoubling, problem.transport) if known.open else known.chosen


def resolution_in_words(problem: Problem, known: Resolutions | None) -> str:
    """The resolution of a problem whose transport may have one."""
    parts = [] if known is None else [known.in_words(transport_of(problem, known))]
    rings = cast(Any, problem.instrument).rings or 1 if has_rays(problem) else 0
    return ", ".join(parts + ([f"{rings} ring{'s' if rings > 1 else ''} of rays a cone"] if rings else []))


def _fitted_again(at: Optimum, problem: FittingProblem, equivalent: float, progress: Progress) -> list[Descent]:
    """The ends at another resolution: those that matter fitted again, the cost of the others there."""

    def with_cost(end: Descent) -> Descent:
        found = float(problem.call(Model.cost_at, end.vector, problem.predict(end.vector)))
        return end._replace(cost=found if np.isfinite(found) else np.inf)

    result, lowest = list(at.ends), with_cost(at.lowest)
    shift = abs(lowest.cost - at.lowest.cost)  # by so much costs may move
    units, fitted = [unit_of(at.problem, end.vector) for end in at.ends], list[int]()
    for index in sorted(range(len(at.ends)), key=lambda index: (index != at.best, at.ends[index].cost)):
        before = at.ends[index]
        near = (other for other in fitted if np.max(np.abs(units[index] - units[other])) < SAME_OUTCOME)
        if (other := next(near, None)) is not None:
            result[index] = result[other]
        elif np.isfinite(before.cost):
            result[index] = with_cost(before)
            above, moved = result[index].cost - lowest.cost, abs(result[index].cost - before.cost)
            if len(fitted) < MOST_MINIMA and not above > equivalent * at.excess + np.fmax(moved, shift):
                end = rough_descent(problem, units[index], fresh=False)
                result[index] = end._replace(steps=before.steps + end.steps)
                fitted.append(index)
                best = min(end.cost for end in result)
                progress("refined fit", len(fitted), None, f"best cost {best:.6g}")
    return result
