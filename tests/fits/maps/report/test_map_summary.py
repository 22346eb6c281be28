"""The numbers and sentences of a map are those of the arrays that were written."""

import io
from pathlib import Path

import numpy as np
import pytest

from fits.maps.fitted_map import FittedMap, open_map
from fits.maps.report import tables, verdicts
from fits.maps.store import FLAGS
from fits.maps.summary import summarised
from fits.reports.tables import print_table
from tests.helpers.painted_maps import FREEDOM, NAMES, bounded, numbers, stored, without

SHAPE, CHUNK = (20, 30), (10, 10)
Found = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def painted() -> Found:
    """600 texels: 30 masked, 20 with too few readings, 10 failed, 25 at a bound, 12 poor, 4 not converged."""
    found = numbers(SHAPE, numerical=True)
    row, column = np.mgrid[:20, :30]
    without(found, row == 0, "masked")
    without(found, column == 0, "too_few_readings")  # the masked one in the corner as well
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
    return stored(tmp_path_factory.mktemp("map") / "a.zarr", painted, CHUNK)


def test_counts_and_quartiles_are_those_of_the_arrays(map: FittedMap, painted: Found) -> None:
    found, fitted = summarised(map), np.isfinite(painted["reduced_chi_square"])
    assert (found.texels, found.there, found.fitted) == (600, 600, 600 - 29 - 20 - 10) == (600, 600, fitted.sum())
    assert found.counts | {"converged": 0} == {
        "fitted": 541,
        "converged": 0,
        "at_bound": 25,
        "poor": 12,
        "restarted": 0,
        "masked": 29,
        "too_few_readings": 20,
        "failed": 10,
        "unidentified": 0,
    }
    assert found.converged == (541 - 4) / 541
    assert found.at_bound == {NAMES[0]: 0, NAMES[1]: 25, NAMES[2]: 0}
    assert found.no_error == {NAMES[0]: 3, NAMES[1]: 25, NAMES[2]: 0}
    for name in NAMES:
        for given, group in ((found.values, "values"), (found.errors, "errors")):
            numbers = painted[f"{group}/{name}"][fitted]
            assert given[name] == pytest.approx(np.percentile(numbers[np.isfinite(numbers)], (25, 50, 75)))
    error = painted["numerical_error"][fitted]
    assert found.numerical_error == pytest.approx(np.percentile(error, (25, 50, 75, 95)))


def test_tables_say_them(map: FittedMap, painted: Found) -> None:
    found = summarised(map)
    counts, quartiles = tables.count_table(found), tables.quartile_table(found, map)
    rows = {row[0]: row[1:] for row in counts.rows}
    assert rows["of the map"] == ("600", "")
    assert rows["fitted"] == ("541", "90.2 %")
    assert rows["converged"] == ("537", "99.3 % of the fitted")
    assert rows["masked"] == ("29", "4.83 %")
    assert rows["at a bound: layers[0].phase.alpha"] == ("25", "4.62 % of the fitted")
    middle = {row[0]: row for row in quartiles.rows}
    fitted = np.isfinite(painted["reduced_chi_square"])
    assert float(middle["base.albedo"][2]) == pytest.approx(np.median(painted["values/base.albedo"][fitted]), rel=1e-3)
    assert middle["layers[0].thickness"][7] == "optical depth"
    assert quartiles.note.startswith("layers[0].thickness has no error in 0.55 % of them. layers[0].phase.alpha has no")
    stream = io.StringIO()
    for table in (counts, quartiles):
        print_table(table, stream)
    assert "99.3 % of the fitted" in stream.getvalue()


def test_the_verdict_says_how_far_to_trust_a_map(map: FittedMap) -> None:
    words, fine = verdicts.in_short(summarised(map), map)
    assert not fine  # 10 of 551 failed
    assert words[0] == "A map of 600 texels: 541 are fitted, 29 masked, 20 with too few readings, 10 failed."
    assert words[1] == "99.3 % of the fitted texels converged."
    assert f"1 ± {np.sqrt(2 / FREEDOM):.2g}" in words[2]
    assert "At a bound: 4.62 % of the fitted texels (layers[0].phase.alpha in 4.62 %)." in words
    assert "Poor: 2.22 % of the fitted texels, whose chi-square is above 1.6, more than noise" in " ".join(words)
    assert words[-1].startswith("The numerical error of the model is 0.025 standard deviations in the median texel")


def told(tmp_path: Path, found: Found, **more: object) -> tuple[str, bool]:
    map = stored(tmp_path / "a.zarr", found, CHUNK, **more)  # type: ignore[arg-type]
    words, fine = verdicts.in_short(summarised(map), map)
    return " ".join(words), fine


def test_a_good_map_is_fine(tmp_path: Path) -> None:
    words, fine = told(tmp_path, numbers(SHAPE))
    assert fine
    assert "No texel is at a bound. No texel is poor" in words
    assert "100 % of the fitted texels converged" in words


@pytest.mark.parametrize(
    ("factor", "sentence"),
    [(1.7, "does not explain the readings to within their noise"), (0.3, "scatter less than the stated noise")],
)
def test_chi_square_far_from_one_is_told(factor: float, sentence: str, tmp_path: Path) -> None:
    """sqrt(2 / 61) is 0.18: 1.7 and 0.3 are four of them away."""
    found = numbers(SHAPE)
    found["reduced_chi_square"] *= factor
    words, fine = told(tmp_path, found)
    assert sentence in words
    assert ("No texel is poor" in words) == (factor < 1.0)
    assert ("No texel stands out" in words) == (factor > 1.0)
    assert not fine


@pytest.mark.parametrize(("texels", "expected"), [(30, True), (31, False)])
def test_a_map_is_fine_if_few_texels_leave_a_parameter_open(texels: int, expected: bool, tmp_path: Path) -> None:
    """Of 600; that they do is told in either case."""
    found = numbers(SHAPE)
    found["flags"].reshape(-1)[:texels] |= FLAGS["unidentified"]
    words, fine = told(tmp_path, found)
    assert "of the fitted texels the readings do not resolve every parameter" in words
    assert fine == expected


def test_shared_parameters_that_are_off_or_unknown_are_told(tmp_path: Path) -> None:
    ior = {"value": 1.5, "error": 0.1, "unit": "1", "converged": False}
    thickness = {"value": 2.0, "error": np.inf, "unit": "mm", "converged": False}
    words, fine = told(tmp_path, numbers(SHAPE), shared={"layers[0].ior": ior, "layers[0].thickness_mm": thickness})
    assert "The joint fit of what texels share has not converged" in words
    assert "The sample does not know layers[0].thickness_mm, which texels share." in words
    assert not fine
    rows = tables.shared_table(open_map(tmp_path / "a.zarr")).rows
    assert rows == (("layers[0].ior", "1.50", "0.10", "1"), ("layers[0].thickness_mm", "2", "unknown", "mm"))


def test_a_map_that_is_not_finished_says_so(tmp_path: Path) -> None:
    found = numbers(SHAPE)
    without(found, np.mgrid[:20, :30][0] == 0, "masked")
    words, fine = told(tmp_path, found, chunks=2)
    assert not fine
    assert words.startswith(
        "The map is not finished: 200 of 600 texels (33.3 %) are there, and the same command goes on with it. "
        "Of what is there, 180 are fitted, 20 masked."
    )


def test_shared_parameters_take_no_degree_of_freedom_from_a_texel(tmp_path: Path) -> None:
    found = numbers(SHAPE)
    found["readings"][:] = 12
    words, _ = told(tmp_path, found, shared={NAMES[0]: {"value": 0.5, "error": 0.1}})
    assert f"1 ± {np.sqrt(2 / 10):.2g}" in words


def test_texels_without_freedom_have_no_verdict_on_the_noise(tmp_path: Path) -> None:
    found = numbers(SHAPE)
    found["readings"][:], found["reduced_chi_square"][:] = 3, np.nan
    words, fine = told(tmp_path, found)
    assert "no more readings than parameters" in words
    assert not fine


@pytest.mark.parametrize(
    ("part", "whole", "words"),
    [
        (0, 7, "0 %"),
        (7, 7, "100 %"),
        (1, 3, "33.3 %"),
        (9996, 10000, "99.96 %"),
        (99999, 100000, "> 99.99 %"),
        (7, 10000, "0.07 %"),
        (1, 100000, "< 0.01 %"),
        (0, 0, "none"),
    ],
)
def test_nearly_all_is_not_said_as_all(part: int, whole: int, words: str) -> None:
    assert tables.share(part, whole) == words


def test_the_worst_texels_come_first_with_their_values(map: FittedMap, painted: Found) -> None:
    table = tables.worst_table(map)
    assert len(table.rows) == tables.WORST == 12
    assert [row[0] for row in table.rows] == [f"[10, {column}]" for column in range(29, 17, -1)]
    assert [float(row[1]) for row in table.rows] == [7.0 + column for column in range(29, 17, -1)]
    value, error = (painted[f"{group}/base.albedo"][10, 29] for group in ("values", "errors"))
    written, _, after = table.rows[0][4].partition(" ± ")
    assert float(written) == pytest.approx(value, abs=0.06 * error)
    assert float(after) == pytest.approx(error, rel=0.05)
    assert {row[-1] for row in table.rows} == {"poor"}


def test_flags_of_the_worst_texels_are_told(tmp_path: Path) -> None:
    found = numbers((2, 2))
    found["reduced_chi_square"][...] = [[4.0, 3.0], [2.0, np.nan]]
    found["flags"][0, 0] = FLAGS["fitted"] | FLAGS["poor"] | FLAGS["unidentified"]
    bounded(found, np.array([[False, True], [False, False]]), 2)
    table = tables.worst_table(stored(tmp_path / "a.zarr", found, (2, 2)))
    assert [row[0] for row in table.rows] == ["[0, 0]", "[0, 1]", "[1, 0]"]
    assert [row[-1] for row in table.rows] == ["not converged, poor, a parameter is not resolved", "at a bound", ""]
    assert "±" not in table.rows[1][4]
