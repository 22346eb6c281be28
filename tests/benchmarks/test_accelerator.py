"""A GPU beside the processor: a tiny run on what there is, and what float32 products are asked for."""

import json
import re
from pathlib import Path

import jax
import jax.numpy as jnp

import layerjax as lj
from benchmarks.studies.accelerator import Task, study
from benchmarks.studies.textured.materials import MATERIALS


def test_a_tiny_run_writes_whole_files(tmp_path: Path) -> None:
    (cheap,) = (one for one in MATERIALS if one.name == "interface over metal, 2007")
    _, paths = study(directory=tmp_path, tasks=[Task(cheap, 16)], precisions=["float64"], rounds=1)
    assert sorted(paths) == sorted(tmp_path.iterdir())
    (row,) = json.loads((tmp_path / "accelerator.json").read_text())["rows"]
    assert row["apart"] < 1e-12  # the same arithmetic, on any two devices
    assert min(row["value"], row["gradient"]) > 0


def test_products_of_the_solver_are_not_rounded_to_what_a_gpu_would_like() -> None:
    def solved(thickness: jax.Array) -> object:
        stack = lj.Stack([lj.Interface(1.5, 0.3), lj.Medium(thickness, 0.9)], lj.Lambertian(0.5))
        return lj.prepare(stack, lj.AddingDoubling(nodes=4, modes=2)).state

    text = jax.jit(solved).lower(jnp.float32(0.5)).as_text()
    products = re.findall(r"stablehlo\.dot_general.*", text)
    assert products
    assert all("HIGHEST" in product for product in products)
