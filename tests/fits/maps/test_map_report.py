"""The report of a map: numbers, tables, sentences and pictures are those of the arrays; its page is one whole file."""

import os
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
import zarr
from matplotlib.colors import LogNorm

import fits
from fits.maps import report
from fits.maps.report import summarise, verdict
from fits.maps.store import FLAGS, Store
from tests.helpers.commands import refused
from tests.helpers.painted_maps import ATTRIBUTES, GOOD, NAMES, bounded, numbers, stored, without

SHAPE, CHUNK = (20, 30), (10, 10)
PLACES = np.arange(600).reshape(SHAPE)
RATIO = numbers(SHAPE)["reduced_chi_square"]
FULL = 8  # pictures of a map of three parameters: two of each, flags, chi-square
PRIOR = {"kind": "gaussian", "scale": dict.fromkeys(NAMES, 0.05)}
SMOOTHING = {"prior": PRIOR, "rounds": 3, "settled": False, "largest_moves": [3.0, 0.5]}
ROUNDS = "base.albedo 0.05), in 3 rounds; "


@pytest.fixture(scope="module")
def painted():
    """600 texels: 29 masked, 20 with too few measurements, 10 failed, 25 at a bound, 12 poor, 4 not converged."""
    arrays = numbers(SHAPE)
    row, column = np.mgrid[:20, :30]
    without(arrays, row == 0, "masked")
    without(arrays, column == 0, "too_few_measurements")  # the masked one in the corner as well
    without(arrays, (row == 19) & (column >= 20), "failed")
    bounded(arrays, (row == 5) & (column >= 5), 1)
    poor = (row == 10) & (column >= 18)
    arrays["reduced_chi_square"][poor] = 7.0 + column[poor]
    arrays["flags"][poor] |= FLAGS["poor"]
    arrays["flags"][(row == 12) & (column >= 26)] &= ~np.uint16(FLAGS["converged"])
    arrays[f"errors/{NAMES[0]}"][1, 1:4] = np.inf
    return arrays


@pytest.fixture(scope="module")
def map(painted, tmp_path_factory):
    return stored(tmp_path_factory.mktemp("map") / "<coat> & co.zarr", painted, CHUNK, numerical={"error": 0.025})


def test_counts_quartiles_and_the_verdict_are_those_of_the_arrays(map, painted):
    numbers, fitted = summarise(map), np.isfinite(painted["reduced_chi_square"])
    counts = {"fitted": 541, "converged": 537, "at_bound": 25, "poor": 12, "restarted": 0, "masked": 29, "failed": 10}
    assert numbers.counts == counts | {"too_few_measurements": 20, "unidentified": 0}
    assert (numbers.texels, numbers.done, numbers.converged) == (600, 600, 537 / 541)
    assert numbers.at_bound == {NAMES[0]: 0, NAMES[1]: 25, NAMES[2]: 0}
    for path in (f"{group}/{name}" for name in NAMES for group in ("values", "errors")):
        each = painted[path][fitted]
        assert numbers.quartiles[path] == pytest.approx(np.percentile(each[np.isfinite(each)], (25, 50, 75)))
    middle = {row[0]: row for row in report.quartile_table(numbers, map).rows}
    assert [middle[name][-1] for name in NAMES] == ["0 %", "4.62 %", "0 %"]  # at a bound
    assert float(middle["base.albedo"][2]) == pytest.approx(np.median(painted["values/base.albedo"][fitted]), rel=1e-3)
    root = ET.fromstring(f"<div>{map._repr_html_()}</div>")  # of a notebook
    shown = {row[0].text: [cell.text for cell in row] for row in root.iter("tr")}
    assert tuple(shown["base.albedo"]) == middle["base.albedo"]
    assert [report.share(part, 100_000) for part in (100_000, 99_999, 1)] == ["100 %", "99.99 %", "< 0.01 %"]
    sentences, sound = verdict(numbers, map)
    assert not sound  # 10 of 551 failed
    words = " ".join(sentences)
    for sentence in (
        "A map of 600 texels: 541 are fitted, 29 masked, 20 with too few measurements, 10 failed.",
        "99.26 % of the fitted texels converged.",
        "4.62 % of the fitted texels are at a bound.",
        "2.21 % of the fitted texels are poor: chi-square is above 1.6, more than noise",
        "The numerical error of the model is at most 0.025 standard deviations in the pilot.",
    ):
        assert sentence in words


def changed(**arrays):
    made = numbers(SHAPE)
    for name, array in arrays.items():
        made[name][...] = array
    return made


def flagged(texels, flag, ratio=RATIO):
    """So many texels with this flag and this chi-square."""
    where = texels > PLACES
    return changed(flags=np.where(where, flag, GOOD), reduced_chi_square=np.where(where, ratio, RATIO))


SCALED = {factor: changed(reduced_chi_square=factor * RATIO) for factor in (0.3, 1.7)}
LARGE = ATTRIBUTES["pilot"] | {"poor_above": 1.5e8}
OFF = {
    "layers[0].ior": {"value": 1.5, "error": 0.1, "unit": "1", "converged": False},
    "layers[0].thickness_mm": {"value": 2.0, "error": np.inf, "unit": "mm", "converged": False},
}
LEAVE = GOOD | FLAGS["unidentified"]


@pytest.mark.parametrize(
    ("arrays", "more", "sound", "sentences"),
    [
        (numbers(SHAPE), {}, True, ["100 % of the fitted texels converged"]),
        # sqrt(2 / 61) is 0.18: 1.7 and 0.3 are four of them away
        (SCALED[1.7], {}, False, ["does not explain the data to within their noise"]),
        (SCALED[0.3], {}, False, ["scatter less than the stated noise"]),
        (SCALED[0.3], {"noise_assumed": True}, False, ["No noise is stated: 5 %", "less than the assumed noise"]),
        (SCALED[1.7], {"options": {"chi_square_sigmas": 5.0}}, True, []),
        # where nothing explains the chi-squares, no texel is said to be good
        (flagged(100, GOOD, 1e8), {"pilot": LARGE}, False, []),
        (flagged(100, GOOD | FLAGS["poor"], 1e8), {}, False, ["16.66 % of the fitted texels are poor"]),
        (changed(reduced_chi_square=np.nan), {}, False, ["No texel has a chi-square: there are no more measurements"]),
        (flagged(30, LEAVE), {}, True, ["of the fitted texels have a parameter that the data leave unidentified"]),
        (flagged(31, LEAVE), {}, False, ["of the fitted texels have a parameter that the data leave unidentified"]),
        (numbers(SHAPE), {"common": OFF}, False, ["joint fit of common parameters has not converged", "mm, common"]),
        (numbers(SHAPE), {"numerical": {"error": 0.2}}, False, ["0.2 standard deviations in the pilot: a finer"]),
        (numbers(SHAPE), {"chunks": 2}, False, ["The map is not finished: 200 of 600 texels (33.33 %) are done"]),
        (changed(measurements=12, reduced_chi_square=1.0), {}, True, [f"1 ± {np.sqrt(2 / 9):.2g}"]),
    ],
)
def test_the_verdict_is_a_matter_of_its_thresholds(arrays, more, sound, sentences, tmp_path):
    map = stored(tmp_path / "a.zarr", arrays, CHUNK, **more)
    words, is_sound = verdict(summarise(map), map)
    assert (is_sound, [one for one in sentences if one not in " ".join(words)]) == (sound, [])
    if more.get("common") is OFF:
        rows = (("layers[0].ior", "1.50", "0.10", "1"), ("layers[0].thickness_mm", "2", "unknown", "mm"))
        assert report.common_table(map).rows == rows


@pytest.mark.parametrize(
    ("state", "count", "words"),
    [
        ("whole", FULL, ["A map of 600 texels: 541 are fitted, 29 masked", "Goodness of fit"]),
        ("empty", 1, ["No texel is fitted."]),
        ("smoothed", FULL + 6, [ROUNDS, "at most 0.5 ", ": it has not settled", "Slice [2] of 5."]),
    ],
)
def test_maps_in_every_state_are_reported_as_one_whole_file(state, count, words, painted, tmp_path):
    arrays, chunk = (numbers((5, 4, 4)), (5, 4, 4)) if state == "smoothed" else (painted, CHUNK)
    map = stored(tmp_path / "<coat> & co.zarr", arrays, chunk, chunks=0 if state == "empty" else None)
    if state == "smoothed":
        groups = {name: map[name][:] for name in map.arrays if "/" in name}
        Store(map.path).save_group("smoothed", groups, {"smoothing": SMOOTHING, "finished": True})
    fits.report(map, path=tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    captions = re.findall(r'<img alt="([^"]*)" src="data:image/png;base64,[^"]{1000,}">', text)
    assert len(captions) == text.count("<img ") == count  # all pictures are inside
    for name in NAMES if count > 1 else ():
        place, error = next(k for k, one in enumerate(captions) if name in one), f"Standard error of {name}"
        expected = [f"{name}, over the map.", f"{error}, over the map."]
        expected += [f"{one}, with a spatial prior." for one in (name, error) if state == "smoothed"]
        assert [one.partition(" Slice")[0] for one in captions[place : place + len(expected)]] == expected
    body = text[text.index("<body>") : text.index("</html>")]
    ET.fromstring(re.sub(r"(<img [^>]*[^/])>", r"\1/>", body))  # it is well formed
    text = re.sub(r"base64,[^\"]*", "", text)
    assert "http" not in text
    made = ("Noise(relative=0.02)", "poor above 1.6", "kind = &quot;Medium&quot;")
    common = 'layers[0].f0</td><td class="number">0.04321</td><td class="number">0.00012'
    for one in ("Map of &lt;coat&gt; &amp; co.zarr", *made, *([common] if count > 1 else []), *words):
        assert one in text, one


def test_the_command_writes_the_page_beside_the_store_or_says_why_not(tmp_path, capsys, layerjax, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arrays = numbers((4, 4))
    without(arrays, np.ones((4, 4), bool), "masked")  # one picture only
    map = stored(tmp_path / "a.zarr", arrays, (2, 2))
    with pytest.raises(ValueError, match="reported by itself"):
        fits.report(map, path=tmp_path / "a.html", others={"b": map})
    output = layerjax("report a.zarr").out
    assert "No texel is fitted." in output
    assert "Report: a.html" in output
    layerjax("report a.zarr/ --out b.html")
    assert (tmp_path / "b.html").read_bytes() == (tmp_path / "a.html").read_bytes()
    zarr.create_group(tmp_path / "other.zarr")
    os.truncate(map.path / "flags" / "c" / "0" / "1", 3)
    for words, message in (
        ("a.zarr", "exists already (--force, or force=True, overwrites it)"),
        ("a.zarr --force", "flags: damaged, "),
        ("a.zarr --compare b", "is not compared"),
        ("a.zarr --out none/a.html", "no directory none"),
        ("other.zarr", "is no store of a fitted map"),
    ):
        assert message in refused(["report", *words.split()], capsys, tmp_path)


def test_an_image_is_the_map_with_row_0_on_top_in_colours_over_the_middle_or_of_the_gravest_flag():
    values = np.arange(12.0).reshape(3, 4)
    values[0, 1], values[2, 2] = np.nan, np.inf
    figure = report.value_picture(values, "a", "mm", "viridis", report.inner_norm(values))
    shown = np.ma.filled(np.ma.asarray(figure.axes[0].images[-1].get_array(), float), np.nan)
    np.testing.assert_array_equal(shown, np.where(np.isfinite(values), values, np.nan))
    assert (figure.axes[0].get_ylim(), figure.axes[1].get_ylabel()) == ((2.5, -0.5), "mm")
    norm = report.inner_norm(np.concatenate([np.linspace(1.0, 2.0, 999), [1e9, np.nan, np.inf]]))
    assert (norm.vmin, norm.vmax) == (pytest.approx(1.0, abs=0.02), pytest.approx(2.0, abs=0.02))
    assert isinstance(report.inner_norm(np.geomspace(1e-3, 1.0, 100)), LogNorm)
    for each in ([], [np.nan], [0.0, 0.0], [-2.0, -2.0]):
        norm = report.inner_norm(np.array(each))
        assert norm.vmin < norm.vmax
    names = ["", "masked", "too_few_measurements", "failed restarted", "fitted poor", "fitted converged poor at_bound"]
    names += ["fitted converged " + one for one in ("unidentified at_bound", "at_bound restarted", "restarted", "")]
    figure = report.flag_picture(np.array([sum(FLAGS[one] for one in each.split()) for each in names], np.uint16))
    np.testing.assert_array_equal(figure.axes[0].images[0].get_array(), [np.arange(10)])
