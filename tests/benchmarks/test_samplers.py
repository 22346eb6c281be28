"""Samplers beside each other: a tiny run leaves whole files behind, goes on with them, and judges what they hold."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.studies import samplers
from tests.helpers.models import line_fit

PLAIN = samplers.Sampled(
    "line", samplers.PLAIN, ["a"], [[-1.0], [0.0], [1.0]], [[0.03]] * 3, [1.0], 2e3, 100, 32, 0.5, 0, True, "", 1.0
)


@pytest.mark.parametrize(("shift", "error", "verdict"), [(0.19, 0.04, "agree"), (0.21, 0.04, "**differ**")])
def test_verdicts(shift: float, error: float, verdict: str) -> None:
    quantiles = (np.array(PLAIN.quantiles) + shift).tolist()
    other = dataclasses.replace(PLAIN, sampler="NUTS", quantiles=quantiles, standard_errors=[[error]] * 3)
    assert samplers.quantile_difference(other, PLAIN) == pytest.approx(shift)
    assert samplers.difference_in_errors(other, PLAIN) == pytest.approx(shift / 0.05)
    assert samplers._row(other, PLAIN)[-1] == verdict
    assert samplers._row(PLAIN, PLAIN)[-1] == "-"


@pytest.mark.slow
def test_a_tiny_run_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("blackjax")
    options = {"posteriors": {"line": line_fit}, "ess": 300.0}

    def cut_short(line: str) -> None:
        raise KeyboardInterrupt(line)

    with pytest.raises(KeyboardInterrupt, match="line, emcee"):
        samplers.study(directory=tmp_path, report=cut_short, **options)
    said: list[str] = []
    text, paths = samplers.study(directory=tmp_path, report=said.append, resume=True, **options)
    assert [line.partition(":")[0] for line in said] == ["line, emcee, none independent", "line, NUTS"]
    assert sorted(paths) == sorted(tmp_path.iterdir())
    assert paths[1].read_text() == text
    chains = json.loads(paths[0].read_text())["chains"]
    assert all(chain["converged"] and chain["effective"] > 300.0 for chain in chains)
    slope = [np.array(chain["quantiles"])[1, 1] for chain in chains]
    np.testing.assert_allclose(slope, slope[0], atol=0.4 * chains[0]["deviations"][1])  # 5 of their errors
    monkeypatch.setattr("fits.sample", cut_short)  # nothing is sampled twice
    samplers.study(directory=tmp_path, resume=True, **options)
    assert json.loads(paths[0].read_text())["chains"] == chains
    with pytest.raises(ValueError, match="other settings"):
        samplers.study(directory=tmp_path, resume=True, **options | {"ess": 400.0})
