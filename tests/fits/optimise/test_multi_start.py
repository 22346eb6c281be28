"""The lowest end of all starts is the fit, however many steps it took; no stack ends above what it contains."""

from dataclasses import replace

import numpy as np
import pytest

import layerjax as lj
from fits import Free, LogUniform, Noise, Problem, fit, read, read_problem, simulate, slices
from fits.optimise import multi_start as starts_module
from fits.optimise.levenberg_marquardt import evaluate_at
from fits.optimise.multi_start import LEAST_GAIN, multi_start, start_points, starts_store, unit_of
from fits.optimise.result import OUTCOMES
from tests.helpers.models import LINE, LOBE_STACK, line, line_data, lobe, noisy_lobe
from tests.helpers.places import COATINGS, EXAMPLES
from tests.helpers.stores import keys

STEEL = read(COATINGS / "nite_on_blasted_steel1008_650nm_inplane.csv").select(incidence=(10.0, 50.0))


def cost_at(problem, values):
    """Of the stack with these values, and everything else at the end of its range that is nearest to nothing."""
    vector = np.array([values.get(name, low) for name, low in zip(problem.names, problem.low, strict=True)])
    return float(evaluate_at(problem, unit_of(problem, vector)).cost)


@pytest.mark.slow
def test_a_stack_never_ends_above_what_it_contains():
    """A haze over flakes on paint: the flakes on paint, beside steel."""
    ends = []
    for name in ("hazy_coat_over_diffuse", "flake_coat_over_diffuse"):
        given = read_problem(EXAMPLES / f"{name}.toml")
        # the cheapest transport: what is asked is about starts, whatever carries the light
        options = {"transport": lj.SingleScattering(), "noise": given.noise, "scale": given.scale}
        ends.append(fit(given.stack, STEEL, starts=8, **options))
    whole, part = ends
    values = {name.replace("layers[0]", "layers[1]"): value for name, value in part.values.items()}
    # to what a start that goes on is worth
    assert whole.minima[0].cost <= cost_at(whole.problem, values) + LEAST_GAIN


def test_a_race_ends_where_all_starts_do(monkeypatch):
    """Of a stack with several minima; few steps tell which starts go on, and the others are not followed."""
    given = read_problem(EXAMPLES / "hazy_coat_over_diffuse.toml")
    problem = Problem(given.stack, STEEL, lj.SingleScattering(), replace(given.noise, discrepancy=False), given.scale)
    points = start_points(problem, 8, 0)
    monkeypatch.setattr(starts_module, "EARLY", 10)
    ends = starts_module.screened_starts(problem, points)
    every = multi_start(problem, points, lambda *_: None)
    assert min(end.cost for end in ends) <= min(end.cost for end in every) + LEAST_GAIN
    assert sum(end.steps for end in ends) < sum(end.steps for end in every)


def test_the_lowest_end_is_the_fit_though_it_ran_out_of_steps(monkeypatch):
    monkeypatch.setattr(starts_module, "MOST_STEPS", 4)
    monkeypatch.setattr(starts_module, "MOST_ROUNDS", 1)
    calls = []
    # a stack of its own, so that the program is compiled with this number of steps
    how = {"transport": lambda *a: lobe(*a), "progress": lambda *a: calls.append(a)}
    result = fit(LOBE_STACK, noisy_lobe(0, 200), starts=6, **how)
    seen = min(float(call[3].split()[-1]) for call in calls)
    assert result.minima[0].cost <= seen * (1 + 1e-5)
    assert sum(result.start_outcomes.values()) == 6
    assert set(result.start_outcomes) <= set(OUTCOMES)


def test_a_start_that_ran_out_of_steps_goes_on(monkeypatch):
    monkeypatch.setattr(starts_module, "MOST_STEPS", 2)
    monkeypatch.setattr(starts_module, "MOST_ROUNDS", 200)
    slowly = fit(LOBE_STACK, noisy_lobe(0), transport=lambda *a: lobe(*a), starts=1)
    monkeypatch.undo()
    at_once = fit(LOBE_STACK, noisy_lobe(0), transport=lobe, starts=1)
    assert slowly.converged
    assert slowly.minima[0].cost == pytest.approx(at_once.minima[0].cost, abs=LEAST_GAIN)


def test_starts_are_those_of_the_same_fit_only(tmp_path):
    path = tmp_path / "starts"

    def kept(count=4, seed=0, **changed):
        """How many starts of an earlier fit are taken for this one."""
        path.write_bytes(written)
        problem = Problem(**{"stack": LINE, "data": line_data(), "transport": line} | changed)
        with starts_store(path, problem, start_points(problem, count, seed)) as store:
            return len(keys(store))

    fit(LINE, line_data(), transport=line, starts=4, checkpoint=path)
    written = path.read_bytes()
    assert kept() == 4
    changes = {"data": line_data(seed=1), "noise": Noise(tails="student"), "objective": "cosine_l2", "scale": 1.01}
    changes |= {"stack": LINE | {"b": 0.1}, "transport": lambda *given: 2.0 * line(*given), "count": 5, "seed": 1}
    assert {name: kept(**{name: other}) for name, other in changes.items()} == dict.fromkeys(changes, 0)


@pytest.mark.slow
def test_a_fit_does_not_end_on_a_plateau():
    """Of backward scattering `Statistical` knows nothing: the only start comes to rest where g is below 0."""
    noise = Noise(relative=0.02, floor=1e-6, discrepancy=False)
    haze, metal = lj.Medium(0.84, 1.0, lj.HenyeyGreenstein(0.13)), lj.Conductor(0.4, 3.2, 0.37)
    data = simulate(lj.Stack([haze], metal), slices([10.0, 30.0, 50.0, 70.0]), lj.Statistical(), 0.02, 1e-6, seed=1)
    thickness, index = Free(0.1, 1e-3, 5.0, LogUniform()), Free(1.5, 0.05, 9.0, LogUniform())
    haze = lj.Medium(thickness, 1.0, lj.HenyeyGreenstein(Free(0.3, -0.6, 0.9)))
    metal = lj.Conductor(index, Free(0.5, 0.01, 9.0, LogUniform()), Free(0.3, 0.02, 1.0))
    found = fit(lj.Stack([haze], metal), data, transport=lj.Statistical(), noise=noise, starts=1)
    truth = {"layers[0].thickness": 0.84, "layers[0].phase.g": 0.13, "base.ior": 0.4, "base.k": 3.2, "base.alpha": 0.37}
    assert found.minima[0].cost <= cost_at(found.problem, truth)
    assert not found.insensitive
