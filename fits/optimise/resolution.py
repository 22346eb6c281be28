"""How finely the transport of a fit solves the stack: as finely as the noise of the data asks for.

A resolution that is left open is that of the start values where starts run, but no finer than is useful far away
from the data. At the optimum it is compared with finer ones, by values alone, until they agree to a tenth of the noise.
One that is given is compared with a finer one, and stays.
"""

import warnings
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

import layerjax as lj
from fits.problem.model import Density, Model
from fits.problem.problem import Problem
from layerjax.mixture import stacks_of
from layerjax.preparation import transport_for
from layerjax.transport.adding_doubling.resolution import is_tilted

FAR = {"nodes": 12, "modes": 16, "ordinates": (8, 12)}
"""The finest resolution of starts: what is finer costs more than it tells far away from the data."""

FINEST_NODES, FINEST_MODES, FINEST_COSINES = 48, 96, 16
"""What is chosen at most."""

LEAST_SCATTER = 0.01
"""Of the data's root mean square: less scatter about a named objective counts as this, so that an error of a thousandth
is enough, which `AddingDoubling` aims at."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Resolutions:
    """The resolutions that a transport may take for a problem.

    Attributes:
        given: the transport, with what it does not state.
        chosen: the same with nothing left open, for the start values.
        tilted: whether the stack is solved by ordinates, not by nodes and modes, as is decided while tracing.
    """

    given: lj.AddingDoubling
    chosen: lj.AddingDoubling
    tilted: bool

    @property
    def open(self) -> bool:
        """Whether a fit chooses the resolution."""
        return (self.given.ordinates if self.tilted else self.given.nodes) is None

    @property
    def far(self) -> lj.AddingDoubling:
        """The resolution that starts are fitted at: the chosen one, but no finer than a look needs."""
        least = {name: min(getattr(self.chosen, name), most) for name, most in FAR.items()}
        return self._as_given(replace(self.chosen, **least))

    def finer(self, transport: lj.AddingDoubling) -> lj.AddingDoubling | None:
        """The transport at the next finer resolution; None beyond the finest that is chosen."""
        finer = self._as_given(transport.finer())
        if self.open and not self.tilted:  # what is as fine as it gets stays, the other is refined
            nodes, modes = transport.nodes or 0, transport.modes or 0
            finer = replace(
                transport,
                nodes=max(nodes, min(finer.nodes or 0, FINEST_NODES)),
                modes=max(modes, min(finer.modes or 0, FINEST_MODES)),
            )
        elif self._size(finer) > (FINEST_COSINES if self.tilted else FINEST_NODES):
            return None
        return None if finer == transport else finer

    def partly_finer(self, transport: lj.AddingDoubling, finer: lj.AddingDoubling) -> list[lj.AddingDoubling]:
        """Transports between the two: as fine as `finer` in modes alone, which cost less, and in nodes alone."""
        if self.tilted:
            return []
        parts = [replace(transport, modes=finer.modes), replace(transport, nodes=finer.nodes)]
        return [part for part in parts if part not in (transport, finer)]

    def coarser(self, transport: lj.AddingDoubling) -> lj.AddingDoubling:
        """The transport at the next coarser resolution."""
        return self._as_given(transport.coarser())

    def in_words(self, transport: lj.AddingDoubling) -> str:
        """Such as "12 nodes, 16 modes"."""
        if self.tilted:
            return "{} cosines, {} azimuths".format(*transport.ordinates or ("?", "?"))
        return f"{transport.nodes} nodes, {transport.modes} modes"

    def _size(self, transport: lj.AddingDoubling) -> int:
        size = (transport.ordinates or (0, 0))[0] if self.tilted else transport.nodes
        return size or 0

    def _as_given(self, transport: lj.AddingDoubling) -> lj.AddingDoubling:
        """The transport with what the user gave put back in; unchanged where the user left nothing to choose."""
        if not self.open:
            return transport
        given = {name: value for name in FAR if (value := getattr(self.given, name)) is not None}
        return replace(transport, **given)


def resolutions(problem: Problem) -> Resolutions | None:
    """Resolutions that the problem's transport may take; None if it has none.

    Which transport "auto" is, is decided by what is known while tracing: a fit that passes through an index of 1 or an
    albedo of 0 stays with one.
    """
    transport, model = problem.transport, problem.model
    directions = model.known if model.optics is None else model.optics.known
    if not isinstance(transport, lj.AddingDoubling | str):
        return None

    def traced(vector: Array) -> tuple[lj.Transport, bool]:
        stack = model.build(vector).stack
        layers = [layer for part in stacks_of(stack) for layer in part.layers]
        return _chosen(stack, transport, directions), any(map(is_tilted, layers))

    start = jnp.asarray(problem.start)
    kind, tilted = eqx.filter_eval_shape(traced, start)
    if not isinstance(kind, lj.AddingDoubling) or kind.orders == "first":
        return None
    given = replace(kind, nodes=None, modes=None, ordinates=None) if isinstance(transport, str) else transport
    chosen = _chosen(model.build(start).stack, given, directions)
    assert isinstance(given, lj.AddingDoubling)
    assert isinstance(chosen, lj.AddingDoubling)
    return Resolutions(given, chosen, tilted)


def _chosen(stack: Any, transport: Any, directions: Any) -> lj.Transport:
    """A fit tells the error that is left by itself."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lj.ResolutionWarning)
        return transport_for(stack, transport, directions)


def at_start(problem: Problem) -> Problem:
    """The problem with the resolution that its start values ask for, if none is given."""
    known = resolutions(problem)
    return replace(problem, transport=known.chosen) if known is not None and known.open else problem


class Values:
    """What a problem predicts with one vector (P,) at several resolutions, of which that at its own is known."""

    def __init__(self, problem: Problem, own: lj.AddingDoubling, vector: Floats, predicted: Floats):
        self.problem, self.vector = problem, vector
        self._known = {own: predicted}
        self._spread = spread(problem, vector, predicted)

    @property
    def count(self) -> int:
        """At how many resolutions."""
        return len(self._known)

    def error(self, transport: lj.AddingDoubling, other: lj.AddingDoubling) -> float:
        """Largest difference between two resolutions, in standard deviations of the data; NaN if one is not finite."""
        near, far = (self._measured(one) for one in (transport, other))
        return float(np.max(np.abs(near - far) / self._spread))

    def _measured(self, transport: lj.AddingDoubling) -> Floats:
        """Values, in the measure of a named objective if it is one."""
        if transport not in self._known:
            self._known[transport] = np.asarray(replace(self.problem, transport=transport).predict(self.vector), float)
        predicted = self._known[transport]
        if self.problem.objective == "likelihood":
            return predicted
        return np.asarray(self.problem.call(Model.standardised_at, self.vector, predicted), float)


def spread(problem: Problem, vector: Floats, predicted: Floats) -> Floats:
    """Standard deviations of the data, (N, C), with noise levels as they are in `vector` (P,), and model discrepancy
    with model discrepancy; for a named objective the scatter of its residuals, one number."""
    if problem.objective == "likelihood":
        sigma = np.asarray(problem.call(Density.sigma_at, vector, predicted), float)
        shared = problem.build(vector).correlation
        return sigma if shared is None else np.hypot(sigma, float(shared.amplitude) * predicted)
    residuals = np.asarray(problem.call(Model.standardised_at, vector, predicted), float)
    data = np.asarray(problem.call(Model.standardised_at, vector, np.zeros_like(predicted)), float)
    scatter = np.sqrt(np.sum(residuals**2) / max(problem.count - len(vector), 1))
    return np.maximum(scatter, LEAST_SCATTER * np.sqrt(np.mean(data**2)))
