"""Reports, notebooks and pictures say what was fitted and how far to trust it, and show what is there."""

import io
import re
import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import equinox as eqx
import numpy as np
import pytest
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

import fits
import layerjax as lj
from fits import Free, Noise, Sphere, Spheres, Totals, fit, load_fit, read, report, save_fit, slices
from fits.data.measurements import Source
from fits.data.scans import in_plane
from fits.reports import tables
from fits.reports.data_summary import data_statements, data_table, energies, reciprocity, repeats, sides, source_rows
from fits.reports.plots import data as pictures
from fits.reports.render import SKY, SUN, _sky, render, sphere, to_screen
from fits.reports.tables import Table, degrees, print_table, with_error
from fits.reports.verdicts import standardised
from tests.helpers.commands import refused
from tests.helpers.data_files import written
from tests.helpers.models import LINE, along, line, line_data
from tests.helpers.refusals import refuses

SPHERES = Spheres(Sphere(100.0, 20.0, 5.0, 8.0, 0.95), Sphere(90.0, 20.0, wall=0.97), 0.98, True)
A, B = "['a']", "['b']"
ANGLES = [10.0, 30.0, 50.0, 70.0]
HEMISPHERE = fits.slices(ANGLES, np.arange(-85.0, 86.0, 5.0), np.arange(0.0, 180.0, 10.0))
SCANS = fits.slices(ANGLES)
SIGNED = np.degrees(np.arctan2(SCANS.wo[:, 0], SCANS.wo[:, 2]))
WHITE = lj.Stack([], lj.Lambertian(1.0))
SINGLE = lj.SingleScattering()
SHEET = pytest.param(lj.Stack([lj.Medium(0.7, 0.9)]), True, marks=pytest.mark.slow)


def test_masked_rows_have_no_residual(coat_fit):
    residuals = standardised(coat_fit)
    assert np.isnan(residuals[-10:]).all()
    assert np.isfinite(residuals[:-10]).all()
    label, count, _, rms = tables.incidence_table(coat_fit).rows[-1]
    assert (label, int(count)) == ("all", len(residuals) - 10)
    assert float(rms) ** 2 * int(count) == pytest.approx(coat_fit.chi_square, rel=0.02)


def test_the_report_holds_everything(coat_fit, tmp_path):
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


def test_numbers_in_words():
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
def test_what_is_too_wide_is_folded_and_never_cut(width, monkeypatch):
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


def test_a_grey_stack_is_drawn_in_all_channels(coat_data):
    values = np.repeat(coat_data.values, 3, axis=1)
    data = replace(coat_data, values=values, sigma=None, channels=("red", "green", "blue"))
    stack = lj.Stack([lj.Medium(0.6, 0.8)], lj.Lambertian(Free(0.5, 0.0, 1.0)))
    grey = fit(stack, data, transport=lj.SingleScattering(), noise=Noise(relative=0.03), starts=1)
    assert grey.predicted.shape == data.used().values.shape
    figure = pictures.curves_picture({"grey": grey})
    assert isinstance(figure, Figure)
    assert sum(len(line.get_xdata()) > 100 for line in figure.axes[0].lines) == 3


def test_maps_only_where_data_leaves_the_plane_and_logarithms_where_the_range_is_wide(coat_fit):
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
    for values, wide in (([0, 0.01, 0.2], True), ([0, 0.1, 0.2], False), ([0], False)):
        assert isinstance(pictures.value_norm(np.array(values)), LogNorm) == wide


def test_a_fit_by_spheres_is_kept_and_reported(tmp_path):
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


def test_on_the_command_line(work, capsys, layerjax):
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


def test_many_channels_have_a_range_and_an_angle_has_one_colour():
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


def rows(html):
    """Words of the cells of all tables, row by row, of a fragment that must be well-formed."""
    return [["".join(cell.itertext()) for cell in row] for row in ET.fromstring(f"<div>{html}</div>").iter("tr")]


def text(html):
    return "".join(ET.fromstring(f"<div>{html}</div>").itertext())


def chain(fit, converged):
    """Independent draws about the best values: 500 steps of 8 walkers."""
    steps = fit.vector + fit.errors * np.random.default_rng(0).standard_normal((500, 8, len(fit.vector)))
    return fits.Posterior(fit, steps, np.zeros((500, 8)), np.ones(len(fit.vector)), acceptance=0.4, converged=converged)


def test_a_fit_is_its_verdict_its_values_and_what_is_not_identified(result):
    direction = fits.Direction(float("inf"), {A: 0.8, B: -0.6}, {A: 0.1, B: 0.2})
    case = replace(result, at_bound=(A,), errors=np.array([np.nan, 0.1]), unidentified=(direction,))
    head, first, second, *more = rows(case._repr_html_())
    assert head == ["parameter", "value", "error", "unit", "bounds", "identifiability"]
    assert [float(row[1]) for row in (first, second)] == pytest.approx(list(result.values.values()), rel=0.01)
    assert (first[2], float(second[2]), first[4]) == ("unknown", 0.1, "-1 to 3")
    assert any(row[2:4] == ["unidentified", f"+0.8 {A}, -0.6 {B}"] for row in more)
    words = text(case._repr_html_())
    assert f"{A} and {B} are not identified separately; {A} is at a bound." in words
    assert f"reduced chi-square {result.reduced_chi_square:.3g}" in words


def test_a_posterior_has_estimates_only_if_its_chain_is_long_enough(result):
    long, short = chain(result, True)._repr_html_(), chain(result, False)._repr_html_()
    head, *found = rows(long)
    assert head[:2] == ["parameter", "median"]
    assert "unit" in head
    assert {row[0]: float(row[1]) for row in found} == pytest.approx(result.values, abs=0.1 * result.errors.min())
    assert "8 walkers made 500 steps" in text(long)
    assert rows(short) == []
    assert "it gives no estimates yet" in text(short)


def test_joint_fits_and_comparisons_are_shown_and_names_are_no_html(result):
    problems = dict.fromkeys(["<b>first</b>", "second"], fits.Problem(LINE, line_data(), line))
    shown = fits.fit(fits.Joint(problems, shared=[A]), starts=1)._repr_html_()
    assert "<b>" not in shown
    assert [head.text for head in ET.fromstring(f"<div>{shown}</div>").iter("h4")] == list(problems)
    assert sum(row[0] == B for row in rows(shown)) == 2
    flat = fits.fit(LINE | {"b": 0.0}, line_data(), transport=line, starts=1)
    shown = fits.compare({"sloped <line>": result, "flat": flat})._repr_html_()
    assert [row[0] for row in rows(shown)] == ["fit", "sloped <line>", "flat"]
    assert "prefer sloped <line>" in text(shown)


def test_words_are_short_and_on_one_line(result, coat_data):
    words = f"{len(coat_data)} data points, 10 of them masked, of value, from simulated data"
    assert repr(coat_data) == f"<Measurements: {words}>"
    assert repr(fits.slices(incidence=[10, 30], outgoing=[0, 20])) == "<Geometry: 4 pairs of directions>"
    assert repr(result).startswith(f"<Fit to 100 measurements: ['a'] {result.vector[0]:.4g} ± ")
    assert repr(chain(result, True)) == "<Posterior of ['a'], ['b']: 500 steps of 8 walkers, converged>"


def seen(values, geometry=HEMISPHERE):
    return along(geometry, np.broadcast_to(values, len(geometry))[:, None])


def statement(data, of):
    return " ".join(words for words in data_statements(data) if words.startswith(f"{of}:"))


def test_how_far_measurements_are_from_reciprocal():
    between = np.sum(HEMISPHERE.wi * HEMISPHERE.wo, axis=1)
    together = np.cos(np.radians(HEMISPHERE.theta_i + HEMISPHERE.theta_o))
    found = reciprocity(seen(0.1 + 0.01 * together + 0.02 * between))
    assert found.number == 6 * 36  # of each two incidences a pair at every azimuth in steps of 10
    assert found.p95 < 1e-9
    # a factor of 1 + a theta_i: pairs differ by a (i - o) over their mean
    found = reciprocity(seen(1.0 + 0.001 * HEMISPHERE.theta_i))
    low, high = 1.0 + 0.001 * np.array(list(combinations(ANGLES, 2))).T
    assert found.median == pytest.approx(np.median((high - low) / (0.5 * (low + high))), rel=1e-6)


def test_energy_is_the_integral():
    """Of a Lambertian surface its albedo over what is covered: up to 85 degrees, sin^2 of it."""
    half = fits.slices([30.0], np.arange(0.0, 86.0, 5.0), np.arange(0.0, 181.0, 10.0))
    too_much = seen(1.2 / np.pi, half)  # the other half is its mirror image
    for one in (*energies(seen(1.2 / np.pi)), *energies(too_much)):
        assert one.covered == pytest.approx(np.sin(np.radians(85.0)) ** 2, rel=0.01)
        assert one.share[0] == pytest.approx(1.2 * one.covered, rel=1e-6)
    assert energies(seen(1.0, SCANS)) == []
    assert "It exceeds 1 at 30°" in statement(too_much, "Energy")


def test_repeats_tell_the_noise():
    once = seen(1.0)
    assert repeats(once) is None
    noise = 1.0 + 0.02 * np.random.default_rng(0).standard_normal((2, len(once), 1))
    both = {name: np.concatenate([getattr(once, name)] * 2) for name in ("wi", "wo", "mask")}
    found = repeats(twice := replace(once, values=np.concatenate(noise), **both))
    assert found.number == len(once)
    # the median of |x - y| is 0.6745 sqrt(2) sigma, known to some percent
    assert found.median == pytest.approx(0.6745 * np.sqrt(2.0) * 0.02, rel=0.1)
    assert "a noise of about 2" in data_statements(twice)[-1]


def test_a_peak_on_the_side_of_the_light_is_told_of():
    """Azimuths that count from the mirror direction: what is read is mirrored."""
    peaks = ((SIGNED - sign * SCANS.theta_i) / 8.0 for sign in (1, -1))
    right, turned = (seen(0.05 + np.exp(-(peak**2)), SCANS) for peak in peaks)
    assert "the brightest side is the light's: at 10° up to 1.05 there" in statement(turned, "Sides")
    assert "phi_o = phi_i + 180" in statement(turned, "Sides")
    one_side = turned.where(SIGNED < 1.0).used()
    assert "all measurements in the plane of incidence lie on the light's side" in statement(one_side, "Sides")
    assert statement(right.where(SIGNED > -1.0).used(), "Sides") == statement(right, "Sides") == ""
    assert not len(sides(turned.where((SIGNED > -6.0) & (np.abs(SIGNED - 8.0) > 8.0)).used()))  # nothing to compare


def test_angles_in_radians_are_asked_about(tmp_path):
    said = "Angles: none is above {}: are they radians? They were read as degrees."
    for text, expected in (
        ("theta_i,theta_o,brdf\n0.5236,0.7854,1\n0.5236,-1.4,1\n", said.format("1.4°")),
        ("theta_i,total_reflectance\n0.1396,0.3\n", said.format("0.1396°")),
        ("theta_i,theta_o,brdf\n0,0,1\n", ""),
        ("theta_i,theta_o,brdf\n0,2,1\n", ""),
    ):
        assert statement(read(written(tmp_path, text, "data.csv")), "Angles") == expected


def test_a_white_sphere_shows_the_cosine() -> None:
    """The pixel in the middle, lit from the viewer and from 60 degrees; a pixel is flat to 1e-3."""
    for light, cosine in (((0.0, 0.0, 1.0), 1.0), ((np.sqrt(0.75), 0.0, 0.5), 0.5)):
        picture = to_screen(sphere(WHITE, lj.prepare(WHITE, SINGLE), light, 65))
        np.testing.assert_allclose(picture[32, 32], to_screen(np.asarray(SUN * cosine + SKY)), atol=2e-3)
    np.testing.assert_allclose(picture[0, 0], to_screen(np.asarray(SKY)))  # beside the sphere


def test_what_loses_nothing_cannot_be_seen_under_a_sky() -> None:
    """A lossless haze returns the sky; 1e-3 for the angles between those of the table."""
    haze = lj.Stack([lj.Medium(1.0, 1.0, lj.HenyeyGreenstein(0.5))])
    solved = lj.prepare(haze, lj.AddingDoubling(nodes=12, modes=8))
    wo = np.asarray(lj.direction(np.radians([0.0, 20.0, 50.0, 80.0]), 1.0))
    np.testing.assert_allclose(_sky(haze, solved, wo), 1.0, atol=1e-3)


@pytest.mark.parametrize(("stack", "behind"), [(WHITE, False), SHEET])
def test_only_a_sheet_is_seen_from_behind(stack: lj.Stack, behind: bool) -> None:
    titles = [axes.get_title(loc="left") for axes in render(stack, SINGLE, size=16).axes]
    assert "lit from the front" in titles
    for title in ("from behind", "BSDF in the plane of incidence, transmitted"):
        assert (title in titles) == behind


def test_bad_arguments_are_named() -> None:
    for size in (4, 1025, 100_000):
        refuses(rf"size: {size} is not a whole number from 16 to 1024", render, WHITE, SINGLE, size=size)
    with pytest.raises(ValueError, match=r"layers: the stack ends in a medium of index 1\.5, .* Interface of ior 1"):
        render(lj.Stack([lj.Interface(1.5, 0.2)]), size=16)
    refuses("transport: RandomWalk is random", render, WHITE, lj.RandomWalk(), size=16)


def test_the_command_draws_files_and_the_best_of_a_fit(work, layerjax, coat_fit, monkeypatch) -> None:
    layerjax("render coat.toml --out haze.png --size 16")
    assert (work / "haze.png").read_bytes().startswith(b"\x89PNG")
    save_fit(coat_fit, "result")
    drawn = []
    monkeypatch.setattr("fits.reports.render.render", lambda *given, **_: drawn.append(given) or Figure())
    layerjax("render result --out coat.png")
    assert (work / "coat.png").exists()
    ((stack, transport),) = drawn
    assert eqx.tree_equal(stack, coat_fit.stack, rtol=1e-12)
    assert transport == coat_fit.problem.transport
