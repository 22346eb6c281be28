"""The two references beside their peers: PythonicDISORT for `AddingDoubling`, Mitsuba's volpath for `RandomWalk`."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import layerjax as lj
from benchmarks.measuring import environment
from benchmarks.measuring.timing import Work, interleaved
from benchmarks.measuring.writing import DIRECTORY, NOT_REACHED, Bar, environment_lines, write
from benchmarks.peers import disort
from benchmarks.peers import functions as peers
from benchmarks.peers.mitsuba_volpath import Volpath
from benchmarks.studies.references import speed
from benchmarks.studies.references.ways import Way, cheapest, largest_error, spread, way_of
from benchmarks.studies.throughput.fitting import Row, as_json, markdown

Floats = NDArray[np.float64]

FULL_BRDF, WALK, FIXED_ERROR, ANISOTROPIC = Bar(0.05, 0.02), Bar(0.4, 0.2), Bar(1e-2, 1e-3), Bar(100.0, 10.0)

AZIMUTHS = np.linspace(0.0, np.pi, 33)
INCIDENCE = (np.arange(16) + 0.5) / 16
VIEW = disort.nodes(32)[:16]
"""Cosines of the full BRDF; those of the viewer are DISORT's own at 32 streams, where it need not interpolate."""

UNLIMITED = 10_000
"""Events after which Mitsuba's Russian roulette begins, if its paths are to end as ours do: by leaving."""

SLAB = {"thickness": 1.0, "g": 0.7, "albedo": 0.99}
STREAMS = (8, 12, 16, 24, 32, 48, 64, 96, 128)
RESOLUTIONS = (
    *((6, 8), (6, 10), (8, 8), (8, 10), (8, 12), (10, 12), (10, 16), (12, 16), (14, 16), (16, 16), (16, 20), (16, 24)),
    *((20, 24), (20, 32), (24, 32), (24, 48), (32, 48), (32, 64)),
)
"""Nodes and modes of `AddingDoubling` that are tried, and below nodes and azimuths where an axis needs them."""
FULL_RESOLUTIONS = (
    *((14, 14), (15, 14), (14, 16), (16, 14), (16, 16), (16, 20), (20, 24)),
    *((24, 32), (28, 36), (28, 40), (32, 40), (32, 48), (40, 48)),
)
"""Nodes and modes of `AddingDoubling` that are tried for the full BRDF."""
FINEST, FINE = (64, 96), (32, 64)
"""What counts as exact: for the full BRDF, and where 1 % is required."""
ANISOTROPIC_RESOLUTIONS = ((4, 8), (6, 12), (8, 16), (10, 16), (10, 20), (10, 24), (12, 24), (16, 24), (16, 32))

COAT = lj.Stack([lj.Interface(1.5, 0.3), lj.Medium(1.0, 0.95, lj.HenyeyGreenstein(0.7))], lj.Lambertian(0.5))
FLAKES = lj.Stack([lj.Medium(2.0, 0.95, lj.SGGX("surface", 0.4)), lj.Medium(1.0, 0.9, lj.HenyeyGreenstein(0.5))])
SYMMETRIC = lj.Stack([lj.Medium(0.5, 0.9, lj.SGGX("fiber", 0.3)), lj.Medium(1.0, 0.9, lj.SGGX("surface", 0.4))])
TILTED = lj.Stack(
    [
        lj.Medium(0.5, 0.9, lj.SGGX("fiber", 0.3, (1.0, 0.0, 0.0))),
        lj.Medium(1.0, 0.9, lj.SGGX("surface", 0.4, (0.4, 0.2, 0.9))),
    ]
)

TEXT = """\
# References compared with peers

{environment}
Wall times, medians of {rounds} interleaved rounds, without compilation; *ratio* is layerjax over the other, the median
of the ratios within a round. Errors are the largest relative ones; values below 1e-3 of the largest are relative to
that. For the full BRDF (16 x 16 cosines, 33 azimuths), each solver runs at the resolution of a fixed series (nodes x
modes of `AddingDoubling`, streams x modes of DISORT) that reaches the error in the least time, from the parameters to
the values. Otherwise `AddingDoubling` runs at the first resolution that reaches the error. For layers with axes it is
the root mean square difference to the random walk. Bars: required, and in brackets the aim. {peers}

{rows}
{speed}"""


CALLED = speed.Size(rounds=21)


@dataclass(frozen=True)
class Size:
    """How much is measured.

    rounds: interleaved repeats. paths: of a walk per pair. errors: to be reached in the full BRDF. depths: thickness of
    the slabs that are walked. pairs: directions of the comparison of walk and solver. called: of the table of times.
    """

    rounds: int
    paths: int
    errors: tuple[float, ...] = (1e-3, 2e-4)
    depths: tuple[float, ...] = (1.0, 10.0)
    pairs: int = 64
    called: speed.Size = CALLED


DEFAULT = Size(7, 1 << 20)
QUICK = Size(3, 1 << 18, errors=(1e-3,), called=speed.Size(rounds=5, starts=4))


def study(
    quick: bool = False,
    with_peers: bool = True,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    size: Size | None = None,
) -> tuple[str, tuple[Path, Path]]:
    """Measure, and write ``references.json`` and ``references.md``; returns the markdown and the two paths."""
    size = size or (QUICK if quick else DEFAULT)
    surroundings = environment.describe()
    missing = {
        name: reason if with_peers else "omitted on request"
        for name, reason in (("PythonicDISORT", disort.why_not()), ("Mitsuba", peers.why_not()))
        if reason is not None or not with_peers
    }
    rows = []
    if "PythonicDISORT" not in missing:
        rows += full_brdf(size, report)
    if "Mitsuba" not in missing:
        rows += walks(size, report)
    rows += fixed_error(size, report)
    fibers, bar = anisotropic(size, report), speed.FIBERS
    rows.append(fibers)
    fast = speed.rows(size.called, "PythonicDISORT" not in missing, report)
    fast.append(speed.row(fibers.work, fibers.unit, fibers.ours, bar, "", fibers.verdict != NOT_REACHED))
    absent = "; ".join(f"{name} did not run: {reason}" for name, reason in missing.items())
    text = TEXT.format(
        environment=environment_lines(surroundings),
        rounds=size.rounds,
        peers=f"{absent}." if absent else "Peers: PythonicDISORT and Mitsuba 3 (`llvm_ad_rgb`), same run.",
        rows=markdown(rows),
        speed=speed.markdown(fast),
    )
    content = {
        "environment": surroundings,
        "rounds": size.rounds,
        "peers missing": missing,
        "rows": as_json(rows),
        "speed": [asdict(row) for row in fast],
    }
    return text, write("references", content, text, directory)


def full_brdf(size: Size, report: Callable[[str], None]) -> list[Row]:
    """Milliseconds of the BRDF of a haze, solver against solver at equal error."""
    haze = lj.Medium(SLAB["thickness"], SLAB["albedo"], lj.HenyeyGreenstein(SLAB["g"]))
    stack = lj.Stack([haze])
    wi = lj.direction(np.arccos(INCIDENCE)[:, None, None], 0.0)
    wo = lj.direction(np.arccos(VIEW)[:, None], AZIMUTHS)
    report("full BRDF: the truth")
    exact = _solver(stack, wi, wo, FINEST, "reflection")()[..., 0]
    other = _discrete_ordinates(max(STREAMS), max(STREAMS), True)()
    known = largest_error(other, exact)
    report(f"full BRDF: AddingDoubling {FINEST} and DISORT {max(STREAMS)} differ by {known:.0e}")
    theirs = [
        way_of(f"{n} x {m}{', corrected' * corrected}", _discrete_ordinates(n, m, corrected), exact)
        for n in STREAMS
        for m in (n // 2, n)
        for corrected in (False, True)
    ]
    ours = [
        way_of(f"{n} x {m}", _compiled(stack, wi, wo, (n, m), "reflection"), exact[..., None])
        for n, m in FULL_RESOLUTIONS
    ]
    rows = []
    for error in size.errors:
        report(f"full BRDF: error {error:g}")
        mine = cheapest(ours, error)
        yours = cheapest(theirs, error)
        seconds = interleaved({"ours": mine.work, "theirs": yours.work}, size.rounds)
        short = "".join(
            f"; {name} falls short" for name, way in (("ours", mine), ("DISORT", yours)) if way.error > error
        )
        note = f"{mine.name} ({mine.error:.0e}); DISORT {yours.name} ({yours.error:.0e}){short}; known to {known:.0e}"
        work = f"full BRDF of a haze, error {error:g}"
        rows.append(_row(work, "ms", 1e3, seconds, "PythonicDISORT", FULL_BRDF, note, mine.error <= error))
    return rows


def walks(size: Size, report: Callable[[str], None]) -> list[Row]:
    """Nanoseconds a path with next-event estimation, in float32: both until they leave, and as Mitsuba comes."""
    wi, wo = np.asarray(lj.direction(0.5, 0.0)), np.asarray(lj.direction(0.6, 3.0))
    narrow = [jnp.asarray(w, jnp.float32) for w in (wi, wo)]
    rows = []
    for depth in size.depths:
        report(f"walk: thickness {depth:g}")
        stack = lj.Stack([lj.Medium(depth, SLAB["albedo"], lj.HenyeyGreenstein(SLAB["g"]))])
        ours = _walk(lj.prepare(stack, lj.RandomWalk(paths=size.paths)), *narrow)
        value, error = (float(x[0]) for x in ours())
        ways: dict[str, Work] = {"ours": ours}
        notes, noise = [], {}
        for name, roulette in (("like ours", UNLIMITED), ("default", 5)):
            scene = Volpath(stack, wi, roulette=roulette)
            peer, peer_error = (float(x[0, 0]) for x in scene.values(wo[None], size.paths))
            ways[name] = partial(scene.mean, wo, size.paths)
            noise[name] = (error / peer_error) ** 2
            notes.append(
                f"{value:.5f} +- {error:.1e} and {peer:.5f} +- {peer_error:.1e}, {noise[name]:.2f} of their variance"
            )
        seconds = interleaved(ways, size.rounds)
        work, scale = f"walk through a haze of thickness {depth:g}", 1e9 / size.paths
        same = {"ours": seconds["ours"], "theirs": seconds["like ours"]}
        rows.append(_row(f"{work}, a path", "ns", scale, same, "volpath, roulette as late", WALK, notes[0]))
        equal = {"ours": seconds["ours"] * noise["default"], "theirs": seconds["default"]}
        rows.append(_row(f"{work}, for the noise of one of theirs", "ns", scale, equal, "volpath", None, notes[1]))
    return rows


def fixed_error(size: Size, report: Callable[[str], None]) -> list[Row]:
    """Milliseconds to 1 %: the solver's largest error over the pairs, the walk's median standard error."""
    rows = []
    for name, stack in (("a rough coat on a diffuse base", COAT), ("flakes over haze", FLAKES)):
        report(f"time to 1 %: {name}")
        wi, wo = _pairs(size.pairs)
        exact = _solver(stack, wi, wo, FINEST, "all")()
        mine = cheapest(
            [way_of(f"{n} x {m}", _solver(stack, wi, wo, (n, m), "all"), exact) for n, m in RESOLUTIONS], 0.01
        )
        walk = lj.RandomWalk(paths=max(size.paths // size.pairs, 2))
        walked = _walk(lj.prepare(stack, walk), wi, wo)
        values, errors = (np.asarray(x) for x in walked())
        reached = float(np.median(errors[values > 0] / values[values > 0]))
        seconds = interleaved({"ours": mine.work, "theirs": walked}, size.rounds)
        seconds["theirs"] = seconds["theirs"] * (reached / 0.01) ** 2
        note = (
            f"{mine.name}, largest error {mine.error:.0e}; {size.pairs} pairs, of which {walk.paths:,} paths each left "
            f"the walk {reached:.1e}, and its time is scaled by the square"
        )
        rows.append(_row(f"{name}, to 1 %", "ms", 1e3, seconds, "RandomWalk", FIXED_ERROR, note, mine.error <= 0.01))
    return rows


def anisotropic(size: Size, report: Callable[[str], None]) -> Row:
    """Milliseconds of two layers of flakes to 1 % (rms): axes in the plane and tilted, against both upright."""
    report("anisotropic layers")
    wi, wo = _pairs(size.pairs)
    ways, notes = [], []
    for stack, tried in ((TILTED, ANISOTROPIC_RESOLUTIONS), (SYMMETRIC, RESOLUTIONS)):
        values, errors = (np.asarray(x) for x in _walk(lj.prepare(stack, lj.RandomWalk(size.paths)), wi, wo)())
        way = _coarsest(stack, wi, wo, tried, values, 0.01, measure=spread)
        short = " falls short" * (way.error > 0.01)
        ways.append(way)
        notes.append(
            f"{way.name} ({way.error:.1e}{short}; walk's median standard error {np.median(errors / values):.0e})"
        )
    seconds = interleaved({"ours": ways[0].work, "theirs": ways[1].work}, size.rounds)
    work = "fibers along x over tilted flakes, to 1 %"
    return _row(
        work, "ms", 1e3, seconds, "both upright", ANISOTROPIC, " and ".join(notes), all(w.error <= 0.01 for w in ways)
    )


def _coarsest(
    stack: lj.Stack,
    wi: Any,
    wo: Any,
    resolutions: Sequence[tuple[int, int]],
    exact: Floats,
    error: float,
    side: Any = "all",
    measure: Callable[[Floats, Floats], float] | None = None,
) -> Way:
    """`AddingDoubling` at the first resolution that reaches the error, largest or by `measure`; else at the last."""
    for nodes, modes in resolutions:
        work = _solver(stack, wi, wo, (nodes, modes), side)
        way = Way(f"{nodes} x {modes}", work, (measure or largest_error)(work(), exact))
        if way.error <= error:
            break
    return way


def _solver(stack: lj.Stack, wi: Any, wo: Any, resolution: tuple[int, int], side: Any) -> Callable[[], Floats]:
    """The whole work of `AddingDoubling`, from the stack to the values; modes are azimuths where an axis needs them."""
    transport = lj.AddingDoubling(nodes=resolution[0], modes=resolution[1], ordinates=resolution)
    return lambda: np.asarray(lj.evaluate(lj.prepare(stack, transport), wi, wo, side=side))


def _compiled(stack: lj.Stack, wi: Any, wo: Any, resolution: tuple[int, int], side: Any) -> Callable[[], Floats]:
    """The work of `AddingDoubling`, from the stack's numbers to the values, as one compiled program."""
    transport = lj.AddingDoubling(nodes=resolution[0], modes=resolution[1])
    program = jax.jit(lambda stack, wi, wo: lj.evaluate(stack, wi, wo, transport, side=side))
    return lambda: np.asarray(program(stack, wi, wo))


def _walk(prepared: lj.Prepared, wi: Any, wo: Any) -> Callable[[], tuple[Any, Any]]:
    """Values and standard errors by the walk, of another key each time."""
    seeds = count()
    return lambda: jax.block_until_ready(lj.evaluate_with_error(prepared, wi, wo, key=jax.random.key(next(seeds))))


def _discrete_ordinates(streams: int, modes: int, corrected: bool) -> Callable[[], Floats]:
    """The BSDF of the slab by PythonicDISORT, (incidence, view, azimuth): a run for each incidence."""
    cosines = None if streams == 2 * len(VIEW) else VIEW
    slab = SLAB["thickness"], SLAB["g"], SLAB["albedo"]

    def work() -> Floats:
        found = [disort.bsdf(*slab, mu, AZIMUTHS, streams, cosines, corrected, modes, True) for mu in INCIDENCE]
        return np.stack(found)

    return work


def _pairs(number: int) -> tuple[Floats, Floats]:
    """Pairs in reflection, cosines above 0.1."""
    random = np.random.default_rng(0)
    cosine, phi = random.uniform(0.1, 1.0, (2, number)), random.uniform(-np.pi, np.pi, (2, number))
    wi, wo = np.asarray(lj.direction(np.arccos(cosine), phi))
    return wi, wo


def _row(
    work: str,
    unit: str,
    scale: float,
    seconds: dict[str, Floats],
    name: str,
    bar: Bar | None,
    note: str,
    reached: bool = True,
) -> Row:
    """One row of the table. `reached`: whether ours has the error that it is about; if not, no bar is met."""
    ratio = float(np.median(seconds["ours"] / seconds["theirs"]))
    ours, theirs = (scale * float(np.median(seconds[way])) for way in ("ours", "theirs"))
    words, verdict = (bar.words(), bar.verdict(ratio)) if bar else ("", "")
    if not reached:
        verdict = NOT_REACHED
    return Row(work, unit, ours, theirs, name, ratio, words, verdict, note)
