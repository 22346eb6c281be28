"""Thresholds of a fit: what they may be, and that a stack file sets them."""

from pathlib import Path

import pytest

import fits
from fits.optimise.options import options_from

STACK = 'transport = "SingleScattering"\n[base]\nkind = "Lambertian"\nalbedo = { start = 0.5, low = 0.0, high = 1.0 }\n'


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"same_cost": 0.0}, r"FitOptions.same_cost is 0.0; it must be a number above 0"),
        ({"numerical_error": "small"}, r"FitOptions.numerical_error is 'small'; it must be a number above 0"),
        ({"autocorrelation": float("inf")}, r"FitOptions.autocorrelation is inf"),
        ({"tolerance": 1.0}, r"\[options\] has an unknown key 'tolerance'; it must be one of same_values, "),
    ],
)
def test_bad_options_are_refused(given: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        options_from(given)


def test_a_stack_file_sets_them(tmp_path: Path) -> None:
    path = tmp_path / "stack.toml"
    path.write_text(STACK + "[options]\nautocorrelation = 0.4\n")
    assert options_from(fits.read_problem(path).options) == fits.FitOptions(autocorrelation=0.4)
    path.write_text(STACK)
    assert options_from(fits.read_problem(path).options) == fits.FitOptions()
