"""Time per direction pair of the forward models and of their gradients, beside plain numpy and the peers."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

import layerjax as lj
from benchmarks.measuring import operations, timing
from benchmarks.measuring.timing import interleaved, once
from benchmarks.measuring.writing import Bar, figure, table
from benchmarks.peers import functions as peers
from benchmarks.peers import plain_numpy
from benchmarks.suite.scenes import CONDUCTOR, REFLECTION, SCENES, Parameters, Scene, pairs

BARS = {
    (CONDUCTOR.name, "float32", "value"): Bar(5.0, 2.0),
    (CONDUCTOR.name, "float32", "value and gradient"): Bar(1.2, 0.5),
    (REFLECTION.name, "float32", "value"): Bar(4.0, 2.0),
    (REFLECTION.name, "float32", "value and gradient"): Bar(0.35, 0.2),
}
BRIGHTER = 1.1
"""The loss is the mean squared difference from the exact values times this."""
PEERS = ("peer", "tuned")
FINITE_DIFFERENCES_SHARE = 20
"""numpy's finite differences run on one pair in this many: on all of them they take minutes."""


@dataclass(frozen=True)
class Size:
    """How much is measured."""

    pairs: int
    rounds: int
    scenes: tuple[Scene, ...] = SCENES
    precisions: tuple[str, ...] = ("float32", "float64")


DEFAULT, QUICK = Size(1_000_000, 15), Size(1_000_000, 3)


@dataclass(frozen=True)
class Row:
    """Medians in nanoseconds per pair, with the quartiles of layerjax and of the peer.

    ratio: the median over rounds of layerjax's time over the peer's. tuned, tuned_ratio: the same for a gradient in
    Dr.Jit's favourite form (see `peers`), which the bars do not refer to. error: largest relative difference of the
    values from numpy's in float64, or of the gradient from the peer's in the same precision. operations: of the
    lowered program. compile_seconds: tracing and compiling, before any of the times here.
    """

    scene: str
    precision: str
    work: str
    layerjax: float
    numpy: float
    peer: float | None
    peer_name: str | None
    ratio: float | None
    tuned: float | None
    tuned_ratio: float | None
    quartiles: dict[str, list[float]]
    bar: str
    verdict: str
    compile_seconds: float
    operations: int
    error: float | None


def run(size: Size, peers_missing: str | None, report: Callable[[str], None]) -> list[Row]:
    """Measure the scenes in each precision; `peers_missing` says why the peers are omitted, if they are."""
    rows = []
    for scene in size.scenes:
        for precision in size.precisions:
            report(f"{scene.name}, {precision}")
            rows += measure(scene, precision, size, peers_missing is None)
    return rows


def measure(scene: Scene, precision: str, size: Size, with_peers: bool) -> list[Row]:
    """The two rows, value and value with gradient, of one scene in one precision."""
    exact_wi, exact_wo = pairs(size.pairs, scene.side)
    model = plain_numpy.model_of(scene.parameters)
    exact = np.stack(model(scene.parameters, exact_wi.T, exact_wo.T, scene.side), axis=-1)
    wi, wo, target = (a.astype(precision) for a in (exact_wi, exact_wo, BRIGHTER * exact))
    peer = peers.of(scene, wi, wo, target, precision == "float64") if with_peers else None
    plain = {name: np.asarray(value, precision) for name, value in scene.parameters.items()}
    columns = [np.ascontiguousarray(w.T) for w in (wi, wo)]
    thin = [np.ascontiguousarray(a[::FINITE_DIFFERENCES_SHARE].T) for a in (wi, wo, target)]

    def values(p: Parameters, wi: Array, wo: Array) -> Array:
        return lj.evaluate(scene.build(p), wi, wo, lj.SingleScattering(), side=scene.side)

    def loss(p: Parameters, wi: Array, wo: Array, target: Array) -> Array:
        return jnp.sum(jnp.mean((values(p, wi, wo) - target) ** 2, axis=0))

    slowly = once(lambda: plain_numpy.gradient(plain, thin[0], thin[1], thin[2], scene.side))
    rows = []
    programs: tuple[tuple[str, Callable[..., Any], tuple[NDArray[Any], ...]], ...] = (
        ("value", values, (wi, wo)),
        ("value and gradient", jax.value_and_grad(loss), (wi, wo, target)),
    )
    for work, function, arrays in programs:
        arguments: tuple[Any, ...] = (scene.arrays(precision), *map(jnp.asarray, arrays))
        compiled, compile_seconds = timing.compiled(function, arguments)
        ways: dict[str, Callable[[], Any]] = {"layerjax": timing.waiting(compiled, arguments)}
        result: Any = ways["layerjax"]()
        if work == "value":
            ways["numpy"] = lambda: model(plain, *columns, scene.side)
            error: float | None = _difference(np.asarray(result, float), exact)
        else:
            error = None if peer is None else _difference(_flat(result[1], scene), _numbers(peer.gradient()[1]))
        if peer is not None:
            ways["peer"] = peer.value if work == "value" else peer.gradient
            if work != "value":
                ways["tuned"] = peer.tuned_gradient
        nanoseconds = {way: 1e9 / size.pairs * t for way, t in interleaved(ways, size.rounds).items()}
        nanoseconds.setdefault("numpy", np.array([1e9 / thin[0].shape[1] * slowly]))
        few = (jnp.asarray(array[:8]) for array in arrays)
        counted = operations.total(function, scene.arrays(precision), *few)
        rows.append(
            _row(scene, precision, work, nanoseconds, peer.name if peer else None, compile_seconds, counted, error)
        )
    return rows


def markdown(rows: list[Row]) -> str:
    """The rows as a table."""
    header: tuple[str, ...] = (
        "ns a pair (median)",
        "type",
        "work",
        "layerjax",
        "numpy",
        "peer",
        "ratio",
        "bar (aim)",
        "verdict",
        "tuned",
        "ratio",
    )
    header += ("compile s", "operations", "difference")
    body = [
        (
            row.scene,
            row.precision,
            row.work,
            figure(row.layerjax),
            figure(row.numpy),
            f"{figure(row.peer)} {row.peer_name}" if row.peer_name else "-",
            figure(row.ratio),
            row.bar,
            row.verdict,
            figure(row.tuned),
            figure(row.tuned_ratio),
            figure(row.compile_seconds, 2),
            str(row.operations),
            "-" if row.error is None else f"{row.error:.0e}",
        )
        for row in rows
    ]
    return table(header, body)


def as_json(rows: list[Row]) -> list[dict[str, Any]]:
    """The rows as plain data."""
    return [asdict(row) for row in rows]


def _row(
    scene: Scene,
    precision: str,
    work: str,
    nanoseconds: dict[str, NDArray[np.float64]],
    peer_name: str | None,
    compile_seconds: float,
    counted: int,
    error: float | None,
) -> Row:
    medians = {way: float(np.median(times)) for way, times in nanoseconds.items()}
    ratios = {
        way: float(np.median(nanoseconds["layerjax"] / times)) for way, times in nanoseconds.items() if way in PEERS
    }
    ratio = ratios.get("peer")
    bar = BARS.get((scene.name, precision, work))
    return Row(
        scene=scene.name,
        precision=precision,
        work=work,
        layerjax=medians["layerjax"],
        numpy=medians["numpy"],
        peer=medians.get("peer"),
        peer_name=peer_name,
        ratio=ratio,
        tuned=medians.get("tuned"),
        tuned_ratio=ratios.get("tuned"),
        quartiles={way: np.quantile(times, [0.25, 0.75]).tolist() for way, times in nanoseconds.items()},
        bar=bar.words() if bar else "",
        verdict="" if bar is None else "no peer" if ratio is None else bar.verdict(ratio),
        compile_seconds=compile_seconds,
        operations=counted,
        error=error,
    )


def _flat(gradient: dict[str, Array], scene: Scene) -> NDArray[np.float64]:
    return np.concatenate([np.ravel(np.asarray(gradient[name], float)) for name in scene.parameters])


def _numbers(slopes: list[Any]) -> NDArray[np.float64]:
    return np.concatenate([np.ravel(np.array(slope, dtype=float)) for slope in slopes])


def _difference(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> float:
    return float(np.max(np.abs(ours - theirs) / np.abs(theirs)))
