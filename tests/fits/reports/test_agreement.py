"""What is said of how a model agrees with the data, beside data of which it is known."""

import re
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from fits.data.geometry import slices
from fits.data.measurements import Measurements
from fits.data.neighbours import correlation, neighbours
from fits.data.scans import signed_angle
from fits.optimise.fit import fit
from fits.optimise.result import Fit
from fits.problem.model import Density
from fits.problem.noise import Noise
from fits.problem.parameters import Free
from fits.problem.problem import Problem
from fits.reports import verdicts
from fits.reports.agreement import agreement, explains, misdescribed, noise_notes
from fits.reports.diagnostics import bsdf, misfit, residual_structure, standardised
from fits.reports.html import page
from fits.reports.plots.model import curves_picture
from tests.helpers.models import line

GEOMETRY = slices([10.0, 30.0, 50.0, 70.0], np.arange(-80.0, 81.0, 4.0))
STACK = {"a": Free(0.9, 0.1, 3.0), "b": Free(0.1, -1.0, 3.0)}
TRUTH = np.array([1.0, 0.5, 0.1, 12.0, 12.0, 0.3])  # the line, and the discrepancy: amplitude, lengths, growth
NOISE = Noise(relative=0.02, floor=1e-4, discrepancy=True)


def assumed(values: np.ndarray) -> Problem:
    count = len(GEOMETRY)
    data = Measurements(GEOMETRY.wi, GEOMETRY.wo, values, None, np.ones(count, bool), ("value",))
    return Problem(STACK, data, line, NOISE)


def simulated(seed: int, factor: float = 1.0) -> Problem:
    """Readings that scatter exactly as the noise model says: a smooth discrepancy of the logarithm, and noise."""
    generator = np.random.default_rng(seed)
    exact = np.asarray(line({"a": 1.0, "b": 0.5}, GEOMETRY.wi, GEOMETRY.wo))
    model = assumed(exact).model
    process, at = model.process, model.build(TRUTH).correlation
    assert process is not None
    lack = np.asarray(process.sample(generator.standard_normal((1, len(process.where))), at))
    return assumed(factor * exact * np.exp(lack) * (1.0 + 0.02 * generator.standard_normal(exact.shape)))


@pytest.fixture(scope="module")
def fitted() -> Fit:
    of = simulated(0)
    return fit(STACK, of.data, transport=line, noise=NOISE, starts=1)


def test_residuals_of_the_assumed_model_are_independent_standard_normal(fitted: Fit) -> None:
    """Six sets that are drawn from the model itself, at its true parameters."""
    structures = []
    pairs: list[tuple[np.ndarray, np.ndarray]] = []
    for seed in range(6):
        true = replace(fitted, problem=simulated(seed), vector=TRUTH)
        residuals = standardised(true)
        structures.append(residual_structure(true.problem.data, residuals))
        pairs.append(neighbours(true.problem.data, residuals))
        assert true.chi_square == pytest.approx(np.sum(residuals**2), rel=1e-6)
        for structure in structures[-1:]:  # of each set within 4 standard errors
            assert abs(structure.rms - 1.0) < 4.0 / np.sqrt(2.0 * structure.count)
            assert abs(structure.lag_one_sigma) < 4.0
    first, second = (np.concatenate(part) for part in zip(*pairs, strict=True))
    count = sum(one.count for one in structures)
    assert np.sqrt(np.mean([one.rms**2 for one in structures])) == pytest.approx(1.0, abs=3.0 / np.sqrt(2.0 * count))
    assert abs(correlation(first, second)) < 3.0 / np.sqrt(len(first))


def test_residuals_of_a_fit_are_nearly_so_and_the_page_says_so_once(fitted: Fit) -> None:
    structure = residual_structure(fitted.problem.data, standardised(fitted))
    assert structure.rms == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * structure.count))
    assert abs(structure.lag_one_sigma) < 4.0
    told = [line for line in explains(fitted, structure) if "correlated by" in line]
    assert len(told) == 1
    assert f"root mean square of {structure.rms:.2f}" in told[0]
    # what is left beside the discrepancy is what a picture shows, and is smaller: it has followed each reading
    assert np.sqrt(np.mean(misfit(fitted) ** 2)) < structure.rms


def test_there_is_one_statement_on_the_quoted_errors(fitted: Fit) -> None:
    """Small residuals that are all alike once made the errors too large by 2.3 and too small by 4.4 on one page."""
    structure = replace(
        residual_structure(fitted.problem.data, standardised(fitted)), rms=0.43, lag_one=0.9, lag_one_sigma=18.0
    )
    small = replace(fitted)
    vars(small)["chi_square"] = 0.19 * fitted.degrees_of_freedom
    told = [line for line in explains(small, structure) if "quoted errors are" in line]
    assert len(told) == 1
    net = np.sqrt(0.19) * np.sqrt(1.9 / 0.1)  # (1 + r) / (1 - r) for the correlation
    assert f"too small by a factor of about {net:.2g} (0.44 for the size of the residuals times 4.4" in told[0]


def test_a_stack_that_misses_is_said_to_though_the_discrepancy_explains_all(fitted: Fit) -> None:
    """chi-square is fine, since the discrepancy takes up the misfit; the stack alone is off by a third."""
    off = replace(fitted, vector=fitted.vector * np.array([1.4, 1.4, 3.0, 1.0, 1.0, 1.0]))
    values = off.problem.data.values
    assert off.reduced_chi_square < 1.5
    lines, fine = verdicts.in_short(off, residual_structure(off.problem.data, standardised(off)))
    assert not fine
    said = re.match(
        r"This stack does not describe the sample: median misfit (\d+) %, stated noise ([\d.]+) %\.", lines[0]
    )
    assert said is not None
    assert float(said[1]) == pytest.approx(100.0 * np.median(off.predicted / values - 1.0), abs=1.0)
    assert float(said[2]) == pytest.approx(2.0)
    last = verdicts.outcome(off, residual_structure(off.problem.data, standardised(off)))[-1]
    without = (
        np.sum(np.square(off.problem.call(Density.offsets_at, off.vector, off.predicted))) / off.degrees_of_freedom
    )
    assert f"with the discrepancy term, {without:.4g} without" in last
    assert misdescribed(replace(fitted, problem=simulated(0), vector=TRUTH)) != []  # 10 % beside a noise of 2 %
    right = replace(fitted.problem, noise=Noise(relative=0.2, floor=1e-4, discrepancy=False))
    assert misdescribed(replace(fitted, problem=right, vector=TRUTH[:2])) == []


def test_another_minimum_is_not_praised_where_nothing_fits(fitted: Fit) -> None:
    structure = residual_structure(fitted.problem.data, standardised(fitted))
    right = replace(fitted.problem, noise=Noise(relative=0.2, floor=1e-4, discrepancy=False))
    good = replace(fitted, problem=right, vector=TRUTH[:2], alternatives=fitted.minima[:1])
    said = " ".join(verdicts.in_short(good, structure)[0])
    assert "Another local minimum of the same model fits equally well" in said
    bad = replace(fitted, vector=1.4 * fitted.vector, alternatives=fitted.minima[:1])
    for words in (verdicts.in_short(bad, structure)[0], verdicts.outcome(bad, structure), verdicts.minima(bad)):
        assert "equally well" not in " ".join(words)


@pytest.mark.parametrize(("factor", "words"), [(1.04, "4 %"), (3.0, "a factor of 3"), (1e4, "a factor of 1e+04")])
def test_a_large_misfit_is_a_factor(fitted: Fit, factor: float, words: str) -> None:
    """As a share of the model it was 100 % wherever the model was far too high."""
    values = factor**-1.0 * fitted.predicted
    for data in (values, factor**2 * values):  # too high as well as too low
        off = replace(fitted, problem=assumed(data))
        vars(off)["predicted"] = fitted.predicted
        assert agreement(off) == [
            f"Half of the {len(GEOMETRY)} readings are within {words} of the stack alone, 95 % of them within {words}."
        ]


def test_both_curves_are_drawn_and_the_residuals_are_those_of_the_one_with_the_discrepancy(fitted: Fit) -> None:
    figure = curves_picture({"model": fitted})
    assert isinstance(figure, Figure)
    upper, lower = figure.axes[:2]
    curves = {str(line.get_label()): line for line in upper.lines}
    data = fitted.problem.data
    rows = np.flatnonzero(np.isclose(data.theta_i, 10.0))
    angle, values = signed_angle(data)[rows], data.values[rows, 0]
    for label, expected in (("model with discrepancy", bsdf(fitted)), ("stack alone", fitted.predicted)):
        drawn = np.interp(angle, *curves[label].get_data())
        np.testing.assert_allclose(drawn, expected[rows, 0], rtol=2e-3)
    (points,) = (line for line in lower.lines if len(np.asarray(line.get_xdata())) == len(rows))
    shown = np.asarray(points.get_ydata())
    drawn = np.interp(angle, *curves["model with discrepancy"].get_data())
    np.testing.assert_allclose(shown, (values - drawn) / (0.02 * values), atol=0.15)
    assert "discrepancy" in lower.get_ylabel()


def test_a_noise_that_was_assumed_is_said_and_repeats_offer_another() -> None:
    once = assumed(np.ones((len(GEOMETRY), 1)))
    (told,) = noise_notes(replace(once, noise=Noise()))
    assert told.startswith("Nothing is stated of the noise: 5 % of the model's value is assumed.")
    assert "(assumed)" in verdicts.noise_in_words(replace(once, noise=Noise()))
    for stated in (Noise(relative=0.05), Noise(floor=0.01)):
        assert noise_notes(replace(once, noise=stated)) == []
        assert "(assumed)" not in verdicts.noise_in_words(replace(once, noise=stated))
    scattered = 1.0 + 0.0017 * np.random.default_rng(0).standard_normal((2 * len(GEOMETRY), 1))
    wi, wo = (np.tile(w, (2, 1)) for w in (GEOMETRY.wi, GEOMETRY.wo))
    twice = Measurements(wi, wo, scattered, None, np.ones(len(wi), bool), ("value",))
    (told,) = noise_notes(Problem(STACK, twice, line, Noise()))
    said = re.search(r"repeated readings scatter by about ([\d.]+) %: `relative = ([\d.]+)`", told)
    assert said is not None
    # the median of 164 differences: 8 % of itself
    assert float(said[1]) == pytest.approx(0.17, rel=0.3)
    assert float(said[2]) == pytest.approx(0.0017, rel=0.3)


def test_relative_noise_beside_the_own_sigma_of_the_data_is_announced() -> None:
    values = np.ones((len(GEOMETRY), 1))
    data = replace(assumed(values).data, sigma=0.04 * values)
    (told,) = noise_notes(Problem(STACK, data, line, Noise(relative=0.03)))
    assert told.startswith("Noise: the data's own sigma, 4 % in the median, and relative = 0.03 beside it")
    for noise in (Noise(), Noise(relative=0.03, use_sigma=False), Noise(relative=0.0)):
        assert noise_notes(Problem(STACK, data, line, noise)) == []


def test_what_was_fitted_lists_the_incidences_that_were(coat_fit: Fit) -> None:
    data = coat_fit.problem.data
    kept = data.where(np.isclose(data.theta_i, 10.0), "held out: incidence=50")
    text = page(replace(coat_fit, problem=replace(coat_fit.problem, data=kept)), None, {})
    assert "<td>incidence</td><td>10°</td>" in text
