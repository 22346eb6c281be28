"""Predictions by wrong stacks: coverage of the intervals of held-out measurements of simulated materials."""

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
from fits.data.scans import Rows, select

NAME = "wrong-stacks"
REPEATS, QUICK = 100, 10
TRUTH = lj.AddingDoubling(nodes=12, modes=16)
NOISE = 0.02
STARTS = 4
HELD_OUT = "incidence=30,70"
COVERAGE = (0.90, 0.98)
"""Required coverage of 95 % intervals."""

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

KINDS = {"independent noise": False, "model discrepancy": True}

TEXT = """\
# Predictions by wrong stacks

{environment}
{repeats} materials, each a rough interface over haze over a diffuse base with numbers drawn at random, measured at 10,
30, 50 and 70 degrees of incidence with noise of {noise:.0%} (all orders, `{truth}`). A stack without
the haze is fitted to the measurements at 10 and 50 degrees and predicts those held out, at 30 and 70: with independent
noise only, and with model discrepancy as well.

{rows}
*in 95 %*, *in 50 %*: mean coverage of these intervals of held-out measurements, and its standard error over the
materials; *error*: the median over materials of the median |prediction / measurement - 1|; *elpd*: mean log predictive
density of a held-out measurement. *chi2*: reduced chi-square of the fit, the median. *verdict*: whether the coverage of
the 95 % intervals is {low:.0%} to {high:.0%}.
"""


@dataclass(frozen=True)
class Repeat:
    """One material, fitted by a wrong stack, and scores of its predictions; coverage in 95 % and 50 % intervals."""

    repeat: int
    kind: str
    reduced_chi_square: float
    coverage_95: float
    coverage_50: float
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
    done = _stored(directory) if resume else []
    simulator = jax.jit(lambda stack, wi, wo: lj.evaluate(stack, wi, wo, TRUTH))
    for index in range(len(done) // len(KINDS), wanted):
        data = material(index, simulator)
        held_out = select(data, HELD_OUT)
        done += [run_repeat(index, kind, data, held_out) for kind in KINDS]
        _save(done, directory)
        report(f"material {index + 1}/{wanted}: coverage of 95 % {done[-1].coverage_95:.2f}, {done[-1].seconds:.1f} s")
    return _save(done, directory)


def material(index: int, simulator: Callable[..., jax.Array]) -> Measurements:
    """Measurements of a material that is drawn at random."""
    generator = np.random.default_rng([2020, index])
    truth = {name: drawn(free, generator) for name, free in MATERIALS.items()}
    stack = coated_haze.stack_of(coated_haze.PARAMETERS | truth)
    data = fits.simulate(stack, coated_haze.goniometer_slices(), simulator, NOISE, 1e-6, seed=index)
    return Measurements(data.wi, data.wo, data.values, None, data.mask, data.channels, data.source)


def run_repeat(index: int, kind: str, data: Measurements, held_out: Rows) -> Repeat:
    """A wrong stack, fitted to all but the held-out measurements, and scores of its predictions of these."""
    began = time.perf_counter()
    noise = fits.Noise(relative=NOISE, floor=1e-6, discrepancy=KINDS[kind])
    fit = fits.fit(WRONG, data.where(~held_out), transport=lj.Statistical(), noise=noise, starts=STARTS, seed=index)
    test = data.where(held_out)
    scores = fits.scores(fits.predict(fit, test, seed=index), test)
    process = fit.problem.build(fit.vector).correlation
    return Repeat(
        repeat=index,
        kind=kind,
        reduced_chi_square=fit.reduced_chi_square,
        coverage_95=scores.coverage[0.95],
        coverage_50=scores.coverage[0.5],
        error=scores.median_error,
        elpd=scores.elpd,
        amplitude=None if process is None else float(process.amplitude),
        seconds=time.perf_counter() - began,
    )


def _stored(directory: Path) -> list[Repeat]:
    path = directory / f"{NAME}.json"
    return [Repeat(**record) for record in json.loads(path.read_text())["repeats"]] if path.exists() else []


def _save(done: list[Repeat], directory: Path) -> tuple[str, tuple[Path, Path]]:
    surroundings = environment.describe()
    rows = [_row(kind, [one for one in done if one.kind == kind]) for kind in KINDS]
    heads = ("", "in 95 %", "in 50 %", "error", "elpd", "chi2", "verdict")
    text = TEXT.format(
        environment=environment_lines(surroundings),
        repeats=len(done) // len(KINDS),
        noise=NOISE,
        truth=TRUTH,
        rows=table(heads, rows),
        low=COVERAGE[0],
        high=COVERAGE[1],
    )
    content = {"environment": surroundings, "repeats": [rounded(asdict(one)) for one in done]}
    return text, write(NAME, content, text, directory)


def _row(kind: str, repeats: list[Repeat]) -> tuple[str, ...]:
    shares = [[one.coverage_95 for one in repeats], [one.coverage_50 for one in repeats]]
    words = [
        f"{100 * np.mean(share):.1f} ± {100 * np.std(share) / max(len(share) - 1, 1) ** 0.5:.1f} %" for share in shares
    ]
    error, chi_square = (
        float(np.median([getattr(one, name) for one in repeats])) for name in ("error", "reduced_chi_square")
    )
    elpd = float(np.mean([one.elpd for one in repeats]))
    verdict = "met" if COVERAGE[0] <= np.mean(shares[0]) <= COVERAGE[1] else "**not met**"
    return kind, *words, f"{100 * error:.1f} %", f"{elpd:.2f}", f"{chi_square:.2f}", verdict
