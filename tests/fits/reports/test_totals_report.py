"""Fits of totals in result directories, reports and on the command line."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import fits
import layerjax as lj
from fits.reports.data_summary import data_table, source_rows
from fits.reports.plots.data import totals_picture
from tests.helpers.commands import refused

SPHERES = fits.Spheres(fits.Sphere(100.0, 20.0, 5.0, 8.0, 0.95), fits.Sphere(90.0, 20.0, wall=0.97), 0.98, True)


def test_a_fit_by_spheres_is_kept_and_reported(tmp_path: Path) -> None:
    totals = fits.Totals.of(reflectance=[[0.2, 0.3, 0.25]], transmittance=[[0.4, 0.4, 0.41]], spheres=SPHERES)
    free = lj.Stack([lj.Medium(fits.Free((0.7,) * 3, 0.01, 5.0), fits.Free(0.5, 0.0, 1.0))])
    fit = fits.fit(free, totals, transport=lj.SingleScattering(), starts=1)
    fits.save_fit(fit, tmp_path / "kept")
    loaded = fits.load_fit(tmp_path / "kept")
    assert loaded.problem.data.spheres == SPHERES
    np.testing.assert_allclose(loaded.predicted, fit.predicted, rtol=1e-12)
    fits.report(loaded, path=tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "as measured with two integrating spheres" in page
    assert "Shares of the incident flux with one sigma" in page
    assert "In the plane of incidence" not in page


def test_on_the_command_line(work: Path, capsys: pytest.CaptureFixture[str], layerjax: Callable) -> None:
    (work / "totals.csv").write_text("theta_i,total_reflectance,total_reflectance_sigma\n0,0.30,0.003\n60,0.21,0.003\n")
    assert "shares of the incident flux" in layerjax("info totals.csv").out
    assert (work / "totals.png").is_file()
    assert "layers[0].thickness" in layerjax("fit totals.csv --stack coat.toml --out result --starts 1").out
    assert (work / "result" / "report.html").is_file()
    layerjax("convert totals.csv copy.csv")
    np.testing.assert_array_equal(fits.read("copy.csv").values, fits.read("totals.csv").values)
    sphere = "200 25 12 1 0.96"
    (work / "slab.rxt").write_text(f"IAD1 1.4 1.5 2.0 1.0 5 0.98 1 {sphere} {sphere} 2 0.3 0.4\n")
    fit = ["fit", "totals.csv", "--stack", "coat.toml", "--out", "r"]
    for words, message in (
        ([*fit, "--select", "incidence=0"], "--select does not apply"),
        ([*fit, "--max-polar-angle", "50"], "--max-polar-angle does not apply"),
        (["info", "totals.csv", "--read", "quantity=brdf_cos"], "'brdf_cos', a totals file holds shares of the light"),
        (["search", "totals.csv", "--out", "r"], "a search needs measurements along directions"),
        (["convert", "slab.rxt", "slab.csv"], "slab.rxt: integrating spheres"),
    ):
        assert message in refused(words, capsys, work)


def test_many_channels_have_a_range_and_an_angle_has_one_colour() -> None:
    names = tuple(f"{nm} nm" for nm in range(400, 700, 10))
    totals = fits.Totals.of(reflectance=np.linspace(0.1, 0.5, 30)[None], channels=names)
    assert data_table(totals).rows == (("reflectance", "0°", "0.1", "0.5"),)
    assert dict(source_rows(totals))["quantity"] == "shares of the incident flux"
    assert len(totals_picture(totals).axes[0].get_xticks()) == 10
    both = fits.Totals.of([8.0, 60.0], reflectance=np.full((2, 2), 0.4), transmittance=np.full((2, 2), 0.3))
    picture = totals_picture(both, SimpleNamespace(predicted=both.values))
    words = {text.get_text() for text in picture.legends[0].get_texts()}
    assert words == {f"{what} at {angle}°" for what in ("measured", "fit") for angle in (8, 60)}
    first, second = (
        {line.get_color() for line in axes.lines if "fit" in str(line.get_label())} for axes in picture.axes
    )
    assert first == second
    assert len(first) == 2
