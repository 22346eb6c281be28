"""What a notebook shows of results: their numbers, reservations, and no word as HTML."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

import fits
from tests.helpers.models import LINE, line, line_data

A, B = "['a']", "['b']"


def rows(html: str) -> list[list[str]]:
    """Words of the cells of all tables, row by row, of a fragment that must be well-formed."""
    return [["".join(cell.itertext()) for cell in row] for row in ET.fromstring(f"<div>{html}</div>").iter("tr")]


def text(html: str) -> str:
    return "".join(ET.fromstring(f"<div>{html}</div>").itertext())


def chain(fit: fits.Fit, converged: bool) -> fits.Posterior:
    """Independent draws about the best values: 500 steps of 8 walkers."""
    steps = fit.vector + fit.errors * np.random.default_rng(0).standard_normal((500, 8, len(fit.vector)))
    return fits.Posterior(fit, steps, np.zeros((500, 8)), np.ones(len(fit.vector)), acceptance=0.4, converged=converged)


def test_a_fit_is_its_verdict_its_values_and_what_is_not_identified(result: fits.Fit) -> None:
    direction = fits.Direction(float("inf"), {A: 0.8, B: -0.6}, {A: 0.1, B: 0.2})
    case = replace(result, at_bound=(A,), errors=np.array([np.nan, 0.1]), unidentified=(direction,))
    head, first, second, *more = rows(case._repr_html_())
    assert head == ["parameter", "value", "error", "unit", "bounds", "identifiability"]
    assert [float(row[1]) for row in (first, second)] == pytest.approx(list(result.values.values()), rel=0.01)
    assert (first[2], float(second[2]), first[4]) == ("unknown", 0.1, "-1 to 3")
    assert any(row[2:4] == ["unidentified", f"+0.8 {A}, -0.6 {B}"] for row in more)
    words = text(case._repr_html_())
    assert f"{A} and {B} are not identified separately; {A} is at a bound." in words
    assert f"reduced chi-square {result.reduced_chi_square:.3g}" in words


def test_a_posterior_has_estimates_only_if_its_chain_is_long_enough(result: fits.Fit) -> None:
    long, short = chain(result, True)._repr_html_(), chain(result, False)._repr_html_()
    head, *found = rows(long)
    assert head[:2] == ["parameter", "median"]
    assert "unit" in head
    assert {row[0]: float(row[1]) for row in found} == pytest.approx(result.values, abs=0.1 * result.errors.min())
    assert "8 walkers made 500 steps" in text(long)
    assert rows(short) == []
    assert "it gives no estimates yet" in text(short)


def test_joint_fits_and_comparisons_are_shown_and_names_are_no_html(result: fits.Fit) -> None:
    problems = dict.fromkeys(["<b>first</b>", "second"], fits.Problem(LINE, line_data(), line))
    shown = fits.fit(fits.Joint(problems, shared=[A]), starts=1)._repr_html_()
    assert "<b>" not in shown
    assert [head.text for head in ET.fromstring(f"<div>{shown}</div>").iter("h4")] == list(problems)
    assert sum(row[0] == B for row in rows(shown)) == 2
    flat = fits.fit(LINE | {"b": 0.0}, line_data(), transport=line, starts=1)
    shown = fits.compare({"sloped <line>": result, "flat": flat})._repr_html_()
    assert [row[0] for row in rows(shown)] == ["fit", "sloped <line>", "flat"]
    assert "prefer sloped <line>" in text(shown)


def test_words_are_short_and_on_one_line(result: fits.Fit, coat_data: fits.Measurements) -> None:
    words = f"{len(coat_data)} data points, 10 of them masked, of value, from simulated data"
    assert repr(coat_data) == f"<Measurements: {words}>"
    assert repr(fits.slices(incidence=[10, 30], outgoing=[0, 20])) == "<Geometry: 4 pairs of directions>"
    assert repr(result).startswith(f"<Fit to 100 measurements: ['a'] {result.vector[0]:.4g} ± ")
    assert repr(chain(result, True)) == "<Posterior of ['a'], ['b']: 500 steps of 8 walkers, converged>"
