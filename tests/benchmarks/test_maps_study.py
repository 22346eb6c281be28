"""The benchmark of maps: how rates are counted, what is reckoned on paper, and a tiny run that leaves whole files."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.studies.maps import engines, fitting, paper
from benchmarks.studies.maps.cases import CASES, job_of, painted_map
from benchmarks.studies.maps.fitting import PROCESSES, Row, Size, rate, warm
from benchmarks.studies.maps.run import study
from benchmarks.studies.maps.work import Texelwise, Timed, first_starts, peak, rows_of, scipy_fit
from fits.engines import Failure

TINY = Size(side=16, chunk=64, scipy=(2, 2), checked=2, rounds=1, repeats=3, tasks=8)
FLAKES = CASES[0]


def task(process: int, began: float, ended: float, fits: int = 10, kind: str = "ours") -> Timed:
    return Timed(kind, fits, began, ended, process, 0)


def row(**changed: object) -> Row:
    numbers = dict.fromkeys(Row.__dataclass_fields__, 0.0)
    return Row(**numbers | {"name": "one", "rate": 200.0, "pilot": 7.0} | changed)  # type: ignore[arg-type]


def test_rates_are_of_the_time_in_which_all_are_at_work() -> None:
    """One worker does 10 fits a second, the other 20, once the second has had its first chunk, at 5 s."""
    slow = [task(1, at, at + 1.0) for at in range(8)]
    fast = [task(2, 0.0, 5.0), *(task(2, 5.0 + 0.5 * at, 5.5 + 0.5 * at) for at in range(8))]
    found = engines.steady(enumerate([*slow, *fast]))
    assert found == pytest.approx(30.0)
    with pytest.raises(ValueError, match="too few chunks"):
        engines.steady(enumerate([*slow, fast[0]]))
    with pytest.raises(ValueError, match="failed: no disk"):
        engines.steady(enumerate([*slow, Failure("no disk")]))


def test_what_compiles_does_not_count() -> None:
    done = [task(1, 0.0, 9.0), task(1, 9.0, 10.0), task(2, 0.0, 9.0, kind="scipy"), task(2, 9.0, 10.0, kind="scipy")]
    kept = [one for _, one in warm([*enumerate(done)])]
    assert [one.began for one in kept] == [9.0, 9.0]
    assert rate([one for one in kept if one.kind == "ours"]) == PROCESSES * 10.0
    assert len(warm([*enumerate(done[:1])])) == 1  # there is nothing else


def test_a_scheduler_is_full_where_chunks_are_asked_for_as_fast_as_it_hands_them_out() -> None:
    """A chunk takes a core 10 s at 100 fits a second and core: 20 tasks a second keep 200 cores at work."""
    found = paper.on_paper(row(), 1000, 20.0, texels=1_000_000)
    assert found.seconds == pytest.approx(10.0)
    assert found.saturated == pytest.approx(200.0)
    # 1,000 chunks: one core after the other; and 256 cores as fast as the scheduler
    assert found.times == pytest.approx((10_007.0, 632.0, 57.0))
    assert paper.on_paper(row(), 1000, None, texels=1_000_000).times[-1] == pytest.approx(7.0 + 1e4 / 256)


def test_a_process_has_had_as_much_memory_as_it_has() -> None:
    held = np.ones(3 << 23)
    assert peak() > held.nbytes


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "why_no_cluster", lambda: "left out")
    monkeypatch.setattr(paper, "why_no_cluster", lambda: "left out")


@pytest.mark.slow  # several pairs of workers, which each import JAX
@pytest.mark.usefixtures("alone")
def test_a_tiny_run_writes_whole_files(tmp_path: Path) -> None:
    text, paths = study(directory=tmp_path, size=TINY, cases=[FLAKES])
    assert sorted(paths) == sorted(tmp_path.iterdir())
    content = json.loads(paths[0].read_text())
    assert paths[1].read_text() == text
    (found,) = content["fits"]
    assert found["texels"] == 256
    assert found["compared"] == 2 * (2 + PROCESSES)
    assert min(found["rate"], found["scipy"]) > 0.0
    assert found["above"] == 0.0
    assert found["converged"] == 1.0
    assert 0.8 < found["width"] < 1.25  # of 256 texels known to 5 %, of four the furthest
    assert found["peak"] > 1e8
    assert {one["what"].partition(":")[0] for one in content["workers"]} == {
        "a chunk of 64 texels beside its solution",
        "memory of a worker",
        "a million texels",
        "the pilot",
    }
    assert [engine["tasks"] for engine in content["engines"]] == [8]
    assert "left out" in text


@pytest.mark.slow
def test_scipy_begins_where_fits_of_the_map_do_and_ends_as_low() -> None:
    """A texel's cost at the truth is above both."""
    with painted_map(FLAKES, 8) as one:
        _, _, found = fitting.fitted(one, replace(TINY, side=8), processes=1)
        job, tasks = job_of(one, TINY.chunk)
        asked = Texelwise(tasks[0], (3, 60))
        rows, vectors = rows_of(job, asked), fitting.vectors_of(found, asked)
        ours = fitting.costs_at(job, rows, vectors)
        units = first_starts(job, rows)
        theirs = [scipy_fit(job, rows.rows(place), unit) for place, unit in enumerate(units)]
        np.testing.assert_allclose(ours, theirs, atol=fitting.ROUNDING)
        truth = np.stack([one.truth[name].ravel()[[3, 60]] for name in found.names], axis=1)
        assert np.all(ours < fitting.costs_at(job, rows, truth))
