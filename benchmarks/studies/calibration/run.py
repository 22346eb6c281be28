"""Repeats of the calibration: simulated, fitted, sampled and ranked one after the other, each kept as it ends."""

import json
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

import fits
import layerjax as lj
from benchmarks.measuring import environment
from benchmarks.measuring.writing import DIRECTORY, environment_lines, figure, rounded, table, write
from benchmarks.studies.calibration import shared
from benchmarks.studies.calibration.ranks import DRAWS, LEAST_P, Row, judged, picture, ranks_of, spread_draws
from benchmarks.suite import coated_haze
from fits._files import write_bytes
from fits.reporting.plots.data import as_png

Floats = NDArray[np.float64]

NAME = "calibration"
REPEATS, QUICK = 200, 20
TRANSPORT = lj.AddingDoubling(nodes=6, modes=6)
NOISE, NOISE_BESIDE, FLOOR = 0.05, 0.02, 1e-6
"""The second where readings share errors: these are of logarithms, in which noise is not quite normal."""

STARTS, WALKERS, STEPS = 4, 12, 5000
APART = 5.0
"""Autocorrelation times after which draws of one walker count as independent."""

FREE = {
    "ior": fits.Free(1.5, 1.2, 2.0, fits.Normal(1.5, 0.07)),
    "alpha": fits.Free(0.3, 0.1, 0.9, fits.LogNormal(0.3, 0.25)),
    "thickness": fits.Free(1.0, 0.1, 10.0, fits.LogNormal(1.0, 0.4)),
    "g": fits.Free(0.5, -0.2, 0.95, fits.Normal(0.5, 0.1)),
}
"""Priors that end more than four standard deviations inside their bounds: no posterior leans on one."""

LABELS = {"ior": "index", "alpha": "roughness", "thickness": "thickness", "g": "asymmetry g"} | shared.LABELS

TEXT = """\
# Calibration of posteriors

{environment}
Simulation-based calibration (Talts, Betancourt, Simpson, Vehtari & Gelman 2018, arXiv:1804.06788): {repeats} truths
drawn from the prior, data simulated from each, and the rank of the truth among {draws} draws of the posterior that
`fits.fit` and `fits.sample` find. If fit, noise model, priors and sampler are right, ranks are uniform.

Rough interface over haze (albedo 0.95) over a diffuse base (albedo 0.3), all orders of scattering, by
`{transport}`. In-plane slices at incidence {incidence} degrees, {readings} readings, noise of
{noise:.0%} of the exact value; the fit is told the level. {errors}
The data are simulated by the solver that fits them, at its resolution: this judges the inference,
[error-vs-time](error-vs-time.md) the solver. {starts} starts a fit, {walkers} walkers. Priors:

{free}
{rows}
*chi-square* over {bins} equal bins, *KS* is the test of Kolmogorov and Smirnov; uniform: both p-values above {least:g}.
*mean* is the mean rank less what it should be, in standard errors.

![A histogram of ranks for each parameter, with the band that should hold 99 % of the bars]({name}.png)

{chains}"""

ERRORS = """Readings share errors of their logarithm as well, drawn from a
process whose numbers are drawn from their priors, by dense matrices; the fit finds these numbers. """


@dataclass(frozen=True)
class Repeat:
    """One repeat, lists by parameter as in `free_of`.

    truth, estimate: physical values, the estimate is that of the fit. apart: autocorrelation times between two draws of
    one walker. fit_converged, converged: of the fit and of the chain. moves: how the chain was moved.
    """

    repeat: int
    truth: list[float]
    estimate: list[float]
    ranks: list[int]
    steps: int
    autocorrelation_time: float
    apart: float
    fit_converged: bool
    converged: bool
    moves: str
    seconds: float


def study(
    quick: bool = False,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    resume: bool = False,
    transport: lj.Transport = TRANSPORT,
    surrogate: bool = True,
    repeats: int | None = None,
    errors: bool = False,
) -> tuple[str, tuple[Path, ...]]:
    """Run it, and write ``calibration.json``, ``.md`` and ``.png``; returns the markdown and the paths.

    With `errors` the files are ``calibration-errors.json`` and so on.

    Args:
        quick: 20 repeats: a look, no result to quote.
        resume: keep the repeats that the directory holds, and run those that it lacks. Each is written as it ends.
        transport: carries the light in the data and in the fits.
        surrogate: of `fits.sample`; left to the clock, a rerun might not be the same.
        repeats: how many there are to be in all; 200 if None.
        errors: whether readings share errors of the model.

    Raises:
        ValueError: repeats to resume that were run with other settings.
    """
    wanted = repeats or (QUICK if quick else REPEATS)
    settings = settings_of(transport, surrogate, errors)
    name = f"{NAME}-errors" if errors else NAME
    done = _held(directory / f"{name}.json", settings) if resume else []
    surroundings = environment.describe()
    model = _simulator(transport)
    if len(done) < wanted:
        report(f"{len(done)} of {wanted} repeats are there; the first to come compiles all programs")
    for index in range(len(done), wanted):
        done.append(run_repeat(index, transport, surrogate, model, errors))
        _save(done, settings, surroundings, directory, name)
        typical = float(np.median([one.seconds for one in done]))
        report(
            f"repeat {index + 1}/{wanted}: {done[-1].steps} steps, {done[-1].seconds:.1f} s, "
            f"about {typical * (wanted - index - 1) / 60:.0f} min left"
        )
    text, paths = _save(done, settings, surroundings, directory, name)
    by_label = {LABELS[one]: _ranks(done, place) for place, one in enumerate(free_of(errors))}
    write_bytes(directory / f"{name}.png", as_png(picture(by_label)), force=True)
    return text, (*paths, directory / f"{name}.png")


def free_of(errors: bool) -> dict[str, fits.Free]:
    """What is free, in the order of the problem's parameters."""
    return FREE | shared.FREE if errors else FREE


def run_repeat(
    index: int, transport: lj.Transport, surrogate: bool, model: Callable[..., Any], errors: bool = False
) -> Repeat:
    """A truth from the prior, its data, fit and posterior, and its ranks; all of them drawn with `index`."""
    began = time.perf_counter()
    generator = np.random.default_rng([2018, index])
    truth = {name: drawn(free, generator) for name, free in free_of(errors).items()}
    own = {name: truth[name] for name in FREE}
    level = NOISE_BESIDE if errors else NOISE
    data = fits.simulate(
        coated_haze.stack_of(coated_haze.PARAMETERS | own), coated_haze.readings(), model, level, FLOOR, seed=index
    )
    if errors:
        data = shared.with_errors(data, truth, generator)
    # sigma is what the model says that it is: the data's own was made with the truth, which it would give away
    correlated = fits.Correlated(**shared.FREE) if errors else False
    noise = fits.Noise(relative=level, floor=FLOOR, use_sigma=False, correlated=correlated)
    stack = coated_haze.stack_of(coated_haze.PARAMETERS | FREE)
    fit = fits.fit(stack, data, transport=transport, noise=noise, starts=STARTS, seed=index)
    walkers = max(WALKERS, 2 * len(truth) + 2)
    posterior = fits.sample(fit, walkers=walkers, seed=index, surrogate=surrogate, max_steps=STEPS, allow_short=True)
    draws, apart = spread_draws(posterior)
    return Repeat(
        repeat=index,
        truth=list(truth.values()),
        estimate=fit.vector.tolist(),
        ranks=ranks_of(np.array(list(truth.values())), draws),
        steps=len(posterior.chain),
        autocorrelation_time=float(np.max(posterior.autocorrelation_time)),
        apart=apart,
        fit_converged=fit.converged,
        converged=posterior.converged,
        moves=posterior.status or "proposals without a surrogate",
        seconds=time.perf_counter() - began,
    )


def drawn(free: fits.Free, generator: np.random.Generator) -> float:
    """A draw from the prior within its bounds, without the density that `fits` computes."""
    low, high = float(free.low), float(free.high)  # type: ignore[arg-type]  # numbers here, no channels
    while True:
        normal = generator.standard_normal()
        prior = free.prior
        if isinstance(prior, fits.Normal):
            value = prior.mean + prior.sd * normal
        elif isinstance(prior, fits.LogNormal):
            value = prior.median * np.exp(prior.sd * normal)
        else:
            raise TypeError(f"no draws from {prior}")
        if low <= value <= high:
            return float(value)


def settings_of(transport: lj.Transport, surrogate: bool, errors: bool = False) -> dict[str, Any]:
    """What has to be the same for repeats to stand in one file, as it stands there."""
    beside = {"errors": {name: repr(free) for name, free in shared.FREE.items()}} if errors else {}
    return rounded(
        beside
        | {
            "transport": repr(transport),
            "surrogate": surrogate,
            "free": {name: repr(free) for name, free in FREE.items()},
            "parameters": coated_haze.PARAMETERS,
            "incidence_degrees": coated_haze.INCIDENCE,
            "noise": NOISE_BESIDE if errors else NOISE,
            "floor": FLOOR,
            "starts": STARTS,
            "walkers": WALKERS,
            "most_steps": STEPS,
            "draws": DRAWS,
        }
    )


def _simulator(transport: lj.Transport) -> Callable[..., Any]:
    """The transport as the fits use it: one program for all truths, told of the directions and of nothing else."""
    geometry = coated_haze.readings()
    known = lj.known_directions(geometry.wi, geometry.wo) if transport.uses_known else None
    return jax.jit(lambda stack, wi, wo: lj.evaluate(stack, wi, wo, transport, known=known))


def _held(path: Path, settings: Mapping[str, Any]) -> list[Repeat]:
    """The repeats that a file holds; ValueError if they were run with other settings."""
    if not path.exists():
        return []
    content = json.loads(path.read_text())
    if content["settings"] != settings:
        raise ValueError(f"{path}: run with other settings, it cannot be resumed")
    return [Repeat(**record) for record in content["repeats"]]


def _save(
    done: list[Repeat], settings: Mapping[str, Any], surroundings: Mapping[str, Any], directory: Path, name: str = NAME
) -> tuple[str, tuple[Path, Path]]:
    """Write all repeats so far and what they say; returns the markdown and the paths."""
    free = free_of("errors" in settings)
    rows = [judged(LABELS[one], _ranks(done, place)) for place, one in enumerate(free)]
    text = TEXT.format(
        environment=environment_lines(surroundings),
        repeats=len(done),
        draws=DRAWS,
        transport=settings["transport"],
        free="".join(
            f"- {LABELS[one]}: {value.prior!r} in [{value.low:g}, {value.high:g}]\n" for one, value in free.items()
        ),
        name=name,
        errors=ERRORS if "errors" in settings else "",
        incidence=", ".join(f"{angle:g}" for angle in coated_haze.INCIDENCE),
        readings=len(coated_haze.readings()),
        noise=settings["noise"],
        starts=STARTS,
        walkers=max(WALKERS, 2 * len(free) + 2),
        rows=_table(rows),
        bins=rows[0].bins,
        least=LEAST_P,
        chains=_chains(done),
    )
    content = {
        "environment": dict(surroundings),
        "settings": dict(settings),
        "parameters": [asdict(row) for row in rows],
        "repeats": [asdict(one) for one in done],
    }
    return text, write(name, content, text, directory)


def _ranks(done: list[Repeat], place: int) -> NDArray[np.int64]:
    return np.array([one.ranks[place] for one in done])


def _table(rows: list[Row]) -> str:
    header = ("parameter", "chi-square", "p", "p of KS", "mean", "verdict")
    body = [
        (
            row.parameter,
            f"{row.chi_square:.1f}",
            figure(row.p_chi_square, 2),
            figure(row.p_kolmogorov_smirnov, 2),
            f"{row.mean_off:+.2f}",
            "uniform" if row.uniform else "**not uniform**",
        )
        for row in rows
    ]
    return table(header, body)


def _chains(done: list[Repeat]) -> str:
    """What to know of the chains: all of them count, also those that fell short."""
    short = [str(one.repeat) for one in done if not one.converged]
    lost = [str(one.repeat) for one in done if not one.fit_converged]
    close = [str(one.repeat) for one in done if one.apart < APART]
    moves = Counter(one.moves for one in done)
    lines = [
        f"Chains that did not converge (ranked all the same): {_listed(short)}. Fits that did not: {_listed(lost)}.",
        f"Steps: {np.median([one.steps for one in done]):.0f} in the median, {max(one.steps for one in done)} at most. "
        f"Draws of one walker lie {min(one.apart for one in done):.1f} autocorrelation times apart or more; less than "
        f"{APART:g}: {_listed(close)}.",
        f"Seconds a repeat: {figure(float(np.median([one.seconds for one in done])))} in the median, the first, which "
        f"compiles, {figure(done[0].seconds)}.",
        *(f"{number} of {len(done)}: {words}." for words, number in moves.most_common()),
    ]
    return "".join(f"- {line}\n" for line in lines)


def _listed(names: list[str]) -> str:
    return f"{len(names)} (repeats {', '.join(names)})" if names else "none"
