"""A fitting problem: stack, data sets, noise model, instrument.

`Problem` is what users and results hold; its `model` holds the same as arrays, for compiled programs.
"""

import abc
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, NDArray

import layerjax as lj
from fits.data.measurements import Measurements
from fits.data.scans import groups
from fits.data.totals import Totals
from fits.names import Objective
from fits.problem.compilation import Static, run
from fits.problem.discrepancy.parameters import Discrepancy, numbers_of
from fits.problem.discrepancy.process import Process, make_process
from fits.problem.hemispherical import Totalling
from fits.problem.instrument import Instrument, optics_of, setting_of
from fits.problem.model import Density, Model, Parts, Side, Transport
from fits.problem.noise import Levels, Noise, is_assumed, noise_levels
from fits.problem.parameters import Box, Free, LogNormal, Normal, Template, is_free, split
from fits.problem.spectra import require_in_range
from fits.problem.values import shown
from layerjax._checks import in_short, require_kind
from layerjax._parameters import plain_name
from layerjax._shapes import channel_count
from layerjax.mixture import require_material
from layerjax.stack import with_known
from layerjax.transport.known_directions import known_directions

Floats = NDArray[np.float64]


class Assembled(NamedTuple):
    """What follows from a problem as it was given; start, low, high: (P,). free: its parameters as they were given."""

    names: tuple[str, ...]
    start: Floats
    low: Floats
    high: Floats
    model: Any
    free: tuple[Free, ...] = ()


class FittingProblem(abc.ABC):
    """One data set or several: parameters in a box, and what the data say of them, as functions of the vector (P,)."""

    objective: Objective

    @property
    @abc.abstractmethod
    def _assembled(self) -> Assembled:
        """What follows from it."""

    @property
    @abc.abstractmethod
    def units(self) -> dict[str, str]:
        """Unit of each parameter; "1" for plain ratios."""

    @property
    @abc.abstractmethod
    def problems(self) -> Mapping[str, Any]:
        """A `Problem` for each data set, by its name."""

    @abc.abstractmethod
    def places(self, name: str) -> tuple[int, ...]:
        """Where the parameters of one data set stand in the vector."""

    @abc.abstractmethod
    def shares(self, predicted: Floats) -> dict[str, Floats]:
        """What `predict` gives of each data set, in the shape of its data."""

    @abc.abstractmethod
    def with_problems(self, changed: Mapping[str, Any]) -> "FittingProblem":
        """The same with other problems in the place of those of the same names."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the P parameters: paths such as ``layers[0].thickness``, ``noise.floor`` or ``scale``."""
        return self._assembled.names

    @property
    def start(self) -> Floats:
        """Where the parameters start, (P,)."""
        return self._assembled.start

    @property
    def low(self) -> Floats:
        """Lower bounds of the parameters, (P,)."""
        return self._assembled.low

    @property
    def high(self) -> Floats:
        """Upper bounds of the parameters, (P,)."""
        return self._assembled.high

    @property
    def model(self) -> Any:
        """The problem as pure functions of the physical vector (P,)."""
        return self._assembled.model

    @property
    def count(self) -> int:
        """Number of data: used samples times channels."""
        return int(self.model.values.size)

    def build(self, vector: ArrayLike) -> Any:
        """Stack, scale and noise levels with the physical vector (P,)."""
        return jax.tree.map(jnp.asarray, self.model.build(jnp.asarray(vector)))

    def predict(self, vector: ArrayLike) -> Array:
        """Scaled BSDF of the used samples, (N, C), in 1/sr; of several data sets one after the other, (N, 1)."""
        return self.call(Density.predict, vector)

    def residuals(self, vector: ArrayLike) -> Array:
        """All residuals of the least-squares problem, (rows,): half their sum of squares is what a fit minimises."""
        return jnp.concatenate([part.reshape(-1) for part in self.call(Density.residuals, vector)])

    def log_likelihood(self, vector: ArrayLike) -> Array:
        """Normalised log-likelihood of the used samples with the physical vector (P,)."""
        return self.call(Density.log_likelihood, vector)

    def log_likelihood_per_datum(self, vector: ArrayLike) -> Array:
        """Normalised log-density of each datum with the physical vector (P,), (N, C)."""
        return self.call(Density.log_likelihood_per_datum, vector)

    def log_prior(self, vector: ArrayLike) -> Array:
        """Log-density of the physical vector, -inf outside the bounds."""
        return self.call(Density.log_prior, vector)

    def log_posterior_unconstrained(self, u: ArrayLike) -> Array:
        """Log-posterior over the unconstrained vector (P,), -inf where undefined."""
        return self.call(Density.log_posterior_unconstrained, u)

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """`function(model, *arguments)`, compiled once for all of this structure; of a method of `Density` the model's
        own of that name."""
        if function in vars(Density).values():
            function = getattr(type(self.model), function.__name__)
        arrays = (jax.tree.map(jnp.asarray, argument, is_leaf=_is_vector) for argument in arguments)
        return run(function, self.split_model, *arrays)

    @cached_property
    def split_model(self) -> tuple[Any, Static]:
        """The model's arrays, and what is static in it wrapped for use as a key."""
        arrays, static = eqx.partition(self.model, eqx.is_array)
        return arrays, Static(static)


def _is_vector(argument: Any) -> bool:
    """Whether numbers are listed, which make an array; a named tuple holds arrays."""
    return type(argument) in (list, tuple)


@dataclass(frozen=True, eq=False)
class Problem(FittingProblem):
    """A stack with `Free` leaves, the measurements that it should explain, and how they scatter about it.

    Args:
        stack: holds `Free` where a number is to be fitted.
        data: only its used samples enter: values of a BSDF, or `Totals`, shares of light (in what follows, in the place
            of a BSDF in 1/sr).
        transport: a layerjax transport that is not random, "auto" (see `layerjax.prepare`), or any callable
            (stack, wi, wo) -> values, of unit directions (N, 3) and a BSDF (N, C) in 1/sr; the stack may then be any
            pytree. A resolution that is not given is what is known while tracing asks for, and for a fit see `fit`.
        noise: how a datum scatters about the model.
        scale: a unitless factor common to all values: a number above 0, `Free`, or None for 1.
        objective: "likelihood", or a named residual: "cosine_l2", "log1p_cos" or "cube_root".
        instrument: by which the measurements were taken; None: exact directions, one scale.

    Raises:
        ValueError: no parameter is free or no sample used, channels do not match, the noise can vanish, the transport
            cannot carry the stack, or a named objective stands beside free noise levels, priors or
            `Free.random_walk_sd`.
    """

    stack: Any
    data: Measurements
    transport: Transport = "auto"
    noise: Noise = field(default_factory=Noise)
    scale: float | Free | None = None
    objective: Objective = "likelihood"
    instrument: Instrument | None = None

    def __post_init__(self) -> None:
        _ = self._assembled  # now, so that what does not fit together is refused where it was given

    def __getstate__(self) -> dict[str, Any]:
        # what it was made from: a model knows parts of its trees by identities, which do not outlive a process
        return {one.name: getattr(self, one.name) for one in fields(self)}

    @cached_property
    def _assembled(self) -> Assembled:
        return _assemble(self)

    @property
    def model(self) -> Model:
        """The problem as pure functions of the physical vector (P,)."""
        return self._assembled.model

    @property
    def units(self) -> dict[str, str]:
        """Unit of each parameter; "1" for plain ratios."""
        return {name: unit(name) for name in self.names}

    @property
    def common_names(self) -> tuple[str, ...]:
        """Names of the parameters that are the same for all texels of a map, one a channel where numbers are."""
        marks = [one.same_for_all_texels for one in self._assembled.free for _ in range(one.arrays()[0].size)]
        return tuple(name for name, marked in zip(self.names, marks, strict=True) if marked)

    @property
    def noise_is_assumed(self) -> bool:
        """Whether neither the data nor `noise` nor the instrument say how large the noise is: see `Noise`."""
        return is_assumed(with_floor(self.noise, self.instrument), self.data)

    @property
    def problems(self) -> "dict[str, Problem]":
        """The one measurement, which has no name."""
        return {"": self}

    def places(self, name: str = "") -> tuple[int, ...]:
        """All places of the vector."""
        return tuple(range(len(self.names)))

    def shares(self, predicted: Floats) -> dict[str, Floats]:
        """All that is predicted."""
        return {"": predicted}

    def with_problems(self, changed: "Mapping[str, Problem]") -> "Problem":
        """What stands in its place."""
        return changed.get("", self)

    def build(self, vector: ArrayLike) -> Parts:
        """Stack, scale and noise levels with the physical vector (P,)."""
        return super().build(vector)

    def predict_at(self, vectors: ArrayLike, wi: ArrayLike, wo: ArrayLike) -> Array:
        """Scaled BSDF along other directions, (M, 3) each, with D vectors (D, P): (D, M, C), in 1/sr."""
        wi, wo = np.asarray(wi, float), np.asarray(wo, float)
        model = replace(self.model, **_directions(self, wi, wo))
        arrays, static = eqx.partition(model, eqx.is_array)
        return run(_over_vectors, (arrays, Static(static)), jnp.asarray(vectors))

    def with_other_rays(self) -> "Problem":
        """The problem with other numbers of rays for the cones of its instrument: what differs is their error."""
        used, optics = self.data.used(), self.model.optics
        assert self.instrument is not None
        assert optics is not None
        incidences, follow = polar_angles(self.data), optics.known is not None
        other = optics_of(self.instrument, self.stack, used.wi, used.wo, incidences, follow, other=True)
        return self.with_model(replace(self.model, optics=other))

    def with_model(self, model: Model) -> "Problem":
        """The problem with other arrays in its model."""
        other = replace(self)
        vars(other)["_assembled"] = self._assembled._replace(model=model)
        return other


UNITS = {
    "noise.floor": "1/sr",
    "instrument.tilt": "deg",
    "noise.discrepancy.length_half": "deg",
    "noise.discrepancy.length_difference": "deg",
    **{"thickness": "optical depth", "thickness_mm": "mm", "mu_s": "1/mm", "mu_a": "1/mm"},
}
"""Units of parameters by their names, or by what these end with; all others are plain ratios."""

PLACES = ("", "scale", "instrument", "noise.relative", "noise.floor", "noise.discrepancy")
"""How names begin of what stands in each place of `Parts`."""


def _assemble(problem: Problem) -> Assembled:
    _require_kinds(problem)
    _require_known(problem.objective, problem.scale)
    require_in_range(problem.stack)
    if isinstance(problem.data, Totals):
        _refuse_angular_only(problem)
    used = problem.data.used()
    if not used.values.size:
        raise ValueError("data: no sample is used; at least one must be")
    levels = noise_levels(with_floor(problem.noise, problem.instrument), used)
    process = make_process(used.wi, used.wo, used.values.shape[1]) if problem.noise.discrepancy else None
    if process is not None:
        process = replace(process, gram=levels.gram(process, used.values))
    template, names, free = split(_numbers(problem, levels, process), _parameter_name)
    if not names:
        raise ValueError("stack: nothing is free; put fits.Free(start, low, high) where a number is to be fitted")
    if problem.objective == "likelihood":
        _require_noise(levels)
    else:
        _refuse_likelihood_only(problem, levels, free)
    model = _model(problem, used, levels, template, Box.of(free), process, names)
    start, low, high = (np.concatenate([np.ravel(entry.arrays()[i]) for entry in free]) for i in range(3))
    _require_same_channels(model, start, used)
    return Assembled(names, start, low, high, model, free)


def _require_kinds(problem: Problem) -> None:
    if isinstance(problem.transport, str | lj.Transport):
        require_material(problem.stack)
    elif not callable(problem.transport):  # a function takes any stack
        raise ValueError(f'transport: {in_short(problem.transport)} is not a Transport or "auto", nor a function')
    require_kind("data", problem.data, Measurements)
    require_kind("noise", problem.noise, Noise)
    require_kind("instrument", problem.instrument, Instrument, None)


def _require_known(objective: str, scale: Any) -> None:
    if objective not in get_args(Objective):
        raise ValueError(f"objective is {objective!r}; it must be one of {', '.join(get_args(Objective))}")
    above_zero = isinstance(scale, int | float) and math.isfinite(scale) and scale > 0
    if not (scale is None or is_free(scale) or above_zero):
        raise ValueError(f"scale is {scale!r}; it must be a finite number above 0, Free or None")


def _numbers(problem: Problem, levels: Levels, process: Process | None) -> tuple[Any, ...]:
    """All that a parameter may stand for, in the order of `Parts`."""
    # what is 0 or 1 stays known where the rest is traced: it costs nothing, and some transports ask for it
    stack = _with_known(problem.stack)
    scale = 1.0 if problem.scale is None else problem.scale
    correlation = None
    if process is not None:
        assert isinstance(problem.noise.discrepancy, Discrepancy)
        correlation = numbers_of(problem.noise.discrepancy, process, problem.data.values.shape[1])
    instrument = None if problem.instrument is None else setting_of(problem.instrument, polar_angles(problem.data))
    rest = (scale, instrument, levels.relative, levels.floor, correlation)
    return (stack, *jax.tree.map(lambda x: x if is_free(x) else jnp.asarray(x), rest, is_leaf=is_free))


def _with_known(stack: Any) -> Any:
    if isinstance(stack, lj.Mixture):
        _require_room(stack)
        return stack.each(_with_known)
    return with_known(stack) if isinstance(stack, lj.Stack) else stack


def _require_room(mixture: lj.Mixture) -> None:
    """Refuse weights that could leave less than nothing for the rest."""
    given = [weight for weight in mixture.weights.values() if weight is not None]
    if any(map(is_free, given)):
        most = sum(float(weight.arrays()[2] if is_free(weight) else weight) for weight in given)
        if most > 1.0:
            raise ValueError(f"Mixture.weights: at their upper bounds they sum to {most:g}; it must be at most 1")


def _parameter_name(path: str) -> str:
    """The name of a place in the tuple that `_numbers` returns."""
    for index, name in enumerate(PLACES):
        if path.startswith(f"[{index}]"):
            return plain_name(name + path.removeprefix(f"[{index}]"))
    return path


def _require_noise(levels: Levels) -> None:
    if not np.all(levels.smallest > 0):
        raise ValueError("noise: sigma could become 0; give a floor above 0, or data with sigma")


def _refuse_angular_only(problem: Problem) -> None:
    """What is said of measurements along directions, and means nothing of totals."""
    for name, given in (("instrument", problem.instrument), ("noise.discrepancy", problem.noise.discrepancy)):
        if given:
            raise ValueError(f"{name} is given, but the data are totals, which have no direction of view")


def _refuse_likelihood_only(problem: Problem, levels: Levels, free: tuple[Free, ...]) -> None:
    objective = problem.objective
    fitted = [name for name in ("relative", "floor") if is_free(getattr(levels, name))]
    if problem.noise.discrepancy:
        raise ValueError(f"noise.discrepancy stands beside objective {objective!r}, which has no noise model")
    if fitted:
        raise ValueError(f"noise.{fitted[0]} is free, but objective {objective!r} has no noise model")
    weighted = [entry.prior for entry in free if isinstance(entry.prior, Normal | LogNormal)]
    if weighted:
        raise ValueError(f"the prior {weighted[0]} has no weight beside objective {objective!r}; omit it")
    smooth = [entry.random_walk_sd for entry in free if entry.random_walk_sd is not None]
    if smooth:
        raise ValueError(f"Free.random_walk_sd is {shown(smooth[0])}, but has no weight beside objective {objective!r}")


def _model(
    problem: Problem,
    used: Measurements,
    levels: Levels,
    template: Template,
    box: Box,
    process: Process | None,
    names: tuple[str, ...],
) -> Model:
    return Model(
        template=template,
        box=box,
        values=jnp.asarray(used.values),
        variance=jnp.asarray(np.broadcast_to(levels.variance, used.values.shape)),
        lowest=jnp.asarray(np.broadcast_to(levels.smallest, used.values.shape)),
        degrees_of_freedom=jnp.asarray(float(problem.noise.degrees_of_freedom)),
        transport=Totalling.of(used, problem.transport) if isinstance(used, Totals) else problem.transport,
        process=process,
        softness=None if process is None else jnp.asarray(levels.softness(used.values)),
        objective=problem.objective,
        tails=problem.noise.tails,
        varying=levels.varying if process is None else levels.fitted,
        moving=sum(not name.startswith("noise.") for name in names),
        **_directions(problem, used.wi, used.wo),
    )


def _directions(problem: Problem, wi: Floats, wo: Floats) -> dict[str, Any]:
    """What a model holds of measurements along these directions, (N, 3) each."""
    follow, given, optics = _uses_known(problem.transport), problem.instrument, None
    if isinstance(problem.data, Totals):
        follow = False  # light leaves along all directions
    if given is not None:
        optics = optics_of(given, problem.stack, wi, wo, polar_angles(problem.data), follow)
    return {
        "wi": jnp.asarray(wi),
        "wo": jnp.asarray(wo),
        "known": known_directions(wi, wo) if follow and optics is None else None,
        "optics": optics,
        "side": _side(wi, wo),
    }


def with_floor(noise: Noise, instrument: Instrument | None) -> Noise:
    """The noise with an instrument's floor."""
    if instrument is None or instrument.floor is None:
        return noise
    if noise.floor is not None:
        raise ValueError("Noise.floor and Instrument.floor are both given; there is one floor")
    return replace(noise, floor=instrument.floor)


def polar_angles(data: Measurements) -> Floats:
    """Polar angles of the light, (K,), of the used samples, in degrees; within `SAME_ANGLE` they are one, at all
    azimuths."""
    theta = data.used().theta_i
    return np.round([np.mean(theta[rows]) for rows in groups(theta)], 2)


def _side(wi: Floats, wo: Floats) -> Side:
    return "reflection" if np.all(wi[:, 2] > 0) and np.all(wo[:, 2] > 0) else "all"


def _over_vectors(model: Model, vectors: Array) -> Array:
    return jax.lax.map(model.predict, vectors)


def _uses_known(transport: Any) -> bool:
    """Whether known directions are of use; where they are not, programs should not depend on how many there are."""
    return transport == "auto" or (isinstance(transport, lj.Transport) and transport.uses_known)


def _require_same_channels(model: Model, start: Floats, used: Measurements) -> None:
    material = model.build(jnp.asarray(start)).stack
    if isinstance(material, lj.Stack | lj.Mixture):
        channel_count(material)
    shape = eqx.filter_eval_shape(model.predict, jnp.asarray(start)).shape
    if shape[-1] not in (1, used.values.shape[-1]):
        raise ValueError(f"stack: it has {shape[-1]} channels, the data {used.values.shape[-1]}: {used.channels}")
    if np.broadcast_shapes(shape, used.values.shape) != used.values.shape:
        raise ValueError(f"transport: it gives values of shape {shape}, the data have {used.values.shape}")


def unit(name: str) -> str:
    """The unit of a parameter of this name; "1" for plain ratios."""
    known = UNITS.get(name)
    whole = re.sub(r"\[\d+\]$|\.amplitude$", "", name)  # of a channel, or of a power law's reference
    return known or UNITS.get(whole.rpartition(".")[2], "1")
