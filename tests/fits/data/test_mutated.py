"""Every reader, with files that are damaged in any way: readings, or one line that says what is wrong."""

from pathlib import Path

import numpy as np
import pytest

from fits.data.measurements import Measurements
from fits.data.reading import read
from fits.names import FORMATS
from tests.helpers.data_files import FILES
from tests.helpers.mutations import mutated


def damaged(kind: str, folder: Path, count: int) -> None:
    name, make = FILES[kind]
    raw = make(folder)
    random = np.random.default_rng(len(kind))
    said = 0
    for _ in range(count):
        bad = folder / name
        bad.write_bytes(mutated(raw, random, 4000 if kind == "zemax" else 400))
        try:
            found = read(bad, format=kind)
        except ValueError as error:
            words = str(error)
            said += 1
        else:
            assert isinstance(found, Measurements)
            continue
        assert words.startswith(str(bad)), words
        assert "\n" not in words, words
    assert said > 0


def test_each_format_is_held_against_damage() -> None:
    assert set(FILES) == set(FORMATS)


@pytest.mark.parametrize("kind", sorted(set(FILES) - {"totals", "rxt", "merl", "rgl"}))
def test_whole_files_are_known_by_their_content(tmp_path: Path, kind: str) -> None:
    name, make = FILES[kind]
    path = tmp_path / f"{name}.txt"
    path.write_bytes(make(tmp_path))
    found = read(path)
    assert isinstance(found, Measurements)
    assert found.source.format == kind


pytestmark = pytest.mark.filterwarnings("ignore:.*more than 3 standard deviations:UserWarning")


@pytest.mark.parametrize("kind", FILES)
def test_some_damaged_files(tmp_path: Path, kind: str) -> None:
    damaged(kind, tmp_path, 8 if kind in ("merl", "rgl") else 40)


@pytest.mark.slow
@pytest.mark.parametrize("kind", FILES)
def test_many_damaged_files(tmp_path: Path, kind: str) -> None:
    damaged(kind, tmp_path, 500)
