"""Calibration: ranks that should count as uniform do, others do not, and a killed run resumes."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

import fits
import layerjax as lj
from benchmarks.__main__ import POSTERIORS
from benchmarks.studies.calibration import cases, ranks, run

CHEAP = lj.AddingDoubling(orders="first")


@pytest.mark.parametrize("count", [1, 4, 9])
def test_every_parameter_has_its_panel(count: int) -> None:
    generator = np.random.default_rng(1)
    labels = [f"number {index}" for index in range(count)]
    figure = ranks.picture({label: generator.integers(0, ranks.DRAWS + 1, 100) for label in labels})
    assert [panel.get_title(loc="left") for panel in figure.axes] == labels
    for panel in figure.axes:
        assert np.sum(panel.patches[0].get_data().values) == 100


@pytest.mark.parametrize(
    ("width", "shift", "uniform"),
    [(1.0, 0.0, True), (0.6, 0.0, False), (1.6, 0.0, False), (1.0, 0.5, False)],
    ids=["right", "too narrow", "too wide", "shifted"],
)
def test_ranks_tell_whether_posteriors_are_right(width: float, shift: float, uniform: bool) -> None:
    """Of a mean with a standard normal prior, seen once with unit noise: its posterior is known."""
    generator = np.random.default_rng(0)
    truth = generator.standard_normal(200)
    mean = 0.5 * (truth + generator.standard_normal(200))
    draws = mean + shift + width * np.sqrt(0.5) * generator.standard_normal((ranks.DRAWS, 200))
    row = ranks.judged("mean", np.array(ranks.ranks_of(truth, draws)))
    assert row.uniform == uniform
    assert row.bins == 20
    if shift:
        assert row.mean_off < -3.0  # posteriors too high: truths rank low


def test_draws_come_from_the_whole_chain_after_its_burn_in() -> None:
    chain = np.arange(1000 * 12).reshape(1000, 12, 1)
    posterior = SimpleNamespace(chain=chain, burn_in=100, autocorrelation_time=np.array([2.0, 4.0]))
    draws, thinning = ranks.spread_draws(posterior)
    assert draws.shape == (ranks.DRAWS, 1)
    assert draws[0] == chain[100, 0]
    assert draws[-1, 0] == chain[999, (ranks.DRAWS - 1) % 12, 0]
    assert thinning == pytest.approx(899 / 98 * 12 / 4.0)


def test_intervals_cover_what_they_state() -> None:
    """Ranks that are each there once: 68 and 90 of 100 are covered, and as many are expected."""
    row = ranks.judged("any", np.arange(100))
    assert row.covered == (68, 90)
    for level, covered in zip(ranks.LEVELS, row.covered, strict=True):
        low, high = ranks.expected(100, level)
        assert low < covered < high


@pytest.mark.parametrize("name", cases.HAZE)
def test_truths_come_from_the_prior(name: str) -> None:
    free = cases.HAZE[name]
    generator = np.random.default_rng(1)
    values = np.array([run.drawn(free, generator) for _ in range(1000)])
    if isinstance(free.prior, fits.LogNormal):
        values, centre = np.log(values), np.log(free.prior.median)
    else:
        centre = free.prior.mean
    assert stats.kstest(values, stats.norm(centre, free.prior.sd).cdf).pvalue > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bounded", "degenerate", "banana", "discrepancy"])
def test_posteriors_are_run(name: str, tmp_path: Path) -> None:
    """Without all orders; free parameters stand in the order of the problem's."""
    assert tuple(cases.CASES) == POSTERIORS
    case = cases.CASES[name]
    cheap = {"transport": CHEAP} if case.discrepancy else {}
    text, paths = run.study(directory=tmp_path, repeats=1, posterior=name, processes=1, **cheap)
    (record,) = json.loads(paths[0].read_text())["repeats"]
    assert len(record["truth"]) == len(record["estimate"]) == len(case.free)
    for free, estimate in zip(case.free.values(), record["estimate"], strict=True):
        assert free.low <= estimate <= free.high
    assert all(label in text for label in case.labels.values())


@pytest.mark.slow
def test_a_run_that_was_stopped_goes_on_where_it_was(tmp_path: Path) -> None:
    """Transport: paths with one event alone, which are cheap."""
    parts_of, cheap = tmp_path / "parts", {"transport": CHEAP, "processes": 1}
    run.study(directory=parts_of, repeats=1, resume=True, **cheap)
    said: list[str] = []
    text, paths = run.study(directory=parts_of, repeats=2, resume=True, report=said.append, **cheap)
    assert [line.partition(":")[0] for line in said[1:]] == ["repeat 2/2"]
    assert sorted(paths) == sorted(parts_of.iterdir())  # and no temporary file is left
    whole = run.study(directory=tmp_path / "whole", repeats=2, **cheap)[1][0]
    parts, at_once = (json.loads(path.read_text()) for path in (paths[0], whole))
    for content in (parts, at_once):
        for record in content["repeats"]:
            assert record.pop("seconds") > 0
    assert parts["repeats"] == at_once["repeats"]
    assert parts["parameters"] == at_once["parameters"]
    assert all(0 <= rank <= ranks.DRAWS for record in parts["repeats"] for rank in record["ranks"])
    assert paths[1].read_text() == text
    with pytest.raises(ValueError, match="other settings"):
        run.study(directory=parts_of, resume=True)
