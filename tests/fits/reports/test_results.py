"""Result directories: what is saved comes back, and writing is all or nothing."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import layerjax as lj
from fits.optimise.result import Fit, Minimum
from fits.optimise.uncertainty import Direction
from fits.problem.noise import Noise
from fits.problem.parameters import Free, LogNormal
from fits.problem.problem import Problem
from fits.reports.results import load_fit, load_posterior, save_fit, writing
from fits.sampling.sample import sample
from tests.helpers.files import contents

STORED = ("vector", "errors", "covariance", "cost", "condition_number")


def assert_same(loaded: Fit, saved: Fit) -> None:
    for name in STORED:
        np.testing.assert_array_equal(getattr(loaded, name), getattr(saved, name), err_msg=name)
    for name in ("at_bound", "converged", "status", "iterations", "unidentified", "units", "values"):
        assert getattr(loaded, name) == getattr(saved, name), name
    assert [one.values for one in loaded.minima] == [one.values for one in saved.minima]
    assert len(loaded.alternatives) == len(saved.alternatives)
    assert loaded.problem.names == saved.problem.names
    np.testing.assert_array_equal(loaded.problem.low, saved.problem.low)
    before, after = saved.problem.data, loaded.problem.data
    assert after.source == before.source
    assert after.channels == before.channels
    np.testing.assert_array_equal(after.mask, before.mask)
    np.testing.assert_array_equal(after.values, before.values)
    np.testing.assert_array_equal(after.sigma, before.sigma)
    # directions pass through degrees that are rounded to 1e-10, that is 2e-12 radians
    np.testing.assert_allclose(after.wo, before.wo, rtol=0, atol=1e-11)
    np.testing.assert_allclose(loaded.predicted, saved.predicted, rtol=1e-9)
    np.testing.assert_allclose(loaded.chi_square, saved.chi_square, rtol=1e-8)


def test_a_saved_fit_comes_back(coat_fit: Fit, tmp_path: Path) -> None:
    save_fit(coat_fit, tmp_path / "result")
    assert_same(load_fit(tmp_path / "result"), coat_fit)


def unfitted(problem: Problem) -> Fit:
    """A `Fit` that stands at the start of its problem, made without running an optimiser."""
    count = len(problem.start)
    minimum = Minimum(dict(zip(problem.names, problem.start, strict=True)), 1.5, 1, problem.build(problem.start).stack)
    return Fit(
        problem=problem,
        vector=problem.start,
        errors=np.full(count, 0.1),
        covariance=0.01 * np.eye(count),
        cost=1.5,
        at_bound=(),
        converged=True,
        status="made by hand",
        iterations=0,
        condition_number=1.0,
        unidentified=(Direction(np.inf, {problem.names[0]: 1.0}, {problem.names[0]: np.inf}),),
        minima=(minimum,),
        alternatives=(minimum,),
    )


@pytest.mark.parametrize(
    "settings",
    [
        {
            "scale": Free(1.0, 0.8, 1.25, LogNormal(1.0, 0.05)),
            "noise": Noise(relative=0.02, floor=1e-4, use_sigma=False, tails="student", degrees_of_freedom=5.0),
        },
        {"scale": 1.1, "objective": "cube_root"},
        {"transport": lj.SingleScattering(), "noise": Noise(relative=Free(0.05, 0.01, 0.5))},
    ],
)
def test_scale_noise_objective_and_transport_come_back(coat_fit: Fit, tmp_path: Path, settings: dict[str, Any]) -> None:
    fit = unfitted(Problem(coat_fit.problem.stack, coat_fit.problem.data, **settings))
    save_fit(fit, tmp_path / "result")
    loaded = load_fit(tmp_path / "result")
    assert_same(loaded, fit)
    for name in ("scale", "noise", "objective", "transport"):
        assert getattr(loaded.problem, name) == getattr(fit.problem, name), name


def test_numbers_that_are_not_finite_are_strings_in_json(coat_fit: Fit, tmp_path: Path) -> None:
    odd = replace(coat_fit, errors=np.array([np.nan, np.inf]), condition_number=np.inf)
    save_fit(odd, tmp_path / "odd")

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is not JSON")

    json.loads((tmp_path / "odd" / "fit.json").read_text(), parse_constant=refuse)
    loaded = load_fit(tmp_path / "odd")
    np.testing.assert_array_equal(loaded.errors, odd.errors)
    assert loaded.condition_number == np.inf


def test_a_result_is_replaced_only_by_force_and_as_a_whole(coat_fit: Fit, tmp_path: Path) -> None:
    directory, precious = tmp_path / "result", tmp_path / "home" / "precious.txt"
    save_fit(coat_fit, directory)
    (directory / "leftover").touch()
    before = contents(directory)
    with pytest.raises(ValueError, match="holds a result already"):
        save_fit(coat_fit, directory)

    def half_way() -> None:
        with writing(directory, force=True) as folder:
            (folder / "fit.json").write_text("half")
            raise RuntimeError("half way")

    with pytest.raises(RuntimeError, match="half way"):
        half_way()
    assert contents(directory) == before
    save_fit(coat_fit, directory, force=True)
    assert not (directory / "leftover").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["result"]
    precious.parent.mkdir()
    precious.write_text("data")
    with pytest.raises(ValueError, match="not a result directory"):
        save_fit(coat_fit, precious.parent, force=True)
    assert precious.read_text() == "data"


def test_a_transport_that_has_no_name_is_refused(coat_fit: Fit, tmp_path: Path) -> None:
    def own(stack: lj.Stack, wi: jax.Array, wo: jax.Array) -> jax.Array:
        return lj.evaluate(stack, wi, wo)

    fit = unfitted(Problem(coat_fit.problem.stack, coat_fit.problem.data, transport=own))
    with pytest.raises(ValueError, match="transport"):
        save_fit(fit, tmp_path / "own")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("fit.json", None, "no fit.json"),
        ("fit.json", "{", "not valid JSON"),
        ("fit.json", "[]", "must be an object"),
        ("fit.json", '{"layerjax_result": 99}', "version 99"),
        ("fit.json", '{"layerjax_result": 4}', "damaged"),
        ("data.csv", None, "data.csv"),
        ("data.csv", "", "data.csv: damaged or changed"),
        ("problem.toml", "layers = 3", "problem.toml: damaged or changed"),
    ],
)
def test_a_damaged_result_is_named(coat_fit: Fit, tmp_path: Path, name: str, content: str | None, words: str) -> None:
    directory = tmp_path / "result"
    save_fit(coat_fit, directory)
    if content is None:
        (directory / name).unlink()
    else:
        (directory / name).write_text(content)
    with pytest.raises((ValueError, FileNotFoundError), match=words) as error:
        load_fit(directory)
    assert "result" in str(error.value)
    assert "\n" not in str(error.value)


def test_one_of_several_measurements_is_not_sampled_by_itself_where_it_was_saved(coat_fit: Fit, tmp_path: Path) -> None:
    save_fit(replace(coat_fit, dataset="plane"), tmp_path / "fit")
    with pytest.raises(ValueError, match="sample: 'plane' is a part of a joint fit"):
        sample(load_fit(tmp_path / "fit"))


def test_there_is_no_posterior_before_sampling(coat_fit: Fit, tmp_path: Path) -> None:
    save_fit(coat_fit, tmp_path / "result")
    assert load_posterior(tmp_path / "result") is None
