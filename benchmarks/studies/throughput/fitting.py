"""Speed of inference: one fit, many fits and a posterior, beside scipy and emcee on a plain numpy model.

Both sides see the same noisy values, 2,000 by default, the same residuals and the same bounds, and start from the same
point. The numpy model is written out here and shares nothing with layerjax.
"""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import emcee
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

import fits
import layerjax as lj
from benchmarks.measuring.repeats import fit_many
from benchmarks.measuring.timing import interleaved
from benchmarks.measuring.writing import Bar, figure, table
from benchmarks.suite.scenes import pairs

Floats = NDArray[np.float64]

NOISE = 0.05
WALKERS = 32
TRUTH = np.array([0.6, 0.9, 0.35, 0.8, 0.4, 0.3])
START = np.array([1.0, 0.7, 0.5, 1.5, 0.0, 0.5])
LOW = np.array([0.01, 0.0, 0.05, 0.01, -0.9, 0.0])
HIGH = np.array([5.0, 1.0, 1.0, 5.0, 0.9, 1.0])
"""Flakes: thickness, albedo, alpha; haze under them: thickness, g; diffuse base: albedo."""


@dataclass(frozen=True)
class Size:
    """How much is measured.

    rounds: interleaved repeats. many: fits at once; few: of them, those that scipy does. numpy_steps: of the chain on
    the numpy likelihood; chain_steps: the most that ours may take (it stops when it has converged).
    samples: values that are fitted.
    """

    rounds: int
    many: int
    few: int
    numpy_steps: int
    chain_steps: int = 20_000
    samples: int = 2_000


DEFAULT, QUICK = Size(7, 1024, 20, 3000), Size(3, 256, 6, 600)


@dataclass(frozen=True)
class Row:
    """Ours and theirs in `unit`; ratio: ours / theirs."""

    work: str
    unit: str
    ours: float
    theirs: float
    theirs_name: str
    ratio: float
    bar: str
    verdict: str
    note: str


def run(size: Size, report: Callable[[str], None]) -> list[Row]:
    """The rows on fitting and sampling."""
    report("one fit")
    problem = coated_lobe(size.samples)
    rows = one_fit(problem, size)
    report(f"{size.many} fits")
    rows.append(many_fits(problem, size))
    report("posterior")
    rows.append(posterior(problem, size))
    return rows


def stack_of(parameters: Any) -> lj.Stack:
    """The six-parameter material; the parameters may be numbers or `fits.Free`."""
    thickness, albedo, alpha, depth, g, base = parameters
    flakes = lj.Medium(thickness, albedo, lj.SGGX("surface", alpha))
    return lj.Stack([flakes, lj.Medium(depth, 0.9, lj.HenyeyGreenstein(g))], lj.Lambertian(base))


def model(p: Floats, wi: Floats, wo: Floats) -> Floats:
    """BSDF of the six-parameter material in plain numpy, (N,), for directions (N, 3) above the surface."""
    thickness, albedo, alpha, depth, g, base = p
    ci, co = wi[:, 2], wo[:, 2]
    half = wi + wo
    half = half / np.sqrt(np.sum(half * half, axis=1))[:, None]
    across = half[:, 0] ** 2 + half[:, 1] ** 2
    flakes = alpha**2 / (np.pi * (across + alpha**2 * half[:, 2] ** 2) ** 2)
    si, so = (np.sqrt(alpha**2 * (w[:, 0] ** 2 + w[:, 1] ** 2) + w[:, 2] ** 2) for w in (wi, wo))
    crossed = thickness * (si / ci + so / co)
    coat = albedo * 0.25 * flakes * -np.expm1(-crossed) / (si * co + so * ci)
    phase = (1 - g * g) / (4 * np.pi * (1 + g * g + 2 * g * np.sum(wi * wo, axis=1)) ** 1.5)
    deep = depth * (1 / ci + 1 / co)
    haze = 0.9 * phase * -np.expm1(-deep) / (ci + co) * np.exp(-crossed)
    return coat + haze + base / np.pi * np.exp(-crossed - deep)


def coated_lobe(samples: int, seed: int = 0) -> fits.Problem:
    """Noisy values of the six-parameter material at random directions, and what is free in it."""
    wi, wo = pairs(samples, "reflection", seed)
    exact = model(TRUTH, wi, wo)
    sigma = NOISE * exact
    values = exact + sigma * np.random.default_rng(seed + 1).standard_normal(samples)
    data = fits.Measurements(
        wi=wi,
        wo=wo,
        values=values[:, None],
        sigma=sigma[:, None],
        mask=np.ones(samples, bool),
        channels=("value",),
    )
    free = [fits.Free(*ends) for ends in zip(START.tolist(), LOW.tolist(), HIGH.tolist(), strict=True)]
    return fits.Problem(stack_of(free), data, transport=lj.SingleScattering())


def scipy_fit(problem: fits.Problem, values: Floats) -> Any:
    """scipy's fit of the values (N, 1) with finite differences, from the same start within the same bounds."""
    wi, wo, sigma = problem.data.wi, problem.data.wo, np.asarray(problem.data.sigma)[:, 0]
    return least_squares(lambda p: (model(p, wi, wo) - values[:, 0]) / sigma, START, bounds=(LOW, HIGH))


def one_fit(problem: fits.Problem, size: Size) -> list[Row]:
    """Milliseconds of one fit from one start: the whole of `fits.fit`, and the solver with standard errors alone."""
    values = np.asarray(problem.data.values)
    seconds = interleaved(
        {
            "fit": lambda: fits.fit(problem, starts=1).vector,
            "solver": lambda: fit_many(problem, values[None]).vectors,
            "scipy": lambda: scipy_fit(problem, values).x,
        },
        size.rounds * 3,
    )
    ours, theirs = fits.fit(problem, starts=1), scipy_fit(problem, values)
    note = f"cost {ours.cost:.4f} in {ours.iterations} steps, scipy {theirs.cost:.4f} in {theirs.nfev} (+ differences)"
    rows = []
    for way, name, bar in (
        ("solver", f"6-parameter fit of {size.samples:,} samples, with standard errors", Bar(0.35, 0.15)),
        ("fit", "the same by fits.fit: checks of bounds, open directions, minima, status", None),
    ):
        ratio = float(np.median(seconds[way] / seconds["scipy"]))
        mine, other = (1e3 * float(np.median(seconds[key])) for key in (way, "scipy"))
        rows.append(_row(name, "ms", mine, other, "scipy least_squares", ratio, bar, note if bar else ""))
    return rows


def many_fits(problem: fits.Problem, size: Size) -> Row:
    """Fits a second of `size.many` noisy repeats in one call, beside scipy on some of them."""
    exact = model(TRUTH, problem.data.wi, problem.data.wo)[:, None]
    noise = np.random.default_rng(7).standard_normal((size.many, *exact.shape))
    values = exact + NOISE * exact * noise
    seconds = interleaved(
        {
            "fits": lambda: fit_many(problem, values).vectors,
            "scipy": lambda: [scipy_fit(problem, row).x for row in values[: size.few]],
        },
        max(size.rounds // 2, 1),
    )
    ours = fit_many(problem, values)
    theirs = [scipy_fit(problem, row).cost for row in values[: size.few]]
    worse = int(np.sum(ours.cost[: size.few] > np.array(theirs) * (1 + 1e-6)))
    note = f"{int(ours.converged.sum())} of {size.many} converged; {worse} of {size.few} cost more than scipy's"
    rates = size.many / seconds["fits"], size.few / seconds["scipy"]
    ratio = float(np.median(rates[0] / rates[1]))
    ours_rate, theirs_rate = (float(np.median(rate)) for rate in rates)
    name = f"{size.many:,} such fits"
    return _row(name, "fits/s", ours_rate, theirs_rate, "scipy in a loop", ratio, Bar(12, 30, rate=True), note)


def posterior(problem: fits.Problem, size: Size) -> Row:
    """Effective samples a second of `fits.sample`, until it stops by itself, beside emcee on the numpy likelihood."""
    fit = fits.fit(problem, starts=1)
    fits.sample(fit, walkers=WALKERS, max_steps=100, allow_unconverged=True)
    chain = _NumpyChain(problem, fit)
    rounds = max(size.rounds // 2, 2)
    ours, speeds, posteriors = [], [], []
    for seed in range(rounds):
        began = time.perf_counter()
        found = fits.sample(fit, walkers=WALKERS, seed=seed, max_steps=size.chain_steps)
        ours.append(float(np.min(found.effective_samples)) / (time.perf_counter() - began))
        posteriors.append(found)
        speeds.append(chain.go_on(size.numpy_steps // rounds))
    theirs = np.array(speeds) * chain.effective_per_step()
    found = posteriors[-1]
    longest = float(np.max(found.autocorrelation_time))
    note = (
        f"{len(found.chain)} steps, autocorrelation time {longest:.1f}, converged {found.converged}; numpy: "
        f"{chain.steps} steps, {chain.autocorrelation_time():.0f}; largest shift of a mean {chain.shift(found):.2f} sd"
    )
    ratio = float(np.median(np.array(ours) / theirs))
    mine, other = float(np.median(ours)), float(np.median(theirs))
    name = f"posterior of the same, {WALKERS} walkers"
    return _row(name, "effective samples/s", mine, other, "emcee + numpy", ratio, Bar(4, 20, rate=True), note)


def markdown(rows: list[Row]) -> str:
    """The rows as a table, with the notes under it."""
    header = ("work", "unit", "layerjax", "other", "", "ratio", "bar (aim)", "verdict")
    body = [
        (r.work, r.unit, figure(r.ours), figure(r.theirs), r.theirs_name, figure(r.ratio), r.bar, r.verdict)
        for r in rows
    ]
    notes = "".join(f"- {row.work}: {row.note}.\n" for row in rows if row.note)
    return f"{table(header, body)}\n{notes}"


def as_json(rows: list[Row]) -> list[dict[str, Any]]:
    """The rows as plain data."""
    return [asdict(row) for row in rows]


class _NumpyChain:
    """emcee as one would use it at first: the default move, one walker at a time, a numpy likelihood."""

    def __init__(self, problem: fits.Problem, fit: fits.Fit) -> None:
        data = problem.data
        sigma, values = np.asarray(data.sigma)[:, 0], data.values[:, 0]

        def log_posterior(p: Floats) -> float:
            if np.any(p < LOW) or np.any(p > HIGH):
                return -np.inf
            return -0.5 * float(np.sum(((values - model(p, data.wi, data.wo)) / sigma) ** 2))

        generator = np.random.default_rng(0)
        cloud = generator.multivariate_normal(fit.vector, fit.covariance, WALKERS)
        inside = np.clip(cloud, LOW + 1e-6, HIGH - 1e-6)
        self.sampler = emcee.EnsembleSampler(WALKERS, len(TRUTH), log_posterior)
        seeded = np.random.RandomState(0)
        self.state: Any = emcee.State(inside, random_state=seeded.get_state())
        self.steps = 0

    def go_on(self, steps: int) -> float:
        """Run this many steps; returns steps a second."""
        began = time.perf_counter()
        self.state = self.sampler.run_mcmc(self.state, steps)
        self.steps += steps
        return steps / (time.perf_counter() - began)

    def autocorrelation_time(self) -> float:
        kept = self.sampler.get_chain(discard=self.steps // 10)
        return float(np.max(emcee.autocorr.integrated_time(kept, tol=0)))

    def effective_per_step(self) -> float:
        return WALKERS / self.autocorrelation_time()

    def shift(self, other: fits.Posterior) -> float:
        """Largest difference of the means of two chains, in standard deviations: both sample the same posterior."""
        mine = self.sampler.get_chain(discard=self.steps // 10, flat=True)
        theirs = other.chain[other.burn_in :].reshape(-1, mine.shape[1])
        return float(np.max(np.abs(mine.mean(axis=0) - theirs.mean(axis=0)) / theirs.std(axis=0)))


def _row(work: str, unit: str, ours: float, theirs: float, name: str, ratio: float, bar: Bar | None, note: str) -> Row:
    words, verdict = (bar.words(), bar.verdict(ratio)) if bar else ("", "")
    return Row(work, unit, ours, theirs, name, ratio, words, verdict, note)
