"""The page of a map: all of it in one file, of stores in every state; and `layerjax report` of a store."""

import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import zarr

import fits
from fits.cli.parser import main
from fits.maps.fitted_map import FittedMap
from fits.maps.report.tables import smoothing_words
from fits.maps.store import Store
from tests.helpers.commands import refused
from tests.helpers.painted_maps import NAMES, bounded, numbers, stored, without

SHAPE, CHUNK = (12, 16), (6, 8)
FULL = 17
"""Pictures of a map of three parameters with numerical errors: four of each, flags, three of fits, correlation."""


def painted(path: Path, chunks: int | None = None) -> FittedMap:
    found = numbers(SHAPE, numerical=True)
    without(found, np.mgrid[:12, :16][0] == 11, "masked")
    bounded(found, np.mgrid[:12, :16][1] == 15, 0)
    return stored(path, found, CHUNK, chunks=chunks)


def pictured(text: str) -> list[str]:
    """The alternative texts of the pictures, which must all be inside."""
    found = re.findall(r'<img alt="([^"]*)" src="data:image/png;base64,[^"]{1000,}">', text)
    assert len(found) == text.count("<img ")
    return found


def without_pictures(text: str) -> str:
    return re.sub(r"base64,[^\"]*", "", text)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("map")
    map = painted(folder / "<coat> & co.zarr")
    fits.report(map, path=folder / "report.html")
    return (folder / "report.html").read_text()


def test_the_page_holds_all_that_there_is(page: str) -> None:
    told = pictured(page)
    assert len(told) == FULL
    assert all(len(words) > 20 for words in told)
    for name in NAMES:
        assert sum(f"{name}, over the map" in words for words in told) == 2
        assert sum(f"{name}, how often" in words for words in told) == 2
    text = without_pictures(page)
    assert "http" not in text
    assert "<coat>" not in text
    assert "Map of &lt;coat&gt; &amp; co.zarr" in text
    for words in (
        "A map of 192 texels: 176 are fitted, 16 masked.",
        'layers[0].f0</td><td class="number">0.04321</td><td class="number">0.00012',
        "Noise(relative=0.02)",
        "SingleScattering()",
        "texels 64, reduced chi square 1.01, poor above 1.6",
        "kind = &quot;Medium&quot;",
        "The worst texels",
        "Made with layerjax",
    ):
        assert words in text, words
    assert 'class="verdict"' in text  # a twelfth at a bound is more than some


def test_the_page_is_well_formed(page: str) -> None:
    body = page[page.index("<body>") : page.index("</html>")]
    ET.fromstring(re.sub(r"(<img [^>]*[^/])>", r"\1/>", body))


def test_a_map_that_is_not_finished_is_reported(tmp_path: Path) -> None:
    fits.report(painted(tmp_path / "a.zarr", chunks=1), path=tmp_path / "a.html")
    text = (tmp_path / "a.html").read_text()
    assert "The map is not finished: 48 of 192 texels (25 %) are there" in text
    assert len(pictured(text)) == FULL
    assert "there so far</td>" in text


@pytest.mark.parametrize("state", ["masked", "empty"])
def test_a_map_without_a_fitted_texel_has_only_its_flags(state: str, tmp_path: Path) -> None:
    found = numbers(SHAPE)
    without(found, np.ones(SHAPE, bool), "masked")
    map = stored(tmp_path / "a.zarr", found, CHUNK, chunks=None if state == "masked" else 0)
    fits.report(map, path=tmp_path / "a.html")
    text = (tmp_path / "a.html").read_text()
    assert len(pictured(text)) == 1
    assert "No texel is fitted." in text
    assert "How it was made" in text
    assert "No texel is fitted." in map._repr_html_()


@pytest.mark.parametrize(("shape", "words"), [((1, 1), ""), ((5, 8, 9), "Shown: slice [2] of 5.")])
def test_maps_of_other_ranks_are_reported(shape: tuple[int, ...], words: str, tmp_path: Path) -> None:
    fits.report(stored(tmp_path / "a.zarr", numbers(shape), shape), path=tmp_path / "a.html")
    text = (tmp_path / "a.html").read_text()
    assert words in text
    assert len(pictured(text)) == FULL - 1 - (shape == (1, 1))  # no numerical error; one texel has no correlation


def smoothed(path: Path, **said: object) -> FittedMap:
    map = painted(path)
    arrays = {f"{group}/{name}": map[f"{group}/{name}"][:] for group in ("values", "errors") for name in NAMES}
    asked = {"kind": "total_variation", "scale": {NAMES[0]: 0.1, NAMES[2]: 0.2}, "rounds": 3}
    about = {"prior": asked, "rounds": 3, "largest_moves": [3.0, 1.0, 0.5], "objective": [50.0, 12.0, 9.0, 8.0]}
    Store(path).save_group("smoothed", arrays, about | said)
    return map


def test_a_smoothed_map_is_shown_beside_the_plain_one(tmp_path: Path) -> None:
    map = smoothed(tmp_path / "a.zarr", settled=False, left=0.25)
    fits.report(map, path=tmp_path / "a.html")
    text = (tmp_path / "a.html").read_text()
    told = pictured(text)
    assert len(told) == FULL + 2 * len(NAMES)
    for name in NAMES:  # each after the plain one that it stands beside
        for words in (name, f"Standard error of {name}"):
            place = next(k for k, one in enumerate(told) if one.startswith(f"{words}, over the map"))
            assert told[place + 1].startswith(f"{words}, with a spatial prior")
    assert smoothing_words(map) in text


@pytest.mark.parametrize(("settled", "left"), [(True, 0.01), (False, 0.25), (False, "inf")])
def test_it_is_said_how_far_smoothing_has_come(settled: bool, left: float | str, tmp_path: Path) -> None:
    words = smoothing_words(smoothed(tmp_path / "a.zarr", settled=settled, left=left))
    assert f"(total variation, of the bounds: {NAMES[0]} 0.1, {NAMES[2]} 0.2): 3 rounds took 42 off" in words
    assert "by at most 0.5 standard errors" in words
    assert ("it has not settled" in words) is not settled
    assert ("about 0.25 more are left to go" in words) is (left == 0.25)


@pytest.mark.parametrize(("names", "words"), [(NAMES, "0.05"), (NAMES[2:], f"{NAMES[2]} 0.05")], ids=["all", "one"])
def test_parameters_are_named_where_not_all_are_smoothed(names: tuple[str, ...], words: str, tmp_path: Path) -> None:
    asked = {"kind": "gaussian", "scale": dict.fromkeys(names, 0.05), "rounds": 3}
    found = smoothing_words(smoothed(tmp_path / "a.zarr", settled=True, prior=asked))
    assert f"(gaussian, of the bounds: {words}):" in found


def test_only_a_map_by_itself_is_reported(tmp_path: Path) -> None:
    map = painted(tmp_path / "a.zarr")
    with pytest.raises(ValueError, match="reported by itself"):
        fits.report(map, path=tmp_path / "a.html", others={"b": map})  # type: ignore[dict-item]
    (tmp_path / "a.html").write_text("mine")
    with pytest.raises(ValueError, match="exists"):
        fits.report(map, path=tmp_path / "a.html", force=False)
    assert (tmp_path / "a.html").read_text() == "mine"


def test_a_notebook_shows_medians_and_the_verdict(tmp_path: Path) -> None:
    map = painted(tmp_path / "a.zarr")
    root = ET.fromstring(f"<div>{map._repr_html_()}</div>")
    rows = {row[0].text: [cell.text for cell in row] for row in root.iter("tr")}
    fitted = map.has("fitted")
    for name in NAMES:
        assert float(str(rows[name][2])) == pytest.approx(np.median(map.values[name][fitted]), rel=1e-3)
    assert "A map of 192 texels" in "".join(root.itertext())


def test_the_command_writes_the_page_beside_the_store(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = numbers((4, 4))
    without(found, np.ones((4, 4), bool), "masked")  # one picture only
    stored(tmp_path / "a.zarr", found, (2, 2))
    assert main(["report", "a.zarr"]) == 0
    output = capsys.readouterr()
    assert "No texel is fitted." in output.out
    assert f"Report: {Path('a.html')}" in output.out
    assert "No texel is fitted." in (tmp_path / "a.html").read_text()
    assert "exists already (--force overwrites it)" in refused(["report", "a.zarr"], capsys, tmp_path)
    assert main(["report", "a.zarr/", "--force"]) == 0
    assert main(["report", "a.zarr", "--out", "b.html"]) == 0
    assert (tmp_path / "b.html").read_bytes() == (tmp_path / "a.html").read_bytes()


def test_the_command_refuses_what_it_cannot_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    map = painted(tmp_path / "a.zarr")
    assert "is not compared" in refused(["report", "a.zarr", "--compare", "b"], capsys, tmp_path)
    assert "no directory none" in refused(["report", "a.zarr", "--out", "none/a.html"], capsys, tmp_path)
    file = map.path / "errors" / "base.albedo" / "c" / "0" / "1"
    os.truncate(file, 3)
    told = refused(["report", "a.zarr"], capsys, tmp_path)
    assert "errors/base.albedo: damaged, " in told
    (map.path / "zarr.json").write_text("{")
    assert "not valid JSON" in refused(["report", "a.zarr"], capsys, tmp_path)
    zarr.create_group(tmp_path / "other.zarr")
    assert "is a zarr group that is not ours" in refused(["report", "other.zarr"], capsys, tmp_path)
