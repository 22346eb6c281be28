"""The report says what was fitted and how far to trust it; its pictures show what is there."""

import io
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

import layerjax as lj
from fits import Fit, Free, Measurements, Noise, fit, report, slices
from fits.data.measurements import Source
from fits.data.scans import in_plane, signed_angle
from fits.reports import tables
from fits.reports.html import FitReport
from fits.reports.plots import data as pictures
from fits.reports.tables import Table, degrees, print_table, with_error
from fits.reports.verdicts import standardised
from tests.helpers.models import along


def test_masked_rows_have_no_residual(coat_fit: Fit) -> None:
    residuals = standardised(coat_fit)
    assert np.isnan(residuals[-10:]).all()
    assert np.isfinite(residuals[:-10]).all()
    label, count, _, rms = tables.incidence_table(coat_fit).rows[-1]
    assert (label, int(count)) == ("all", len(residuals) - 10)
    assert float(rms) ** 2 * int(count) == pytest.approx(coat_fit.chi_square, rel=0.02)


def test_the_report_holds_everything(coat_fit: Fit, tmp_path: Path) -> None:
    strange = Source("<coat> & paint.csv", "csv", "brdf_cos", ("a note",), "Somebody's laboratory")
    named = replace(coat_fit, problem=replace(coat_fit.problem, data=replace(coat_fit.problem.data, source=strange)))
    path = tmp_path / "report.html"
    report(named, path=path, others={"the other": coat_fit})
    text = path.read_text()
    words = ["&lt;coat&gt; &amp; paint.csv", "brdf_cos", "a note", "Somebody&#x27;s laboratory", "10 masked"]
    words += ["layers[0].thickness", "base.albedo", "optical depth", "reduced chi-square", "condition number", "jax "]
    words += ["Not sampled", "Comparison", "the other", "starts", "kind = &quot;Lambertian&quot;"]
    for word in words:
        assert word in text, word
    assert "<coat>" not in text
    pictured = re.findall(r'src="([^"]{30})', text)
    assert len(pictured) == 3  # curves, maps, comparison
    (correlation,) = re.findall(r"<td>base.albedo \(2\)</td><td class=.number.>([-+.\d]+)", text)
    assert float(correlation) == pytest.approx(coat_fit.correlation[1, 0], abs=0.005)
    assert all(start.startswith("data:image/png;base64,") for start in pictured)
    assert "http" not in re.sub(r"base64,[^\"]*", "", text)
    with pytest.raises(ValueError, match="exists"):  # it replaces an earlier one only by force
        report(coat_fit, path=path, force=False)
    assert path.read_text() == text


def test_the_report_begins_with_the_verdict_and_lists_the_incidences_that_were_fitted(
    coat_fit: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = coat_fit.problem.data
    kept = data.where(np.isclose(data.theta_i, 10.0), "held out: incidence=50")
    part = FitReport(replace(coat_fit, problem=replace(coat_fit.problem, data=kept)))
    monkeypatch.setattr("fits.reports.html.image", lambda *_: "")
    text = part.page()
    assert "<td>incidence</td><td>10°</td>" in text
    heads = re.findall("<h2>(.*?)</h2>", text)
    assert heads == ["Values", "Data and model", "Diagnostics", "Identifiability", "Posterior"]
    assert text.index('class="verdict') < text.index("<h2>")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def printed(table: Table, width: int, patch: pytest.MonkeyPatch) -> str:
    """What a terminal of that width shows, without its colours."""
    for name, value in {"COLUMNS": str(width), "LINES": "50", "TERM": "xterm"}.items():
        patch.setenv(name, value)
    terminal = Terminal()
    print_table(table, terminal)
    return re.sub(r"\x1b\[[0-9;]*m", "", terminal.getvalue())


def test_numbers_in_words() -> None:
    """Degrees to two decimals at most, values to two digits of their error."""
    angles = {89.8511: "89.85°", 30.0: "30°", -1e-9: "0°", 55.5: "55.5°", 359.996: "360°"}
    assert [degrees(angle) for angle in angles] == list(angles.values())
    values = {
        (0.53217, 0.0214): ("0.532", "0.021"),
        (1234.567, 12.0): ("1235", "12"),
        (0.5, float("nan")): ("0.5", "unknown"),
        (1e-7, 2.5e-9): ("1e-07", "2.5e-09"),
        (123456.0, 34567.0): ("123456", "34567"),
    }
    assert [with_error(*pair) for pair in values] == list(values.values())


@pytest.mark.parametrize("width", [40, 80, 200])
def test_what_is_too_wide_is_folded_and_never_cut(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = tuple(
        (f"layers[{k}].thickness", f"{1.23456 * 10**k:.4f}", "weakly identified, direction 1") for k in range(3)
    )
    text = printed(Table("Fit", ("parameter", "value", "identifiability"), rows), width, monkeypatch)
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


def test_curves_show_data_model_and_residuals(coat_fit: Fit) -> None:
    figure = pictures.curves_picture({"model": coat_fit})
    assert isinstance(figure, Figure)
    assert len(figure.axes) == 4  # two incidences, each with its residuals
    upper, lower = figure.axes[:2]
    line = next(line for line in upper.lines if line.get_label() == "model")
    data, used = coat_fit.problem.data, coat_fit.problem.data.mask
    rows = np.flatnonzero(used & in_plane(data) & (data.theta_i == 10))
    expected = np.full(len(used), np.nan)
    expected[used] = coat_fit.predicted[:, 0]
    # the angles of the data are points of the curve
    np.testing.assert_allclose(np.interp(signed_angle(data)[rows], *line.get_data()), expected[rows], rtol=1e-6)
    drawn = np.concatenate([np.asarray(line.get_ydata()) for line in lower.lines if len(line.get_xdata()) > 2])
    assert np.nanmax(np.abs(drawn)) <= np.abs(coat_fit.residuals).max() + 1e-12


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
