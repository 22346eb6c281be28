"""Bands of predictions by stacks that are wrong: of simulated materials, how many unseen readings they hold."""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import jax
import numpy as np

import fits
import layerjax as lj
from benchmarks.measuring import environment
from benchmarks.measuring.writing import DIRECTORY, environment_lines, rounded, table, write
from benchmarks.studies.calibration.run import drawn
from benchmarks.suite import coated_haze
from fits.data.measurements import Measurements
from fits.data.selection import Rows, select

NAME = "wrong-stacks"
REPEATS, QUICK = 100, 10
TRUTH = lj.AddingDoubling(nodes=12, modes=16)
NOISE = 0.02
STARTS = 4
ASKED = "incidence=30,70"
BAND = (0.90, 0.98)

MATERIALS = {
    "ior": fits.Free(1.5, 1.2, 2.0, fits.Normal(1.5, 0.1)),
    "alpha": fits.Free(0.3, 0.1, 0.9, fits.LogNormal(0.3, 0.3)),
    "thickness": fits.Free(0.5, 0.05, 10.0, fits.LogNormal(0.5, 0.7)),
    "albedo": fits.Free(0.9, 0.5, 1.0, fits.Normal(0.9, 0.1)),
    "g": fits.Free(0.5, -0.5, 0.9, fits.Normal(0.5, 0.3)),
    "base": fits.Free(0.2, 0.01, 0.9, fits.LogNormal(0.2, 0.7)),
}
"""Rough interfaces over haze over a diffuse base are drawn from these."""

WRONG = lj.Stack(
    [lj.Interface(fits.Free(1.5, 1.01, 3.0), fits.Free(0.3, 0.02, 1.0))], lj.Lambertian(fits.Free(0.2, 0.0, 1.0))
)
"""What is fitted: it has no haze."""

KINDS = {"noise alone": False, "shared errors": True}

TEXT = """\
# Predictions by wrong stacks

{environment}
{repeats} materials, each a rough interface over haze over a diffuse base with numbers drawn at random, read at 10, 30,
50 and 70 degrees of incidence with noise of {noise:.0%} (all orders, `{truth}`). A stack without
the haze is fitted to the readings at 10 and 50 degrees and foretells those at 30 and 70.

{rows}
*in 95 %*, *in 50 %*: mean share of the unseen readings inside these bands, and its standard error over the materials;
*error*: the median over materials of the median |prediction / reading - 1|; *score*: mean log-density of a reading.
*chi2*: per degree of freedom, the median. Asked for: {low:.0%} to {high:.0%} in the band of 95 %.
"""


@dataclass(frozen=True)
class Repeat:
    """One material, fitted by a wrong stack: scores of what it foretells."""

    repeat: int
    kind: str
    reduced_chi_square: float
    within_95: float
    within_half: float
    error: float
    elpd: float
    amplitude: float | None
    seconds: float


def study(
    quick: bool = False,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    resume: bool = False,
    repeats: int | None = None,
) -> tuple[str, tuple[Path, ...]]:
    """Run it, and write ``wrong-stacks.json`` and ``.md``; returns the markdown and the paths.

    Args:
        quick: 10 materials: a look, no result to quote.
        resume: keep the materials that the directory holds, and run those that it lacks.
        repeats: how many there are to be in all; 100 if None.
    """
    wanted = repeats or (QUICK if quick else REPEATS)
    done = _held(directory) if resume else []
    simulator = jax.jit(lambda stack, wi, wo: lj.evaluate(stack, wi, wo, TRUTH))
    for index in range(len(done) // len(KINDS), wanted):
        data = material(index, simulator)
        asked = select(data, ASKED)
        done += [run_repeat(index, kind, data, asked) for kind in KINDS]
        _save(done, directory)
        report(
            f"material {index + 1}/{wanted}: {done[-1].within_95:.2f} of the readings held, {done[-1].seconds:.1f} s"
        )
    return _save(done, directory)


def material(index: int, simulator: Callable[..., jax.Array]) -> Measurements:
    """Readings of one that was drawn at random."""
    generator = np.random.default_rng([2020, index])
    truth = {name: drawn(free, generator) for name, free in MATERIALS.items()}
    stack = coated_haze.stack_of(coated_haze.PARAMETERS | truth)
    data = fits.simulate(stack, coated_haze.readings(), simulator, NOISE, 1e-6, seed=index)
    return Measurements(data.wi, data.wo, data.values, None, data.mask, data.channels, data.source)


def run_repeat(index: int, kind: str, data: Measurements, asked: Rows) -> Repeat:
    """A wrong stack, fitted to what was not asked for."""
    began = time.perf_counter()
    noise = fits.Noise(relative=NOISE, floor=1e-6, discrepancy=KINDS[kind])
    fit = fits.fit(WRONG, data.where(~asked), transport=lj.Statistical(), noise=noise, starts=STARTS, seed=index)
    unseen = data.where(asked)
    found = fits.scores(fits.predict(fit, unseen, seed=index), unseen)
    at = fit.problem.build(fit.vector).correlation
    return Repeat(
        repeat=index,
        kind=kind,
        reduced_chi_square=fit.reduced_chi_square,
        within_95=found.coverage[0.95],
        within_half=found.coverage[0.5],
        error=found.median_error,
        elpd=found.elpd,
        amplitude=None if at is None else float(at.amplitude),
        seconds=time.perf_counter() - began,
    )


def _held(directory: Path) -> list[Repeat]:
    path = directory / f"{NAME}.json"
    return [Repeat(**record) for record in json.loads(path.read_text())["repeats"]] if path.exists() else []


def _save(done: list[Repeat], directory: Path) -> tuple[str, tuple[Path, Path]]:
    surroundings = environment.describe()
    rows = [_row(kind, [one for one in done if one.kind == kind]) for kind in KINDS]
    heads = ("", "in 95 %", "in 50 %", "error", "score", "chi2", "held as asked")
    text = TEXT.format(
        environment=environment_lines(surroundings),
        repeats=len(done) // len(KINDS),
        noise=NOISE,
        truth=TRUTH,
        rows=table(heads, rows),
        low=BAND[0],
        high=BAND[1],
    )
    content = {"environment": surroundings, "repeats": [rounded(asdict(one)) for one in done]}
    return text, write(NAME, content, text, directory)


def _row(kind: str, found: list[Repeat]) -> tuple[str, ...]:
    shares = [[one.within_95 for one in found], [one.within_half for one in found]]
    words = [
        f"{100 * np.mean(share):.1f} ± {100 * np.std(share) / max(len(share) - 1, 1) ** 0.5:.1f} %" for share in shares
    ]
    error, chi_square = (
        float(np.median([getattr(one, name) for one in found])) for name in ("error", "reduced_chi_square")
    )
    score = float(np.mean([one.elpd for one in found]))
    held = "yes" if BAND[0] <= np.mean(shares[0]) <= BAND[1] else "**no**"
    return kind, *words, f"{100 * error:.1f} %", f"{score:.2f}", f"{chi_square:.2f}", held
