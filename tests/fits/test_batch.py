"""Files of a folder by several stacks: every result as of a fit alone, what is done stays, what fails costs itself."""

import contextlib
import csv
import shutil
from pathlib import Path

import pytest
from scipy import stats

import fits
from fits import ReadOptions, batch
from fits._files import locked
from fits.batch import STORE
from fits.reports.html import FitReport
from tests.helpers.coats import TRUE, make_folder
from tests.helpers.files import contents
from tests.helpers.refusals import refuses

STACKS, FEW = ["coat.toml", "bare.toml"], {"starts": 2}
FIT_FILE = batch.fit_file
FAILED = {"file": "a.csv", "stack": "two", "result": "failed", "status": "unreadable"}


@pytest.fixture(scope="module", autouse=True)
def whole(tmp_path_factory):
    """A folder with scans/, coat.toml and bare.toml, and in out/ the fits of all files by both; no report is drawn."""
    folder = tmp_path_factory.mktemp("batch")
    make_folder(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FitReport, "write", lambda _, at: (at / "report.html").write_text("drawn"))
        with contextlib.chdir(folder):
            fits.fit_files("scans", STACKS, "out", **FEW)
        yield folder


@pytest.fixture
def folder(whole, tmp_path, monkeypatch):
    """A current directory with a copy of it, but the fits."""
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True, ignore=shutil.ignore_patterns("out"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def counted(whole, monkeypatch):
    """Which fits are made, in this process; each is a copy of the one that is there, and takes no time."""
    made = []

    def copied(directory, *_, **__):
        made.append(f"{directory.parent.name} {directory.name}")
        shutil.copytree(whole / "out" / directory.parent.name / directory.name, directory, dirs_exist_ok=True)
        return FitReport(fits.load_fit(directory))

    monkeypatch.setattr(batch, "fit_file", copied)
    return made


def table():
    with open("out/table.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_every_file_is_fitted_by_every_stack(whole, counted, monkeypatch):
    monkeypatch.chdir(whole)
    before = contents(whole)
    found = fits.fit_files("scans", STACKS, "out", **FEW)
    assert not counted  # nothing is done again
    assert {path for path, content in contents(whole).items() if before[path] != content} <= {f"{whole}/out/{STORE}"}
    pairs = [(file, stack) for file in ("broken.csv", "coated.csv", "paint.csv") for stack in ("coat", "bare")]
    assert [(row["file"], row["stack"]) for row in found.rows] == pairs
    assert not found.complete
    assert [Path(path).name for path in found.skipped] == ["README.md"]
    assert "twenty" in found.rows[0]["status"]
    assert found.best == {"coated.csv": "coat", "paint.csv": "bare"}
    lines = table()
    for row, line in zip(found.rows, lines, strict=True):
        assert all(line[name] == row[name] for name in ("file", "stack", "result", "status"))
        if row["result"] == "failed":
            continue
        fit = fits.load_fit(Path("out") / row["file"] / row["stack"])
        data = fit.problem.data.used()
        density = stats.norm.logpdf(data.values, fit.predicted, data.sigma).sum()
        assert row["criterion"] == "AIC"
        assert row["loss"] == pytest.approx(2 * len(fit.vector) - 2 * density, rel=1e-9)
        assert row["measurements"] == len(data) == int(line["measurements"])
        for name, value in TRUE[row["file"]].items() if row["stack"] == found.best[row["file"]] else ():
            assert abs(row[name] - value) < 4.0 * row[f"{name} error"]
        for name, value in fit.values.items():
            assert row[name] == value == pytest.approx(float(line[name]), rel=1e-7)
            error = float(line[f"{name} error"] or "nan")  # empty of a parameter at a bound
            assert row[f"{name} error"] == pytest.approx(error, rel=1e-7, nan_ok=True)
    assert [line["layers[0].thickness"] != "" for line in lines[4:]] == [True, False]
    assert [line["standing"] for line in lines[:3]] == ["", "", "best"]
    assert lines[3]["standing"].startswith("+")


@pytest.mark.parametrize("late", [False, True], ids=["between", "before the row is kept"])
def test_an_interrupted_batch_resumes(folder, counted, late):
    fit_one, calls = batch.fit_one, []

    def interrupted(job, task):
        if len(counted) == 2 and not late:
            raise KeyboardInterrupt
        row = fit_one(job, task)
        if len(counted) == 3:
            raise KeyboardInterrupt
        return row

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch, "fit_one", interrupted)
        with pytest.raises(KeyboardInterrupt):
            fits.fit_files("scans", STACKS, "out", progress=lambda *given: calls.append(given[:3]), **FEW)
    assert [line["status"] for line in table()].count("not done yet") == 3 - late
    assert calls == [("fits", done, 6) for done in range(4 + late)]
    found = fits.fit_files("scans", STACKS, "out", **FEW)
    assert [row["result"] == "failed" for row in found.rows] == [True, True, False, False, False, False]
    assert len(counted) == 4 + late
    assert len(set(counted)) == 4


def test_a_result_of_something_else_is_refused_by_name_and_damage_is_fitted_again(folder, counted):
    fits.fit_files("scans/paint.csv", STACKS, "out", **FEW)
    before = contents(folder / "out")

    def refused(message, **options):
        refuses(message, fits.fit_files, "scans/paint.csv", STACKS, "out", **(FEW | options))
        assert contents(folder / "out") == before

    refused(r"out/paint.csv/coat: holds the work of another problem \(starts 2, not 3\); --force", starts=3)
    refused(r"\(read max_polar_angle None, not 60.0\)", read_options=ReadOptions(max_polar_angle=60.0))
    (folder / "bare.toml").write_text((folder / "bare.toml").read_text().replace("start = 0.5", "start = 0.6"))
    refused(r"out/paint.csv/bare: holds the work of another problem \(stack\)")
    with locked(folder / "out" / f"{STORE}.lock", "it"):
        before = contents(folder / "out")
        refused(f"out/{STORE} is in use by another process", force=True)
    del counted[:]
    assert fits.fit_files("scans/paint.csv", STACKS, "out", force=True, **FEW).complete
    assert counted == ["paint.csv bare"]
    path = folder / "out" / "paint.csv" / "bare" / "fit.json"
    path.write_text(path.read_text()[:-100])
    shutil.rmtree(folder / "out" / "paint.csv" / "coat")
    assert fits.fit_files("scans/paint.csv", STACKS, "out", **FEW).complete
    assert counted == ["paint.csv bare", "paint.csv coat", "paint.csv bare"]
    with open("scans/paint.csv", "a") as file:
        file.write("\n")
    before = contents(folder / "out")
    refused(r"\(file [0-9a-f]{8}, not")
    (folder / "out" / STORE).unlink()
    before = contents(folder / "out")
    refused(r"holds no batch\.store: choose another directory")


@pytest.mark.slow
def test_held_out_data_decide(folder):
    reading = ReadOptions(hold_out=("incidence=50",))
    found = fits.fit_files(["scans/coated.csv"], STACKS, "out", read_options=reading, **FEW)
    assert found.best == {"coated.csv": "coat"}
    coat, bare = found.rows
    assert coat["criterion"] == bare["criterion"] == "-2 elpd"
    assert coat["loss"] < bare["loss"]
    fit = fits.load_fit("out/coated.csv/coat")
    scores = fits.predict(fit, fits.read("out/coated.csv/coat/held_out.csv")).scores
    assert coat["loss"] == pytest.approx(-2.0 * scores.elpd * scores.count, abs=2e-3 * scores.count)


@pytest.mark.slow
def test_processes_give_what_threads_give(folder, whole):
    """A worker knows nothing of the patches here: reports are drawn, where they are wanted."""
    albedo = fits.load_fit(whole / "out" / "paint.csv" / "bare").values["base.albedo"]
    for reports, out in ((True, "out"), (False, "plain")):
        files = ["scans/paint.csv", "scans/broken.csv"]
        found = fits.fit_files(files, ["bare.toml"], out, processes=2, reports=reports, **FEW)
        assert found.rows[0]["base.albedo"] == pytest.approx(albedo, rel=1e-6)
        assert [row["result"] == "failed" for row in found.rows] == [False, True]
    assert "data:image/png" in Path("out/paint.csv/bare/report.html").read_text()
    assert not list(folder.glob("plain/*/*/report.html"))


def test_what_goes_wrong_in_one_fit_ends_none_of_the_others(folder, counted, monkeypatch):
    copied = batch.fit_file

    def broken(directory, *given, **options):
        if directory.parent.name == "coated.csv" and directory.name == "coat":
            raise RuntimeError("no memory\nis left")
        by = FIT_FILE if directory.parent.name == "paint.csv" and directory.name == "bare" else copied
        return by(directory, *given, **options)

    monkeypatch.setattr(batch, "fit_file", broken)
    fits.fit_files("scans/coated.csv", ["bare.toml"], "out", **FEW)
    precious = folder / "out" / "paint.csv" / "bare" / "precious"
    precious.parent.mkdir(parents=True)
    precious.touch()
    for force in (False, True):
        found = fits.fit_files(["scans/coated.csv", "scans/paint.csv"], STACKS, "out", force=force, **FEW)
        assert [row["result"] for row in found.rows] == ["failed", "converged", "converged", "failed"]
        assert found.rows[0]["status"] == "RuntimeError: no memory is left"
        assert "bare: exists and is not a result directory" in found.rows[3]["status"]
        assert precious.exists()


def test_bad_input_is_named_and_writes_nothing(folder):
    for name in ("empty", "copies"):
        (folder / name).mkdir()
    shutil.copy(folder / "bare.toml", folder / "copies" / "coat.toml")
    for name in ("paint.csv", "table.csv"):
        shutil.copy(folder / "scans" / "paint.csv", folder / "copies" / name)
    before = contents(folder)
    for files, stacks, out, message in (
        (["nowhere"], STACKS, "out", "no such file or folder: 'nowhere'"),
        (["empty"], STACKS, "out", "empty: no measurement file is given"),
        (["scans/paint.csv", "copies/paint.csv"], STACKS, "out", "scans/paint.csv and copies/paint.csv: results go by"),
        (["scans"], ["coat.toml", "copies/coat.toml"], "out", "results go by this name"),
        (["copies/table.csv"], STACKS, "out", r"copies/table.csv: the batch has a file of this name"),
        (["scans"], STACKS, "scans", r"is not empty, and holds no batch\.store"),
        (["scans"], STACKS, "coat.toml", "File exists: 'coat.toml'"),
    ):
        refuses(message, fits.fit_files, files, stacks, out, error=(ValueError, OSError))
        assert contents(folder) == before
        assert not (folder / "out").exists()


# ---- which stack is best of a file ----


def row(stack, loss, file="a.csv", **more):
    usual = {"result": "converged", "criterion": "AIC", "reduced_chi_square": 1.0, "status": ""}
    return {"file": file, "stack": stack, "loss": loss} | usual | more


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([row("one", 10.0), row("two", 11.9), row("three", 15.0)], ["best", "+1.9", "+5.0"]),
        # what did not converge is not the best of what did
        ([row("one", 10.0, result="not converged"), row("two", 17.0)], ["-7.0", "best"]),
        # nothing is said of what cannot be compared
        ([row("one", 10.0), FAILED], ["best", ""]),
        ([row("one", 10.0), row("two", 90.0, criterion="cube_root")], ["", ""]),
    ],
)
def test_stacks_of_a_file_are_ranked(rows, words):
    ranked = batch.ranked([*rows, row("one", 9.0, "b.csv"), row("two", 1.0, "b.csv"), row("one", 1.0, "c")])
    assert [one["standing"] for one in ranked] == [*words, "+8.0", "best", "best"]
    found = fits.FittedFiles(Path(), ranked, ("scans/README.md",))
    assert {"b.csv": "two", "c": "one"}.items() <= found.best.items()
    assert ("a.csv" in found.best) == ("best" in words)
    count, there = len(ranked), sum(one["result"] != "failed" for one in ranked)
    assert batch.statements(found)[0].startswith(f"{there} of {count} fits are there, ")
    assert batch.statements(found)[1] == "Not taken for measurements: scans/README.md."
    assert len(batch.overview(ranked * 20, most=10).rows) == 11
