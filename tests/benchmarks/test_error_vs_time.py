"""Error against run time: the norms, the verdicts of a walk, and a tiny run that leaves whole files behind."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import layerjax as lj
from benchmarks import __main__
from benchmarks.measuring import accuracy
from benchmarks.studies.error_vs_time import run as error_vs_time
from benchmarks.studies.error_vs_time import tables as error_tables
from benchmarks.studies.error_vs_time.models import MODELS, Model, Row, Size, named
from benchmarks.studies.error_vs_time.truth import References, compare
from benchmarks.suite.cases import Case, Directions

DIRECTIONS = Directions(
    wi=np.array([[0, 0, 1.0], [0, 0.6, 0.8]]),
    wo=np.array([[0, 0.6, 0.8], [0, 0.6, -0.8]]),
    lights=np.array([[0, 0, 1.0], [0, 0.6, 0.8]]),
    light=np.array([0, 1]),
)
ALBEDO = np.array([[[0.5], [0.4]], [[0.1], [0.2]]])  # reflected and transmitted, of both lights


def test_relative_l2_is_weighted_by_both_cosines() -> None:
    error, values = np.array([[0.1], [0.2]]), np.array([[1.0], [2.0]])
    expected = np.sqrt((0.8 * 0.1**2 + 0.64 * 0.2**2) / (0.8 * 1.0 + 0.64 * 4.0))
    assert accuracy.relative_l2(error, values, DIRECTIONS.weights) == pytest.approx(expected)


def test_small_values_are_judged_by_the_albedo_of_their_light_and_side() -> None:
    floors = [0.01 * 0.5 / np.pi, 0.01 * 0.2 / np.pi]  # the first is reflected, the second transmitted
    np.testing.assert_allclose(accuracy.scale(np.zeros((2, 1)), ALBEDO, DIRECTIONS)[:, 0], floors)
    assert accuracy.worst(np.array([[0.1], [-0.3]]), np.array([[1.0], [2.0]])) == pytest.approx(0.15)


def test_a_walk_tells_bias_from_noise() -> None:
    values = np.full((2, 1), 1.0)
    inside = compare(values, values + 0.008, np.full((2, 1), 1e-3), ALBEDO, DIRECTIONS)
    assert (inside.failures, inside.worst) == ((0, 0), 0.0)  # 8 standard errors, but less than 1 %
    assert inside.bias == pytest.approx(np.sqrt(0.008**2 - 0.001**2))
    noisy = compare(values, values + 0.05, np.full((2, 1), 0.04), ALBEDO, DIRECTIONS)
    assert (noisy.failures, noisy.bias) == ((0, 0), 0.0)
    off = compare(values, values + np.array([[0.001], [0.05]]), np.full((2, 1), 1e-3), ALBEDO, DIRECTIONS)
    assert off.failures == (0, 1)  # the second pair is transmitted
    assert off.worst == pytest.approx(0.05)


def test_noise_of_the_stated_size_is_no_bias() -> None:
    rng = np.random.default_rng(1)
    many = DIRECTIONS.take(np.tile([0, 1], 500))
    values = rng.uniform(0.1, 1.0, (1000, 1))
    found = compare(values, values * (1 + 0.02 * rng.normal(size=(1000, 1))), 0.02 * values, ALBEDO, many)
    assert found.bias == 0.0
    assert np.mean(found.z**2) == pytest.approx(1.0, abs=0.2)


def test_models_are_registered_by_name() -> None:
    assert [model.name for model in named(None)] == [model.name for model in MODELS]
    assert [model.name for model in named(["random walk"])] == ["random walk"]
    with pytest.raises(ValueError, match="model 'walk' is not one of 'single scattering', "):
        named(["walk"])


def test_bad_usage_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["--families", "paints"], ["--models", "walk"], ["--stacks", "sond"]):
        with pytest.raises(SystemExit) as stopped:
            __main__.main(["error-vs-time", *arguments])
        assert stopped.value.code != 0
        printed = capsys.readouterr().err.strip()
        assert "Traceback" not in printed
        assert "error: " in printed.splitlines()[-1]
        assert arguments[1] in printed.splitlines()[-1]


def test_differences_that_timings_cannot_tell_are_no_figures() -> None:
    """Few values cost 1 ms, that is 100 ns of each of 10,000."""
    row = Row("a", "coated_metals", "m", "s", 1, 1e-3, 1e-3, None, 0.0, 1e-3, None, 1, False)
    found = [dataclasses.replace(row, nanoseconds_per_value=each) for each in (0.0, 50.0, 70.0)]
    assert error_tables.time_of_a_value(found, called=True) == "50.0"
    assert error_tables.time_of_a_value([*found, found[0]], called=True) == "-"
    assert error_tables.time_of_a_value([*found, found[0]], called=False) == "25.0"


@pytest.mark.slow
def test_one_stack_writes_whole_files(tmp_path: Path) -> None:
    """Haze, which compiles fast."""
    haze = lj.Stack([lj.Medium(0.2, 0.5, lj.HenyeyGreenstein(0.3))])
    solver, walk = lj.AddingDoubling(nodes=4, modes=4), lj.RandomWalk(paths=256)
    models = [Model("single scattering", MODELS[0].steps), Model("solver", {"4": solver})]
    text, paths = error_vs_time.study(
        directory=tmp_path,
        cases=[Case("thin_haze", "transmitting_slabs", "here", "A remark.", haze)],
        models=models,
        references=References(truth=solver, check=walk, solver=solver, walk=walk),
        size=Size(batch=32, walked_opaque=5, walked_transmitting=8, rounds=1),
    )
    assert sorted(paths) == sorted(tmp_path.iterdir())
    content = json.loads((tmp_path / "error-vs-time.json").read_text())
    assert (tmp_path / "error-vs-time.md").read_text() == text
    rows = {row["model"]: row for row in content["rows"]}
    assert rows["solver"]["l2"] < 1e-12  # it is its own truth here
    assert 0.005 < rows["single scattering"]["l2"] < 0.2


@pytest.mark.slow
def test_a_tiny_run_writes_whole_files(tmp_path: Path) -> None:
    """One channel, few nodes and paths: the harness, not the models, is tested."""
    directory = tmp_path / "new"
    haze = lj.Stack([lj.Medium(0.2, 0.5, lj.HenyeyGreenstein(0.3))])
    coat = lj.Stack([lj.Interface(1.5, 0.3)], lj.Lambertian(0.5))
    solver, walk = lj.AddingDoubling(nodes=8, modes=8), lj.RandomWalk(paths=256)
    references = References(truth=solver, check=walk, solver=solver, walk=walk)
    size = Size(batch=32, walked_opaque=5, walked_transmitting=8, rounds=1)
    models = [Model("single scattering", MODELS[0].steps), Model("solver", {"8": solver}), Model("walk", {"256": walk})]

    coated = Case("coat", "plastics_and_paints", "here", "A remark.", coat)

    def study(case: Case) -> tuple[str, tuple[Path, ...]]:
        return error_vs_time.study(
            directory=directory, cases=[case], models=models, references=references, size=size, resume=True
        )

    study(Case("thin_haze", "transmitting_slabs", "here", "A remark.", haze))
    text, paths = study(coated)
    assert sorted(paths) == sorted(directory.iterdir())  # and no temporary file is left
    content = json.loads((directory / "error-vs-time.json").read_text())
    assert (directory / "error-vs-time.md").read_text() == text
    assert (directory / "error-vs-time.png").read_bytes().startswith(b"\x89PNG")
    assert [judgement["stack"] for judgement in content["stacks"]] == ["thin_haze", "coat"]  # the second was added
    assert all(judgement["z_root_mean_square"] < 5 for judgement in content["stacks"])
    rows = {(row["stack"], row["model"]): row for row in content["rows"]}
    assert ("coat", "single scattering") not in rows  # not supported, so not measured
    assert rows["thin_haze", "solver"]["l2"] < 1e-12  # it is its own truth here
    assert rows["thin_haze", "solver"]["truth_limits"]
    # of what a slab of tau 0.2 and albedo 0.5 scatters, some 5 % have scattered again; towards grazing more
    assert 0.005 < rows["thin_haze", "single scattering"]["l2"] < 0.2
    assert all(row["nanoseconds_per_value"] > 0 and row["operations"] > 0 for row in rows.values())
    assert rows["thin_haze", "walk"]["pairs"] == 8
    before = rows["coat", "walk"]
    models.append(Model("called", {"8": solver}, called=True))
    models.append(Model("coarse", {"5": solver.coarser()}))  # its programs are there, for the error of the truth
    study(coated)  # a model that joins: the rest stands as it was
    content = json.loads((directory / "error-vs-time.json").read_text())
    rows = {(row["stack"], row["model"]): row for row in content["rows"]}
    assert rows["coat", "walk"] == before
    assert rows["coat", "called"]["l2"] < 1e-12  # the truth is called, too
    assert rows["coat", "called"]["prepare_seconds"] > 0
    assert 0 < rows["coat", "coarse"]["l2"] < 0.1
    again = tmp_path / "again"
    slower = dataclasses.replace(size, batch=64, rounds=2)  # what times alone depend on
    kept = error_vs_time.study(
        directory=again, cases=[coated], models=models, references=references, size=slower, truths=directory
    )
    assert sorted(kept[1]) == sorted(again.iterdir())
    anew = json.loads((again / "error-vs-time.json").read_text())
    assert [judgement["stack"] for judgement in anew["stacks"]] == ["coat"]  # of the case that was measured
    judged = {judgement["stack"]: judgement for judgement in content["stacks"]}
    assert anew["stacks"][0] == judged["coat"]  # same seeds, same truth
    assert {row["model"] for row in anew["rows"]} == {row["model"] for row in content["rows"] if row["stack"] == "coat"}
    with pytest.raises(ValueError, match="measured with other settings"):
        error_vs_time.study(directory=directory, cases=[], models=models, references=references, resume=True)
    with pytest.raises(ValueError, match="measured with other settings"):  # a truth by other walks
        error_vs_time.study(directory=tmp_path, cases=[], models=models, references=references, truths=directory)
