"""The throughput benchmark: forward models and inference, in one run, with the environment beside them."""

from collections.abc import Callable
from pathlib import Path

from benchmarks.measuring import environment
from benchmarks.measuring.writing import DIRECTORY, environment_lines, write
from benchmarks.peers import functions as peers
from benchmarks.studies.throughput import fitting, forward_models

TEXT = """\
# Throughput

{environment}
Wall times, medians of {rounds} interleaved rounds, without compilation; *ratio* is layerjax over the other, the median
of the ratios within a round. BLAS has one thread, which is fastest for such small matrices. Bars: required, and in
brackets the aim. {peers}

## Forward models

{pairs:,} direction pairs, RGB. The gradient is that of a mean squared difference, in all parameters (conductor 7,
SpongeCake 20); numpy's is by forward differences, timed once on a part of the pairs. *operations* counts those of the
lowered program; *difference* is the largest relative one, of values from numpy's in float64, of gradients from the
peer's in the same type. *tuned* is a gradient in Dr.Jit with every parameter broadcast to all lanes, which saves one
kernel per parameter; the bars refer to the gradient without this.

{forward}
## Fits and posteriors

As one calls them: `fits` uses all cores; scipy in a loop, and emcee with its default move and one walker at a time,
use one.

{inference}"""


def study(
    quick: bool = False,
    with_peers: bool = True,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    forward_size: forward_models.Size | None = None,
    fitting_size: fitting.Size | None = None,
) -> tuple[str, tuple[Path, Path]]:
    """Measure, and write ``throughput.json`` and ``throughput.md``; returns the markdown and the two paths.

    The sizes default to those of a quick or of a full run.
    """
    forward_size = forward_size or (forward_models.QUICK if quick else forward_models.DEFAULT)
    fitting_size = fitting_size or (fitting.QUICK if quick else fitting.DEFAULT)
    surroundings = environment.describe()
    missing = peers.why_not() if with_peers else "omitted on request"
    forward = forward_models.run(forward_size, missing, report)
    inference = fitting.run(fitting_size, report)
    found = "Peers: Mitsuba 3 and Dr.Jit, same run." if missing is None else f"Peers did not run: {missing}."
    text = TEXT.format(
        environment=environment_lines(surroundings),
        rounds=forward_size.rounds,
        peers=found,
        pairs=forward_size.pairs,
        forward=forward_models.markdown(forward),
        inference=fitting.markdown(inference),
    )
    content = {
        "environment": surroundings,
        "pairs": forward_size.pairs,
        "rounds": forward_size.rounds,
        "peers": missing or "ran",
        "forward_models": forward_models.as_json(forward),
        "inference": fitting.as_json(inference),
    }
    return text, write("throughput", content, text, directory)
