"""What is asked of errors that readings share: what is refused, and how stack files say it."""

from pathlib import Path

import pytest

import layerjax as lj
from fits.problem.discrepancy.parameters import Discrepancy
from fits.problem.noise import Noise
from fits.problem.parameters import Free, LogNormal
from fits.problem.stack_file import read_problem, write_problem


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"amplitude": -0.1}, r"Noise.discrepancy.amplitude is -0.1; it must be a number in \[1e-06, 1\]"),
        (
            {"length_half": Free(20.0, 0.0, 50.0)},
            r"Noise.discrepancy.length_half.low is 0.0; it must be a number in \[0.1, 360\]",
        ),
        (
            {"channel_correlation": 1.5},
            r"Noise.discrepancy.channel_correlation is 1.5; it must be a number in \[0, 1\]",
        ),
        ({"length_difference": Free((20.0, 20.0), 1.0, 50.0)}, "Noise.discrepancy.length_difference has 2 channels"),
        ({"length_half": "wide"}, "Noise.discrepancy.length_half is 'wide'"),
    ],
)
def test_bad_numbers_are_refused(given: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Discrepancy(**given)


@pytest.mark.parametrize(
    "given", [True, Discrepancy(), Discrepancy(amplitude=0.05, length_half=Free(12.0, 8.0, 20.0, LogNormal(12.0, 0.2)))]
)
def test_stack_files_keep_it(tmp_path: Path, given: Discrepancy | bool) -> None:
    stack = lj.Stack([], lj.Lambertian(Free(0.5, 0.0, 1.0)))
    write_problem(tmp_path / "stack.toml", stack, noise=Noise(relative=0.03, discrepancy=given))
    assert read_problem(tmp_path / "stack.toml").noise == Noise(relative=0.03, discrepancy=given)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("discrepancy = 0.1", "noise.discrepancy is 0.1"),
        ("discrepancy = { angle = 3.0 }", "angle"),
        ("discrepancy = { length_half = -3.0 }", "noise.discrepancy.length_half is -3.0"),
        ("discrepancy = { length_half = { start = 10.0, low = 5.0 } }", "noise.discrepancy.length_half has no high"),
    ],
)
def test_bad_stack_files_are_refused(tmp_path: Path, line: str, message: str) -> None:
    (tmp_path / "stack.toml").write_text(f'[base]\nkind = "Lambertian"\nalbedo = 0.5\n[noise]\n{line}\n')
    with pytest.raises(ValueError, match=message):
        read_problem(tmp_path / "stack.toml")
