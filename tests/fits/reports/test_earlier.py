"""Earlier results keep the transport and the noise that they were made with."""

import json
from pathlib import Path

import pytest

import layerjax as lj
from fits.optimise.fit import fit
from fits.optimise.result import Fit
from fits.problem.discrepancy.parameters import Correlated
from fits.problem.noise import Noise
from fits.problem.parameters import Free
from fits.reports.earlier import transport_meant
from fits.reports.results import load_fit, save_fit

FACE, PAINT = lj.Interface(1.5, Free(0.2, 0.05, 0.8)), lj.Lambertian(Free(0.5, 0.0, 1.0))
FIXED = lj.AddingDoubling(nodes=32, modes=48, ordinates=(10, 24))


@pytest.mark.parametrize(
    ("stack", "given", "meant"),
    [
        (lj.Stack([lj.Medium(Free(0.5, 0.0, 2.0), 0.8)], PAINT), "auto", lj.SingleScattering()),
        (lj.Stack([FACE, lj.Medium(Free(0.5, 0.0, 2.0), 0.0)], PAINT), "auto", lj.Statistical(microfacets="single")),
        (lj.Stack([FACE, lj.Medium(0.5, Free(0.5, 0.0, 1.0))], PAINT), "auto", FIXED),
        (lj.Stack([FACE], PAINT), lj.AddingDoubling(), FIXED),
        (lj.Stack([FACE], PAINT), lj.AddingDoubling(nodes=8), lj.AddingDoubling(8, 48, (10, 24))),
        (lj.Stack([FACE], PAINT), lj.ENDF(), lj.ENDF()),
    ],
)
def test_what_was_meant(stack, given, meant):
    assert transport_meant(stack, given) == meant


def test_such_a_result_is_read_so(coat_fit: Fit, tmp_path: Path) -> None:
    save_fit(coat_fit, tmp_path / "result")
    path = tmp_path / "result" / "fit.json"
    content = json.loads(path.read_text())
    for key in ("transport", "resolution", "numerical_error", "checksum", "checksums"):  # which 0.1.0 did not write
        del content[key]
    path.write_text(json.dumps(content))
    problem = tmp_path / "result" / "problem.toml"
    problem.write_text(problem.read_text().replace('transport = "SingleScattering"', ""))
    loaded = load_fit(tmp_path / "result")
    assert loaded.problem.transport == lj.SingleScattering()
    assert loaded.numerical_error is None
    assert loaded.chi_square == pytest.approx(coat_fit.chi_square, rel=1e-9)


def test_shared_errors_did_not_grow_towards_grazing(coat_fit: Fit, tmp_path: Path) -> None:
    given = coat_fit.problem
    noise = Noise(correlated=Correlated(amplitude=0.05, half=20.0, difference=20.0, growth=0.0))
    save_fit(fit(given.stack, given.data, transport=given.transport, noise=noise, starts=1), tmp_path / "result")
    problem, path = tmp_path / "result" / "problem.toml", tmp_path / "result" / "fit.json"
    assert problem.read_text().count("growth = 0.0\n") == 1
    problem.write_text(problem.read_text().replace("growth = 0.0\n", ""))
    content = json.loads(path.read_text())
    del content["checksum"], content["checksums"]  # of what they were
    path.write_text(json.dumps(content))
    loaded = load_fit(tmp_path / "result")
    assert loaded.problem.names == tuple(entry["name"] for entry in content["parameters"])
    assert loaded.problem.noise == noise
    assert loaded.chi_square == pytest.approx(content["derived"]["chi_square"], rel=1e-9)
