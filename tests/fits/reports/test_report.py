"""The report says what was fitted and how far to trust it; its pictures show what is there."""

import io
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

import layerjax as lj
from fits import Fit, Free, Measurements, Noise, Sphere, Spheres, Totals, fit, load_fit, read, report, save_fit, slices
from fits.data.measurements import Source
from fits.data.scans import in_plane
from fits.reports import tables
from fits.reports.data_summary import data_table, source_rows
from fits.reports.plots import data as pictures
from fits.reports.tables import Table, degrees, print_table, with_error
from fits.reports.verdicts import standardised
from tests.helpers.commands import refused
from tests.helpers.models import along


def test_masked_rows_have_no_residual(coat_fit: Fit) -> None:
    residuals = standardised(coat_fit)
    assert np.isnan(residuals[-10:]).all()
    assert np.isfinite(residuals[:-10]).all()
    label, count, _, rms = tables.incidence_table(coat_fit).rows[-1]
    assert (label, int(count)) == ("all", len(residuals) - 10)
    assert float(rms) ** 2 * int(count) == pytest.approx(coat_fit.chi_square, rel=0.02)


def test_the_report_holds_everything(coat_fit: Fit, tmp_path: Path) -> None:
    """The verdict first, and of the incidences those that were fitted."""
    strange = Source("<coat> & paint.csv", "csv", "brdf_cos", ("a note",), "Somebody's laboratory")
    kept = replace(coat_fit.problem.data, source=strange)
    kept = kept.where(np.isclose(kept.theta_i, 10.0), "held out: incidence=50")
    named = replace(coat_fit, problem=replace(coat_fit.problem, data=kept))
    path = tmp_path / "report.html"
    report(named, path=path, others={"the other": named})
    text = path.read_text()
    words = ["&lt;coat&gt; &amp; paint.csv", "brdf_cos", "a note", "Somebody&#x27;s laboratory", " masked"]
    words += ["layers[0].thickness", "base.albedo", "optical depth", "reduced chi-square", "condition number", "jax "]
    words += ["Not sampled", "the other", "starts", "kind = &quot;Lambertian&quot;", "<td>incidence</td><td>10°</td>"]
    for word in words:
        assert word in text, word
    assert "<coat>" not in text
    heads = ["Values", "Data and model", "Diagnostics", "Identifiability", "Posterior", "Comparison"]
    assert re.findall("<h2>(.*?)</h2>", text) == heads
    assert text.index('class="verdict') < text.index("<h2>")
    pictured = re.findall(r'src="([^"]{30})', text)
    assert len(pictured) == 3  # curves, maps, comparison
    (correlation,) = re.findall(r"<td>base.albedo \(2\)</td><td class=.number.>([-+.\d]+)", text)
    assert float(correlation) == pytest.approx(coat_fit.correlation[1, 0], abs=0.005)
    assert all(start.startswith("data:image/png;base64,") for start in pictured)
    assert "http" not in re.sub(r"base64,[^\"]*", "", text)
    with pytest.raises(ValueError, match="exists"):  # it replaces an earlier one only by force
        report(coat_fit, path=path, force=False)
    assert path.read_text() == text


def test_numbers_in_words() -> None:
    """Degrees to two decimals at most, values to two digits of their error."""
    angles = {89.8511: "89.85°", 30.0: "30°", -1e-9: "0°", 55.5: "55.5°", 359.996: "360°"}
    assert [degrees(angle) for angle in angles] == list(angles.values())
    values = {
        (0.53217, 0.0214): ("0.532", "0.021"),
        (1234.567, 12.0): ("1235", "12"),
        (0.5, np.nan): ("0.5", "unknown"),
    }
    values |= {(1e-7, 2.5e-9): ("1e-07", "2.5e-09"), (123456.0, 34567.0): ("123456", "34567")}
    assert [with_error(*pair) for pair in values] == list(values.values())


@pytest.mark.parametrize("width", [40, 80, 200])
def test_what_is_too_wide_is_folded_and_never_cut(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = tuple((f"layers[{k}].thickness", "1.2346", "weakly identified, direction 1") for k in range(3))
    for name, value in {"COLUMNS": str(width), "LINES": "50", "TERM": "xterm"}.items():
        monkeypatch.setenv(name, value)
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    print_table(Table("Fit", ("parameter", "value", "identifiability"), rows), terminal)
    text = re.sub(r"\x1b\[[0-9;]*m", "", terminal.getvalue())  # without its colours
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    assert Counter("".join("".join(row).replace(" ", "") for row in rows)) <= Counter(text)


def test_a_grey_stack_is_drawn_in_all_channels(coat_data: Measurements) -> None:
    values = np.repeat(coat_data.values, 3, axis=1)
    data = replace(coat_data, values=values, sigma=None, channels=("red", "green", "blue"))
    stack = lj.Stack([lj.Medium(0.6, 0.8)], lj.Lambertian(Free(0.5, 0.0, 1.0)))
    grey = fit(stack, data, transport=lj.SingleScattering(), noise=Noise(relative=0.03), starts=1)
    assert grey.predicted.shape == data.used().values.shape
    figure = pictures.curves_picture({"grey": grey})
    assert isinstance(figure, Figure)
    assert sum(len(line.get_xdata()) > 100 for line in figure.axes[0].lines) == 3


def test_maps_only_where_data_leaves_the_plane(coat_fit: Fit) -> None:
    data = coat_fit.problem.data
    assert isinstance(pictures.maps_picture(coat_fit), Figure)
    assert len(pictures.data_picture(data).axes) == 4  # curves, two maps and their colour bar
    kept = in_plane(data)
    only = replace(data, wi=data.wi[kept], wo=data.wo[kept], values=data.values[kept], sigma=None, mask=data.mask[kept])
    assert pictures.maps_picture(replace(coat_fit, problem=replace(coat_fit.problem, data=only))) is None
    assert len(pictures.data_picture(only).axes) == 1
    for azimuth in (60.0, (0.0, 90.0), tuple(range(0, 180, 10))):  # drawn however it lies, and though it is dark
        dark = along(slices(incidence=(0, 40), azimuth=azimuth), 0.0)
        assert pictures.as_png(pictures.data_picture(dark)).startswith(b"\x89PNG")


def test_axes_are_logarithmic_where_the_range_is_wide() -> None:
    for values, wide in (([0, 0.01, 0.2], True), ([0, 0.1, 0.2], False), ([0], False)):
        assert isinstance(pictures.value_norm(np.array(values)), LogNorm) == wide


SPHERES = Spheres(Sphere(100.0, 20.0, 5.0, 8.0, 0.95), Sphere(90.0, 20.0, wall=0.97), 0.98, True)


def test_a_fit_by_spheres_is_kept_and_reported(tmp_path: Path) -> None:
    totals = Totals.of(reflectance=[[0.2, 0.3, 0.25]], transmittance=[[0.4, 0.4, 0.41]], spheres=SPHERES)
    free = lj.Stack([lj.Medium(Free((0.7,) * 3, 0.01, 5.0), Free(0.5, 0.0, 1.0))])
    found = fit(free, totals, transport=lj.SingleScattering(), starts=1)
    save_fit(found, tmp_path / "kept")
    loaded = load_fit(tmp_path / "kept")
    assert loaded.problem.data.spheres == SPHERES
    np.testing.assert_allclose(loaded.predicted, found.predicted, rtol=1e-12)
    report(loaded, path=tmp_path / "report.html")
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
    np.testing.assert_array_equal(read("copy.csv").values, read("totals.csv").values)
    sphere = "200 25 12 1 0.96"
    (work / "slab.rxt").write_text(f"IAD1 1.4 1.5 2.0 1.0 5 0.98 1 {sphere} {sphere} 2 0.3 0.4\n")
    words = ["fit", "totals.csv", "--stack", "coat.toml", "--out", "r"]
    for command, message in (
        ([*words, "--select", "incidence=0"], "--select does not apply"),
        ([*words, "--max-polar-angle", "50"], "--max-polar-angle does not apply"),
        (["info", "totals.csv", "--read", "quantity=brdf_cos"], "'brdf_cos', a totals file holds shares of the light"),
        (["search", "totals.csv", "--out", "r"], "a search needs measurements along directions"),
        (["convert", "slab.rxt", "slab.csv"], "slab.rxt: integrating spheres"),
    ):
        assert message in refused(command, capsys, work)


def test_many_channels_have_a_range_and_an_angle_has_one_colour() -> None:
    names = tuple(f"{nm} nm" for nm in range(400, 700, 10))
    totals = Totals.of(reflectance=np.linspace(0.1, 0.5, 30)[None], channels=names)
    assert data_table(totals).rows == (("reflectance", "0°", "0.1", "0.5"),)
    assert dict(source_rows(totals))["quantity"] == "shares of the incident flux"
    assert len(pictures.totals_picture(totals).axes[0].get_xticks()) == 10
    both = Totals.of([8.0, 60.0], reflectance=np.full((2, 2), 0.4), transmittance=np.full((2, 2), 0.3))
    picture = pictures.totals_picture(both, SimpleNamespace(predicted=both.values))
    words = {text.get_text() for text in picture.legends[0].get_texts()}
    assert words == {f"{what} at {angle}°" for what in ("measured", "fit") for angle in (8, 60)}
    colours = [[line.get_color() for line in axes.lines if "fit" in str(line.get_label())] for axes in picture.axes]
    assert colours[0] == colours[1]
    assert len(set(colours[0])) == 2
