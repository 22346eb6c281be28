"""Whether a fit counts errors that readings share, where that is left to the residuals."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.measuring.repeats import fit_many
from fits.data.geometry import slices
from fits.data.measurements import Measurements
from fits.optimise import multi_start as starts_module
from fits.optimise.fit import fit
from fits.optimise.multi_start import Floats
from fits.optimise.result import Fit
from fits.problem.discrepancy import Discrepancy, log_scales, places
from fits.problem.noise import Noise
from fits.problem.parameters import Free
from fits.problem.problem import FittingProblem, Problem
from fits.reports import tables, verdicts
from fits.reports.results import load_fit, save_fit
from fits.sampling.posterior import Posterior
from tests.helpers.models import line

STACK = {"a": Free(0.9, 0.1, 3.0), "b": Free(0.1, -1.0, 3.0)}
GEOMETRY = slices([10.0, 50.0], np.arange(-80.0, 81.0, 4.0))
NOISE = Noise(relative=0.02, floor=1e-4)


def readings(wave: float, seed: int = 0) -> Measurements:
    """Of the line, times one plus a wave along the viewing angle, with noise of 2 %."""
    exact = np.asarray(line({"a": 1.0, "b": 0.5}, GEOMETRY.wi, GEOMETRY.wo))
    angle = np.arctan2(GEOMETRY.wo[:, :1], GEOMETRY.wo[:, 2:])
    noise = 0.02 * np.random.default_rng(seed).standard_normal(exact.shape)
    values = exact * (1.0 + wave * np.sin(8.0 * angle) + noise)
    return Measurements(GEOMETRY.wi, GEOMETRY.wo, values, None, np.ones(len(values), bool), ("value",))


@pytest.fixture(scope="module")
def wrong() -> Fit:
    return fit(STACK, readings(0.1), transport=line, noise=NOISE, starts=2)


def test_a_wrong_shape_is_fitted_with_them(wrong: Fit) -> None:
    plain = fit(
        STACK, readings(0.1), transport=line, noise=Noise(relative=0.02, floor=1e-4, discrepancy=False), starts=2
    )
    assert wrong.problem.noise.discrepancy == Discrepancy()
    assert wrong.without_discrepancy is not None
    assert plain.without_discrepancy is None
    assert wrong.without_discrepancy.values == pytest.approx(plain.values, rel=1e-6)
    assert wrong.without_discrepancy.chi_square == pytest.approx(plain.chi_square)
    assert wrong.without_discrepancy.residual_autocorrelation > 0.8
    assert wrong.log_likelihood > plain.log_likelihood + 20.0
    assert 0.03 < wrong.values["noise.discrepancy.amplitude"] < 0.3
    for name in plain.values:
        assert wrong.standard_errors[name] > 2.0 * plain.standard_errors[name]


def test_repeats_are_fitted_by_what_their_own_readings_tell() -> None:
    """Where noise is a level, readings tell the less of their logarithms the smaller they are."""
    data, noise = readings(0.1), Noise(relative=0.0, floor=0.05, discrepancy=Discrepancy(0.1, 10.0, 10.0, 0.0))
    small = replace(data, values=0.2 * data.values)
    by_others, by_themselves = (fit_many(Problem(STACK, one, line, noise), small.values[None]) for one in (data, small))
    np.testing.assert_allclose(by_others.vectors, by_themselves.vectors, rtol=1e-6)
    np.testing.assert_allclose(by_others.standard_errors, by_themselves.standard_errors, rtol=1e-6)


def test_simulated_readings_share_errors(wrong: Fit) -> None:
    steps, walkers = 64, 16
    chain = np.tile(wrong.vector, (steps, walkers, 1))
    posterior = Posterior(wrong, chain, chain[..., 0], np.ones(chain.shape[-1]), 1.0, converged=True)
    simulated = posterior.inference_data.posterior_predictive["value"].to_numpy().reshape(-1, *wrong.predicted.shape)
    found = simulated / wrong.predicted
    at = wrong.problem.build(wrong.vector).correlation
    shared = at.amplitude * np.exp(at.grazing_exponent * np.asarray(log_scales(places(GEOMETRY.wi, GEOMETRY.wo))))
    # of 1024 draws, and a regression on nodes between them
    np.testing.assert_allclose(np.log(found).std(axis=0)[:, 0], np.hypot(shared, 0.02), rtol=0.1)


def test_a_right_one_is_not() -> None:
    found = fit(STACK, readings(0.0), transport=line, noise=NOISE, starts=2)
    assert found.without_discrepancy is None
    assert not found.problem.noise.discrepancy
    assert list(found.values) == ["['a']", "['b']"]


@pytest.mark.parametrize("noise", [Noise(relative=0.02, floor=1e-4, tails="student"), NOISE])
def test_where_they_cannot_be_counted_they_are_not(noise: Noise) -> None:
    objective = "likelihood" if noise.tails == "student" else "cube_root"
    noise = noise if objective == "likelihood" else Noise()
    assert (
        fit(STACK, readings(0.1), transport=line, noise=noise, starts=1, objective=objective).without_discrepancy
        is None
    )


def test_both_are_told(wrong: Fit) -> None:
    words = " ".join(verdicts.verdict(wrong).remarks)
    assert "neighbouring residuals correlate by +0." in words
    assert "Set `discrepancy = false` to disable it" in words
    assert f"Model discrepancy: {100.0 * wrong.values['noise.discrepancy.amplitude']:.2g} % of the BSDF" in words
    table = tables.parameter_table(wrong, both=True)
    place = table.columns.index("independent noise")
    before = {row[0]: row[place] for row in table.rows if row[place]}
    assert list(before) == ["['a']", "['b']"]
    assert float(before["['a']"].split()[0]) == pytest.approx(wrong.without_discrepancy.values["['a']"], rel=0.01)


def test_a_noise_that_was_assumed_is_in_the_status_of_a_fit(wrong: Fit) -> None:
    assert "assumed" not in wrong.status
    plain = fit(STACK, readings(0.0), transport=line, noise=Noise(discrepancy=False), starts=1)
    assert "a noise of 5 % of the model's value was assumed" in plain.status


def test_starts_are_those_that_were_asked_for(wrong: Fit) -> None:
    """Two with independent noise, then one from each of their minima and two more with the discrepancy."""
    again = sum(wrong.start_outcomes.values())
    assert again > 2
    words = verdicts.starts_in_words(wrong)
    assert words.startswith(
        f"{wrong.minima[0].count} of {again} starts with the discrepancy term converged to the best"
    )


def test_a_killed_fit_goes_on_in_either_part(tmp_path, wrong: Fit, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = tmp_path / "starts"

    def stop(stage: str, done: int, total: int | None = None, info: str = "") -> None:
        if stage.endswith("model discrepancy") and done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(STACK, readings(0.1), transport=line, noise=NOISE, starts=2, progress=stop, checkpoint=kept)
    run: list[str] = []
    end = starts_module.rough_descent

    def counted(problem: FittingProblem, point: Floats) -> starts_module.StartOutcome:
        run.append(type(problem).__name__)
        return end(problem, point)

    monkeypatch.setattr(starts_module, "rough_descent", counted)
    found = fit(STACK, readings(0.1), transport=line, noise=NOISE, starts=2, checkpoint=kept)
    np.testing.assert_array_equal(found.vector, wrong.vector)
    assert len(run) == 1  # of two starts and, with model discrepancy, three
    assert {path.name for path in tmp_path.iterdir()} >= {"starts", "starts-discrepancy"}


def test_a_result_directory_keeps_it(tmp_path, coat_fit: Fit) -> None:
    from fits.optimise.fit import without_discrepancy

    problem = replace(coat_fit.problem, noise=Noise(relative=0.03, discrepancy=True))
    found = fit(problem.stack, problem.data, transport=problem.transport, noise=problem.noise, starts=1)
    found = replace(found, without_discrepancy=without_discrepancy(coat_fit))
    save_fit(found, tmp_path / "result")
    again = load_fit(tmp_path / "result")
    assert again.without_discrepancy == found.without_discrepancy
    assert again.problem.noise == found.problem.noise
    assert again.values == found.values
