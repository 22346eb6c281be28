"""The models that are set against each other, and the measurement of one of them on one stack."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import layerjax as lj
from benchmarks.measuring import operations, timing
from benchmarks.measuring.accuracy import relative_l2, scale, worst
from benchmarks.studies.error_vs_time.truth import Truth, albedos, key_of
from benchmarks.suite.cases import Case, Directions
from layerjax.stack import simplify, simplify_and_name


@dataclass(frozen=True)
class Model:
    """A way of solving a stack, at one resolution or at several, from coarse to fine, each with a label.

    called: whether the stack itself is evaluated, so that its directions are known, in place of a prepared one.
    albedos: whether they are compared too.
    """

    name: str
    steps: Mapping[str, lj.Transport]
    called: bool = False
    albedos: bool = True


MODELS = (
    Model("single scattering", {"first order": lj.SingleScattering()}),
    Model("SpongeCake", {"two lobes": lj.SpongeCake()}),
    Model("statistics, forward", {"2018": lj.Statistical(symmetric=False, facet_multiple_scattering=False)}),
    Model("statistics, symmetric", {"2018": lj.Statistical(facet_multiple_scattering=False)}),
    Model("ENDF, paper", {"one bounce": lj.ENDF(form="paper")}),
    Model("ENDF, reciprocal", {"one bounce": lj.ENDF()}),
    Model("Weidlich & Wilkie", {"one half vector": lj.WeidlichWilkie()}),
    Model(
        "adding-doubling",
        {
            f"{nodes} nodes": lj.AddingDoubling(nodes=nodes, modes=3 * nodes // 2, ordinates=ordinates)
            for nodes, ordinates in ((8, (6, 12)), (16, (8, 16)), (32, (10, 24)))
        },
    ),
    Model(
        "adding-doubling, fixed directions",
        {f"{nodes} nodes": lj.AddingDoubling(nodes=nodes, modes=3 * nodes // 2) for nodes in (6, 12, 24)},
        called=True,
        albedos=False,  # of all directions: by tables, as above
    ),
    Model("adding-doubling, automatic resolution", {"default": lj.AddingDoubling()}, called=True),
    Model("random walk", {f"{2**k:,} paths": lj.RandomWalk(paths=2**k) for k in (8, 11, 14)}),
)
"""What is compared. A model joins by a line here."""


VALUES = 10_000
"""Of one stack: so many are timed at once, and what the stack costs once is spread over as many."""

STEP = 8.0
"""A step of a model costs up to so many times the one before."""


@dataclass(frozen=True)
class Size:
    """How much is measured.

    batch: pairs that one timed evaluation has (those of the stack, repeated), `walked` for walks. rounds: repeats, of
    which the median counts. longest: seconds; a model's steps end before one that would take longer, as far as the last
    one tells.
    """

    batch: int = VALUES
    walked_opaque: int = 15
    walked_transmitting: int = 20
    rounds: int = 5
    longest: float = 30.0

    def walked(self, case: Case) -> int:
        """Pairs at which a walk is evaluated."""
        return self.walked_opaque if case.stack.base is not None else self.walked_transmitting


@dataclass(frozen=True)
class Run:
    """What a model gave at one resolution, and what it cost. indices: the evaluated pairs of the stack."""

    model: str
    step: str
    indices: NDArray[np.intp]
    values: NDArray[np.float64]
    albedo: NDArray[np.float64] | None
    nanoseconds_per_value: float
    prepare_seconds: float
    compile_seconds: float | None
    operations: int
    seconds: float


@dataclass(frozen=True)
class Row:
    """One model at one resolution on one stack.

    Errors are None where a value was not finite or is not compared, compile_seconds where compiled programs were read
    from JAX's cache on disk.
    """

    stack: str
    family: str
    model: str
    step: str
    pairs: int
    l2: float | None
    worst: float | None
    albedo: float | None
    nanoseconds_per_value: float
    prepare_seconds: float
    compile_seconds: float | None
    operations: int
    truth_limits: bool


def named(names: Sequence[str] | None) -> list[Model]:
    """The registered models of these names, all if None. ValueError for a name that is none."""
    known = {model.name: model for model in MODELS}
    for name in names or ():
        if name not in known:
            raise ValueError(f"model {name!r} is not one of {', '.join(map(repr, known))}")
    return [model for model in MODELS if names is None or model.name in names]


class Programs:
    """Compile times and operation counts, by structure: stacks that differ in numbers alone share their programs."""

    def __init__(self) -> None:
        self._known: dict[Any, tuple[float | None, int]] = {}

    def of(self, key: Any, seconds: float, count: Callable[[], int]) -> tuple[float | None, int]:
        """The figures of this structure; those given, if it is the first time that it is met."""
        if key not in self._known:
            cached = getattr(jax.config, "jax_compilation_cache_dir", None) is not None
            self._known[key] = (None if cached else max(seconds, 0.0), count())
        return self._known[key]


def supports(transport: lj.Transport, stack: lj.Stack) -> bool:
    """Whether the transport carries this stack."""
    try:
        transport.check(*simplify_and_name(stack))
    except ValueError:
        return False
    return True


def run(case: Case, model: Model, size: Size, programs: Programs) -> list[Run]:
    """Every step of a model on a stack, as far as time allows."""
    runs: list[Run] = []
    for label, transport in model.steps.items():
        if not supports(transport, case.stack):
            break
        measure = _called if model.called else _prepared
        runs.append(measure(case, model, label, transport, size, programs))
        if STEP * runs[-1].seconds > size.longest:
            break
    return runs


def _prepared(case: Case, model: Model, label: str, transport: lj.Transport, size: Size, programs: Programs) -> Run:
    """Evaluate a stack that is prepared once."""
    directions = case.directions
    if transport.random:
        indices = turns = directions.some(size.walked(case))
        key = key_of(case.name, 2)
    else:
        indices, turns = _in_turn(directions, size)
        key = None
    wi, wo = jnp.asarray(directions.wi[turns]), jnp.asarray(directions.wo[turns])

    def prepare() -> lj.Prepared:
        return jax.block_until_ready(lj.prepare(case.stack, transport))

    def evaluate() -> jax.Array:
        return jax.block_until_ready(lj.evaluate(prepared, wi, wo, key=key))

    prepared, preparing, prepare_seconds = timing.cold_and_warm(prepare, size.rounds)
    values, evaluating, seconds = timing.cold_and_warm(evaluate, size.rounds)
    compiling = max(preparing - prepare_seconds, 0.0) + max(evaluating - seconds, 0.0)
    compile_seconds, counted = programs.of(
        _structure(case.stack, label, model.name, len(turns)), compiling, lambda: _operations(prepared, wi, wo, key)
    )
    return Run(
        model=model.name,
        step=label,
        indices=indices,
        values=np.asarray(values)[: len(indices)],
        albedo=albedos(prepared, directions, transport, key) if model.albedos else None,
        nanoseconds_per_value=1e9 * seconds / len(turns),
        prepare_seconds=prepare_seconds,
        compile_seconds=compile_seconds,
        operations=counted,
        seconds=prepare_seconds + seconds,
    )


def _called(case: Case, model: Model, label: str, transport: lj.Transport, size: Size, programs: Programs) -> Run:
    """Evaluate a stack that is not prepared: its cost once is that of a call for its own pairs."""
    directions = case.directions
    indices, turns = _in_turn(directions, size)

    def call(wi: NDArray[np.float64], wo: NDArray[np.float64]) -> jax.Array:
        return jax.block_until_ready(lj.evaluate(case.stack, wi, wo, transport))

    values, calling, few = timing.cold_and_warm(lambda: call(directions.wi, directions.wo), size.rounds)
    _, _, many = timing.cold_and_warm(lambda: call(directions.wi[turns], directions.wo[turns]), size.rounds)
    arrays, others = eqx.partition(case.stack, eqx.is_array_like)
    compile_seconds, counted = programs.of(
        _structure(case.stack, label, model.name, len(indices)),
        calling - few,
        lambda: operations.total(
            lambda arrays: lj.evaluate(
                eqx.combine(arrays, others),
                directions.wi,
                directions.wo,
                lj.choose_transport(case.stack, transport=transport),
            ),
            arrays,
        ),
    )
    return Run(
        model=model.name,
        step=label,
        indices=indices,
        values=np.asarray(values),
        albedo=albedos(case.stack, directions, transport) if model.albedos else None,
        nanoseconds_per_value=1e9 * max(many - few, 0.0) / (len(turns) - len(indices)),
        prepare_seconds=few,
        compile_seconds=compile_seconds,
        operations=counted,
        seconds=many,
    )


def _in_turn(directions: Directions, size: Size) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """All pairs of a stack, and as many as a timed evaluation has."""
    indices = np.arange(len(directions.wi))
    return indices, np.arange(max(size.batch, 2 * len(indices))) % len(indices)


def row(case: Case, run: Run, truth: Truth, limit: float) -> Row:
    """The errors of a run beside its times. limit: relative L2 error of the truth."""
    directions, values = case.directions.take(run.indices), truth.values[run.indices]
    error = run.values - values
    l2 = _finite(relative_l2(error, values, directions.weights))
    return Row(
        stack=case.name,
        family=case.family,
        model=run.model,
        step=run.step,
        pairs=len(run.indices),
        l2=l2,
        worst=_finite(worst(error, scale(values, truth.albedo, directions))),
        albedo=None if run.albedo is None else _finite(float(np.max(np.abs(run.albedo - truth.albedo)))),
        nanoseconds_per_value=run.nanoseconds_per_value,
        prepare_seconds=run.prepare_seconds,
        compile_seconds=run.compile_seconds,
        operations=run.operations,
        truth_limits=l2 is not None and l2 <= limit,
    )


def _operations(prepared: lj.Prepared, wi: jax.Array, wo: jax.Array, key: jax.Array | None) -> int:
    arrays, others = eqx.partition(prepared, eqx.is_array)
    return operations.total(lambda arrays: lj.evaluate(eqx.combine(arrays, others), wi, wo, key=key), arrays)


def _structure(stack: lj.Stack, label: str, name: str, pairs: int) -> Any:
    """What decides which program is compiled: everything but the numbers."""
    leaves, tree = jax.tree.flatten(simplify(stack))
    return name, label, pairs, str(tree), tuple(leaf if isinstance(leaf, float) else leaf.shape for leaf in leaves)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
