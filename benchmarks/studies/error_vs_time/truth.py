"""What the models are compared with, how far it can itself be trusted, and whether the two references agree."""

import dataclasses
import io
import time
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array
from numpy.typing import NDArray

import layerjax as lj
from benchmarks.measuring.accuracy import Values, relative_l2, scale, worst
from benchmarks.suite.cases import Case, Directions

STANDARD_ERRORS, TOLERANCE = 4.0, 0.01
"""Two references agree within the larger of so many standard errors and this share of the value."""

PROBED = 256
"""Paths by which the time of a walk is estimated."""

ROUNDED = 1e-14
"""1/sr: what sums of 64 modes of light of order 1 are rounded to in float64, and no path of a walk ever brings."""

ROUNDING = 1e-9
"""Relative error of sums in float64: the least limit of a truth, also where it is exact."""


@dataclass(frozen=True)
class References:
    """Who says what is true: the truth, the walk that checks it, and the two whose default settings are compared.

    The uncertainty of the truth is its difference from its own coarser resolution.
    """

    truth: lj.Transport
    check: lj.Transport
    solver: lj.Transport
    walk: lj.Transport


REFERENCES = References(
    truth=lj.AddingDoubling(nodes=48, modes=64, ordinates=(14, 24)),
    check=lj.RandomWalk(paths=2**15),
    solver=lj.AddingDoubling(),
    walk=lj.RandomWalk(),
)


@dataclass(frozen=True)
class Truth:
    """Values and their uncertainty, (n, C); albedos of the lights, reflected and transmitted, (2, k, C)."""

    values: Values
    uncertainty: Values
    albedo: NDArray[np.float64]
    albedo_uncertainty: float


@dataclass(frozen=True)
class Check:
    """What a walk says of another transport's values at some pairs.

    z: difference over standard error, (n, C). bias: relative L2 of what the walk's noise does not explain, 0 if all of
    it may be noise. failures: how many values are further apart than agreed on, on the light's side and on the other.
    worst: the largest difference among them, relative to the value (0 if there is none).
    """

    z: Values
    bias: float
    failures: tuple[int, int]
    worst: float


@dataclass(frozen=True)
class Judged:
    """What is known of the truth of one stack, and whether the references agree on it at their default settings.

    uncertainty: of the relative L2, of the worst value and of the albedo, by two resolutions. bias: relative L2 that
    the walk finds beyond its noise, at `walked` pairs. z: root mean square and largest, truth against walk. compared,
    failures, worst: values of the default solver against the default walk of so many paths (see `Check`); cause: why
    they differ, if that is known.
    """

    stack: str
    family: str
    source: str
    remark: str
    pairs: int
    walked: int
    uncertainty: float
    worst_uncertainty: float
    albedo_uncertainty: float
    bias: float
    z_root_mean_square: float
    z_largest: float
    compared: int
    failures: tuple[int, int]
    worst: float
    paths: int
    date: str
    seconds: float
    cause: str = ""

    @property
    def limit(self) -> float:
        """Relative L2 error below which the truth says nothing."""
        return max(self.uncertainty, self.bias, ROUNDING)

    @property
    def agrees(self) -> bool:
        """Whether the references agree in every value."""
        return sum(self.failures) == 0


def judge(case: Case, references: References, walked: int, longest: float = np.inf) -> tuple[Judged, Truth]:
    """The truth of a stack, checked with a walk; and the default solver against the default walk.

    walked: pairs. longest: seconds; walks that would take longer have fewer paths (light may
    turn between lossless interfaces for very long).
    """
    began = time.perf_counter()
    directions = case.directions
    truth = reference(case.stack, directions, references.truth)
    indices = directions.some(walked)
    checked, _ = _walked(case, references.check, 0, truth.values[indices], truth, indices, longest)
    agreement, paths = _agreement(case, references, truth, indices, longest)
    return Judged(
        stack=case.name,
        family=case.family,
        source=case.source,
        remark=case.remark,
        pairs=len(directions.wi),
        walked=len(indices),
        uncertainty=relative_l2(truth.uncertainty, truth.values, directions.weights),
        worst_uncertainty=worst(truth.uncertainty, scale(truth.values, truth.albedo, directions)),
        albedo_uncertainty=truth.albedo_uncertainty,
        bias=checked.bias,
        z_root_mean_square=float(np.sqrt(np.mean(checked.z**2))),
        z_largest=float(np.max(checked.z)),
        compared=agreement.z.size,
        failures=agreement.failures,
        worst=agreement.worst,
        paths=paths,
        date=time.strftime("%Y-%m-%d", time.gmtime()),
        seconds=time.perf_counter() - began,
        cause=case.differs,
    ), truth


def agree_anew(
    case: Case, references: References, judged: Judged, truth: Truth, longest: float = np.inf
) -> tuple[Judged, Truth]:
    """What is known of a truth, with the default solver set against the default walk once more."""
    indices = case.directions.some(judged.walked)
    agreement, paths = _agreement(case, references, truth, indices, longest)
    return dataclasses.replace(
        judged, failures=agreement.failures, worst=agreement.worst, paths=paths, cause=case.differs
    ), truth


def _agreement(
    case: Case, references: References, truth: Truth, indices: NDArray[np.intp], longest: float
) -> tuple[Check, int]:
    """The default solver against the default walk, at some pairs; and the paths that the walk had."""
    values = np.asarray(lj.evaluate(case.stack, case.directions.wi, case.directions.wo, references.solver))
    agreement, walk = _walked(case, references.walk, 1, values[indices], truth, indices, longest)
    return agreement, getattr(walk, "paths", 0)


def _walked(
    case: Case,
    walk: lj.Transport,
    run: int,
    values: Values,
    truth: Truth,
    indices: NDArray[np.intp],
    longest: float,
) -> tuple[Check, lj.Transport]:
    """What a walk, with as many paths as time allows, says of values at some pairs."""
    few = case.directions.take(indices)
    walk = affordable(walk, case.stack, few, longest)
    estimates, errors = lj.evaluate_with_error(case.stack, few.wi, few.wo, walk, key=key_of(case.name, run))
    return compare(values, np.asarray(estimates), np.asarray(errors), truth.albedo, few), walk


def affordable(walk: lj.Transport, stack: lj.Stack, directions: Directions, longest: float) -> lj.Transport:
    """The walk with as many paths as so many seconds allow, at most its own."""
    if not isinstance(walk, lj.RandomWalk) or walk.paths < 2 * PROBED or not np.isfinite(longest):
        return walk
    probe = dataclasses.replace(walk, paths=PROBED)
    seconds = []
    for run in range(2):  # the first compiles
        began = time.perf_counter()
        found = lj.evaluate(stack, directions.wi, directions.wo, probe, key=jax.random.key(run))
        jax.block_until_ready(found)
        seconds.append(time.perf_counter() - began)
    paths = walk.paths
    while paths > PROBED and seconds[1] * paths / PROBED > longest:
        paths //= 2
    return dataclasses.replace(walk, paths=paths)


def reference(stack: lj.Stack, directions: Directions, transport: lj.Transport) -> Truth:
    """The truth for a stack, with the error estimate of two resolutions."""
    values, uncertainty = lj.evaluate_with_error(stack, directions.wi, directions.wo, transport)
    albedo = albedos(stack, directions, transport)
    coarser = lj.choose_transport(stack, transport=transport).coarser()
    other = albedo if coarser is None else albedos(stack, directions, coarser)
    return Truth(np.asarray(values), np.asarray(uncertainty), albedo, float(np.max(np.abs(albedo - other))))


def albedos(
    stack: lj.Stack | lj.Prepared, directions: Directions, transport: lj.Transport, key: Array | None = None
) -> NDArray[np.float64]:
    """Directional albedos of all lights, reflected and transmitted, (2, k, C)."""
    return np.stack([np.asarray(side) for side in lj.albedo(stack, directions.lights, transport, key=key)])


def compare(
    values: Values, estimates: Values, errors: Values, albedo: NDArray[np.float64], directions: Directions
) -> Check:
    """What estimates with standard errors say of the values, at the pairs of directions."""
    apart = np.abs(estimates - values)
    size = scale(values, albedo, directions)
    # where all paths that count give the same, or none comes, the error is rounding
    noise = np.maximum(np.maximum(errors, ROUNDING * size), ROUNDED)
    z = apart / noise
    weights = directions.weights[:, None]
    beyond = np.sum(weights * (apart**2 - noise**2)) / np.sum(weights * size**2)
    by_chance = np.mean(z**2) <= 1.0 + STANDARD_ERRORS * np.sqrt(2.0 / z.size)  # the scatter of chi square
    failed = apart > np.maximum(STANDARD_ERRORS * noise, TOLERANCE * size)
    through = int(failed[directions.transmits].sum())
    return Check(
        z=z,
        bias=0.0 if by_chance else float(np.sqrt(max(beyond, 0.0))),
        failures=(int(failed.sum()) - through, through),
        worst=float(np.max(np.where(failed, apart / size, 0.0))),
    )


def pack(truths: Mapping[str, Truth]) -> bytes:
    """Booleans by stack as the bytes of an .npz file."""
    arrays = {f"{name}/{part}": value for name, truth in truths.items() for part, value in vars(truth).items()}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def unpack(path: Path) -> dict[str, Truth]:
    """What `pack` wrote; nothing where there is no such file."""
    if not path.exists():
        return {}
    parts: dict[str, dict[str, Any]] = {}
    with np.load(path) as arrays:
        for key, value in arrays.items():
            name, part = key.split("/")
            parts.setdefault(name, {})[part] = value if value.ndim else float(value)
    return {name: Truth(**part) for name, part in parts.items()}


def key_of(name: str, run: int) -> Array:
    """The key of a stack's walks: the same every time, another for every run."""
    return jax.random.fold_in(jax.random.key(zlib.crc32(name.encode())), run)
