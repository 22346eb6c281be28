"""Repeats of the calibration: simulated, fitted, sampled and ranked, each kept as it ends."""

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

import fits
import layerjax as lj
from benchmarks.measuring import environment
from benchmarks.measuring.writing import DIRECTORY, environment_lines, figure, rounded, table, write
from benchmarks.studies.calibration.cases import CASES, FLOOR, Case
from benchmarks.studies.calibration.discrepancy import FREE as DISCREPANCY
from benchmarks.studies.calibration.discrepancy import with_discrepancy
from benchmarks.studies.calibration.ranks import (
    DRAWS,
    LEAST_P,
    LEVELS,
    Row,
    expected,
    judged,
    picture,
    ranks_of,
    spread_draws,
)
from fits._files import write_bytes
from fits.engines import Failure, run
from fits.problem.compilation import cores
from fits.reports.plots.data import as_png
from layerjax.evaluate import evaluate_known
from layerjax.transport.known_directions import known_directions

REPEATS, QUICK = 200, 20
STARTS, WALKERS = 4, 12
LEAST_THINNING = 5.0
"""Autocorrelation times after which draws of one walker count as independent."""

TEXT = """\
# Calibration of posteriors{kind}

{environment}
Simulation-based calibration (Talts, Betancourt, Simpson, Vehtari & Gelman 2018, arXiv:1804.06788): {repeats} truths
drawn from the prior, data simulated from each, and the rank of the truth among {draws} draws of the posterior that
`fits.fit` and `fits.sample` give. If fit, noise model, priors and sampler are right, ranks are uniform.

{words} {count} measurements in the plane of incidence, noise of {noise:.0%} of the exact value, a level
that the fit knows. {starts} starts a fit, {walkers} walkers. Priors:

{free}
{rows}
*chi-square* over {bins} equal bins, *KS* is the test of Kolmogorov and Smirnov; uniform: both p-values above {least:g}.
*mean* is the mean rank less what it should be, in standard errors. *in 68 %*, *in 90 %*: truths that central intervals
cover; {expected} of {repeats} are expected (central 95 % of the binomial distribution).

![A histogram of ranks for each parameter, with the interval that 99 % of the bars should be in]({name}.png)

{chains}"""


@dataclass(frozen=True)
class Repeat:
    """One repeat, lists by parameter as in `free_of`.

    truth, estimate: physical values, the estimate is that of the fit. thinning: of a walker, in autocorrelation times.
    fit_converged, converged: of the fit and of the chain.
    """

    repeat: int
    truth: list[float]
    estimate: list[float]
    ranks: list[int]
    steps: int
    autocorrelation_time: float
    thinning: float
    fit_converged: bool
    converged: bool
    seconds: float


def study(
    quick: bool = False,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    resume: bool = False,
    posterior: str = "haze",
    transport: lj.Transport | None = None,
    repeats: int | None = None,
    processes: int | None = None,
) -> tuple[str, tuple[Path, ...]]:
    """Run it, and write ``calibration.json``, ``.md`` and ``.png``; returns the markdown and the paths.

    Of other posteriors than "haze" the files are ``calibration-discrepancy.json`` and so on.

    Args:
        quick: 20 repeats: a look, no result to quote.
        resume: keep the repeats that the directory holds, and run those that it lacks. Each is written as it ends.
        posterior: one of `CASES`.
        transport: carries the light in the data and in the fits; None: that of the case.
        repeats: how many there are to be in all; 200 if None.
        processes: repeats at a time, a process each; one for each core if None. 1: by threads, one a core.

    Raises:
        ValueError: repeats to resume that were run with other settings.
    """
    case, processes = _case(posterior, transport), processes or cores()
    wanted = repeats or (QUICK if quick else REPEATS)
    settings = settings_of(case)
    path = directory / f"{case.name}.json"
    done = _stored(path, settings) if resume else []
    left = sorted(set(range(wanted)) - {one.repeat for one in done})
    at_once = processes if processes > 1 else cores()
    surroundings = environment.describe()
    if left:
        report(f"{len(done)} of {wanted} repeats are there; the first to come compile all programs")
    for _, found in run(_work, (posterior, transport), left, processes=processes):
        if isinstance(found, Failure):
            raise ValueError(found.error)
        done = sorted([*done, found], key=lambda one: one.repeat)
        _save(done, case, settings, surroundings, directory)
        minutes = float(np.median([one.seconds for one in done])) * (wanted - len(done)) / at_once / 60
        report(f"repeat {len(done)}/{wanted}: {found.steps} steps, {found.seconds:.1f} s, about {minutes:.0f} min left")
    text, paths = _save(done, case, settings, surroundings, directory)
    by_label = {case.labels[one]: _ranks(done, place) for place, one in enumerate(case.free)}
    write_bytes(path.with_suffix(".png"), as_png(picture(by_label)), force=True)
    return text, (*paths, path.with_suffix(".png"))


def _case(posterior: str, transport: lj.Transport | None) -> Case:
    case = CASES[posterior]
    return case if transport is None else replace(case, transport=transport)


def _work(settings: tuple[str, lj.Transport | None], index: int) -> Repeat:
    posterior, transport = settings
    return run_repeat(index, _case(posterior, transport), _simulator(posterior, transport))


def run_repeat(index: int, case: Case, model: Callable[..., Any]) -> Repeat:
    """A truth from the prior, its data, fit and posterior, and its ranks; all of them drawn with `index`."""
    began = time.perf_counter()
    truth, fit = _fitted(index, case, model)
    posterior = fits.sample(fit, walkers=_walkers(case), seed=index, max_steps=case.most_steps, allow_unconverged=True)
    draws, thinning = spread_draws(posterior)
    return Repeat(
        repeat=index,
        truth=list(truth.values()),
        estimate=fit.vector.tolist(),
        ranks=ranks_of(np.array(list(truth.values())), draws),
        steps=len(posterior.chain),
        autocorrelation_time=float(np.max(posterior.autocorrelation_time)),
        thinning=thinning,
        fit_converged=fit.converged,
        converged=posterior.converged,
        seconds=time.perf_counter() - began,
    )


def _fitted(index: int, case: Case, model: Callable[..., Any]) -> tuple[dict[str, float], fits.Fit]:
    """A truth from the prior, and the fit of its data."""
    generator = np.random.default_rng([2018, index])
    truth = {name: drawn(free, generator) for name, free in case.free.items()}
    stack = case.stack({name: truth[name] for name in case.of_stack})
    data = fits.simulate(stack, case.geometry, model, case.noise, FLOOR, seed=index)
    data = replace(data, values=truth.get("scale", 1.0) * data.values)
    if case.discrepancy:
        data = with_discrepancy(data, truth, generator)
    # sigma is what the model says that it is: the data's own was made with the truth, which it would give away
    discrepancy = fits.Discrepancy(**DISCREPANCY) if case.discrepancy else False
    noise = fits.Noise(relative=case.noise, floor=FLOOR, use_sigma=False, discrepancy=discrepancy)
    scale = case.free["scale"] if case.scale else None
    fit = fits.fit(
        case.stack(case.of_stack), data, transport=case.transport, noise=noise, scale=scale, starts=STARTS, seed=index
    )
    return truth, fit


def fitted_case(posterior: str, index: int = 0) -> fits.Fit:
    """The fit of a repeat."""
    return _fitted(index, _case(posterior, None), _simulator(posterior, None))[1]


def _walkers(case: Case) -> int:
    return max(WALKERS, 2 * len(case.free) + 2)


def drawn(free: fits.Free, generator: np.random.Generator) -> float:
    """A draw from the prior within its bounds, without the density that `fits` computes."""
    low, high = float(free.low), float(free.high)  # type: ignore[arg-type]  # numbers here, no channels
    while True:
        prior = free.prior
        if isinstance(prior, fits.Normal):
            value = prior.mean + prior.sd * generator.standard_normal()
        elif isinstance(prior, fits.LogNormal):
            value = prior.median * np.exp(prior.sd * generator.standard_normal())
        elif isinstance(prior, fits.Uniform):
            value = generator.uniform(low, high)
        else:
            raise TypeError(f"no draws from {prior}")
        if low <= value <= high:
            return float(value)


def settings_of(case: Case) -> dict[str, Any]:
    """What has to be the same for repeats to stand in one file, as it stands there."""
    in_degrees = np.degrees(np.arccos(np.unique(case.geometry.wi[:, 2].round(9))))
    free = case.of_stack if case.discrepancy else case.free
    return rounded(
        dict(case.settings)
        | {
            "transport": repr(case.transport),
            "free": {name: repr(one) for name, one in free.items()},
            "incidence_degrees": sorted(in_degrees.round(6).tolist()),
            "noise": case.noise,
            "floor": FLOOR,
            "starts": STARTS,
            "walkers": WALKERS,
            "most_steps": case.most_steps,
            "draws": DRAWS,
        }
    )


@cache
def _simulator(posterior: str, other: lj.Transport | None) -> Callable[..., Any]:
    """The transport as the fits use it: one program for all truths, which knows the directions and nothing else."""
    case = _case(posterior, other)
    transport = case.transport
    known = known_directions(case.geometry.wi, case.geometry.wo) if transport.uses_known_directions else None
    return jax.jit(lambda stack, wi, wo: evaluate_known(stack, wi, wo, transport, known=known))


def _stored(path: Path, settings: Mapping[str, Any]) -> list[Repeat]:
    """The repeats that a file holds; ValueError if they were run with other settings."""
    if not path.exists():
        return []
    content = json.loads(path.read_text())
    if content["settings"] != settings:
        raise ValueError(f"{path}: run with other settings, it cannot be resumed")
    return [Repeat(**record) for record in content["repeats"]]


def _save(
    done: list[Repeat], case: Case, settings: Mapping[str, Any], surroundings: Mapping[str, Any], directory: Path
) -> tuple[str, tuple[Path, Path]]:
    """Write all repeats so far and what they say; returns the markdown and the paths."""
    rows = [judged(case.labels[one], _ranks(done, place)) for place, one in enumerate(case.free)]
    text = TEXT.format(
        environment=environment_lines(surroundings),
        repeats=len(done),
        draws=DRAWS,
        words=case.words.format(transport=settings["transport"]),
        free="".join(
            f"- {case.labels[one]}: {value.prior!r} in [{value.low:g}, {value.high:g}]\n"
            for one, value in case.free.items()
        ),
        name=case.name,
        kind=": " * ("-" in case.name) + case.name.partition("-")[2],
        count=len(case.geometry),
        noise=case.noise,
        starts=STARTS,
        walkers=_walkers(case),
        rows=_table(rows),
        bins=rows[0].bins,
        least=LEAST_P,
        expected=" and ".join("{:.0f} to {:.0f}".format(*expected(len(done), level)) for level in LEVELS),
        chains=_chains(done),
    )
    content = {
        "environment": dict(surroundings),
        "settings": dict(settings),
        "parameters": [asdict(row) for row in rows],
        "repeats": [asdict(one) for one in done],
    }
    return text, write(case.name, content, text, directory)


def _ranks(done: list[Repeat], place: int) -> NDArray[np.int64]:
    return np.array([one.ranks[place] for one in done])


def _table(rows: list[Row]) -> str:
    header = ("parameter", "chi-square", "p", "p of KS", "mean", "in 68 %", "in 90 %", "verdict")
    body = [
        (
            row.parameter,
            f"{row.chi_square:.1f}",
            figure(row.p_chi_square, 2),
            figure(row.p_kolmogorov_smirnov, 2),
            f"{row.mean_off:+.2f}",
            *map(str, row.covered),
            "uniform" if row.uniform else "**not uniform**",
        )
        for row in rows
    ]
    return table(header, body)


def _chains(done: list[Repeat]) -> str:
    """What to know of the chains: all of them count, also those that fell short."""
    short = [str(one.repeat) for one in done if not one.converged]
    lost = [str(one.repeat) for one in done if not one.fit_converged]
    close = [str(one.repeat) for one in done if one.thinning < LEAST_THINNING]
    lines = [
        f"Chains that did not converge (ranked all the same): {_listed(short)}. Fits that did not: {_listed(lost)}.",
        f"Steps: {np.median([one.steps for one in done]):.0f} in the median, {max(one.steps for one in done)} at most. "
        f"Draws of one walker lie {min(one.thinning for one in done):.1f} autocorrelation times apart or more; less "
        f"than {LEAST_THINNING:g}: {_listed(close)}.",
        f"Seconds a repeat: {figure(float(np.median([one.seconds for one in done])))} in the median, the first, which "
        f"compiles, {figure(done[0].seconds)}.",
    ]
    return "".join(f"- {line}\n" for line in lines)


def _listed(names: list[str]) -> str:
    return f"{len(names)} (repeats {', '.join(names)})" if names else "none"
