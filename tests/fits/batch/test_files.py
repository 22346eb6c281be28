"""Files of a folder by several stacks: every result as of a fit alone, what is done stays, what fails costs itself."""

import csv
import json
import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

import fits
from fits._files import locked
from fits.batch import work
from fits.batch.files import LOCK
from fits.batch.rows import Row
from tests.helpers.coats import TRUE
from tests.helpers.files import contents

STACKS = ["coat.toml", "bare.toml"]
FEW = {"starts": 2}


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Which fits are made, in this process."""
    made: list[str] = []
    fit = work.fit_into

    def counting(directory: Path, *given: object, **options: object) -> object:
        made.append(f"{directory.parent.name} {directory.name}")
        return fit(directory, *given, **options)

    monkeypatch.setattr(work, "fit_into", counting)
    return made


def test_every_file_is_fitted_by_every_stack(folder: Path, counted: list[str]) -> None:
    told: list[tuple[object, ...]] = []
    found = fits.fit_files("scans", STACKS, "out", progress=lambda *given: told.append(given), **FEW)
    assert [(row.file, row.stack) for row in found.rows] == [
        (file, stack) for file in ("broken.csv", "coated.csv", "paint.csv") for stack in ("coat", "bare")
    ]
    assert not found.complete
    assert [Path(path).name for path in found.left_out] == ["README.md"]
    assert "twenty" in found.rows[0].failure
    assert found.best == {"coated.csv": "coat", "paint.csv": "bare"}
    assert len(counted) == 4
    assert told[0][:3] == ("fits", 2, 6)
    assert told[-1][:3] == ("fits", 6, 6)
    for file, truth in TRUE.items():
        fit = fits.load_fit(Path("out") / file / found.best[file])
        for name, value in truth.items():
            assert abs(fit.values[name] - value) < 4.0 * fit.standard_errors[name]
    for row in found.rows[2:]:
        fit = fits.load_fit(Path("out") / row.directory)
        assert row.converged == fit.converged
        assert {one.name: one.value for one in row.parameters} == fit.values
        data = fit.problem.data.used()
        density = stats.norm.logpdf(data.values, fit.predicted, data.sigma).sum()
        assert row.aic == pytest.approx(2 * len(fit.vector) - 2 * density, rel=1e-9)
        assert row.readings == len(data)

    before = contents(folder)
    again = fits.fit_files("scans", STACKS, "out", **FEW)
    assert len(counted) == 4
    assert repr(again.rows) == repr(found.rows)
    assert contents(folder) == before


def test_ctrl_c_ends_it_with_the_fit_that_is_in_hand(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[Path] = []

    def interrupted(directory: Path, *_: object, **__: object) -> None:
        begun.append(directory)
        raise KeyboardInterrupt if len(begun) == 2 else ValueError("no fit")

    monkeypatch.setattr(work, "fit_into", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fits.fit_files("scans", STACKS, "out", **FEW)
    assert len(begun) == 2  # of four
    assert [row["failure"] for row in json.loads(Path("out/table.json").read_text())["rows"]].count("not done yet") == 3


def test_the_table_holds_it_all(folder: Path) -> None:
    found = fits.fit_files("scans", STACKS, "out", **FEW)
    with open("out/table.csv", newline="") as file:
        table = list(csv.DictReader(file))
    stored = json.loads(Path("out/table.json").read_text())
    assert len(table) == len(stored["rows"]) == 6
    for row, line, entry in zip(found.rows, table, stored["rows"], strict=True):
        assert (line["file"], line["stack"]) == (row.file, row.stack) == (entry["file"], entry["stack"])
        assert line["result"] == ("failed" if row.failure else "fitted")
        assert ("twenty" in line["status"]) == bool(row.failure)
        for one in row.parameters:
            np.testing.assert_allclose(float(line[one.name]), one.value, rtol=1e-7)
            error = line[f"{one.name} error"] or "nan"  # empty of a parameter at a bound
            np.testing.assert_allclose(float(error), one.error, rtol=1e-7)
    assert table[4]["layers[0].thickness"] != ""
    assert table[5]["layers[0].thickness"] == ""
    assert [line["standing"] for line in table[:2]] == ["", ""]
    assert table[2]["standing"] == "best"
    assert table[3]["standing"].startswith("+")
    assert stored["best"] == found.best
    page = Path("out/report.html").read_text()
    for word in ("coated.csv/coat/report.html", "paint.csv/bare/report.html", "twenty", "README.md", "base.albedo"):
        assert word in page
    for link in {part.split('"')[0] for part in page.split('href="')[1:]}:
        assert (folder / "out" / link).is_file()


def test_what_was_interrupted_goes_on(folder: Path, counted: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    whole = work.fit_one

    def interrupted(job: work.Job, task: work.Task) -> Row:
        if len(counted) == 2:
            raise KeyboardInterrupt
        return whole(job, task)

    monkeypatch.setattr("fits.batch.files.fit_one", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fits.fit_files("scans", STACKS, "out", **FEW)
    with open("out/table.csv", newline="") as file:
        words = [line["status"] for line in csv.DictReader(file)]
    assert words.count("not done yet") == 2
    monkeypatch.setattr("fits.batch.files.fit_one", whole)
    assert len(fits.fit_files("scans", STACKS, "out", **FEW).rows) == 6
    assert len(counted) == len(set(counted)) == 4


def test_a_result_of_something_else_is_refused_by_name(folder: Path, counted: list[str]) -> None:
    fits.fit_files("scans/paint.csv", STACKS, "out", **FEW)
    before = contents(folder / "out")

    def refused(message: str, **options: object) -> None:
        with pytest.raises(ValueError, match=message):
            fits.fit_files("scans/paint.csv", STACKS, "out", **(FEW | options))
        assert contents(folder / "out") == before

    refused(r"out/paint.csv/coat: holds a fit of other settings \(starts 2, not 3\) \(--force", starts=3)
    refused(r"other settings \(max_polar_angle default, not 60.0\)", max_polar_angle=60.0)
    (folder / "bare.toml").write_text((folder / "bare.toml").read_text().replace("start = 0.5", "start = 0.6"))
    refused("out/paint.csv/bare: holds a fit of another stack of this name")
    del counted[:]
    assert fits.fit_files("scans/paint.csv", STACKS, "out", force=True, **FEW).complete
    assert counted == ["paint.csv bare"]
    with open("scans/paint.csv", "a") as file:
        file.write("\n")
    before = contents(folder / "out")
    refused("holds a fit of what the file held before it was changed")


def test_a_damaged_result_costs_itself_alone(folder: Path, counted: list[str]) -> None:
    fits.fit_files("scans/paint.csv", STACKS, "out", **FEW)
    for name in ("fit.json", "origin.json"):
        path = folder / "out" / "paint.csv" / "bare" / name
        path.write_text(path.read_text()[:-100])
        found = fits.fit_files("scans/paint.csv", STACKS, "out", **FEW)
        assert [row.fitted for row in found.rows] == [True, False]
        assert name in found.rows[1].failure
        assert "--force" in found.rows[1].failure
        assert fits.fit_files("scans/paint.csv", STACKS, "out", force=True, **FEW).complete
    assert counted == ["paint.csv coat", "paint.csv bare", "paint.csv bare", "paint.csv bare"]
    (folder / "out" / "table.json").write_text("{")
    assert fits.fit_files("scans/paint.csv", STACKS, "out", **FEW).complete


@pytest.mark.slow
def test_readings_that_are_held_out_decide(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from fits.reports.html import predict_held_out
    from fits.reports.results import load_held_out

    def report(folder: Path, name: str, fit: fits.Fit) -> object:
        unseen = load_held_out(folder)
        assert unseen is not None
        return predict_held_out(fit, None, unseen)

    monkeypatch.setattr("fits.batch.fitting.write_report", report)
    found = fits.fit_files(["scans/coated.csv"], STACKS, "out", hold_out=["incidence=50"], **FEW)
    assert found.best == {"coated.csv": "coat"}
    coat, bare = found.rows
    assert coat.scored == bare.scored > 0
    assert coat.score > bare.score
    fit = fits.load_fit("out/coated.csv/coat")
    seen = fits.predict(fit, fits.read("out/coated.csv/coat/held_out.csv")).scores
    assert coat.score == pytest.approx(seen.elpd, abs=1e-3)
    assert "log score" in Path("out/report.html").read_text()


def test_the_best_of_a_search_is_a_result_like_others(
    folder: Path, coat_fit: fits.Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    searched: list[Path] = []

    def search_into(directory: Path, data: fits.Measurements, given: fits.Searching) -> SimpleNamespace:
        searched.append(directory.relative_to(folder))
        assert given == fits.Searching(layers=1)
        return SimpleNamespace(best=SimpleNamespace(name="haze / diffuse", fit=coat_fit))

    monkeypatch.setattr(work, "search_into", search_into)
    looked = {"search": fits.Searching(layers=1), **FEW}
    found = fits.fit_files(["scans/paint.csv", "scans/broken.csv"], ["bare.toml"], "out", **looked)
    assert [(row.stack, row.structure, row.fitted) for row in found.rows] == [
        ("bare", "", True),
        ("search", "haze / diffuse", True),
        ("bare", "", False),
        ("search", "", False),
    ]
    assert fits.load_fit("out/paint.csv/search").values == pytest.approx(coat_fit.values)
    fits.fit_files("scans/paint.csv", [], "out", **looked)
    assert searched == [Path("out/paint.csv/search-stacks")]
    with pytest.raises(ValueError, match=r"search: holds a fit of other settings \(layers 1, not 3\)"):
        fits.fit_files("scans/paint.csv", [], "out", search=True)


def test_processes_give_what_threads_give(folder: Path) -> None:
    """A worker knows nothing of the patches here: reports are drawn."""
    alone = fits.fit_files(["scans/paint.csv"], ["bare.toml"], "alone", **FEW)
    found = fits.fit_files(["scans/paint.csv", "scans/broken.csv"], ["bare.toml"], "out", processes=2, **FEW)
    assert [row.fitted for row in found.rows] == [True, False]
    for one, other in zip(found.rows[0].parameters, alone.rows[0].parameters, strict=True):
        assert one.value == pytest.approx(other.value, rel=1e-6)
    assert "data:image/png" in Path("out/paint.csv/bare/report.html").read_text()


def test_reports_may_be_left_out(folder: Path) -> None:
    assert fits.fit_files("scans/paint.csv", STACKS, "out", reports=False, **FEW).complete
    assert not list((folder / "out").glob("*/*/report.html"))
    assert "href=" not in Path("out/report.html").read_text()


def test_one_run_at_a_time_writes_there(folder: Path) -> None:
    os.mkdir("out")
    with locked(Path("out") / LOCK, "it"), pytest.raises(ValueError, match="out is in use by another process"):
        fits.fit_files("scans", STACKS, "out", **FEW)
    assert contents(folder / "out") == {}


def test_a_mistake_in_one_fit_ends_none_of_the_others(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fit = work.fit_into

    def broken(directory: Path, *given: object, **options: object) -> object:
        if directory.name == "coat":
            raise RuntimeError("no memory\nis left")
        return fit(directory, *given, **options)

    monkeypatch.setattr(work, "fit_into", broken)
    found = fits.fit_files("scans/paint.csv", STACKS, "out", **FEW)
    assert found.rows[0].failure == "RuntimeError: no memory is left"
    assert found.rows[1].fitted


@pytest.mark.parametrize(
    ("files", "stacks", "message"),
    [
        (["nowhere"], STACKS, "no such file or folder: 'nowhere'"),
        (["empty"], STACKS, "empty: holds no measurement file"),
        ([], STACKS, "no file is given"),
        (["scans"], [], "no stack is given"),
        (["scans"], ["nowhere.toml"], "no such file: 'nowhere.toml'"),
        (["scans/broken.csv"], STACKS, "twenty"),
        (["scans", "scans/paint.csv"], STACKS, r"scans/paint.csv and scans/paint.csv: results go by the file's name"),
        (["scans"], ["coat.toml", "scans/../coat.toml"], "results go by the stack's name"),
        (["scans"], ["search.toml"], r"search.toml: its name must be another"),
        (["table.csv"], STACKS, r"table.csv: its name must be another"),
    ],
)
def test_bad_input_is_named_and_writes_nothing(folder: Path, files: list[str], stacks: list[str], message: str) -> None:
    (folder / "empty").mkdir()
    (folder / "search.toml").write_text((folder / "bare.toml").read_text())
    (folder / "table.csv").write_text("")
    before = contents(folder)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        fits.fit_files(files, stacks, "out")
    assert contents(folder) == before
    assert not (folder / "out").exists()


def test_places_that_hold_something_else_are_left_alone(folder: Path) -> None:
    before = contents(folder)
    for place, message in (
        ("scans", "is not empty, and holds no fits"),
        ("coat.toml", "is a file"),
        ("no/such", "there is no directory"),
    ):
        with pytest.raises(ValueError, match=message):
            fits.fit_files("scans", STACKS, place, **FEW)
    assert contents(folder) == before
    fits.fit_files("scans/paint.csv", ["bare.toml"], "out", **FEW)
    (folder / "out" / "paint.csv" / "coat").mkdir()
    (folder / "out" / "paint.csv" / "coat" / "precious").write_text("")
    for force in (False, True):
        with pytest.raises(ValueError, match="coat: holds something that fit-many did not make"):
            fits.fit_files("scans/paint.csv", STACKS, "out", force=force, **FEW)


def test_a_result_that_is_removed_meanwhile_is_not_there(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = work.fit_one
    done: list[str] = []

    def removing(job: work.Job, task: work.Task) -> Row:
        if done:
            shutil.rmtree(folder / "out" / done.pop(), ignore_errors=True)
        row = whole(job, task)
        done.append(row.directory)
        return row

    monkeypatch.setattr("fits.batch.files.fit_one", removing)
    found = fits.fit_files("scans/paint.csv", STACKS, "out", **FEW)
    assert [row.fitted for row in found.rows] == [False, True]
    assert found.rows[0].failure == "paint.csv/coat: was removed while others were fitted"
    assert not found.complete
    assert "was removed" in Path("out/table.csv").read_text()


def test_an_output_that_is_removed_meanwhile_is_told(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = work.fit_one

    def removing(job: work.Job, task: work.Task) -> Row:
        row = whole(job, task)
        shutil.rmtree(folder / "out")
        return row

    monkeypatch.setattr("fits.batch.files.fit_one", removing)
    with pytest.raises((ValueError, FileNotFoundError), match="out"):
        fits.fit_files("scans/paint.csv", STACKS, "out", **FEW)
    assert not (folder / "out").exists()
