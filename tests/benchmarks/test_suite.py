"""The suite of stacks: complete, readable by the command line, and looked at from everywhere."""

import jax
import numpy as np
import pytest

import layerjax as lj
from benchmarks.suite.cases import DIRECTORY, FAMILIES, GROUP, load
from fits.problem.parameters import is_free
from fits.problem.stack_file import read_problem

CASES = load()
NAMES = {case.name: case for case in CASES}
PAPERS = ("Belcour 2018", "de Dinechin & Belcour 2022", "Guo et al. 2015", "Wang et al. 2022", "d'Eon & Weidlich 2024")


def test_the_suite_is_large_and_every_family_has_stacks() -> None:
    assert len(CASES) >= 60
    assert len(NAMES) == len(CASES)
    counts = {family: sum(case.family == family for case in CASES) for family in FAMILIES}
    assert min(counts.values()) >= 5
    assert {path.parent.name for path in DIRECTORY.glob("*/*.toml")} == set(FAMILIES)


def test_every_stack_says_where_it_comes_from_and_is_all_numbers() -> None:
    for case in CASES:
        assert case.source.startswith((*PAPERS, "this suite")), case.name
        assert case.remark.endswith("."), case.name
        assert not any(is_free(leaf) for leaf in jax.tree.leaves(case.stack, is_leaf=is_free)), case.name
    assert {paper for paper in PAPERS for case in CASES if case.source.startswith(paper)} == set(PAPERS)


def test_published_numbers() -> None:
    shade, dragon, glass = NAMES["window_shade"], NAMES["dusty_gold"], NAMES["rough_glass_slab"]
    assert [float(layer.phase.alpha) for layer in shade.stack.layers] == [0.1, 1.0]
    np.testing.assert_array_equal(shade.stack.layers[0].albedo, [0.9, 0.9, 0.7])
    assert float(dragon.stack.layers[0].phase.g) == 0.7
    assert float(glass.stack.layers[0].alpha) == pytest.approx((2 / 100) ** 0.5, abs=1e-6)  # kappa = 2 / alpha^2
    metal = NAMES["frosted_metal"].stack
    assert (float(metal.layers[0].ior), float(metal.layers[0].alpha)) == (1.49, 0.1)
    np.testing.assert_array_equal(metal.base.k, [1.0, 0.1, 0.1])


def test_a_stack_of_the_suite_is_a_problem_of_the_command_line() -> None:
    problem = read_problem(DIRECTORY / "leaves_and_wood" / "plant.toml")
    assert problem.about["source"] == NAMES["plant"].source
    assert isinstance(problem.stack, lj.Stack)


@pytest.mark.parametrize(("name", "groups"), [("satin_varnish", 5), ("window_shade", 20), ("grazing_thin_haze", 20)])
def test_directions_cover_all_sides(name: str, groups: int) -> None:
    case = NAMES[name]
    directions = case.directions
    assert len(directions.wi) == groups * GROUP
    for w in (directions.wi, directions.wo, directions.lights):
        np.testing.assert_allclose(np.linalg.norm(w, axis=-1), 1.0, atol=1e-14)
    np.testing.assert_allclose(directions.lights[directions.light], directions.wi, atol=1e-14)
    sides = {(a > 0, b > 0) for a, b in zip(directions.wi[:, 2], directions.wo[:, 2], strict=True)}
    assert len(sides) == (1 if case.stack.base is not None else 4)
    incidence = np.degrees(np.arccos(np.abs(directions.lights[:, 2])))
    assert (incidence.min(), incidence.max()) == pytest.approx((60, 88) if "grazing" in name else (10, 85))
    # nothing along the unscattered light, where the BSDF of flakes has no value; the mirror direction is there
    assert np.linalg.norm(directions.wi + directions.wo, axis=-1).min() > 0.015
    mirrored = directions.wi * [-1, -1, 1]
    assert (np.linalg.norm(mirrored - directions.wo, axis=-1) < 1e-12).any()
    # in the plane of incidence and out of it
    turn = np.cross(directions.wi, directions.wo)[:, 2]
    assert (np.abs(turn) < 1e-12).any()
    assert (np.abs(turn) > 0.1).any()


@pytest.mark.parametrize("name", ["satin_varnish", "window_shade"])
def test_some_directions_miss_no_light_and_no_side(name: str) -> None:
    directions = NAMES[name].directions
    indices = directions.some(20)
    assert len(indices) == 20
    few = directions.take(indices)
    assert set(few.light) == set(directions.light)
    assert set(few.transmits) == set(directions.transmits)


def test_unknown_families_are_named() -> None:
    with pytest.raises(ValueError, match="family 'paints' is not one of plastics_and_paints, "):
        load(["paints"])
