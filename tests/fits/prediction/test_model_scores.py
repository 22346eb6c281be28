"""Comparison of models: cross-validation, evidence, stacking weights and criteria, all known of linear regression."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

from fits import ComparisonOptions, Free, Noise, Normal, Problem, average, compare, cross_validate, fit, predict, slices
from fits.prediction.cross_validation import CrossValidation, rank_models, require_groups, stacking, without
from fits.prediction.evidence import Evidence, evidence
from fits.reports import tables
from tests.helpers.models import COUNT, LINE, along, design, line, line_data, measured
from tests.helpers.refusals import refuses

SIGMA = 0.05
GEOMETRY = slices([10.0, 30.0, 50.0], np.arange(-75.0, 76.0, 10.0))
STACK = {"a": Free(0.9, -4.0, 6.0, Normal(1.0, 0.5)), "b": Free(0.1, -4.0, 5.0, Normal(0.5, 0.4))}
FLAT = STACK | {"b": 0.0}
EXACT = np.asarray(line({"a": 1.0, "b": 0.5}, GEOMETRY.wi, GEOMETRY.wo))
COLUMNS = np.stack([np.ones(len(GEOMETRY)), GEOMETRY.wo[:, 2]], axis=-1)
DATA = along(GEOMETRY, EXACT + SIGMA * np.random.default_rng(0).standard_normal(EXACT.shape), SIGMA)
LINES = {"flat": LINE | {"b": 0.0}, "line": LINE}
SLOPING = line_data(truth=(1.0, 0.2))


def fitted(stack, data=DATA, **settings):
    return fit(stack, data, transport=line, noise=Noise(discrepancy=False), starts=2, **settings)


@pytest.fixture(scope="module")
def found():
    return fitted(STACK)


@pytest.fixture(scope="module")
def flat():
    return fitted(FLAT)


def held_out_density(rows):
    """Log predictive density of these rows by regression on the others, and the priors."""
    others = np.setdiff1d(np.arange(len(DATA)), rows)
    x, widths = COLUMNS[others], np.array([0.5, 0.4])
    precision = x.T @ x / SIGMA**2 + np.diag(widths**-2)
    mean = np.linalg.solve(precision, x.T @ DATA.values[others, 0] / SIGMA**2 + np.array([1.0, 0.5]) / widths**2)
    width = np.sqrt(np.sum(COLUMNS[rows] @ np.linalg.inv(precision) * COLUMNS[rows], axis=-1) + SIGMA**2)
    return stats.norm.logpdf(DATA.values[rows, 0], COLUMNS[rows] @ mean, width)


@pytest.mark.parametrize("discrepancy", [False, True])
def test_held_out_rows_have_no_influence(discrepancy):
    """Nor on a discrepancy: so few measurements are all inducing points, with these rows and without them."""
    rows, noise = np.arange(len(DATA)) % 3 == 0, Noise(discrepancy=discrepancy)
    whole, fewer = (Problem(STACK, data, line, noise) for data in (DATA, DATA.where(~rows)))
    left = without(whole, rows)
    for slope in (0.5, -0.3):
        ends = [np.linspace(1.0 - slope, 1.0 + slope, len(whole.start)) * whole.start, whole.start]
        gaps = [float(np.subtract(*map(of.log_likelihood, ends))) for of in (left, fewer)]
        assert gaps[0] == pytest.approx(gaps[1], abs=1e-3 if discrepancy else 1e-6)


def test_held_out_rows_tell_nothing_of_a_floor():
    """Next to dark measurements noise of a thousand times their size was less than the floor's upper bound."""
    noise = Noise(relative=0.01, floor=Free(1e-5, 1e-6, 0.1), discrepancy=True)
    dark = replace(DATA, values=0.0 * DATA.values)
    problem, rows = Problem(STACK, dark, line, noise), np.arange(len(DATA)) % 3 == 0
    model = without(problem, rows).model
    sigmas = [np.asarray(model.sigma_at(vector, dark.values))[rows] for vector in (problem.start, problem.high)]
    np.testing.assert_allclose(*sigmas, rtol=1e-5)


def test_held_out_data_are_predicted_by_the_others(found):
    left = cross_validate(found, draws=2000)
    assert left.groups == ("θᵢ = 10°", "θᵢ = 30°", "θᵢ = 50°")
    assert left.converged
    for rows in left.rows:
        np.testing.assert_allclose(left.log_density[rows, 0], held_out_density(rows), atol=0.05)
    assert left.elpd == pytest.approx(left.elpd_by_group.sum())


def test_errors_by_few_draws_are_told(found):
    """Beside exact densities; and more draws are taken until they are as small as asked for."""
    rough = [cross_validate(found, draws=64, seed=seed, options=ComparisonOptions(most_draws=64)) for seed in range(8)]
    exact = [held_out_density(rows).sum() for rows in rough[0].rows]
    off = np.stack([(one.elpd_by_group - exact) / one.errors for one in rough])  # 24 of them
    assert 0.5 < np.sqrt(np.mean(off**2)) < 1.5
    finer = cross_validate(found, draws=64, options=ComparisonOptions(monte_carlo_error=0.1))
    assert np.all(finer.errors <= 0.1)
    assert np.max(rough[0].errors) > 0.1
    assert finer.elpd == pytest.approx(sum(exact), abs=4.0 * finer.error)


def test_measurements_in_no_group_do_not_count():
    """One scan, and three measurements in another plane, too few to hold some out."""
    scan, wo = np.abs(DATA.theta_i - 10.0) < 1.0, DATA.wo.copy()
    aside = np.flatnonzero(scan)[:3]
    wo[aside] = wo[aside][:, [1, 0, 2]]
    left = cross_validate(fitted(STACK, replace(DATA, wo=wo).where(scan)))
    assert len(left.groups) == 5  # parts of the scan: one incidence says nothing of others
    alone = np.setdiff1d(np.arange(scan.sum()), np.concatenate(left.rows))
    assert left.log_density[alone].tolist() == [[0.0]] * 3


def product(stack, wi, wo):
    return (stack["a"] * stack["b"] + 0.0 * wo[:, 2])[:, None]


@pytest.mark.parametrize(
    ("transport", "free", "truth"),
    [
        (product, {"a": Free(1.0, 0.1, 5.0), "b": Free(1.0, 0.1, 5.0)}, {"a": 1.0, "b": 0.8}),  # a hyperbola
        (line, {"a": Free(0.5, 0.0, 1.0), "b": Free(0.1, -1.0, 3.0)}, {"a": 1.02, "b": 0.5}),  # beyond a bound
        (product, {"a": Free(0.1, 0.0, 1.0), "b": Free(0.1, 0.0, 1.0)}, {"a": 0.0, "b": 0.0}),  # nothing is known
    ],
)
def test_evidence_is_the_integral_over_the_box(transport, free, truth):
    """Of posteriors that are no ellipsoids, beside quadrature; the noise is so large that the box matters."""
    sigma, count, at = 0.1, 1500, slices([10.0, 50.0], np.arange(-75.0, 76.0, 10.0))
    exact = np.asarray(transport(truth, at.wi, at.wo))
    data = along(at, exact + sigma * np.random.default_rng(0).standard_normal(exact.shape), sigma)
    one = fit(free, data, transport=transport, noise=Noise(discrepancy=False), starts=2)
    sides = [np.linspace(low, high, count + 1) for low, high in zip(one.problem.low, one.problem.high, strict=True)]
    a, b = np.meshgrid(*(0.5 * (side[1:] + side[:-1]) for side in sides), indexing="ij")
    models = (a + b * cosine if transport is line else a * b for cosine in at.wo[:, 2])
    squares = sum((y - model) ** 2 for y, model in zip(data.values[:, 0], models, strict=True))
    logs = -0.5 * squares / sigma**2 - len(at) * np.log(sigma * np.sqrt(2.0 * np.pi))
    estimate = evidence(one)
    assert estimate.reliable
    assert abs(estimate.log_evidence - float(logsumexp(logs) - 2.0 * np.log(count))) < 4.0 * estimate.error
    assert estimate.error < 0.1


def test_weights_of_stacking_are_the_best():
    generator = np.random.default_rng(0)
    densities = generator.standard_normal((3, 200)) + np.array([[0.3], [0.2], [-5.0]])
    weights = stacking(densities)

    def score(w):
        return float(np.mean(logsumexp(densities + np.log(w)[:, None], axis=0)))

    others = generator.dirichlet(np.ones(3), 2000)
    assert score(weights) >= max(map(score, others)) - 1e-9
    assert weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(stacking(np.array([[0.0, 0.0], [-50.0, -50.0]])), [1.0, 0.0], atol=1e-6)


def test_fits_are_ranked_by_elpd_and_averaged_by_stacking(found, flat):
    candidates = {"flat": flat, "line": found}
    compared = compare(candidates, refit=True)
    best, other = (row.model_score for row in compared.rows)
    assert (compared.sorted_by, [row.name for row in compared.rows]) == ("elpd", ["line", "flat"])
    assert best.elpd_diff == 0.0
    assert other.elpd_diff == pytest.approx(best.elpd - other.elpd)
    odds = np.exp(best.evidence.log_evidence - other.evidence.log_evidence)
    assert best.model_probability / other.model_probability == pytest.approx(odds)
    assert "by cross-validation" in compared.verdict
    columns = set(tables.comparison_table(compared).columns)
    assert {"elpd", "weight", "log evidence", "model probability"} <= columns
    stacked = average(candidates)
    assert stacked.weights == pytest.approx({row.name: row.model_score.weight for row in compared.rows})
    assert predict(stacked, DATA).scores.count == DATA.values.size


def test_averages_are_mixtures(found, flat):
    both = predict(average({"line": found, "flat": flat}, {"line": 3.0, "flat": 1.0}), DATA, draws=4000)
    parts = [np.exp(predict(of, DATA, draws=2000).log_density(DATA.values)) for of in (found, flat)]
    np.testing.assert_allclose(both.log_density(DATA.values), np.log(0.75 * parts[0] + 0.25 * parts[1]), atol=0.05)
    many = {f"{number}": found for number in range(9)}  # more than draws: of those that are drawn at all, two
    assert len(predict(average(many, dict.fromkeys(many, 1.0)), DATA, draws=4).values) == 4 * 2


def test_bad_requests_are_refused(found, flat):
    two = {"line": found, "flat": flat}
    named = replace(found, problem=replace(found.problem, stack=LINE, objective="cube_root"))
    few = fitted(STACK, DATA.where((np.abs(DATA.theta_i - 10.0) < 1.0) & (DATA.theta_o < 10.0)))
    for call, message in (
        (lambda: average(two, {"line": 1.0}), "it must give each of line, flat"),
        (lambda: average(two, {"line": -1.0, "flat": 2.0}), "a number of at least 0"),
        (lambda: average({}), "there is no fit to average"),
        (lambda: cross_validate(named), "a fit of 'cube_root' has no noise model"),
        (lambda: evidence(named), "a fit of 'cube_root' has no noise model"),
        (lambda: cross_validate(few), "too few measurements to hold some"),
    ):
        refuses(message, call)


def test_what_is_worse_everywhere_is_distinguished():
    """In three groups of ten, over which a gap is spread evenly: also by 1130 +- 780, if it is so everywhere."""
    groups, rows, known = ("1", "2", "3"), tuple(np.split(np.arange(30), 3)), Evidence(0.0, 0.1, 0.1)
    best = CrossValidation(groups, rows, np.zeros((30, 1)), True, np.zeros(3))
    for gaps, clear in (((30, 200, 900), True), ((2, 200, 900), False), ((5, 6, 7), True), ((-1, 0.5, 2), False)):
        other = CrossValidation(groups, rows, -np.repeat(gaps, 10)[:, None] / 10.0, True, np.zeros(3))
        seen = rank_models({"best": best, "other": other}, {"best": known, "other": known})["other"]
        assert (seen.clear_diff > 0.0) == clear


@pytest.fixture(scope="module")
def both():
    return {name: fit(stack, SLOPING, transport=line, starts=2) for name, stack in LINES.items()}


def test_criteria_are_those_of_the_books(both):
    comparison = compare(both)
    assert comparison.sorted_by == "aic"
    assert [row.name for row in comparison.rows] == ["line", "flat"]
    for row, columns in zip(comparison.rows, (2, 1), strict=True):
        x = design(COUNT)[:, :columns]
        rest = SLOPING.values[:, 0] - x @ np.linalg.lstsq(x, SLOPING.values[:, 0], rcond=None)[0]
        likelihood = stats.norm.logpdf(rest, 0, 0.05).sum()
        assert row.fit.degrees_of_freedom == COUNT - columns
        assert row.aic == pytest.approx(2 * columns - 2 * likelihood, rel=1e-8)
        assert row.bic == pytest.approx(columns * math.log(COUNT) - 2 * likelihood, rel=1e-8)


def test_the_verdict_says_what_the_data_prefer(both):
    compared = compare(both)
    aic, bic = (getattr(compared.rows[1], name) - getattr(compared.rows[0], name) for name in ("aic", "bic"))
    words = f"The data prefer line to flat: AIC difference {aic:.1f}, BIC difference {bic:.1f}."
    assert compared.verdict == words
    slope, error = both["line"].values["['b']"], both["line"].standard_errors["['b']"]
    nearly = fit({"a": Free(0.9, -1.0, 3.0), "b": slope + 0.4 * error}, SLOPING, transport=line, starts=2)
    aic, bic = 2 - 0.16, math.log(COUNT) - 0.16  # a parameter less, for 0.4 standard errors
    words = f"other and line are statistically indistinguishable: AIC difference {aic:.1f}, BIC difference {bic:.1f}."
    assert compare({"line": both["line"], "other": nearly}).verdict == words


def test_a_misfit_counts_as_noise_in_the_verdict():
    """Errors stated ten times too small: differences in log-likelihood shrink by the best one's reduced chi-square."""
    poor = measured(SLOPING.values, 0.005)
    comparison = compare({name: fit(stack, poor, transport=line) for name, stack in LINES.items()})
    assert any("no candidate explains the data" in note for note in comparison.notes)
    best, other = comparison.rows
    assert 80 < best.fit.reduced_chi_square < 130
    gain = (other.fit.chi_square - best.fit.chi_square) / best.fit.reduced_chi_square
    words = f"AIC difference {gain - 2:.1f}, BIC difference {gain - math.log(COUNT):.1f} (noise scaled to the residuals"
    assert words in comparison.verdict


def test_what_differs_is_said_or_refused(both):
    scaled = fit(LINE, SLOPING, transport=line, scale=1.1, starts=2)
    notes = compare({"line": both["line"], "scaled": scaled}).notes
    assert any(note.startswith("the fits differ in scale") for note in notes)
    other = fit(LINE, measured(SLOPING.values + 0.01, 0.05), transport=line, starts=1)
    named = replace(both["line"], problem=replace(both["line"].problem, objective="log1p_cos"))
    for more, message in (
        ({"other": other}, "'line' and 'other' were fitted to different data"),
        ({"named": named}, "only fits of one objective"),
        ({}, "at least 2"),
    ):
        refuses(message, compare, {"line": both["line"]} | more)
    compared = compare({"a": named, "b": named})
    assert compared.sorted_by == "chi_square"
    assert math.isnan(compared.rows[0].aic)


def test_thresholds_are_options(both):
    comparison = compare(both, options=ComparisonOptions(slight_difference=1e6))
    assert "line and flat are statistically indistinguishable" in comparison.verdict
    assert comparison.options.slight_difference == 1e6
    assert len(require_groups(both["line"])) > 2
    with pytest.raises(ValueError, match="too few measurements to hold some of them out"):
        require_groups(both["line"], ComparisonOptions(min_incidences=10**6))
