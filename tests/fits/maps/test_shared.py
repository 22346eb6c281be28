"""Numbers that texels have in common: which they are, and the stack with them held."""

import jax
import numpy as np
import pytest

import layerjax as lj
from fits.data.geometry import slices
from fits.data.measurements import Measurements
from fits.maps.shared import hold, shared_names
from fits.problem.discrepancy.parameters import Discrepancy
from fits.problem.instrument import Instrument
from fits.problem.noise import Noise
from fits.problem.parameters import Free, Uniform, is_free
from fits.problem.problem import Problem
from fits.problem.spectra import PowerLaw
from fits.problem.stack_file import read_problem, write_problem

HAZE = lj.Medium(
    Free(0.5, 0.1, 2.0), [0.5, 0.6, 0.7], lj.HenyeyGreenstein(Free(0.3, 0.0, 0.9, same_for_all_texels=True))
)
COAT = lj.Stack([HAZE], lj.Lambertian(Free((0.1, 0.2, 0.3), 0.0, 1.0, same_for_all_texels=True)))
VALUES = {"layers[0].phase.g": 0.4, "base.albedo[0]": 0.5, "base.albedo[1]": 0.25, "base.albedo[2]": 0.125}


def _data(channels: int = 3) -> Measurements:
    view = slices(incidence=(10.0, 40.0), outgoing=(-30.0, 0.0, 20.0, 50.0))
    names = tuple(f"channel{k}" for k in range(channels))
    return Measurements(view.wi, view.wo, np.full((8, channels), 0.1), None, np.ones(8, bool), names)


def test_the_mark_is_shown_only_where_it_is_set() -> None:
    assert repr(Free(0.5, 0.0, 1.0)) == "Free(0.5, 0.0, 1.0)"  # checkpoints of earlier versions go by it
    assert repr(Free(0.5, 0.0, 1.0, same_for_all_texels=True)) == "Free(0.5, 0.0, 1.0, same_for_all_texels=True)"
    assert Free(0.5, 0.0, 1.0, same_for_all_texels=True) != Free(0.5, 0.0, 1.0)
    for wrong in (1, "yes", None):
        with pytest.raises(ValueError, match=r"Free.same_for_all_texels is .*; it must be True or False"):
            Free(0.5, 0.0, 1.0, Uniform(), None, wrong)  # type: ignore[arg-type]


def test_a_stack_file_has_the_mark(tmp_path) -> None:
    scale = Free(1.0, 0.8, 1.25, same_for_all_texels=True)
    path = tmp_path / "coat.toml"
    write_problem(path, COAT, scale=scale)
    assert path.read_text().count("shared = true") == 3
    again = read_problem(path)
    assert again.scale == scale
    assert again.stack.layers[0].thickness == HAZE.thickness
    assert again.stack.layers[0].phase.g == HAZE.phase.g
    assert again.stack.base.albedo == COAT.base.albedo
    path.write_text("[base]\nkind = 'Lambertian'\nalbedo = { start = 0.5, low = 0, high = 1, shared = 1 }\n")
    with pytest.raises(ValueError, match=r"base.albedo.shared is 1, must be true or false"):
        read_problem(path)


def test_shared_names_are_those_of_the_problem() -> None:
    assert shared_names(Problem(COAT, _data(), lj.SingleScattering())) == tuple(VALUES)
    plain = Problem(
        lj.Stack([HAZE], lj.Lambertian(0.5)),
        _data(),
        lj.SingleScattering(),
        noise=Noise(
            relative=Free(0.05, 0.01, 0.5),
            discrepancy=Discrepancy(amplitude=Free(0.1, 0.01, 0.5, same_for_all_texels=True)),
        ),
        scale=Free(1.0, 0.8, 1.2, same_for_all_texels=True),
        instrument=Instrument(
            tilt=Free(0.0, -1.0, 1.0, same_for_all_texels=True), floor=Free(1e-3, 1e-4, 1e-2, same_for_all_texels=True)
        ),
    )
    expected = {"layers[0].phase.g", "scale", "instrument.tilt", "noise.floor", "noise.discrepancy.amplitude"}
    assert set(shared_names(plain)) == expected
    assert shared_names(plain) == tuple(name for name in plain.names if name in expected)


def test_shared_names_of_mixtures_and_power_laws() -> None:
    waves = (450.0, 550.0, 650.0)
    law = PowerLaw(Free(1.0, 0.1, 3.0), Free(1.0, 0.5, 2.0, same_for_all_texels=True), waves)
    bare = lj.Stack([lj.Medium(law, 0.5)], lj.Lambertian(0.5))
    mixed = lj.Mixture({"bare": bare, "coat": COAT}, [Free(0.3, 0.0, 1.0, same_for_all_texels=True), None])
    names = shared_names(Problem(mixed, _data(), lj.SingleScattering()))
    own = {"weights.bare", "bare.layers[0].thickness.exponent", *(f"coat.{name}" for name in VALUES)}
    assert set(names) == own
    held = hold(mixed, dict.fromkeys(names, 0.5))
    left = [leaf for leaf in jax.tree.leaves(held, is_leaf=is_free) if is_free(leaf)]
    assert left == [Free(1.0, 0.1, 3.0), HAZE.thickness]


def test_shared_numbers_are_held() -> None:
    held = hold(COAT, VALUES | {"layers[0].thickness": 9.0})
    assert held.layers[0].thickness == HAZE.thickness
    np.testing.assert_array_equal(held.layers[0].phase.g, 0.4)
    np.testing.assert_array_equal(held.base.albedo, [0.5, 0.25, 0.125])
    np.testing.assert_array_equal(held.layers[0].albedo, HAZE.albedo)
    assert Problem(held, _data(), lj.SingleScattering()).names == ("layers[0].thickness",)


def test_a_power_law_that_is_known_becomes_its_numbers() -> None:
    waves = (400.0, 800.0)
    law = PowerLaw(
        Free(1.0, 0.1, 3.0, same_for_all_texels=True),
        Free(1.0, 0.5, 2.0, same_for_all_texels=True),
        waves,
        reference=400.0,
    )
    stack = lj.Stack([lj.Medium(law, Free(0.5, 0.0, 1.0))], lj.Lambertian(0.5))
    held = hold(stack, {"layers[0].thickness.amplitude": 2.0, "layers[0].thickness.exponent": 1.0})
    np.testing.assert_allclose(held.layers[0].thickness, [2.0, 1.0], rtol=1e-12)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, r"values has no 'layers\[0\].phase.g', which is shared; it has none"),
        (VALUES | {"base.albedo[1]": float("nan")}, r"values\['base.albedo\[1\]'\] is nan; it must be finite"),
    ],
)
def test_what_is_missing_is_named(values: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        hold(COAT, values)
