"""Whether a search finds the stack: how places are counted, and that a stopped run goes on. Searches have their own."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.studies import structures
from benchmarks.studies.structures import TRUTHS, Repeat
from fits.structure_search import named


def repeat(index: int, place: int | None = 0, best: str | None = None, clear_diff: float | None = -1.0) -> Repeat:
    truth = named(TRUTHS[index])
    return Repeat(index, truth, place, best or truth, 2.0, clear_diff, 14, 30.0)


def test_places_are_counted(tmp_path: Path) -> None:
    simple, complex_ = named(TRUTHS[0]), named(TRUTHS[-1])
    done = [
        repeat(0),  # found
        repeat(1, place=2, best=complex_),  # among the first three, the more complex one ahead of it by chance
        repeat(2, place=3, best=complex_, clear_diff=5.0),  # beaten by a more complex one
        repeat(10, place=None, best=simple, clear_diff=None),  # not looked at, beaten by a simpler one
    ]
    text, paths = structures._save(done, tmp_path)
    assert "among the first three in 2 of 4" in text
    assert "preferred by more than chance in 1." in text
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    assert rows[-1] == ["all", "4", "1", "2", "2", "1", "14", "30 s"]
    assert [Repeat(**one) for one in json.loads(paths[0].read_text())["repeats"]] == done


def test_a_run_that_was_stopped_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(structures, "run_repeat", lambda index: asked.append(index) or repeat(index))
    structures.study(directory=tmp_path, repeats=2, processes=1)
    structures.study(directory=tmp_path, repeats=4, resume=True, processes=1)
    assert asked == [0, 1, 2, 3]


def test_materials_are_stacks_of_their_own() -> None:
    """The same for the same number, with noise of 2 %, another for another."""
    (structure, data), (again, same), (_, other) = map(structures.material, (0, 0, 12))
    assert structure == again == TRUTHS[0]
    np.testing.assert_array_equal(data.values, same.values)
    assert data.sigma is None
    assert not np.allclose(data.values, other.values, rtol=0.1)
