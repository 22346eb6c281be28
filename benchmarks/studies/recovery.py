"""Are the errors honest? Noisy repeats of simulated goniometer slices, fitted and sampled as users do.

The exact values come from `layerjax.evaluate`: this is a study of the inference. The noise comes from numpy.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy import stats

import fits
import layerjax as lj
from benchmarks.measuring import environment
from benchmarks.measuring.repeats import Repeats, fit_many
from benchmarks.measuring.writing import DIRECTORY, environment_lines, figure, table, write

Floats = NDArray[np.float64]

INCIDENCE = (10.0, 30.0, 50.0, 70.0)
NOISE = 0.05
STARTS = 8
WALKERS = 32
WITHIN = 3.0
ENOUGH = 0.98
LEVEL = 0.6827

TEXT = """\
# Recovery

{environment}
Flakes (SGGX: thickness, albedo, alpha) over a rough diffuse base (Oren-Nayar: albedo, roughness), five free parameters
with wide uniform priors. In-plane slices at incidence {incidence} degrees, {samples} values, {noise:.0%} noise of the
exact value; the fit knows the relative level and applies it to its own model. {starts} starts a fit.

## {repeats} fits

*pull* is (fitted - true) / standard error: a mean of 0 +- {error:.2f} and a standard deviation of 1 +- {spread:.2f} are
right. Required: within {within:g} standard errors in at least {enough:.0%} of the repeats. Converged: {converged}; a
parameter ended on a bound in {bounded}. *many* are the same figures of {many:,} other repeats by `fit_many`, one start
each.

{fitted}
## {repeats} posteriors

Central 68 % intervals: how many cover the truth. The expected count is {expected:.0f}; {low:.0f} to {high:.0f} is the
central 95 % of the binomial distribution. Converged chains: {chains}, {steps:.0f} steps in the median.

{covered}"""


@dataclass(frozen=True)
class Size:
    """Repeats that are fitted and sampled, and repeats that are fitted by `fit_many`."""

    repeats: int
    many: int


DEFAULT, QUICK = Size(100, 2000), Size(12, 100)


@dataclass(frozen=True)
class Row:
    """One parameter over all repeats; `covered` counts posterior intervals, `within_3` fits."""

    parameter: str
    truth: float
    typical_error: float
    mean_of_pulls: float
    sd_of_pulls: float
    within_3: int
    recovered: bool
    many_mean_of_pulls: float
    many_sd_of_pulls: float
    many_within_3: float
    covered: int
    coverage_holds: bool
    posterior_sd_over_error: float


def study(
    quick: bool = False,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    size: Size | None = None,
) -> tuple[str, tuple[Path, Path]]:
    """Run it, and write ``recovery.json`` and ``recovery.md``; returns the markdown and the two paths."""
    size = size or (QUICK if quick else DEFAULT)
    geometry = fits.slices(incidence=INCIDENCE)
    exact = np.asarray(
        lj.evaluate(
            stack_of(TRUTH.values()), jnp.asarray(geometry.wi), jnp.asarray(geometry.wo), lj.SingleScattering()
        ),
        float,
    )
    generator = np.random.default_rng(2024)
    noisy = exact * (1.0 + NOISE * generator.standard_normal((size.repeats, *exact.shape)))
    others = exact * (1.0 + NOISE * generator.standard_normal((size.many, *exact.shape)))

    report(f"{size.many} fits at once")
    many = fit_many(problem_of(geometry, noisy[0]), others)
    results = []
    for index, values in enumerate(noisy):
        if index % 10 == 0:
            report(f"repeat {index} of {size.repeats}")
        fit = fits.fit(problem_of(geometry, values), starts=STARTS, seed=index)
        results.append((fit, fits.sample(fit, walkers=WALKERS, seed=index, allow_unconverged=True)))
    rows = _rows(results, many, size)
    limits = stats.binom.interval(0.95, size.repeats, LEVEL)
    counts = _counts(results, many)
    surroundings = environment.describe()
    content = {
        "environment": surroundings,
        "repeats": size.repeats,
        "many": size.many,
        "noise": NOISE,
        "incidence_degrees": INCIDENCE,
        "coverage_limits_95": [float(limit) for limit in limits],
        **counts,
        "parameters": [asdict(row) for row in rows],
    }
    text = _markdown(surroundings, size, exact.size, counts, limits, rows)
    return text, write("recovery", content, text, directory)


def _counts(results: list[tuple[fits.Fit, fits.Posterior]], many: Repeats) -> dict[str, int | float]:
    return {
        "fits_converged": sum(fit.converged for fit, _ in results),
        "fits_with_a_parameter_at_a_bound": sum(bool(fit.at_bound) for fit, _ in results),
        "many_converged": int(many.converged.sum()),
        "chains_converged": sum(posterior.converged for _, posterior in results),
        "median_steps": float(np.median([len(posterior.chain) for _, posterior in results])),
    }


def _markdown(
    surroundings: Mapping[str, Any],
    size: Size,
    samples: int,
    counts: Mapping[str, float],
    limits: tuple[float, float],
    rows: list[Row],
) -> str:
    return TEXT.format(
        environment=environment_lines(surroundings),
        incidence=", ".join(f"{angle:g}" for angle in INCIDENCE),
        samples=samples,
        noise=NOISE,
        starts=STARTS,
        repeats=size.repeats,
        error=1 / np.sqrt(size.repeats),
        spread=1 / np.sqrt(2 * size.repeats),
        within=WITHIN,
        enough=ENOUGH,
        converged=counts["fits_converged"],
        bounded=counts["fits_with_a_parameter_at_a_bound"],
        many=size.many,
        expected=LEVEL * size.repeats,
        low=limits[0],
        high=limits[1],
        chains=counts["chains_converged"],
        steps=counts["median_steps"],
        fitted=_fitted_table(rows),
        covered=_covered_table(rows),
    )


TRUTH = {
    "layers[0].thickness": 0.5,
    "layers[0].albedo": 0.8,
    "layers[0].phase.alpha": 0.3,
    "base.albedo": 0.4,
    "base.roughness": 0.5,
}


def stack_of(parameters: Any) -> lj.Stack:
    """The material; the five parameters may be numbers or `fits.Free`."""
    thickness, albedo, alpha, base, roughness = parameters
    return lj.Stack([lj.Medium(thickness, albedo, lj.SGGX("surface", alpha))], lj.OrenNayar(base, roughness))


def problem_of(geometry: fits.Geometry, values: Floats) -> fits.Problem:
    """What a user would write for these values, (N, 1)."""
    free = (
        fits.Free(1.0, 0.01, 5.0),
        fits.Free(0.5, 0.0, 1.0),
        fits.Free(0.5, 0.02, 1.0),
        fits.Free(0.5, 0.0, 1.0),
        fits.Free(0.3, 0.0, 1.0),
    )
    used = np.ones(len(geometry), bool)
    data = fits.Measurements(geometry.wi, geometry.wo, values, None, used, ("value",))
    return fits.Problem(stack_of(free), data, lj.SingleScattering(), noise=fits.Noise(relative=NOISE))


def _rows(results: list[tuple[fits.Fit, fits.Posterior]], many: Repeats, size: Size) -> list[Row]:
    names = results[0][0].problem.names
    truth = np.array([TRUTH[name] for name in names])
    vectors = np.array([fit.vector for fit, _ in results])
    errors = np.array([fit.errors for fit, _ in results])
    summaries = np.array([list(posterior.summary().values()) for _, posterior in results])  # (repeats, P, 5)
    with np.errstate(invalid="ignore"):
        pulls = (vectors - truth) / errors
        ratio = summaries[..., 4] / errors
    covered = np.sum((summaries[..., 1] <= truth) & (truth <= summaries[..., 2]), axis=0)
    within = np.sum(np.abs(pulls) <= WITHIN, axis=0)  # a parameter at a bound has no error and does not count
    usable = many.converged & np.all(many.standard_errors > 0, axis=1)
    many_pulls = (many.vectors[usable] - truth) / many.standard_errors[usable]
    low, high = stats.binom.interval(0.95, size.repeats, LEVEL)
    return [
        Row(
            parameter=name,
            truth=float(truth[i]),
            typical_error=float(np.nanmedian(errors[:, i])),
            mean_of_pulls=float(np.nanmean(pulls[:, i])),
            sd_of_pulls=float(np.nanstd(pulls[:, i], ddof=1)),
            within_3=int(within[i]),
            recovered=bool(within[i] >= ENOUGH * size.repeats),
            many_mean_of_pulls=float(np.mean(many_pulls[:, i])),
            many_sd_of_pulls=float(np.std(many_pulls[:, i], ddof=1)),
            many_within_3=float(np.sum(np.abs(many_pulls[:, i]) <= WITHIN) / size.many),
            covered=int(covered[i]),
            coverage_holds=bool(low <= covered[i] <= high),
            posterior_sd_over_error=float(np.nanmedian(ratio[:, i])),
        )
        for i, name in enumerate(names)
    ]


def _fitted_table(rows: list[Row]) -> str:
    header = ("parameter", "truth", "typical error", "mean pull", "sd of pulls", "within 3", "verdict")
    header_many = ("many: mean pull", "many: sd", "many: within 3")
    body = [
        (
            row.parameter,
            figure(row.truth),
            figure(row.typical_error, 2),
            f"{row.mean_of_pulls:+.2f}",
            f"{row.sd_of_pulls:.2f}",
            str(row.within_3),
            "met" if row.recovered else "**not met**",
            f"{row.many_mean_of_pulls:+.3f}",
            f"{row.many_sd_of_pulls:.3f}",
            f"{row.many_within_3:.2%}",
        )
        for row in rows
    ]
    return table((*header, *header_many), body)


def _covered_table(rows: list[Row]) -> str:
    header = ("parameter", "68 % intervals that cover the truth", "verdict", "posterior sd / standard error")
    body = [
        (
            row.parameter,
            str(row.covered),
            "met" if row.coverage_holds else "**not met**",
            f"{row.posterior_sd_over_error:.2f}",
        )
        for row in rows
    ]
    return table(header, body)
