"""The benchmarks' own models agree with layerjax, and their runs leave whole files behind."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from benchmarks.measuring import environment
from benchmarks.measuring import writing as results
from benchmarks.peers import functions as peers
from benchmarks.peers import plain_numpy
from benchmarks.studies import recovery
from benchmarks.studies.textured import run as textured
from benchmarks.studies.textured.materials import MATERIALS
from benchmarks.studies.throughput import fitting, forward_models
from benchmarks.studies.throughput import run as throughput
from benchmarks.suite.scenes import CONDUCTOR, SCENES, Scene, pairs

SINGLE = lj.SingleScattering()

COUNT = 200
BY_NAME = pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)


def ours(scene: Scene, wi, wo):
    return np.asarray(lj.evaluate(scene.build(scene.arrays("float64")), wi, wo, SINGLE, side=scene.side))


@BY_NAME
def test_plain_numpy_agrees_with_layerjax(scene: Scene) -> None:
    """Tolerance: the plain form of exp(-a) - exp(-b) loses up to 5 digits where a and b agree to 1e-5."""
    wi, wo = pairs(COUNT, scene.side)
    plain = np.stack(plain_numpy.model_of(scene.parameters)(scene.parameters, wi.T, wo.T, scene.side), axis=-1)
    np.testing.assert_allclose(plain, ours(scene, wi, wo), rtol=1e-10 if scene.side == "all" else 1e-13)


@pytest.mark.slow
@BY_NAME
def test_finite_differences_agree_with_layerjax(scene: Scene) -> None:
    """Tolerance: forward differences with a step of sqrt(eps) keep some 7 digits of slopes of the size of the loss."""
    wi, wo = pairs(COUNT, scene.side)
    target = 1.1 * ours(scene, wi, wo)

    def loss(p):
        return jnp.sum(jnp.mean((lj.evaluate(scene.build(p), wi, wo, SINGLE, side=scene.side) - target) ** 2, axis=0))

    value, slopes = jax.jit(jax.value_and_grad(loss))(scene.arrays("float64"))
    parameters = {name: np.asarray(number) for name, number in scene.parameters.items()}
    plain, differences = plain_numpy.gradient(parameters, wi.T, wo.T, target.T, scene.side)
    assert plain == pytest.approx(float(value), rel=1e-10)
    assert scene.count == sum(slope.size for slope in slopes.values()) in (7, 20)
    for name, slope in slopes.items():
        np.testing.assert_allclose(differences[name], slope, rtol=1e-3, atol=1e-5 * plain, err_msg=name)


@BY_NAME
@pytest.mark.peers
def test_the_peers_agree_with_plain_numpy(scene: Scene) -> None:
    """Tolerance: float32, through about a hundred operations."""
    reason = peers.why_not()
    if reason is not None:
        pytest.skip(reason)
    wi, wo = pairs(COUNT, scene.side)
    plain = np.stack(plain_numpy.model_of(scene.parameters)(scene.parameters, wi.T, wo.T, scene.side), axis=-1)
    peer = peers.of(scene, *(array.astype("float32") for array in (wi, wo, 1.1 * plain)))
    np.testing.assert_allclose(np.stack([np.array(v) for v in peer.value()], axis=-1), plain, rtol=1e-4)
    ways = peer.gradient, peer.tuned_gradient
    slopes, tuned = (np.concatenate([np.ravel(np.array(slope)) for slope in way()[1]]) for way in ways)
    np.testing.assert_allclose(slopes, tuned, rtol=1e-3)


def test_the_material_that_is_fitted_agrees_with_its_numpy_model() -> None:
    wi, wo = pairs(COUNT, "reflection")
    values = lj.evaluate(fitting.stack_of(fitting.TRUTH), wi, wo, SINGLE)
    np.testing.assert_allclose(fitting.model(fitting.TRUTH, wi, wo), values[:, 0], rtol=1e-13)


@pytest.mark.slow
def test_a_tiny_throughput_run_writes_whole_files(tmp_path: Path) -> None:
    text, paths = throughput.study(
        with_peers=False,
        directory=tmp_path / "new",
        forward_size=forward_models.Size(pairs=64, rounds=1, scenes=(CONDUCTOR,), precisions=("float32",)),
        fitting_size=fitting.Size(rounds=1, many=2, few=1, numpy_steps=200, chain_steps=100, samples=64),
    )
    assert sorted(paths) == sorted((tmp_path / "new").iterdir())  # and no temporary file is left
    content = json.loads(paths[0].read_text())
    assert paths[1].read_text() == text
    assert content["environment"].keys() == environment.describe().keys()
    assert [row["work"] for row in content["forward_models"]] == ["value", "value and gradient"]
    assert all(row["layerjax"] > 0 and row["numpy"] > 0 and row["peer"] is None for row in content["forward_models"])
    assert {row["verdict"] for row in content["forward_models"]} == {"no peer"}
    assert all(row["ours"] > 0 and row["theirs"] > 0 for row in content["inference"])


@pytest.mark.slow
def test_a_tiny_run_of_maps_writes_whole_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cheap transport keeps its texels, one that takes longer than it may has fewer of them; memory does not grow."""
    few = [material for material in MATERIALS if isinstance(material.transport, lj.SingleScattering)]
    size = textured.Size(texels=(20_000,), precisions=("float32",), rounds=1, longest=100.0)
    _, paths = textured.study(with_peers=False, directory=tmp_path, size=size, materials=few)
    (row,) = json.loads(paths[0].read_text())["rows"]
    assert row["texels"] == 20_000
    assert 0.0 < row["value"] < 1e3
    assert row["gradient"] > 1.0
    assert row["memory"] is None  # so small a map does not tell
    monkeypatch.setattr(textured, "MANY", 20_000)
    assert textured.measure(few[0], "float32", 20_000, size, with_peers=False).memory < 64.0
    assert row["principled"] is None
    hurried = dataclasses.replace(size, longest=1e-9)
    assert textured.measure(few[0], "float32", 20_000, hurried, with_peers=False).texels == textured.PROBED


@pytest.mark.slow
def test_a_tiny_recovery_run_writes_whole_files(tmp_path: Path) -> None:
    text, paths = recovery.study(directory=tmp_path, size=recovery.Size(repeats=2, many=4))
    content = json.loads(paths[0].read_text())
    assert paths[1].read_text() == text
    assert [row["parameter"] for row in content["parameters"]] == list(recovery.TRUTH)
    assert all(0 <= row["within_3"] <= 2 and 0 <= row["covered"] <= 2 for row in content["parameters"])


def test_results_are_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    results.write("x", {"a": 1}, "first\n", tmp_path)
    results.write("x", {"a": 2}, "second\n", tmp_path)
    with pytest.raises(ValueError, match="not JSON compliant"):
        results.write("x", {"a": float("nan")}, "third\n", tmp_path)
    assert json.loads((tmp_path / "x.json").read_text()) == {"a": 2}
    assert (tmp_path / "x.md").read_text() == "second\n"
    assert len(list(tmp_path.iterdir())) == 2


def test_every_record_has_a_line_and_six_digits(tmp_path: Path) -> None:
    rows = [{"name": "first", "error": 1 / 3, "pair": (1e-9 / 7, 2)}, {"name": "second", "error": None, "pair": [1, 2]}]
    content = {"environment": {"cores": 2}, "angles": [0.1, 30.0], "done": True, "none": [], "rows": rows}
    before = results.write("x", content, "", tmp_path)[0].read_text()
    assert '    {"name": "first", "error": 0.333333, "pair": [1.42857e-10, 2]},\n' in before
    assert '  "angles": [0.1, 30.0],\n' in before
    assert json.loads(before) == results.rounded(content)
    rows[1]["error"] = 0.5
    after = results.write("x", content, "", tmp_path)[0].read_text()
    assert sum(a != b for a, b in zip(before.splitlines(), after.splitlines(), strict=True)) == 1


@pytest.mark.parametrize("path", sorted(results.DIRECTORY.glob("*.json")), ids=lambda path: path.stem)
def test_stored_results_stand_as_they_would_be_written_now(path: Path) -> None:
    content = json.loads(path.read_text())
    assert path.read_text() == results.as_json(content)
    assert content["environment"].keys() <= environment.describe().keys() | set(environment.PACKAGES)


def test_tables_line_up() -> None:
    lines = results.table(("work", "ns"), [("a", "1"), ("longer", "1,234.5")]).splitlines()
    assert lines == ["| work   |      ns |", "|--------|--------:|", "| a      |       1 |", "| longer | 1,234.5 |"]


def test_figures_have_three_digits() -> None:
    numbers = (None, 0.0, 0.012345, 1.2345, 12.345, 1234.5, 1.2e-5)
    assert [results.figure(x) for x in numbers] == ["-", "0", "0.0123", "1.23", "12.3", "1,234", "1.20e-05"]


@pytest.mark.parametrize(("ratio", "verdict"), [(0.1, "aim met"), (0.3, "met"), (0.5, "**not met**")])
def test_the_bar(ratio: float, verdict: str) -> None:
    assert results.Bar(0.35, 0.2).verdict(ratio) == verdict
    assert results.Bar(1 / 0.35, 1 / 0.2, rate=True).verdict(1 / ratio) == verdict
