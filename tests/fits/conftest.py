"""One small fit of simulated data that the tests of results, reports and the command line share."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import layerjax as lj
from fits import Fit, Measurements, fit, read_problem, simulate, slices, write_csv
from fits.cli.parser import main
from tests.helpers.models import line_fit

PROBLEM = """\
# a hazy coat over paint
transport = "SingleScattering"

[[layers]]
kind = "Medium"
thickness = { start = 1.0, low = 0.05, high = 5.0 }
albedo = 0.8

[base]
kind = "Lambertian"
albedo = { start = 0.5, low = 0.0, high = 1.0 }
"""


@pytest.fixture(scope="session")
def coat_toml(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stack file with two free parameters."""
    path = tmp_path_factory.mktemp("stack") / "coat.toml"
    path.write_text(PROBLEM)
    return path


@pytest.fixture(scope="session")
def coat_data() -> Measurements:
    """Noisy slices of that stack with known parameters; the last ten measurements are masked."""
    truth = lj.Stack([lj.Medium(thickness=0.6, albedo=0.8)], base=lj.Lambertian(albedo=0.4))
    view = slices(incidence=(10, 50), azimuth=(0, 60))
    data = simulate(truth, view, transport=lj.SingleScattering(), noise=0.03, seed=1)
    return data.where(np.arange(len(data)) < len(data) - 10, "the last ten readings are left out")


@pytest.fixture
def work(tmp_path: Path, coat_data: Measurements, coat_toml: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A current directory that holds data.csv and coat.toml."""
    write_csv(coat_data, tmp_path / "data.csv")
    (tmp_path / "coat.toml").write_text(coat_toml.read_text())
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def layerjax(capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """What a command prints, to `out` and `err`, that ends with this code."""

    def run(words: str, code: int = 0) -> Any:
        capsys.readouterr()
        assert main(words.split()) == code
        return capsys.readouterr()

    return run


@pytest.fixture(scope="session")
def coat_fit(coat_toml: Path, coat_data: Measurements) -> Fit:
    """The fit of that stack to those slices."""
    given = read_problem(coat_toml)
    return fit(given.stack, coat_data, transport=given.transport, noise=given.noise, starts=4, seed=0)


@pytest.fixture(scope="session")
def result() -> Fit:
    """The fit of a line: the cheapest model there is."""
    return line_fit()
