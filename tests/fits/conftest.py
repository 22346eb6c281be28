"""One small fit of simulated data that the tests of results, reports and the command line share."""

import numpy as np
import pytest

from fits import fit, read_problem, write_csv
from fits.cli.parser import main
from tests.helpers import coats
from tests.helpers.models import line_fit


@pytest.fixture(scope="session")
def coat_toml(tmp_path_factory):
    """A stack file with two free parameters."""
    path = tmp_path_factory.mktemp("stack") / "coat.toml"
    path.write_text(coats.HAZY)
    return path


@pytest.fixture(scope="session")
def coat_data():
    """Noisy slices of that stack with known parameters; the last ten measurements are masked."""
    data = coats.measurements("coated")
    return data.where(np.arange(len(data)) < len(data) - 10, "the last ten measurements are masked")


@pytest.fixture
def work(tmp_path, coat_data, coat_toml, monkeypatch):
    """A current directory that holds data.csv and coat.toml."""
    write_csv(coat_data, tmp_path / "data.csv")
    (tmp_path / "coat.toml").write_text(coat_toml.read_text())
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def layerjax(capsys):
    """What a command prints, to `out` and `err`, that ends with this code."""

    def run(words, code=0):
        capsys.readouterr()
        assert main(words.split()) == code
        return capsys.readouterr()

    return run


@pytest.fixture(scope="session")
def coat_fit(coat_toml, coat_data):
    given = read_problem(coat_toml)
    return fit(given.stack, coat_data, transport=given.transport, noise=given.noise, starts=4, seed=0)


@pytest.fixture(scope="session")
def result():
    """The fit of a line: the cheapest model there is."""
    return line_fit()
