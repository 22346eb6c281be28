"""What a report says of a fit, and that no two of its statements contradict each other."""

import re
from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from fits.data.geometry import slices
from fits.data.measurements import Measurements
from fits.data.scans import correlation, neighbours, signed_angle
from fits.optimise.fit import fit
from fits.optimise.result import Fit
from fits.optimise.uncertainty import Direction
from fits.problem.model import Model
from fits.problem.noise import Noise
from fits.problem.parameters import Free
from fits.problem.problem import Problem
from fits.reports import tables, verdicts
from fits.reports.diagnostics import bsdf, misfit, residual_structure, standardised
from fits.reports.plots.model import curves_picture
from fits.reports.verdicts import Assessment, assess
from tests.helpers.models import line

GEOMETRY = slices([10.0, 30.0, 50.0, 70.0], np.arange(-80.0, 81.0, 4.0))
STACK = {"a": Free(0.9, 0.1, 3.0), "b": Free(0.1, -1.0, 3.0)}
TRUTH = np.array([1.0, 0.5, 0.1, 12.0, 12.0, 0.3])  # the line, and the discrepancy: amplitude, lengths, exponent
NOISE = Noise(relative=0.02, floor=1e-4, discrepancy=True)
WIDE = Noise(relative=0.2, floor=1e-4, discrepancy=False)
TERM = SimpleNamespace(amplitude=0.05, grazing_exponent=0.5, length_half=18.0, length_difference=11.0)


def problem_of(values: np.ndarray) -> Problem:
    count = len(GEOMETRY)
    data = Measurements(GEOMETRY.wi, GEOMETRY.wo, values, None, np.ones(count, bool), ("value",))
    return Problem(STACK, data, line, NOISE)


def simulated(seed: int) -> Problem:
    """Measurements that scatter exactly as the noise model says: a smooth discrepancy of the logarithm, and noise."""
    generator = np.random.default_rng(seed)
    exact = np.asarray(line({"a": 1.0, "b": 0.5}, GEOMETRY.wi, GEOMETRY.wo))
    model = problem_of(exact).model
    process, at = model.process, model.build(TRUTH).correlation
    assert process is not None
    discrepancy = np.asarray(process.sample(generator.standard_normal((1, len(process.where))), at))
    return problem_of(exact * np.exp(discrepancy) * (1.0 + 0.02 * generator.standard_normal(exact.shape)))


@pytest.fixture(scope="module")
def fitted() -> Fit:
    return fit(STACK, simulated(0).data, transport=line, noise=NOISE, starts=1)


def said(facts: Assessment) -> list[verdicts.Statement]:
    """All statements of a report that depend on facts."""
    more = (verdicts.remarks(facts), verdicts.residuals(facts), verdicts.identification(facts))
    return [*verdicts.opening(facts), *(one for section in more for one in section)]


def test_no_two_statements_contradict_each_other(coat_fit: Fit) -> None:
    """A report once said that sigma is too large, errors by 2, and that correlation makes errors too small by 4.4."""
    facts = assess(coat_fit)
    first, second = coat_fit.problem.names
    direction = Direction(0.3, {first: 0.8, second: -0.6}, {first: 0.01, second: 0.02})
    all_identified = dict.fromkeys((first, second), "identified")
    parameters = [
        {"words": all_identified},
        {"words": all_identified | {first: f"correlated with {second} +0.97"}},
        {"words": all_identified | {first: "weakly identified: see direction 1"}, "unidentified": (direction,)},
        {"words": all_identified | {first: "at a bound"}, "at_bound": (first,)},
        {"words": all_identified | {first: "insensitive: no effect"}, "insensitive": (first,)},
        {"words": all_identified | {first: "limited by the instrument"}, "limits": {first: 0.1}},
        {"words": all_identified | {first: "prior-dominated: error near the width of the bounds"}},
    ]
    table = product(
        (True, False),  # converged
        (True, False),  # a likelihood
        (True, False),  # noise stated
        (True, False),  # described
        (-9.0, 0.0, 9.0),  # excess of chi-square
        ((0.0, 0.0), (0.9, 18.0)),  # correlation of neighbours, and in standard errors
        (None, (TERM, 0.99)),  # discrepancy
        (0, 1, 3),  # alternatives
        parameters,
    )
    seen = 0
    for converged, likelihood, stated, described, excess, (lag, lag_sigma), term, others, identified in table:
        if not described and (not likelihood or (term is None and excess <= 0.0)):
            continue  # what is not described has a large chi-square, at least without the discrepancy
        case = replace(
            facts,
            converged=converged,
            likelihood=likelihood,
            noise_assumed=not stated,
            described=described,
            excess=excess,
            ratio={-9.0: 0.2, 0.0: 1.0, 9.0: 4.0}[excess],
            structure=replace(facts.structure, lag_one=lag, lag_one_sigma=lag_sigma),
            discrepancy=term,
            alternatives=others,
            **identified,
        )
        claims: dict[str, str] = {}
        for sentence, own in said(case):
            assert sentence.endswith((".", ")"))
            for topic, claim in own.items():
                assert claims.setdefault(topic, claim) == claim, (topic, [one.sentence for one in said(case)])
            if term is not None:  # chi-square and correlation are those of the whitened residuals
                assert "residuals" not in sentence or "whitened" in sentence or "Correlated" in sentence, sentence
            seen += 1
        assert claims["errors"] != "valid" or case.error_factor == 1.0
        if likelihood and described and converged and not others:
            assert claims["errors"] == ("valid" if case.error_factor == 1.0 else claims["errors"])
    assert seen > 10_000


def test_one_statement_weighs_size_and_correlation_of_residuals(coat_fit: Fit) -> None:
    facts = assess(coat_fit)
    structure = replace(facts.structure, lag_one=0.9, lag_one_sigma=18.0)
    case = replace(facts, excess=-9.0, ratio=0.19, structure=structure, discrepancy=(TERM, 0.9))
    factor = np.sqrt(0.19) * np.sqrt(1.9 / 0.1)  # (1 + r) / (1 - r) for the correlation
    assert f"too small by a factor of about {factor:.2g} (0.44 for the size of the whitened residuals times 4.4" in (
        verdicts.opening(case)[1].sentence
    )
    large = replace(facts, excess=9.0, ratio=9.0, structure=replace(facts.structure, lag_one_sigma=0.0))
    assert "too small by a factor of about 3 (3 for the size of the residuals)" in verdicts.opening(large)[1].sentence


def test_the_verdict_is_three_sentences_and_quotes_the_misfit(coat_fit: Fit) -> None:
    found = verdicts.verdict(coat_fit)
    assert len(found.sentences) == 3
    assert found.sound
    assert found.sentences[2] == "The data identify every parameter."
    values = coat_fit.problem.data.used().values
    errors = np.sort(np.abs(coat_fit.predicted / values - 1.0).ravel())
    half, most = map(float, re.findall(r"([\d.e-]+) %", found.sentences[0])[::2])
    assert np.mean(errors < 0.01 * half) == pytest.approx(0.5, abs=0.05)
    assert np.mean(errors < 0.01 * most) == pytest.approx(0.95, abs=0.05)
    facts = assess(coat_fit)
    for change in ({"converged": False}, {"excess": 9.0, "ratio": 9.0}, {"alternatives": 1}, {"numerical_error": 9.0}):
        assert not verdicts.verdict(coat_fit, replace(facts, **change)).sound


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
        # of each set within 4 standard errors
        assert abs(structures[-1].rms - 1.0) < 4.0 / np.sqrt(2.0 * structures[-1].count)
        assert abs(structures[-1].lag_one_sigma) < 4.0
    first, second = (np.concatenate(part) for part in zip(*pairs, strict=True))
    count = sum(one.count for one in structures)
    assert np.sqrt(np.mean([one.rms**2 for one in structures])) == pytest.approx(1.0, abs=3.0 / np.sqrt(2.0 * count))
    assert abs(correlation(first, second)) < 3.0 / np.sqrt(len(first))


def test_statements_on_residuals_are_about_the_whitened_ones(fitted: Fit) -> None:
    facts = assess(fitted)
    assert facts.structure.rms == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * facts.structure.count))
    (line,) = (line for line in verdicts.sentences(verdicts.residuals(facts)) if "correlated by" in line)
    assert line.startswith("Neighbouring whitened residuals")
    assert f"root mean square is {facts.structure.rms:.2f}" in line
    # beside the curve with the discrepancy, which follows the data, residuals are smaller
    assert np.sqrt(np.mean(misfit(fitted) ** 2)) < facts.structure.rms


def test_a_stack_that_misses_is_named_though_the_discrepancy_absorbs_all(fitted: Fit) -> None:
    off = replace(fitted, vector=fitted.vector * np.array([1.4, 1.4, 3.0, 1.0, 1.0, 1.0]))
    values = off.problem.data.values
    assert off.reduced_chi_square < 1.5
    found = verdicts.verdict(off)
    assert not found.sound
    words = r"This stack does not describe the sample: median misfit (\d+) %, stated noise ([\d.]+) %\."
    match = re.match(words, found.sentences[0])
    assert match is not None
    assert float(match[1]) == pytest.approx(100.0 * np.median(off.predicted / values - 1.0), abs=1.0)
    assert float(match[2]) == pytest.approx(2.0)
    without = np.sum(np.square(off.problem.call(Model.offsets_at, off.vector, off.predicted))) / off.degrees_of_freedom
    assert f"with the discrepancy term, {without:.4g} without" in verdicts.summary(off)[-1]
    assert not assess(replace(fitted, problem=simulated(0), vector=TRUTH)).described  # 10 % beside a noise of 2 %
    right = replace(fitted, problem=replace(fitted.problem, noise=WIDE), unidentified=())
    right = replace(right, vector=TRUTH[:2], errors=fitted.errors[:2], covariance=fitted.covariance[:2, :2])
    assert assess(right).described


@pytest.mark.parametrize(("factor", "words"), [(1.04, "4 %"), (3.0, "a factor of 3"), (1e4, "a factor of 1e+04")])
def test_a_large_misfit_is_a_factor(fitted: Fit, factor: float, words: str) -> None:
    """As a share of the model it was 100 % wherever the model was far too high."""
    near = f"Half of the {len(GEOMETRY)} measurements are within {words} of the stack without model discrepancy, 95 % "
    for values in (fitted.predicted / factor, factor * fitted.predicted):
        off = replace(fitted, problem=problem_of(values))
        vars(off)["predicted"] = fitted.predicted
        facts = replace(assess(off), described=True)
        assert verdicts.opening(facts)[0].sentence.startswith(f"{near}within {words}, ")


def test_both_curves_are_drawn_and_the_residuals_are_those_of_the_one_with_the_discrepancy(fitted: Fit) -> None:
    figure = curves_picture({"model": fitted})
    assert isinstance(figure, Figure)
    upper, lower = figure.axes[:2]
    curves = {str(line.get_label()): line for line in upper.lines}
    data = fitted.problem.data
    rows = np.flatnonzero(np.isclose(data.theta_i, 10.0))
    angle, values = signed_angle(data)[rows], data.values[rows, 0]
    for label, expected in (("model with discrepancy", bsdf(fitted)), ("without discrepancy", fitted.predicted)):
        drawn = np.interp(angle, *curves[label].get_data())
        np.testing.assert_allclose(drawn, expected[rows, 0], rtol=2e-3)
    (points,) = (line for line in lower.lines if len(np.asarray(line.get_xdata())) == len(rows))
    shown = np.asarray(points.get_ydata())
    drawn = np.interp(angle, *curves["model with discrepancy"].get_data())
    np.testing.assert_allclose(shown, (values - drawn) / (0.02 * values), atol=0.15)


@pytest.mark.parametrize(
    ("noise", "sigma", "words"),
    [
        (Noise(), None, "No noise is stated: 5 % of the model's value is assumed."),
        (Noise(relative=0.05), None, None),
        (Noise(floor=0.01), None, None),
        (
            Noise(relative=0.03),
            0.04,
            "Noise: the data's own sigma, 4 % in the median, and relative = 0.03, added in quadrature.",
        ),
        (Noise(), 0.04, None),
        (Noise(relative=0.03, use_sigma=False), 0.04, None),
        (Noise(relative=0.0), 0.04, None),
    ],
)
def test_noise_that_is_assumed_or_added_is_announced(noise: Noise, sigma: float | None, words: str | None) -> None:
    values = np.ones((len(GEOMETRY), 1))
    data = replace(problem_of(values).data, sigma=None if sigma is None else sigma * values)
    problem = Problem(STACK, data, line, noise)
    assert [sentence.startswith(words or "?") for sentence in verdicts.noise_statements(problem)] == [True] * bool(
        words
    )
    assert ("(assumed)" in tables.noise_in_words(problem)) == (words is not None and "assumed" in words)


def test_repeated_measurements_offer_a_noise() -> None:
    scattered = 1.0 + 0.0017 * np.random.default_rng(0).standard_normal((2 * len(GEOMETRY), 1))
    wi, wo = (np.tile(w, (2, 1)) for w in (GEOMETRY.wi, GEOMETRY.wo))
    twice = Measurements(wi, wo, scattered, None, np.ones(len(wi), bool), ("value",))
    (words,) = verdicts.noise_statements(Problem(STACK, twice, line, Noise()))
    match = re.search(r"repeated measurements scatter by about ([\d.]+) %: `relative = ([\d.]+)`", words)
    assert match is not None
    # the median of 164 differences: 8 % of itself
    assert float(match[1]) == pytest.approx(0.17, rel=0.3)
    assert float(match[2]) == pytest.approx(0.0017, rel=0.3)


def altered(fit: Fit, correlation: np.ndarray | None = None, **fields: object) -> Fit:
    """A fit with some of its fields, or its correlation, replaced."""
    if correlation is not None:
        fields["covariance"] = correlation * np.outer(fit.errors, fit.errors)
    return replace(fit, **fields)


def test_unidentified_directions_and_bounds_are_named(coat_fit: Fit) -> None:
    first, second = coat_fit.problem.names
    together = Direction(0.3, {first: 0.8, second: -0.6}, {first: 0.01, second: 0.02})
    undecided = altered(coat_fit, unidentified=(together,), at_bound=(second,))
    words = " ".join(verdicts.sentences(verdicts.identification(assess(undecided))))
    assert "1 of 2 principal directions of parameter space have a standard error above 10 %" in words
    assert f"At a bound: {second}" in words
    (row,) = tables.unidentified_table(undecided).rows
    assert row == (
        "1",
        "0.3",
        "weakly identified",
        f"+0.8 {first}, -0.6 {second}",
        f"{first} 0.01, {second} 0.02",
    )
    separately = f"{first} and {second} are not identified separately"
    assert verdicts.verdict(undecided).sentences[2] == f"{separately}; {second} is at a bound."
    several = altered(coat_fit, unidentified=(together, together, together))
    assert verdicts.verdict(several).sentences[2] == f"{separately} (and more)."
    assert verdicts.identifiability(undecided)[first] == "weakly identified: see direction 1"
    alone = altered(coat_fit, np.eye(2))
    assert verdicts.identifiability(alone)[first] == "identified"
    assert verdicts.identifiability(altered(coat_fit, np.array([[1.0, 0.97], [0.97, 1.0]])))[first] == (
        f"correlated with {second} +0.97"
    )
    unknown = altered(coat_fit, unidentified=(Direction(np.inf, {first: 1.0}, {first: np.inf}),))
    assert verdicts.verdict(unknown).sentences[2] == f"{first} is unidentified."
    assert tables.unidentified_table(unknown).rows[0][:3] == ("1", "infinite", "unidentified")
    assert verdicts.identifiability(unknown)[first] == "unidentified: see direction 1"


def test_a_small_share_in_an_unidentified_direction_leaves_a_parameter_identified(coat_fit: Fit) -> None:
    """alpha 0.284 +- 0.017 was called weakly identified for a weight of 0.028: it is known to 2 % of its range."""
    first, second = coat_fit.problem.names
    mostly = Direction(0.6, {first: 0.9996, second: 0.028}, {first: 0.01, second: 0.02})
    one = altered(coat_fit, np.eye(2), unidentified=(mostly,))
    assert verdicts.identifiability(one) == {first: "weakly identified: see direction 1", second: "identified"}
    assert verdicts.verdict(one).sentences[2] == f"{first} is weakly identified."
    # of two directions, the one to which a parameter owes more of its variance
    other = Direction(0.2, {second: 0.9996, first: 0.028}, {first: 0.01, second: 0.02})
    words = verdicts.identifiability(altered(coat_fit, np.eye(2), unidentified=(mostly, other)))
    assert words == {first: "weakly identified: see direction 1", second: "weakly identified: see direction 2"}
    # a box and a half across, of which a parameter has a third
    wide = Direction(1.5, {first: 0.94, second: 0.34}, {first: 0.01, second: 0.02})
    words = verdicts.identifiability(altered(coat_fit, np.eye(2), unidentified=(wide,)))
    assert words[first].startswith("unidentified")
    assert words[second].startswith("weakly identified")
