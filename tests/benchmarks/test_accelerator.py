"""A GPU beside the processor: a tiny run on what there is, and what float32 products are asked for."""

import json
import re
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import layerjax as lj
from benchmarks.studies.accelerator import study
from benchmarks.studies.accelerator.tasks import Task


@pytest.mark.slow
def test_a_tiny_run_writes_whole_files_and_keeps_other_rows(tmp_path: Path) -> None:
    lines: list[str] = []
    value = Task("interface over metal, 2007", 16)
    unknown = replace(value, material="of no name")
    study(report=lines.append, directory=tmp_path, tasks=[value, unknown], rounds=1)
    _, paths = study(report=lines.append, directory=tmp_path, tasks=[replace(value, kind="gradient")], rounds=1)
    assert sorted(paths) == sorted(tmp_path.iterdir())
    rows = json.loads((tmp_path / "accelerator.json").read_text())["rows"]
    assert [row["kind"] for row in rows] == ["value", "gradient"]
    assert any("failed" in line for line in lines)
    for row in rows:
        assert row["difference"] < 1e-12  # the same arithmetic, on any two devices
        assert min(row["microseconds"], row["microseconds_on_processor"], row["compile_seconds"]) > 0


def test_products_of_the_solver_are_not_rounded_to_what_a_gpu_would_like() -> None:
    def solved(thickness: jax.Array) -> object:
        stack = lj.Stack([lj.Interface(1.5, 0.3), lj.Medium(thickness, 0.9)], lj.Lambertian(0.5))
        return lj.prepare(stack, lj.AddingDoubling(nodes=4, modes=2)).state

    text = jax.jit(solved).lower(jnp.float32(0.5)).as_text()
    products = re.findall(r"stablehlo\.dot_general.*", text)
    assert products
    assert all("HIGHEST" in product for product in products)
