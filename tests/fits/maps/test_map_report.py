"""The report of a map: its numbers, tables and sentences are those of the arrays that were written; its page is one
file, of stores in every state; its pictures show numbers where they are, and grey where there are none."""

import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import zarr
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from scipy import stats

import fits
from fits.cli.parser import main
from fits.maps.report import pictures, tables
from fits.maps.report.tables import summarise
from fits.maps.report.verdicts import verdict
from fits.maps.store import FLAGS, FittedMap, Store
from tests.helpers.commands import refused
from tests.helpers.painted_maps import FREEDOM, GOOD, NAMES, bounded, numbers, stored, without

SHAPE, CHUNK = (20, 30), (10, 10)
FULL = 9
"""Pictures of a map of three parameters: two of each, flags, two of chi-square."""
Found = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def painted() -> Found:
    """600 texels: 30 masked, 20 with too few measurements, 10 failed, 25 at a bound, 12 poor, 4 not converged."""
    found = numbers(SHAPE)
    row, column = np.mgrid[:20, :30]
    without(found, row == 0, "masked")
    without(found, column == 0, "too_few_measurements")  # the masked one in the corner as well
    without(found, (row == 19) & (column >= 20), "failed")
    bounded(found, (row == 5) & (column >= 5), 1)
    poor = (row == 10) & (column >= 18)
    found["reduced_chi_square"][poor] = 7.0 + column[poor]
    found["flags"][poor] |= FLAGS["poor"]
    found["flags"][(row == 12) & (column >= 26)] &= ~np.uint16(FLAGS["converged"])
    found[f"errors/{NAMES[0]}"][1, 1:4] = np.inf
    return found


@pytest.fixture(scope="module")
def map(painted: Found, tmp_path_factory: pytest.TempPathFactory) -> FittedMap:
    return stored(tmp_path_factory.mktemp("map") / "<coat> & co.zarr", painted, CHUNK, numerical={"error": 0.025})


# ---- numbers, tables and sentences ----


def test_counts_and_quartiles_are_those_of_the_arrays(map: FittedMap, painted: Found) -> None:
    found, fitted = summarise(map), np.isfinite(painted["reduced_chi_square"])
    counts = {"fitted": 541, "converged": 537, "at_bound": 25, "poor": 12, "restarted": 0, "masked": 29, "failed": 10}
    assert found.counts == counts | {"too_few_measurements": 20, "unidentified": 0}
    assert (found.texels, found.there, found.converged) == (600, 600, 537 / 541)
    assert found.at_bound == {NAMES[0]: 0, NAMES[1]: 25, NAMES[2]: 0}
    assert found.no_error == {NAMES[0]: 3, NAMES[1]: 25, NAMES[2]: 0}
    for name in NAMES:
        for given, group in ((found.values, "values"), (found.errors, "errors")):
            each = painted[f"{group}/{name}"][fitted]
            assert given[name] == pytest.approx(np.percentile(each[np.isfinite(each)], (25, 50, 75)))
    rows = {row[0]: row[1:] for row in tables.count_table(found).rows}
    assert rows["of the map"] == ("600", "")
    assert rows["converged"] == ("537", "99.3 % of the fitted")
    assert rows["masked"] == ("29", "4.83 %")
    assert rows["at a bound: layers[0].phase.alpha"] == ("25", "4.62 % of the fitted")
    quartiles = tables.quartile_table(found, map)
    middle = {row[0]: row for row in quartiles.rows}
    assert float(middle["base.albedo"][2]) == pytest.approx(np.median(painted["values/base.albedo"][fitted]), rel=1e-3)
    assert middle["layers[0].thickness"][7] == "optical depth"
    assert quartiles.note.startswith("layers[0].thickness has no error in 0.55 % of them. layers[0].phase.alpha has no")
    root = ET.fromstring(f"<div>{map._repr_html_()}</div>")  # of a notebook
    shown = {row[0].text: [cell.text for cell in row] for row in root.iter("tr")}
    assert tuple(shown["base.albedo"]) == middle["base.albedo"]
    assert "A map of 600 texels" in "".join(root.itertext())


def test_the_verdict_says_how_far_to_trust_a_map(map: FittedMap) -> None:
    words, fine = verdict(summarise(map), map)
    assert not fine  # 10 of 551 failed
    assert words[0] == "A map of 600 texels: 541 are fitted, 29 masked, 20 with too few measurements, 10 failed."
    assert words[1] == "99.3 % of the fitted texels converged."
    assert f"1 ± {np.sqrt(2 / FREEDOM):.2g}" in words[2]
    assert "At a bound: 4.62 % of the fitted texels (layers[0].phase.alpha in 4.62 %)." in words
    assert "Poor: 2.22 % of the fitted texels: chi-square is above 1.6, more than noise" in " ".join(words)
    assert words[-1] == "The numerical error of the model is at most 0.025 standard deviations in the pilot."


def changed(**arrays: object) -> Found:
    """A good map but for these arrays."""
    found = numbers(SHAPE)
    for name, array in arrays.items():
        found[name][...] = array
    return found


def scaled(factor: float) -> Found:
    return changed(reduced_chi_square=factor * numbers(SHAPE)["reduced_chi_square"])


def unidentified(texels: int) -> Found:
    return changed(flags=np.where(np.arange(600).reshape(SHAPE) < texels, GOOD | FLAGS["unidentified"], GOOD))


UNFINISHED = (
    "The map is not finished: 200 of 600 texels (33.3 %) are there, and the same command resumes it. Of what is"
)
ONE = {NAMES[0]: {"value": 0.5, "error": 0.1, "unit": "1", "converged": True}}
OFF = {
    "layers[0].ior": {"value": 1.5, "error": 0.1, "unit": "1", "converged": False},
    "layers[0].thickness_mm": {"value": 2.0, "error": np.inf, "unit": "mm", "converged": False},
}


@pytest.mark.parametrize(
    ("found", "more", "fine", "sentences"),
    [
        (numbers(SHAPE), {}, True, ["No texel is at a bound. No texel is poor", "100 % of the fitted texels converge"]),
        # sqrt(2 / 61) is 0.18: 1.7 and 0.3 are four of them away
        (scaled(1.7), {}, False, ["does not explain the data to within their noise", "No texel stands out"]),
        (scaled(0.3), {}, False, ["scatter less than the stated noise", "No texel is poor"]),
        (scaled(1.7), {"options": {"chi_square_sigmas": 5.0}}, True, ["No texel is poor"]),
        (unidentified(30), {}, True, ["of the fitted texels the data leave a parameter unidentified"]),
        (unidentified(31), {}, False, ["of the fitted texels the data leave a parameter unidentified"]),
        (unidentified(31), {"options": {"flagged_share": 0.1}}, True, []),
        (numbers(SHAPE), {"common": OFF}, False, ["joint fit of common parameters has not converged", "mm, common"]),
        (numbers(SHAPE), {"numerical": {"error": 0.2}}, False, ["0.2 standard deviations in the pilot: a finer"]),
        (numbers(SHAPE), {"chunks": 2}, False, [UNFINISHED]),
        # of 12 measurements two are fitted away
        (changed(measurements=12, reduced_chi_square=1.0), {"common": ONE}, True, [f"1 ± {np.sqrt(2 / 10):.2g}"]),
        (changed(measurements=3, reduced_chi_square=np.nan), {}, False, ["no more measurements than parameters"]),
    ],
)
def test_the_verdict_is_a_matter_of_its_thresholds(
    found: Found, more: dict, fine: bool, sentences: list[str], tmp_path: Path
) -> None:
    map = stored(tmp_path / "a.zarr", found, CHUNK, **more)
    words, found_fine = verdict(summarise(map), map)
    assert found_fine == fine
    for sentence in sentences:
        assert sentence in " ".join(words)
    if more.get("common") is OFF:
        rows = (("layers[0].ior", "1.50", "0.10", "1"), ("layers[0].thickness_mm", "2", "unknown", "mm"))
        assert tables.common_table(map).rows == rows


@pytest.mark.parametrize(
    ("part", "whole", "words"),
    [
        *((0, 7, "0 %"), (7, 7, "100 %"), (1, 3, "33.3 %"), (9996, 10000, "99.96 %"), (99999, 100000, "> 99.99 %")),
        *((7, 10000, "0.07 %"), (1, 100000, "< 0.01 %"), (0, 0, "none")),
    ],
)
def test_nearly_all_is_not_said_as_all(part: int, whole: int, words: str) -> None:
    assert tables.share(part, whole) == words


def test_the_worst_texels_come_first_with_their_values_and_flags(
    map: FittedMap, painted: Found, tmp_path: Path
) -> None:
    table = tables.worst_table(map)
    assert [row[0] for row in table.rows] == [f"[10, {column}]" for column in range(29, 17, -1)]
    assert [float(row[1]) for row in table.rows] == [7.0 + column for column in range(29, 17, -1)]
    value, error = (painted[f"{group}/base.albedo"][10, 29] for group in ("values", "errors"))
    written, _, after = table.rows[0][4].partition(" ± ")
    assert float(written) == pytest.approx(value, abs=0.06 * error)
    assert float(after) == pytest.approx(error, rel=0.05)
    assert {row[-1] for row in table.rows} == {"poor"}
    found = numbers((2, 2))
    found["reduced_chi_square"][...] = [[4.0, 3.0], [2.0, np.nan]]
    found["flags"][0, 0] = FLAGS["fitted"] | FLAGS["poor"] | FLAGS["unidentified"]
    bounded(found, np.array([[False, True], [False, False]]), 2)
    table = tables.worst_table(stored(tmp_path / "a.zarr", found, (2, 2)))
    assert [row[0] for row in table.rows] == ["[0, 0]", "[0, 1]", "[1, 0]"]
    assert [row[-1] for row in table.rows] == ["not converged, poor, a parameter is unidentified", "at a bound", ""]
    assert "±" not in table.rows[1][4]


# ---- the page ----


def reported(map: FittedMap, folder: Path) -> tuple[str, list[str]]:
    """The text of a page, and the alternative texts of its pictures, which must all be inside."""
    fits.report(map, path=folder / "report.html")
    text = (folder / "report.html").read_text()
    told = re.findall(r'<img alt="([^"]*)" src="data:image/png;base64,[^"]{1000,}">', text)
    assert len(told) == text.count("<img ")
    return text, told


def test_the_page_is_one_whole_file(map: FittedMap, tmp_path: Path) -> None:
    text, told = reported(map, tmp_path)
    assert len(told) == FULL
    for name in NAMES:
        assert sum(f"{name}, over the map" in words for words in told) == 2
    body = text[text.index("<body>") : text.index("</html>")]
    ET.fromstring(re.sub(r"(<img [^>]*[^/])>", r"\1/>", body))  # it is well formed
    text = re.sub(r"base64,[^\"]*", "", text)
    assert "http" not in text
    assert "<coat>" not in text
    for words in (
        "Map of &lt;coat&gt; &amp; co.zarr",
        "A map of 600 texels: 541 are fitted, 29 masked",
        'layers[0].f0</td><td class="number">0.04321</td><td class="number">0.00012',
        "Noise(relative=0.02)",
        "&quot;poor_above&quot;: 1.6",
        "kind = &quot;Medium&quot;",
        "The worst texels",
        "Made with layerjax",
        'class="verdict"',
    ):
        assert words in text, words


@pytest.mark.parametrize(
    ("state", "count", "words"),
    [
        ("unfinished", FULL, "there so far</td>"),
        ("masked", 1, "No texel is fitted."),
        ("empty", 1, "No texel is fitted."),
        ("one texel", FULL, "A map of 1 texels"),
        ("one axis", FULL, "A map of 30 texels"),
        ("three axes", FULL, "Shown: slice [2] of 5."),
    ],
)
def test_maps_in_every_state_are_reported(state: str, count: int, words: str, painted: Found, tmp_path: Path) -> None:
    shape = {"one texel": (1, 1), "one axis": (30,), "three axes": (5, 8, 9)}.get(state, SHAPE)
    found = painted if state == "unfinished" else numbers(shape)
    if state == "masked":
        without(found, np.ones(shape, bool), "masked")
    chunks = {"unfinished": 2, "empty": 0}.get(state)
    chunk = CHUNK if len(shape) == 2 else shape
    text, told = reported(stored(tmp_path / "a.zarr", found, chunk, chunks=chunks), tmp_path)
    assert len(told) == count
    assert words in text


@pytest.mark.parametrize(
    ("scale", "settled", "said"),
    [
        ({NAMES[0]: 0.1, NAMES[2]: 0.2}, True, f"{NAMES[0]} 0.1, {NAMES[2]} 0.2"),
        (dict.fromkeys(NAMES, 0.05), False, "0.05"),
    ],
)
def test_a_smoothed_map_is_shown_beside_the_plain_one(scale: dict, settled: bool, said: str, tmp_path: Path) -> None:
    map = stored(tmp_path / "a.zarr", numbers((4, 4)), (4, 4))
    arrays = {f"{group}/{name}": map[f"{group}/{name}"][:] for group in ("values", "errors") for name in NAMES}
    about = {"prior": {"kind": "gaussian", "scale": scale}, "rounds": 3, "settled": settled, "finished": True}
    Store(map.path).save_group("smoothed", arrays, about | {"largest_moves": [3.0, 1.0, 0.5]})
    words = tables.smoothing_words(map)
    assert f"(gaussian, of the bounds: {said}), in 3 rounds; in the last one texels moved by at most 0.5" in words
    assert ("it has not settled" in words) != settled
    text, told = reported(map, tmp_path)
    assert words in text
    for name in NAMES:
        place = told.index(f"{name}, over the map.")
        several = (name, f"Standard error of {name}")
        assert told[place + 1 : place + 4] == [
            f"{several[1]}, over the map.", *(f"{one}, with a spatial prior." for one in several)
        ]  # fmt: skip


def test_the_command_writes_the_page_beside_the_store_and_refuses_what_it_cannot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = numbers((4, 4))
    without(found, np.ones((4, 4), bool), "masked")  # one picture only
    map = stored(tmp_path / "a.zarr", found, (2, 2))
    with pytest.raises(ValueError, match="reported by itself"):
        fits.report(map, path=tmp_path / "a.html", others={"b": map})  # type: ignore[dict-item]
    assert main(["report", "a.zarr"]) == 0
    output = capsys.readouterr().out
    assert "No texel is fitted." in output
    assert "Report: a.html" in output
    assert main(["report", "a.zarr/", "--force"]) == 0
    assert main(["report", "a.zarr", "--out", "b.html"]) == 0
    assert (tmp_path / "b.html").read_bytes() == (tmp_path / "a.html").read_bytes()
    capsys.readouterr()
    zarr.create_group(tmp_path / "other.zarr")
    os.truncate(map.path / "flags" / "c" / "0" / "1", 3)
    for words, told in (
        (["a.zarr"], "exists already (--force overwrites it)"),
        (["a.zarr", "--force"], "flags: damaged, "),
        (["a.zarr", "--compare", "b"], "is not compared"),
        (["a.zarr", "--out", "none/a.html"], "no directory none"),
        (["other.zarr"], "is no store of a fitted map"),
    ):
        assert told in refused(["report", *words], capsys, tmp_path)


# ---- pictures ----


def image_of(figure: Figure, place: int = -1) -> np.ndarray:
    """What an image of a figure shows, NaN where it is transparent."""
    return np.ma.filled(np.ma.asarray(figure.axes[0].images[place].get_array(), float), np.nan)


def legend_of(figure: Figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def test_an_image_is_the_map_with_row_0_on_top() -> None:
    values, fitted = np.arange(12.0).reshape(3, 4), np.ones((3, 4), bool)
    fitted[0, 1], values[2, 2] = False, np.inf
    figure = pictures.value_picture(values, fitted, "a", "mm", "viridis")
    expected = np.where(fitted & np.isfinite(values), values, np.nan)
    np.testing.assert_array_equal(np.where(np.isfinite(image_of(figure)), image_of(figure), np.nan), expected)
    assert figure.axes[0].get_ylim() == (2.5, -0.5)
    assert figure.axes[1].get_ylabel() == "mm"
    assert legend_of(figure) == ["not fitted"]
    np.testing.assert_array_equal(image_of(figure, 0), ~fitted)
    large = pictures.value_picture(np.zeros((2400, 30)), np.ones((2400, 30), bool), "a", "mm", "viridis")
    assert image_of(large).shape == (1200, 15)
    assert large.axes[0].get_ylim() == (2399.5, -0.5)  # axes count texels of the map


@pytest.mark.parametrize(
    ("shape", "drawn", "told"),
    [
        ((5,), (1, 5), ""),
        ((1, 1), (1, 1), ""),
        ((4, 7, 3, 4), (3, 4), "slice [2, 3] of 4 x 7"),
        ((2001, 2000), (1001, 1000), "one texel in 2 x 2"),
        ((6001,), (1, 1501), "one texel in 4 x 4"),
    ],
)
def test_what_is_drawn_of_a_map(shape: tuple[int, ...], drawn: tuple[int, ...], told: str) -> None:
    part, words = pictures.shown_part(shape)
    assert (np.empty(shape, bool)[part].shape, words) == (drawn, told)


def test_colours_run_over_the_middle_and_are_logarithmic_where_it_is_wide() -> None:
    norm = pictures.norm_of(np.concatenate([np.linspace(1.0, 2.0, 999), [1e9, np.nan, np.inf]]))
    assert (norm.vmin, norm.vmax) == (pytest.approx(1.0, abs=0.02), pytest.approx(2.0, abs=0.02))
    assert not isinstance(norm, LogNorm)
    assert isinstance(pictures.norm_of(np.geomspace(1e-3, 1.0, 100)), LogNorm)
    assert not isinstance(pictures.norm_of(np.linspace(0.0, 100.0, 100)), LogNorm)
    for each in ([], [np.nan], [0.0, 0.0], [3.0], [-2.0, -2.0]):
        norm = pictures.norm_of(np.array(each))
        assert norm.vmin < norm.vmax
    ratio = np.geomspace(0.5, 20.0, 100).reshape(10, 10)
    ratio[0, 0] = 0.0
    norm = pictures.chi_square_picture(ratio, np.ones((10, 10), bool)).axes[0].images[-1].norm
    assert norm(1.0) == pytest.approx(0.5)  # white
    assert 15.0 < 1.0 / float(norm.vmin or 0.0) < 20.0


def test_a_texel_is_shown_as_the_gravest_of_its_flags() -> None:
    cases = {
        "not there yet": 0,
        "masked": FLAGS["masked"],
        "too few measurements": FLAGS["too_few_measurements"],
        "failed": FLAGS["failed"] | FLAGS["restarted"],
        "not converged": FLAGS["fitted"] | FLAGS["poor"],
        "poor": GOOD | FLAGS["poor"] | FLAGS["at_bound"],
        "unidentified": GOOD | FLAGS["unidentified"] | FLAGS["at_bound"],
        "at a bound": GOOD | FLAGS["at_bound"] | FLAGS["restarted"],
        "fine, started again": GOOD | FLAGS["restarted"],
        "fine": GOOD,
    }
    found = pictures.states_of(np.array(list(cases.values()), np.uint16))
    assert [pictures.STATES[place].words for place in found] == list(cases)
    flags = np.full((3, 4, 5), GOOD, np.uint16)
    flags.flat[:7] = FLAGS["masked"]
    assert legend_of(pictures.flag_picture(flags)) == ["masked: 7", "fine: 53"]  # of all texels


def test_the_histogram_is_beside_what_noise_makes_of_it() -> None:
    ratio = np.random.default_rng(0).chisquare(40, 200_000) / 40
    axes = pictures.chi_square_histogram(ratio, np.full(ratio.size, 40)).axes[0]
    at, expected = axes.lines[0].get_data()
    np.testing.assert_allclose(expected, 40 * stats.chi2.pdf(40 * np.asarray(at), 40), rtol=1e-10)
    for each in ([], [np.nan], [2.0], [0.0, 0.0], [np.inf, 1.0, 2.0]):
        pictures.chi_square_histogram(np.array(each), np.full(len(each), 5))
