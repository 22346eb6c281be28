"""Result directories: what is saved comes back, and writing is all or nothing."""

import json
from dataclasses import replace

import numpy as np
import pytest

import layerjax as lj
from fits import Direction, Free, Instrument, LogNormal, Noise, Problem, load_fit, load_posterior, sample, save_fit
from fits._files import locked
from fits.optimise.result import Minimum, WithoutDiscrepancy
from fits.reports.results import save_posterior, writing
from fits.sampling.sample import load
from tests.helpers.files import contents
from tests.helpers.refusals import refuses

ARRAYS = ("vector", "errors", "covariance", "cost", "condition_number")
SAME = ["at_bound", "converged", "status", "iterations", "unidentified", "units", "values", "without_discrepancy"]
STUDENT = Noise(relative=0.02, floor=1e-4, use_sigma=False, tails="student", degrees_of_freedom=5.0)


@pytest.fixture
def directory(coat_fit, tmp_path):
    save_fit(coat_fit, tmp_path / "result")
    return tmp_path / "result"


def assert_same(loaded, saved):
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(loaded, name), getattr(saved, name), err_msg=name)
    for name in SAME:
        assert getattr(loaded, name) == getattr(saved, name), name
    assert [one.values for one in loaded.minima] == [one.values for one in saved.minima]
    assert len(loaded.alternatives) == len(saved.alternatives)
    np.testing.assert_array_equal(loaded.problem.low, saved.problem.low)
    before, after = saved.problem.data, loaded.problem.data
    for name in ("source", "channels", "mask", "values", "sigma"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name), err_msg=name)
    # directions pass through degrees that are rounded to 1e-10, that is 2e-12 radians
    np.testing.assert_allclose(after.wo, before.wo, rtol=0, atol=1e-11)
    np.testing.assert_allclose(loaded.predicted, saved.predicted, rtol=1e-9)
    np.testing.assert_allclose(loaded.chi_square, saved.chi_square, rtol=1e-8)


def unfitted(coat_fit, **settings):
    """A `Fit` of the same data that stands at the start of its problem, made without running an optimiser."""
    problem = Problem(coat_fit.problem.stack, coat_fit.problem.data, **settings)
    minimum = Minimum(dict(zip(problem.names, problem.start, strict=True)), 1.5, 1, True)
    direction = Direction(np.inf, {problem.names[0]: 1.0}, {problem.names[0]: np.inf})
    found = {"vector": problem.start, "errors": np.full(len(problem.start), 0.1), "unidentified": (direction,)}
    found |= {"covariance": 0.01 * np.eye(len(problem.start)), "minima": (minimum,)}
    if problem.noise.discrepancy:
        before = WithoutDiscrepancy(coat_fit.values, coat_fit.standard_errors, 30.0, 20, 12.5, 0.4, 19)
        found["without_discrepancy"] = before
    return replace(coat_fit, problem=problem, **found)


@pytest.mark.parametrize(
    "settings",
    [
        None,
        {"scale": Free(1.0, 0.8, 1.25, LogNormal(1.0, 0.05)), "noise": STUDENT},
        {"scale": 1.1, "objective": "cube_root", "transport": lj.SingleScattering()},
        {"instrument": Instrument(0.5, 1.0, Free(0.0, -2.0, 2.0), 0.03, 1e-3), "transport": lj.SingleScattering()},
        {"noise": Noise(relative=0.03, discrepancy=True)},
    ],
)
def test_a_saved_fit_comes_back(coat_fit, tmp_path, settings):
    """Also that it is a part of a joint fit, which is not sampled by itself."""
    fit = coat_fit if settings is None else unfitted(coat_fit, **settings)
    fit = replace(fit, condition_number=np.inf, dataset="plane")  # a word in JSON
    save_fit(fit, tmp_path / "result")
    loaded = load_fit(tmp_path / "result")
    assert_same(loaded, fit)
    refuses(r"sample: ('plane' is a part of a joint|a fit of 'cube_root')", sample, loaded)
    for name in ("scale", "noise", "objective", "transport", "instrument"):
        assert getattr(loaded.problem, name) == getattr(fit.problem, name), name


def test_a_result_is_replaced_only_by_force_and_as_a_whole(coat_fit, directory, tmp_path):
    (directory / "leftover").touch()
    before = contents(directory)
    refuses("holds a result already", save_fit, coat_fit, directory)

    with pytest.raises(ZeroDivisionError), writing(directory, force=True) as folder:
        (folder / "fit.json").write_text(f"half {1 / 0}")
    assert contents(directory) == before
    save_fit(coat_fit, directory, force=True)
    assert not (directory / "leftover").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["result"]
    (tmp_path / "precious.txt").write_text("data")
    refuses("not a result directory", save_fit, coat_fit, tmp_path, force=True)
    assert (tmp_path / "precious.txt").read_text() == "data"


def test_a_transport_that_has_no_name_is_refused(coat_fit, tmp_path):
    with pytest.raises(ValueError, match="transport"):
        save_fit(unfitted(coat_fit, transport=lambda stack, wi, wo: lj.evaluate(stack, wi, wo)), tmp_path / "own")
    assert not list(tmp_path.iterdir())


def test_there_is_no_posterior_before_the_first_step(coat_fit, directory):
    assert load_posterior(directory) is None
    (directory / "chain.db").write_bytes(b"")
    assert load_posterior(directory) is None
    refuses("no steps yet", load, coat_fit, directory / "chain.db")
    (directory / "chain.db").write_bytes(b"SQLite format 3")
    refuses(r"chain\.db: damaged", load_posterior, directory)


def test_a_chain_that_begins_again_is_not_allowed_what_the_last_one_was(coat_fit, directory):
    options = {"walkers": 16, "path": directory / "chain.db"}
    save_posterior(sample(coat_fit, max_steps=200, allow_unconverged=True, **options), directory)
    assert load_posterior(directory).allow_unconverged
    sample(coat_fit, max_steps=100, resume=False, **options)
    assert not load_posterior(directory).allow_unconverged


def test_damage_to_a_result_is_seen(directory):
    """64 bytes inverted, every 512 bytes; one digit, another version, and a file that is gone."""
    for name in ("fit.json", "data.csv", "problem.toml"):
        whole = (directory / name).read_bytes()
        for place in range(0, len(whole), 512):
            other = bytes(255 - byte for byte in whole[place : place + 64])
            (directory / name).write_bytes(whole[:place] + other + whole[place + 64 :])
            refuses(name, load_fit, directory)
        (directory / name).write_bytes(whole)
    path, whole = directory / "fit.json", (directory / "fit.json").read_text()
    content = json.loads(whole)
    content["fit"]["cost"] += 1e-9
    for text, words in (
        (json.dumps(content), r"fit\.json: damaged or changed"),
        ('{"layerjax_result": 99}', "is version 99 of the format"),
    ):
        path.write_text(text)
        refuses(words, load_fit, directory)
    path.write_text(whole)
    for name in ("data.csv", "fit.json"):
        (directory / name).unlink()
        refuses(name, load_fit, directory, error=(ValueError, FileNotFoundError))


def test_what_killed_processes_left_is_tidied_up(coat_fit, directory, tmp_path):
    """By the next one that writes: half of a result goes, and a result that was aside comes back."""
    before = contents(directory)
    directory.rename(tmp_path / ".result.old.partial")
    (tmp_path / ".result.new.partial").mkdir()
    (tmp_path / ".result.lock").write_text("1\n")
    refuses("holds a result already", save_fit, coat_fit, directory)
    assert contents(directory) == before
    assert [path.name for path in tmp_path.iterdir()] == ["result"]
    with locked(directory / "chain.db.lock", "its chain"), pytest.raises(ValueError, match="in use"):
        save_fit(coat_fit, directory, force=True)
    with writing(directory, force=True), pytest.raises(ValueError, match="in use"):
        save_fit(coat_fit, directory, force=True)
