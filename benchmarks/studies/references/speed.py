"""How fast all orders of scattering are to call, to differentiate, to fit and to sample: seconds beside the bars.

One stack, a rough coat over haze on a diffuse base, 140 measurements of a goniometer, six parameters.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import layerjax as lj
from benchmarks.measuring.timing import interleaved
from benchmarks.measuring.writing import NOT_REACHED, Bar, figure, table
from benchmarks.peers import disort
from benchmarks.studies.references.cold import WARM_CALLS, Orders, What, Work, fresh, programs, second
from benchmarks.studies.references.ways import Way, cheapest, largest_error
from benchmarks.suite import coated_haze

Floats = NDArray[np.float64]

ERROR = 1e-3
RESOLUTIONS = ((4, 4), (4, 6), (5, 6), (6, 6), (6, 8), (8, 8), (8, 12), (12, 16), (16, 24), (24, 32))
"""Nodes and modes of `AddingDoubling` that are tried until one reaches the error."""
FINEST = (48, 64)
CALLS = 20
"""In a row, in a round: one call after half a second of something else finds its data and its threads asleep."""
STREAMS = (8, 12, 16, 24, 32, 48, 64)
STEEPEST = float(np.cos(np.radians(12.0)))
"""Cosine of the viewer up to which PythonicDISORT is judged: nearer to the normal, what it interpolates between its
nodes is off by up to 1 % even at 64 streams."""

VALUE, JACOBIAN, RELATIVE = Bar(1.0, 0.4), Bar(4.0, 1.0), Bar(0.1, 0.02)
COMPILE: dict[What, Bar] = {"value": Bar(1.6, 1.0), "jacobian": Bar(5.0, 2.5), "gradient": Bar(5.0, 2.5)}
FIRST: dict[What, Bar] = {"evaluate": Bar(1.8, 1.0), "grad": Bar(4.0, 2.5)}
SECOND: dict[What, Bar] = {"evaluate": Bar(1.0, 0.4), "grad": Bar(3.0, 1.0)}
LATER: dict[What, Bar] = {"evaluate": Bar(2.0, 1.0), "grad": Bar(5.0, 3.0)}
NEXT = Bar(1.0, 0.4)
COLD_FIT, WARM_FIT, SAMPLING, FIBERS = Bar(10.0, 6.0), Bar(3.0, 0.5), Bar(30.0, 15.0), Bar(80.0, 30.0)

CALLED = {"value": "value", "jacobian": "value and Jacobian", "gradient": "value and gradient"}
FIRST_OF = {"evaluate": "`lj.evaluate`", "grad": "`jax.grad` of it"}
IMPORTED = "after the imports"

TEXT = """\
## Speed of all orders

Rough interface over haze over a diffuse base, six free parameters, {count} measurements at four incidences, one
call from the parameters to the values. `AddingDoubling` runs at the first resolution of a series, from coarse to fine,
whose largest error is below {error:g}; programs are jitted with `lj.compiler_options()`. Cold times are those of a new
process without a cache of programs, warm times medians of interleaved rounds or of {later} calls.

{rows}"""


@dataclass(frozen=True)
class Size:
    """How much is measured.

    rounds: interleaved repeats. resolutions: tried, the coarsest first. orders: of scattering. cold: what fresh
    processes measure. starts: of the fit. ess: effective samples after it.
    """

    rounds: int
    resolutions: Sequence[tuple[int, int]] = RESOLUTIONS
    orders: Orders = "all"
    cold: Sequence[What] = ("value", "jacobian", "gradient", "evaluate", "grad", "fit")
    starts: int = 16
    ess: float = 1000.0


@dataclass(frozen=True)
class Row:
    """What was measured, in `unit`, beside what is required and aimed at."""

    what: str
    unit: str
    measured: float
    least: float
    aim: float
    verdict: str
    note: str = ""


def rows(size: Size, with_disort: bool, report: Callable[[str], None]) -> list[Row]:
    """Warm calls, then what fresh processes wait for."""
    report("speed: warm calls")
    found, work = warm(size, with_disort)
    for what in size.cold:
        report(f"speed: {what} in a fresh process")
        results = fresh(what, work)
        if what in FIRST:
            results["second"] = second(what, work)
        found += cold_rows(what, results, work)
    return found


def warm(size: Size, with_disort: bool) -> tuple[list[Row], Work]:
    """Milliseconds of a value and of a Jacobian, and beside PythonicDISORT; and the resolution that they need."""
    vector = jnp.array(list(coated_haze.PARAMETERS.values()))
    exact = _goniometer(coated_haze.stack_of(), size.orders)
    for nodes, modes in size.resolutions:
        work = Work(nodes, modes, size.orders, size.starts, size.ess)
        calls = programs(work.transport)
        error = largest_error(np.asarray(calls["value"](vector)), exact)
        if error <= ERROR:
            break

    def called(name: str) -> None:
        for _ in range(CALLS):
            jax.block_until_ready(calls[name](vector))

    ways: dict[str, Callable[[], object]] = {name: partial(called, name) for name in ("value", "jacobian")}
    if with_disort:
        peer = _discrete_ordinates()
        ways["peer"] = peer.work
    seconds = interleaved(ways, size.rounds)
    value, jacobian = (1e3 * float(np.median(seconds[name])) / CALLS for name in ("value", "jacobian"))
    reached = error <= ERROR
    note = f"{nodes} x {modes}, largest error {error:.0e}"
    found = [
        row(f"value, error {ERROR:g}", "ms", value, VALUE, note, reached),
        row("value and Jacobian of 6 parameters", "ms", jacobian, JACOBIAN, "", reached),
    ]
    if with_disort:
        ratio = float(np.median(seconds["jacobian"] / CALLS / seconds["peer"]))
        note = (
            f"{figure(1e3 * float(np.median(seconds['peer'])))} ms for the haze on its base without the interface, "
            f"which it lacks, at {peer.name} (error {peer.error:.0e}, viewers within 12 degrees of the normal omitted)"
        )
        reached = reached and peer.error <= ERROR
        found.append(row("the same, relative to PythonicDISORT's value", "", ratio, RELATIVE, note, reached))
    return found, work


def cold_rows(what: What, results: dict[str, float], work: Work) -> list[Row]:
    """The rows of one measurement by a fresh process."""
    if what in COMPILE:
        return [row(f"compile, {CALLED[what]}, cold", "s", results["seconds"], COMPILE[what])]
    if what in FIRST:
        name, later = FIRST_OF[what], 1e3 * results["later"]
        first = row(f"first {name}, the README's coat, fresh process", "s", results["seconds"], FIRST[what], IMPORTED)
        again = row(f"first {name}, second process, cached programs", "s", results["second"], SECOND[what])
        warm = row(f"{name}, un-jitted, warm", "ms", later, LATER[what])
        if what == "grad":
            return [first, again, warm]
        added = row("first `lj.evaluate` of the next stack", "s", results["next"], NEXT, "the coat and one medium more")
        statistical = row(f"{name} by `Statistical`, un-jitted, warm", "ms", 1e3 * results["statistical"], LATER[what])
        return [first, again, added, warm, statistical]
    sampled = (
        f"{results['effective']:,.0f} in {results['evaluations']:,.0f} steps of a walker, {results['acceptance']:.2f} "
        "of the proposals accepted; with its compilation"
    )
    return [
        row(
            f"fit of 6 parameters, {work.starts} starts, cold process",
            "s",
            results["cold"],
            COLD_FIT,
            "imports and compilation included",
        ),
        row("the same, warm, of other data", "s", results["warm"], WARM_FIT),
        row(f"{work.ess:,.0f} effective samples after the fit, exact", "s", results["sample"], SAMPLING, sampled),
    ]


def row(what: str, unit: str, measured: float, bar: Bar, note: str = "", reached: bool = True) -> Row:
    """One row of the table. reached: whether it has the error that it is about; if not, no bar is met."""
    verdict = bar.verdict(measured) if reached else NOT_REACHED
    return Row(what, unit, measured, bar.least, bar.aim, verdict, note)


def markdown(rows: Sequence[Row]) -> str:
    """The section of the page: the table, with notes under it."""
    header = ("what", "unit", "measured", "at least", "aim", "verdict")
    body = [(r.what, r.unit, figure(r.measured), f"{r.least:g}", f"{r.aim:g}", r.verdict) for r in rows]
    notes = "".join(f"- {r.what}: {r.note}.\n" for r in rows if r.note)
    count = len(coated_haze.goniometer_slices())
    return TEXT.format(count=count, error=ERROR, later=WARM_CALLS, rows=f"{table(header, body)}\n{notes}")


def _goniometer(stack: lj.Stack, orders: Orders = "all") -> Floats:
    """The values of all measurements, (N,), by what counts as exact."""
    geometry, transport = coated_haze.goniometer_slices(), lj.AddingDoubling(*FINEST, orders=orders)
    return np.asarray(lj.evaluate(stack, geometry.wi, geometry.wo, transport))[:, 0]


def _discrete_ordinates() -> Way:
    """PythonicDISORT's values of the haze on its base without the interface, as fast as it has the error."""
    p, geometry = coated_haze.PARAMETERS, coated_haze.goniometer_slices()
    exact = _goniometer(lj.Stack([coated_haze.stack_of().layers[1]], lj.Lambertian(p["base"])))
    azimuth = np.abs(
        np.arctan2(geometry.wo[:, 1], geometry.wo[:, 0]) - np.arctan2(geometry.wi[:, 1], geometry.wi[:, 0])
    )
    azimuths, turn = np.unique(azimuth.round(9), return_inverse=True)

    def values(streams: int, modes: int, corrected: bool) -> Floats:
        found = np.zeros(len(geometry))
        for incidence in np.unique(geometry.wi[:, 2]):
            seen = geometry.wi[:, 2] == incidence
            cosines, place = np.unique(geometry.wo[seen, 2], return_inverse=True)
            slab = p["thickness"], p["g"], p["albedo"], float(incidence), azimuths, streams, cosines
            found[seen] = disort.bsdf(*slab, corrected, modes, True, p["base"])[place, turn[seen]]
        return found

    judged, ways = geometry.wo[:, 2] < STEEPEST, []
    for streams, corrected in product(STREAMS, (False, True)):
        for modes in (streams // 2, streams):
            work = partial(values, streams, modes, corrected)
            error = largest_error(work()[judged], exact[judged])
            ways.append(Way(f"{streams} x {modes}{', corrected' * corrected}", work, error))
    return cheapest(ways, ERROR)
