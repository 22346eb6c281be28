"""The benchmark of fits of maps, with the environment beside it."""

from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.measuring import environment
from benchmarks.measuring.writing import DIRECTORY, environment_lines, write
from benchmarks.studies.maps import engines, fitting, paper
from benchmarks.studies.maps.cases import CASES, FREE, Case
from benchmarks.studies.maps.fitting import PROCESSES, Size

NAME = "maps"

TEXT = """\
# Fits of maps

{environment}
Painted maps of {side} x {side} texels, 64 measurements each in one channel with noise of 2 %, {free} free parameters
per texel, fitted by `fits.fit_map` in chunks of {chunk:,} texels. Compilation and the first chunk of each worker are
not included.

## Texels per second

Chunks of `fit_map`, with reading and writing, alternate with fits of single texels by scipy's `least_squares` (trust
region, the same compiled residuals and Jacobian, the same starts) in {processes} processes with a core each. scipy uses
the emulator where `fit_map` does. *compared*: number of texels that scipy fitted. *above scipy's*: share of these whose
cost is higher than scipy's by more than {rounding:g}; *below*: lower by more than {other:g} (another minimum). *pulls*:
half the width of the central 68 % of (fit - truth) / error, for the parameter furthest from 1, over texels whose
parameters are all identified and within bounds. *chi-square*: mean reduced chi-square. *error, sd*: largest numerical
error of the model at the optimum of {checked} texels, from the next finer resolution, in standard deviations of a
measurement.

{fits}
## Workers

Rates while all workers are busy: from the end of the first chunk of the last worker to the end of the last chunk of the
first; medians of {rounds} interleaved rounds. One worker is one process with one thread. Memory is the peak of a worker
that compiles all programs. {missing}

{workers}
## Estimated scaling

Rates of empty tasks on this machine, where {processes} workers share the cores with the scheduler. *scheduler full at*:
number of cores that request chunks as fast as the scheduler sends them. The times of 4 million texels (2048 x 2048,
2.1 GB of values) are estimates from these rates: the pilot on one machine, then the chunks, with cores of this speed
and a disk that is not the bottleneck.

{paper}"""


def study(
    quick: bool = False,
    with_peers: bool = True,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    size: Size | None = None,
    cases: Sequence[Case] = CASES,
) -> tuple[str, tuple[Path, Path]]:
    """Measure, and write ``maps.json`` and ``maps.md``; returns the markdown and the two paths.

    with_peers: whether scipy fits as well.
    """
    size = size or (fitting.QUICK if quick else Size())
    surroundings = environment.describe()
    rows = fitting.run(cases, size, with_peers, report)
    figures = engines.run(cases[0], rows, size, report)
    handing, papers = paper.run(rows, size, report)
    reason = engines.why_no_cluster()
    text = TEXT.format(
        environment=environment_lines(surroundings),
        side=size.side,
        free=FREE,
        chunk=size.chunk,
        processes=PROCESSES,
        rounding=fitting.ROUNDING,
        other=fitting.OTHER,
        checked=size.checked,
        fits=fitting.markdown(rows),
        rounds=size.rounds,
        missing="" if reason is None else f"There was no cluster: {reason}.",
        workers=engines.markdown(figures),
        paper=paper.markdown(handing, papers),
    )
    content = {
        "environment": surroundings,
        "side": size.side,
        "chunk": size.chunk,
        "rounds": size.rounds,
        "fits": fitting.as_json(rows),
        "workers": engines.as_json(figures),
        "engines": paper.as_json(handing),
        "paper": paper.as_json(papers),
    }
    return text, write(NAME, content, text, directory)
