"""What a report says of a fit, and that no two of its statements contradict each other."""

import re
from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from fits import Direction, Discrepancy, Noise, Problem, fit
from fits.data.scans import correlation, neighbours, signed_angle
from fits.prediction.predict import with_discrepancy
from fits.reports import tables, verdicts
from fits.reports.plots.data import curves_picture, misfit
from fits.reports.verdicts import assess, identifiability, standardised
from tests.helpers.models import POSITIVE_LINE, SCANS, along, line, wrong_line

TRUTH = np.array([1.0, 0.5, 0.1, 12.0, 12.0, 0.3])  # the line, and the discrepancy: amplitude, lengths, exponent
NOISE = Noise(relative=0.02, floor=1e-4, discrepancy=True)
FIRST, SECOND, WEAKLY = "layers[0].thickness", "base.albedo", "weakly identified: see direction"
TOGETHER = Direction(0.3, {FIRST: 0.8, SECOND: -0.6}, {FIRST: 0.01, SECOND: 0.02})
TERM = SimpleNamespace(amplitude=0.05, grazing_exponent=0.5, length_half=18.0, length_difference=11.0)
MOSTLY = Direction(0.6, {FIRST: 0.9996, SECOND: 0.028}, {FIRST: 0.01, SECOND: 0.02})
OTHER = Direction(0.2, {SECOND: 0.9996, FIRST: 0.028}, {FIRST: 0.01, SECOND: 0.02})
BROAD = Direction(1.5, {FIRST: 0.94, SECOND: 0.34}, {FIRST: 0.01, SECOND: 0.02})
UNKNOWN = Direction(np.inf, {FIRST: 1.0}, {FIRST: np.inf})
SEPARATELY = f"{FIRST} and {SECOND} are not identified separately"


def simulated(seed):
    return Problem(POSITIVE_LINE, wrong_line(seed, Discrepancy(*TRUTH[2:])), line, NOISE)


@pytest.fixture(scope="module")
def fitted():
    return fit(POSITIVE_LINE, simulated(0).data, transport=line, noise=NOISE, starts=1)


def test_no_two_statements_contradict_each_other(coat_fit):
    """A report once said that sigma is too large, errors by 2, and that correlation makes errors too small by 4.4."""
    facts = assess(coat_fit)
    parameters = ["identified", f"correlated with {SECOND} +0.97", f"{WEAKLY} 1", "at a bound", "insensitive: no"]
    parameters += ["limited by", "prior-dominated:"]
    sizes = {-9.0: 0.2, 0.0: 1.0, 9.0: 4.0}  # excess of chi-square, and chi-square
    count, switches = 0, [(True, False)] * 4
    table = product(*switches, sizes, (0.0, 0.9), (None, (TERM, 9.0)), (0, 1, 3), parameters)
    for converged, likelihood, stated, described, excess, lag, term, others, identified in table:
        if not described and (not likelihood or (term is None and excess <= 0.0)):
            continue  # what is not described has a large chi-square, at least without the discrepancy
        fitted = SimpleNamespace(converged=converged, is_posterior=likelihood, alternatives=range(others))
        vars(fitted).update(degrees_of_freedom=400, unidentified=(TOGETHER,) * (WEAKLY in identified))
        size = {"excess": excess, "ratio": sizes[excess], "lag_one": lag}
        case = replace(facts, fit=fitted, noise_assumed=not stated, described=described, discrepancy=term, **size)
        case = replace(case, words={FIRST: identified, SECOND: "identified"})
        said = [one for some in verdicts.statements(case).values() for one in some]
        claims: dict[str, str] = {}
        for sentence, own in said:
            assert sentence.endswith((".", ")"))
            for topic, claim in own.items():
                assert claims.setdefault(topic, claim) == claim, (topic, [one.sentence for one in said])
            if term is not None:  # chi-square and correlation are those of the whitened residuals
                assert "residuals" not in sentence or "whitened" in sentence or not likelihood, sentence
            count += 1
        assert claims["errors"] != "valid" or case.error_factors == (1.0, 1.0)
        if likelihood and described and converged and not others:
            assert (claims["errors"] == "valid") == (case.error_factors == (1.0, 1.0))
    assert count > 10_000


def test_one_statement_weighs_size_and_correlation_of_residuals(coat_fit):
    facts = assess(coat_fit)
    case = replace(facts, excess=-9.0, ratio=0.19, lag_one=0.9, discrepancy=(TERM, 0.9))
    factor = np.sqrt(0.19) * np.sqrt(1.9 / 0.1)  # (1 + r) / (1 - r) for the correlation
    words = f"too small by a factor of about {factor:.2g} (0.44 for the size of the whitened residuals times 4.4"
    assert words in verdicts.statements(case)["verdict"][1].sentence
    far = replace(facts, misfit=(1.04, 3.0))  # a large deviation is a factor: as a share of the model it is at most 1
    assert "within 4 % of the model, 95 % within a factor of 3" in verdicts.statements(far)["verdict"][0].sentence


def test_the_verdict_is_three_sentences_and_quotes_the_misfit(coat_fit):
    found, facts = verdicts.verdict(coat_fit), assess(coat_fit)
    assert len(found.sentences) == 3
    assert found.sound
    assert found.sentences[2] == "The data identify every parameter."
    errors = np.sort(np.abs(coat_fit.predicted / coat_fit.problem.data.used().values - 1.0).ravel())
    half, most = map(float, re.findall(r"([\d.e-]+) %", found.sentences[0])[::2])
    assert np.mean(errors < 0.01 * half) == pytest.approx(0.5, abs=0.05)
    assert np.mean(errors < 0.01 * most) == pytest.approx(0.95, abs=0.05)
    other = replace(coat_fit, minima=(replace(coat_fit.minima[0], equivalent=True),))
    stopped = replace(coat_fit, converged=False)
    for change in ({"fit": stopped}, {"fit": other}, {"excess": 9.0, "ratio": 9.0}, {"resolved": False}):
        assert not verdicts.verdict(coat_fit, replace(facts, **change)).sound


def test_residuals_of_the_assumed_model_are_independent_standard_normal(fitted):
    """Six sets that are drawn from the model itself, at its true parameters."""
    residuals, pairs = [], []
    for seed in range(6):
        true = replace(fitted, problem=simulated(seed), vector=TRUTH)
        residuals.append(standardised(true))
        pairs.append(neighbours(true.problem.data, residuals[-1]))
        assert true.chi_square == pytest.approx(np.sum(residuals[-1] ** 2), rel=1e-6)
    first, second = (np.concatenate(part) for part in zip(*pairs, strict=True))
    size = np.sqrt(np.mean(np.square(residuals)))
    assert size == pytest.approx(1.0, abs=3.0 / np.sqrt(2.0 * np.size(residuals)))
    assert abs(correlation(first, second)) < 3.0 / np.sqrt(len(first))
    # beside the curve with the discrepancy, which follows the data, residuals are smaller
    assert np.mean(misfit(fitted) ** 2) < np.mean(standardised(fitted) ** 2)


def test_a_stack_that_misses_is_named_though_the_discrepancy_absorbs_all(fitted):
    off = replace(fitted, vector=fitted.vector * np.array([1.4, 1.4, 3.0, 1.0, 1.0, 1.0]))
    assert off.reduced_chi_square < 1.5
    found = verdicts.verdict(off)
    assert not found.sound
    words = r"This stack does not describe the sample: median misfit (\d+) %, stated noise ([\d.]+) %\."
    median, noise = map(float, re.match(words, found.sentences[0]).groups())
    assert median == pytest.approx(100.0 * np.median(off.predicted / off.problem.data.values - 1.0), abs=1.0)
    assert noise == pytest.approx(2.0)
    alone = np.sum((np.log(off.problem.data.values / off.predicted) / 0.02) ** 2) / off.degrees_of_freedom
    words = r"The reduced chi-square is ([\d.e+]+) with it and ([\d.e+]+) without"
    within, without = map(float, re.search(words, found.remarks[0]).groups())
    assert within == pytest.approx(off.reduced_chi_square, rel=0.01)
    assert without == pytest.approx(alone, rel=0.05)
    assert not assess(replace(fitted, problem=simulated(0), vector=TRUTH)).described  # 10 % beside a noise of 2 %
    true = {"vector": TRUTH[:2], "errors": fitted.errors[:2], "covariance": fitted.covariance[:2, :2]}
    wide = replace(fitted.problem, noise=Noise(relative=0.2, floor=1e-4, discrepancy=False))
    assert assess(replace(fitted, problem=wide, unidentified=(), **true)).described


def test_both_curves_are_drawn_and_the_residuals_are_those_of_the_one_with_the_discrepancy(fitted):
    figure = curves_picture({"model": fitted})
    assert isinstance(figure, Figure)
    assert len(figure.axes) == 8  # four incidences, each with its residuals
    upper, lower = figure.axes[:2]
    curves = {str(line.get_label()): line for line in upper.lines}
    data = fitted.problem.data
    rows = np.flatnonzero(np.isclose(data.theta_i, 10.0))
    angle, values = signed_angle(data)[rows], data.values[rows, 0]
    whole = with_discrepancy(fitted, data.wi, data.wo, fitted.predicted)
    for label, expected in (("model with discrepancy", whole), ("without discrepancy", fitted.predicted)):
        drawn = np.interp(angle, *curves[label].get_data())
        np.testing.assert_allclose(drawn, expected[rows, 0], rtol=1e-6)  # these angles are points of the curve
    (points,) = (line for line in lower.lines if len(np.asarray(line.get_xdata())) == len(rows))
    drawn = np.interp(angle, *curves["model with discrepancy"].get_data())
    np.testing.assert_allclose(np.asarray(points.get_ydata()), (values - drawn) / (0.02 * values), atol=0.15)


def test_noise_that_is_assumed_is_announced(coat_fit):
    (words,) = verdicts.statements(replace(assess(coat_fit), noise_assumed=True))["remarks"]
    assert words.sentence.startswith("No noise is stated: 5 % of the model's value is assumed.")
    for noise, sigma, said in (
        (Noise(), None, "0.05 of the model's value (assumed), "),
        (Noise(relative=0.03), 0.04, "the file's own sigma, 0.03 of the model's value, "),
        (Noise(relative=0.03, use_sigma=False, tails="student"), 0.04, "0.03 of the model's value, "),
    ):
        assert tables.noise_in_words(Problem(POSITIVE_LINE, along(SCANS, 1.0, sigma), line, noise)).startswith(said)


@pytest.mark.parametrize(
    ("correlated", "directions", "at_bound", "words", "sentence"),
    [
        (0.0, (), (), ("identified", "identified"), "The data identify every parameter."),
        (0.97, (), (), (f"correlated with {SECOND} +0.97", f"correlated with {FIRST} +0.97"), "The data identify"),
        (0.0, (TOGETHER,), (SECOND,), (f"{WEAKLY} 1", "at a bound"), f"{SEPARATELY}; {SECOND} is at a bound."),
        (0.0, (TOGETHER,) * 3, (), (f"{WEAKLY} 1", f"{WEAKLY} 1"), f"{SEPARATELY} (and more)."),
        (0.0, (UNKNOWN,), (), ("unidentified: see direction 1", "identified"), f"{FIRST} is unidentified."),
        # alpha 0.284 +- 0.017 was called weakly identified for a weight of 0.028: it is known to 2 % of its range
        (0.0, (MOSTLY,), (), (f"{WEAKLY} 1", "identified"), f"{FIRST} is weakly identified."),
        # of two directions, the one to which a parameter owes more of its variance
        (0.0, (MOSTLY, OTHER), (), (f"{WEAKLY} 1", f"{WEAKLY} 2"), f"{FIRST} is weakly identified (and more)."),
        # a box and a half across, of which a parameter has a third
        (0.0, (BROAD,), (), ("unidentified: see direction 1", f"{WEAKLY} 1"), f"{SEPARATELY}."),
    ],
)  # fmt: skip
def test_unidentified_directions_and_bounds_are_named(coat_fit, correlated, directions, at_bound, words, sentence):
    covariance = np.array([[1.0, correlated], [correlated, 1.0]]) * np.outer(coat_fit.errors, coat_fit.errors)
    case = replace(coat_fit, covariance=covariance, unidentified=directions, at_bound=at_bound)
    assert identifiability(case) == dict(zip((FIRST, SECOND), words, strict=True))
    assert verdicts.verdict(case).sentences[2].startswith(sentence)
    assert ("no error" in tables.parameter_table(case).note) == bool(at_bound)
    shown = tables.unidentified_table(case).rows
    assert [row[2] == "unidentified" for row in shown] == [one.unconstrained for one in directions]
    if directions[:1] == (TOGETHER,):
        assert shown[0][3:] == (f"+0.8 {FIRST}, -0.6 {SECOND}", f"{FIRST} 0.01, {SECOND} 0.02")
