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
Painted maps of {side} x {side} texels, 64 measurements each in one channel with noise of 2 %, {free} free numbers a
texel, fitted by `fits.fit_map` in chunks of {chunk:,} texels. Everything is warm: what compiles comes before, programs
are kept on disk, and of each worker the first chunk does not count.

## Texels a second

Chunks as `fit_map` does them, reading and writing among them, and fits of single texels by scipy's `least_squares`
(trust region in the unit box, the same compiled residuals and Jacobian, from where `fit_map` begins) by turns in the
same {processes} processes, a core each. Where there is an emulator scipy has it too. *compared*: texels that scipy
fitted; of these *above scipy's* is the share whose cost is above its by more than {rounding:g}, *below* that of costs
lower by more than {other:g} (another minimum). *pulls*: half of what the middle 68 % of (fit - truth) / error span, of
the parameter furthest from 1, over texels with all parameters identified within bounds. *chi-square*: reduced, mean.
*error, sd*: of the model at the optimum beside the solver at the next finer resolution, in standard deviations of a
measurement, the largest of {checked} texels.

{fits}
## Workers

Rates while all workers are at work: they wait for each other after the first chunk, and the last chunk of the first to
be done ends it; medians of {rounds} rounds in turns. One worker is a spawned process with one thread and chunks
of the same map. Memory is the most that the system has seen of a worker that compiles
all programs. {missing}

{workers}
## Scaling on paper

Empty tasks through the engines on this machine, where {processes} workers share its cores with the scheduler: a
scheduler with a machine of its own is no slower. *scheduler full at*: so many cores ask for chunks as fast as it hands
them out.
Times of 4 million texels (2048 x 2048, 2.1 GB of values): the pilot, which one machine fits first, and chunks by
these rates; cores as fast as these, and a disk that keeps up.

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
