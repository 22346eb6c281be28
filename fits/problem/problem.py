"""A fitting problem: stacks, data sets, noise model, instrument; one measurement, or several with parameters in common.

`Problem` and `Joint` are what users hold; their `model` holds the same as arrays, for compiled programs.
"""

import abc
import copy
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import product
from numbers import Real
from typing import Any, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

import layerjax as lj
from fits.data.geometry import Floats
from fits.data.measurements import TO_HAVE_THEM, Measurements
from fits.data.scans import groups
from fits.data.totals import Totals
from fits.names import Objective
from fits.problem.compilation import Static, run
from fits.problem.discrepancy import Discrepancy, Process, make_process, numbers_of
from fits.problem.hemispherical import Totalling
from fits.problem.instrument import Instrument, optics_of, setting_of
from fits.problem.model import JointModel, Linearisation, Model, Parts, Transport, linearise, predict_each
from fits.problem.noise import Levels, Noise, is_assumed, noise_levels, require_size
from fits.problem.parameters import Box, Free, LogNormal, Normal, is_free, names_of, require_in_range, split
from layerjax._checks import abbreviate, require_choice, require_kind, require_number
from layerjax._parameters import plain_name
from layerjax._shapes import channel_count
from layerjax.mixture import require_material
from layerjax.stack import make_constants_static
from layerjax.transport.known_directions import KnownDirections, KnownPairs, known_directions, known_pairs

# of parameters by how their names end; all others are plain ratios
UNITS = {
    "noise.floor": "1/sr",
    "instrument.tilt": "deg",
    "noise.discrepancy.length_half": "deg",
    "noise.discrepancy.length_difference": "deg",
    "thickness": "optical depth",
    "thickness_mm": "mm",
    "thickness_nm": "nm",
    "wavelengths_nm": "nm",
    "mu_s": "1/mm",
    "mu_a": "1/mm",
}
# how names begin of what stands in each place of `Parts`
PLACES = ("", "scale", "instrument", "noise.relative", "noise.floor", "noise.discrepancy")


class Assembled(NamedTuple):
    """What follows from a problem as it was given: its parameters by name, their density, and for each data set the
    places of its own in the vector."""

    free: dict[str, Free]
    model: Any
    places: tuple[tuple[int, ...], ...]


class FittingProblem(abc.ABC):
    """One data set or several: parameters in a box, and what the data say of them, as functions of the vector (P,)."""

    objective: Objective

    @property
    @abc.abstractmethod
    def _assembled(self) -> Assembled:
        """What follows from it."""

    @property
    @abc.abstractmethod
    def problems(self) -> "Mapping[str, Problem]":
        """A `Problem` for each data set, by its name; one measurement by itself has none: ""."""

    @abc.abstractmethod
    def with_problems(self, changed: "Mapping[str, Problem]") -> "FittingProblem":
        """The same with other problems in the place of those of the same names."""

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of the P parameters: paths such as ``layers[0].thickness``, ``noise.floor`` or ``scale``."""
        return names_of(self._assembled.free)

    @cached_property
    def _bounds(self) -> list[Floats]:
        arrays = [one.arrays() for one in self._assembled.free.values()]
        return [np.concatenate([np.ravel(one) for one in each]) for each in zip(*arrays, strict=True)]

    @property
    def start(self) -> Floats:
        """Where the parameters start, (P,)."""
        return self._bounds[0]

    @property
    def low(self) -> Floats:
        """Lower bounds of the parameters, (P,)."""
        return self._bounds[1]

    @property
    def high(self) -> Floats:
        """Upper bounds of the parameters, (P,)."""
        return self._bounds[2]

    @property
    def units(self) -> dict[str, str]:
        """Unit of each parameter; "1" for plain ratios."""
        return {name: unit(name) for name in self.names}

    @property
    def model(self) -> Any:
        """The problem as pure functions of the physical vector (P,)."""
        return self._assembled.model

    @property
    def count(self) -> int:
        """Number of data: used samples times channels."""
        return int(self.model.values.size)

    def places(self, name: str = "") -> tuple[int, ...]:
        """Where the parameters of one data set stand in the vector."""
        if name not in self.problems:
            raise ValueError(f"part {name!r} is not one of {', '.join(self.problems)}")
        return dict(zip(self.problems, self._assembled.places, strict=True))[name]

    def shares(self, predicted: Floats) -> dict[str, Floats]:
        """What `predict` gives of each data set, in the shape of its data."""
        split = self.model.split(predicted) if len(self.problems) > 1 else [predicted]
        return dict(zip(self.problems, split, strict=True))

    def build(self, vector: ArrayLike) -> Any:
        """Stack, scale and noise levels with the physical vector (P,)."""
        return jax.tree.map(jnp.asarray, self.model.build(jnp.asarray(vector)))

    def predict(self, vector: ArrayLike) -> Array:
        """Scaled BSDF of the used samples, (N, C), in 1/sr; of several data sets one after the other, (N, 1)."""
        return self.call(Model.predict, vector)

    def residuals(self, vector: ArrayLike) -> Array:
        """All residuals of the least-squares problem, (rows,): half their sum of squares is what a fit minimises."""
        return jnp.concatenate([part.reshape(-1) for part in self.call(Model.residuals, vector)])

    def log_likelihood(self, vector: ArrayLike) -> Array:
        """Normalised log-likelihood of the used samples with the physical vector (P,)."""
        return self.call(Model.log_likelihood, vector)

    def log_prior(self, vector: ArrayLike) -> Array:
        """Log-density of the physical vector, -inf outside the bounds."""
        return self.call(Model.log_prior, vector)

    def log_posterior_unconstrained(self, u: ArrayLike) -> Array:
        """Log-posterior over the unconstrained vector (P,), -inf where undefined."""
        return self.call(Model.log_posterior_unconstrained, u)

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """`function(model, *arguments)`, compiled once for all of this structure; of a `JointModel` its own method of
        the name of one of `Model`."""
        if function in vars(Model).values():
            function = getattr(type(self.model), function.__name__)

        def is_vector(argument: Any) -> bool:  # numbers that are listed make an array; other tuples hold arrays
            return type(argument) in (list, tuple) and all(isinstance(one, Real | np.generic) for one in argument)

        def array(leaf: Any) -> Any:  # of numpy for compiled programs, which take it faster than jnp.asarray makes one
            return leaf if isinstance(leaf, Array | np.ndarray) else np.asarray(leaf)

        arrays = (jax.tree.map(array, argument, is_leaf=is_vector) for argument in arguments)
        return run(function, self.split_model, *arrays)

    def linearise(self, vector: ArrayLike) -> list[Linearisation]:
        """Predictions of each data set at a vector (P,), and their slopes: by one program, with discrepancy or not."""
        vector, known = np.asarray(vector, float), []
        for name, problem in self.problems.items():
            forward = problem.without_discrepancy
            known.append(forward.call(linearise, vector[list(self.places(name))[: len(forward.names)]]))
        return known

    @cached_property
    def split_model(self) -> tuple[Any, Static]:
        """The model's arrays, and what is static in it wrapped for use as a key."""
        arrays, static = eqx.partition(self.model, eqx.is_array)
        return arrays, Static(static)


@dataclass(frozen=True, eq=False)
class Problem(FittingProblem):
    """A fitting problem: a stack with `Free` parameters, measurements, transport, noise model and instrument.

    Args:
        stack: a stack with `Free` in the place of each number that is fitted.
        data: `Measurements`, or `Totals`, whose shares of light then take the place of a BSDF; masked ones are not
            used.
        transport: a deterministic transport, "auto" (see `layerjax.prepare`), or any function (stack, wi, wo) ->
            values, of unit directions (N, 3) and a BSDF (N, C) in 1/sr; the stack may then be any pytree.
        noise: the noise model, see `Noise`.
        scale: a factor common to all values: a number above 0, `Free`, or None for 1.
        objective: "likelihood", or a named residual: "cosine_l2", "log1p_cos" or "cube_root".
        instrument: see `Instrument`; None: exact directions.

    Raises:
        ValueError: no parameter is free, no measurement is used, channels do not match, the noise can vanish, the
            transport does not support the stack, or a named objective is combined with free noise levels, priors or
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
    def common_names(self) -> tuple[str, ...]:
        """Names of the parameters that are common to all texels of a map."""
        return names_of({name: one for name, one in self._assembled.free.items() if one.same_for_all_texels})

    @property
    def noise_is_assumed(self) -> bool:
        """Whether the noise level is assumed, since neither data, `noise` nor instrument specify it (see `Noise`)."""
        return is_assumed(with_floor(self.noise, self.instrument), self.data)

    @property
    def problems(self) -> "dict[str, Problem]":
        """The problem itself, as the only data set."""
        return {"": self}

    @cached_property
    def without_discrepancy(self) -> "Problem":
        """The problem with independent noise, whose parameters are the first of this one."""
        if not self.noise.discrepancy:
            return self
        other, own = replace(self, noise=replace(self.noise, discrepancy=False)), self.model
        same = {name: getattr(own, name) for name in ("wi", "wo", "known", "optics", "side", "transport")}
        return other.with_model(replace(other.model, **same))

    def with_problems(self, changed: "Mapping[str, Problem]") -> "Problem":
        """The problem that replaces this one."""
        return changed.get("", self)

    def predict_at(self, vectors: ArrayLike, wi: ArrayLike, wo: ArrayLike) -> Array:
        """Scaled BSDF along other directions, (M, 3) each, with D vectors (D, P): (D, M, C), in 1/sr."""
        wi, wo = np.asarray(wi, float), np.asarray(wo, float)
        other = self.with_model(replace(self.model, **_directions(self, wi, wo)))
        return other.call(predict_each, vectors)

    def with_other_rays(self) -> "Problem":
        """The problem with other numbers of rays for the apertures, to estimate their error."""
        used = self.data.used()
        return self.with_model(replace(self.model, **_directions(self, used.wi, used.wo, other_rays=True)))

    def with_model(self, model: Model) -> "Problem":
        """The problem with other arrays in its model."""
        other = copy.copy(self)  # which takes what `__getstate__` gives
        vars(other)["_assembled"] = self._assembled._replace(model=model)
        if "without_discrepancy" in vars(self) and self.noise.discrepancy and model.wi is self.model.wi:
            vars(other)["without_discrepancy"] = self.without_discrepancy
        return other


class Joint(FittingProblem):
    """Data sets that are fitted together, each a `Problem` of its own, with parameters in common.

    It stands in the place of a stack and its data: `fits.fit(fits.Joint({...}, shared=[...]))`. What is found of one
    data set is `Fit.part(name)`, and `Posterior.part(name)`.

    Args:
        parts: the problems by name, two or more, each with a likelihood.
        shared: names of parameters that are one in all problems: ``layers[0].ior``, with all its channels, or how names
            begin, such as ``layers[0]`` for all that is free in that layer. Bounds and priors must agree; they start as
            in the first. The others are named after their problem, ``plane.scale``.

    Raises:
        ValueError: fewer than two problems, a named objective, a shared name that is not in every problem, or free
            parameters of one name that differ.
    """

    objective: Objective = "likelihood"

    def __init__(self, parts: Mapping[str, Problem], shared: Sequence[str] = ()):
        require_kind("parts", parts, Mapping)
        self.parts, self.shared = dict(parts), tuple([shared] if isinstance(shared, str) else shared)
        if len(self.parts) < 2:
            raise ValueError(f"Joint.parts is {list(self.parts)}; it must name at least two problems")
        for name, problem in self.parts.items():
            if problem.objective != "likelihood":
                raise ValueError(f"Joint.parts[{name!r}].objective is {problem.objective!r}; it must be 'likelihood'")
        _ = self._assembled

    @cached_property
    def _assembled(self) -> Assembled:
        # what is shared comes first, then the others of each data set under its name
        common = self._common()
        own = {
            part: {name if name in common else f"{part}.{name}": one for name, one in problem._assembled.free.items()}
            for part, problem in self.parts.items()
        }
        free = common | {name: one for some in own.values() for name, one in some.items() if name not in common}
        place = {name: index for index, name in enumerate(names_of(free))}
        places = tuple(tuple(place[name] for name in names_of(some)) for some in own.values())
        models = tuple(problem.model for problem in self.parts.values())
        varying = any(one.varying for one in models)
        model = JointModel(parts=models, box=Box.of(free.values()), places=places, varying=varying)
        return Assembled(free, model, places)

    def _common(self) -> dict[str, Free]:
        """What is shared, as the first data set has it. ValueError where it is not in every one, or differs."""
        sets = {part: problem._assembled.free for part, problem in self.parts.items()}
        (first, common), *others = sets.items()
        for given in self.shared:
            every = {name for free in sets.values() for name in free if _begins(given, name)}
            if not every:
                raise ValueError(f"Joint.shared: no problem has a free parameter {given!r}")
            for part, free in sets.items():
                if missing := every - set(free):
                    words = ", ".join(sorted(missing))
                    raise ValueError(f"Joint.shared: {words} is not free in {part!r}; it must be in every problem")
        common = {name: one for name, one in common.items() if any(_begins(given, name) for given in self.shared)}
        for (name, one), (part, free) in product(common.items(), others):
            own, other = ((of.shape, of.low, of.high, of.prior, of.random_walk_sd) for of in (one, free[name]))
            if own != other:
                words = f"{name} has other bounds or another prior in {part!r} than in {first!r}"
                raise ValueError(f"Joint.shared: {words}")
        return common

    def build(self, vector: ArrayLike) -> Parts:
        """Stacks, scales and noise levels with the physical vector (P,), each by the names of the data sets."""
        vector = np.asarray(vector)
        built = {name: problem.build(vector[list(self.places(name))]) for name, problem in self.parts.items()}
        parts: Any = (dict(zip(built, one, strict=True)) for one in zip(*built.values(), strict=True))
        return Parts(*parts)

    @property
    def problems(self) -> dict[str, Problem]:
        """`parts`."""
        return self.parts

    def with_problems(self, changed: Mapping[str, Problem]) -> "Joint":
        """The same with other problems in the place of those of the same names; what is new in them is not shared."""
        return Joint({**self.parts, **changed}, list(self._common())) if changed else self


def _begins(prefix: str, name: str) -> bool:
    """Whether a parameter's name is this, or that of a part of it."""
    return name == prefix or name.startswith((f"{prefix}.", f"{prefix}["))


def _assemble(problem: Problem) -> Assembled:
    """What follows from a problem; ValueError for parts that do not fit together."""
    # 1. each part is of its kind
    _require_kinds(problem)
    used, noise = problem.data.used(), with_floor(problem.noise, problem.instrument)
    if not used.values.size:
        raise ValueError("data: no sample is used; at least one must be")

    # 2. all that a parameter may stand for, in the order of `Parts`
    levels = noise_levels(noise, used)
    if problem.objective == "likelihood" and noise.floor is None:
        require_size(levels)
    process = correlation = setting = None
    if isinstance(noise.discrepancy, Discrepancy):
        process = make_process(used.wi, used.wo, used.values.shape[1])
        correlation = numbers_of(noise.discrepancy, np.asarray(process.shortest), used.values.shape[1])
    if problem.instrument is not None:
        setting = setting_of(problem.instrument, polar_angles(problem.data))
    scale = 1.0 if problem.scale is None else problem.scale
    rest = (scale, setting, levels.relative, levels.floor, correlation)
    rest = jax.tree.map(lambda x: x if is_free(x) else jnp.asarray(x), rest, is_leaf=is_free)
    template, free = split((_make_static(problem.stack), *rest), _parameter_name)
    if not free:
        raise ValueError("stack: nothing is free; put fits.Free(start, low, high) where a number is to be fitted")
    _require_weights(problem.objective, levels, process, free)
    names = names_of(free)

    # 3. the same as arrays
    model = Model(
        template=template,
        box=Box.of(free.values()),
        values=jnp.asarray(used.values),
        variance=jnp.asarray(np.broadcast_to(levels.variance, used.values.shape)),
        least_floor=jnp.asarray(levels.least_floor),
        degrees_of_freedom=jnp.asarray(float(noise.degrees_of_freedom)),
        transport=Totalling.of(used, problem.transport) if isinstance(used, Totals) else problem.transport,
        process=process,
        softness=None if process is None else jnp.asarray(levels.softness(used.values)),
        objective=problem.objective,
        tails=noise.tails,
        varying=levels.varying if process is None else levels.fitted,
        moving=sum(not name.startswith("noise.") for name in names),
        **_directions(problem, used.wi, used.wo),
    ).with_projection()
    start = jnp.asarray(np.concatenate([entry.arrays()[0].ravel() for entry in free.values()]))
    material = model.build(start).stack
    if isinstance(material, lj.Stack | lj.Mixture):
        channel_count(material)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lj.ResolutionWarning)  # nothing is solved here
        shape = eqx.filter_eval_shape(model.predict, start).shape
    if shape[-1] not in (1, used.values.shape[-1]):
        raise ValueError(f"stack: it has {shape[-1]} channels, the data {used.values.shape[-1]}: {used.channels}")
    if np.broadcast_shapes(shape, used.values.shape) != used.values.shape:
        raise ValueError(f"transport: it gives values of shape {shape}, the data have {used.values.shape}")
    return Assembled(free, model, (tuple(range(len(names))),))


def _require_kinds(problem: Problem) -> None:
    if isinstance(problem.transport, str | lj.Transport):
        require_material(problem.stack)
    elif not callable(problem.transport):  # a function takes any stack
        raise ValueError(f'transport: {abbreviate(problem.transport)} is not a Transport or "auto", nor a function')
    require_kind("data", problem.data, Measurements, fix=TO_HAVE_THEM)
    require_kind("noise", problem.noise, Noise)
    require_kind("instrument", problem.instrument, Instrument, None)
    require_choice("objective", problem.objective, get_args(Objective))
    if not (problem.scale is None or is_free(problem.scale)):
        require_number("scale", problem.scale, 0.0, open_ends=True)
    require_in_range(problem.stack)
    if isinstance(problem.data, Totals):
        for name, given in (("instrument", problem.instrument), ("noise.discrepancy", problem.noise.discrepancy)):
            if given:
                raise ValueError(f"{name} is given, but the data are totals, which have no direction of view")


def _require_weights(objective: Objective, levels: Levels, process: Process | None, free: Mapping[str, Free]) -> None:
    """A likelihood needs noise; beside a named residual nothing may stand that only a likelihood weighs."""
    if objective == "likelihood":
        if not np.all(levels.variance + np.square(levels.least_floor) > 0):
            raise ValueError("noise: sigma could become 0; give a floor above 0, or data with sigma")
        return
    weighed = [f"noise.{name}" for name in ("relative", "floor") if is_free(getattr(levels, name))]
    weighed += [] if process is None else ["noise.discrepancy"]
    for name, one in free.items():
        if isinstance(one.prior, Normal | LogNormal) or one.random_walk_sd is not None:
            weighed.append(f"the prior of {name}")
    if weighed:
        raise ValueError(f"{weighed[0]}: objective {objective!r} weighs neither levels of noise nor priors; omit it")


def _make_static(stack: Any) -> Any:
    """What is 0 or 1 stays known where the rest is traced: it costs nothing, and some transports ask for it."""
    if not isinstance(stack, lj.Mixture):
        return make_constants_static(stack) if isinstance(stack, lj.Stack) else stack
    given = [weight for weight in stack.weights.values() if weight is not None]
    most = sum(float(weight.arrays()[2] if is_free(weight) else weight) for weight in given)
    if any(map(is_free, given)) and most > 1.0:
        raise ValueError(f"Mixture.weights: at their upper bounds they sum to {most:g}; it must be at most 1")
    return stack.map_parts(_make_static)


def _parameter_name(path: str) -> str:
    """The name of a place in a tuple in the order of `Parts`."""
    index, rest = re.fullmatch(r"\[(\d)\](.*)", path, re.DOTALL).groups()  # type: ignore[union-attr]
    return plain_name(PLACES[int(index)] + rest)


def _directions(problem: Problem, wi: Floats, wo: Floats, other_rays: bool = False) -> dict[str, Any]:
    """What a model holds of measurements along these directions, (N, 3) each; other_rays: see `optics_of`."""
    transport, optics = problem.transport, None
    known: KnownDirections | KnownPairs | None = None
    of_pairs = not isinstance(problem.data, Totals)  # whose light leaves along all directions
    # where known directions are of no use, programs should not depend on how many there are
    follow = of_pairs and (
        isinstance(transport, str) or (isinstance(transport, lj.Transport) and transport.uses_known_directions)
    )
    pair = of_pairs and isinstance(transport, lj.Transport) and transport.uses_known_pairs
    if problem.instrument is not None:
        incidences = polar_angles(problem.data)
        optics = optics_of(problem.instrument, problem.stack, wi, wo, incidences, follow, other_rays)
    elif follow:
        known = known_directions(wi, wo)
    elif pair:
        known = known_pairs(wi, wo)
    return {
        "wi": jnp.asarray(wi),
        "wo": jnp.asarray(wo),
        "known": known,
        "optics": optics,
        "side": "reflection" if np.all(wi[:, 2] > 0) and np.all(wo[:, 2] > 0) else "all",
    }


def with_floor(noise: Noise, instrument: Instrument | None) -> Noise:
    """The noise with an instrument's floor."""
    if instrument is None or instrument.floor is None:
        return noise
    if noise.floor is not None:
        raise ValueError("Noise.floor and Instrument.floor are both given; there is one floor")
    return replace(noise, floor=instrument.floor)


def polar_angles(data: Measurements) -> Floats:
    """Polar angles of the light, (K,), of the used samples, in degrees; within `SAME_ANGLE` they are one."""
    theta = data.used().theta_i
    return np.round([np.mean(theta[rows]) for rows in groups(theta)], 2)


def unit(name: str) -> str:
    """The unit of a parameter of this name; "1" for plain ratios."""
    whole = re.sub(r"\[\d+\]$|\.amplitude$", "", name)  # of a channel, or of a power law's reference
    return next((one for end, one in UNITS.items() if whole.endswith(end)), "1")
