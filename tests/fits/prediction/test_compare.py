"""Comparison of fits: the criteria written out, and which stack wins."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from fits import ComparisonOptions, Free, compare, fit
from fits.prediction.cross_validation import require_groups
from tests.helpers.models import COUNT, LINE, design, line, line_data, measured

STACKS = {"flat": LINE | {"b": 0.0}, "line": LINE}
DATA = line_data(truth=(1.0, 0.2))


@pytest.fixture(scope="module")
def fits() -> dict:
    return {name: fit(stack, DATA, transport=line, starts=2) for name, stack in STACKS.items()}


def test_criteria_are_those_of_the_books(fits: dict) -> None:
    comparison = compare(fits)
    assert comparison.sorted_by == "aic"
    assert [row.name for row in comparison.rows] == ["line", "flat"]
    for row, columns in zip(comparison.rows, (2, 1), strict=True):
        x = design(COUNT)[:, :columns]
        rest = DATA.values[:, 0] - x @ np.linalg.lstsq(x, DATA.values[:, 0], rcond=None)[0]
        likelihood = stats.norm.logpdf(rest, 0, 0.05).sum()
        assert row.fit.degrees_of_freedom == COUNT - columns
        assert row.aic == pytest.approx(2 * columns - 2 * likelihood, rel=1e-8)
        assert row.bic == pytest.approx(columns * math.log(COUNT) - 2 * likelihood, rel=1e-8)


def test_the_verdict_says_what_the_data_prefer(fits: dict) -> None:
    compared = compare(fits)
    aic, bic = (getattr(compared.rows[1], name) - getattr(compared.rows[0], name) for name in ("aic", "bic"))
    words = f"The data prefer line to flat: AIC difference {aic:.1f}, BIC difference {bic:.1f}."
    assert compared.verdict == words
    slope, error = fits["line"].values["['b']"], fits["line"].standard_errors["['b']"]
    nearly = fit({"a": Free(0.9, -1.0, 3.0), "b": slope + 0.4 * error}, DATA, transport=line, starts=2)
    aic, bic = 2 - 0.16, math.log(COUNT) - 0.16  # a parameter less, for 0.4 standard errors
    words = f"other and line are statistically indistinguishable: AIC difference {aic:.1f}, BIC difference {bic:.1f}."
    assert compare({"line": fits["line"], "other": nearly}).verdict == words


def test_a_misfit_counts_as_noise_in_the_verdict() -> None:
    """Errors stated ten times too small: differences in log-likelihood shrink by the best one's reduced chi-square."""
    poor = measured(DATA.values, 0.005)
    comparison = compare({name: fit(stack, poor, transport=line) for name, stack in STACKS.items()})
    assert any("no candidate explains the data" in note for note in comparison.notes)
    best, other = comparison.rows
    assert 80 < best.fit.reduced_chi_square < 130
    gain = (other.fit.chi_square - best.fit.chi_square) / best.fit.reduced_chi_square
    words = f"AIC difference {gain - 2:.1f}, BIC difference {gain - math.log(COUNT):.1f} (noise scaled to the residuals"
    assert words in comparison.verdict


def test_what_differs_is_said_or_refused(fits: dict) -> None:
    scaled = fit(LINE, DATA, transport=line, scale=1.1, starts=2)
    notes = compare({"line": fits["line"], "scaled": scaled}).notes
    assert any(note.startswith("the fits differ in scale") for note in notes)
    other = fit(LINE, measured(DATA.values + 0.01, 0.05), transport=line, starts=1)
    named = replace(fits["line"], problem=replace(fits["line"].problem, objective="log1p_cos"))
    for more, message in (
        ({"other": other}, "'line' and 'other' were fitted to different data"),
        ({"named": named}, "only fits of one objective"),
        ({}, "at least 2"),
    ):
        with pytest.raises(ValueError, match=message):
            compare({"line": fits["line"]} | more)
    both = compare({"a": named, "b": named})
    assert both.sorted_by == "chi_square"
    assert math.isnan(both.rows[0].aic)


def test_thresholds_are_options(fits: dict) -> None:
    comparison = compare(fits, options=ComparisonOptions(slight_difference=1e6))
    assert "line and flat are statistically indistinguishable" in comparison.verdict
    assert comparison.options.slight_difference == 1e6
    assert len(require_groups(fits["line"])) > 2
    with pytest.raises(ValueError, match="too few measurements to hold some of them out"):
        require_groups(fits["line"], ComparisonOptions(min_incidences=10**6))
