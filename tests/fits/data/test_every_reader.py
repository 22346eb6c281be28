"""Every format, as programs and people leave files behind, and damaged: each reads right, or is refused on one line."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fits.data.measurements import LARGEST, Measurements
from fits.data.reading import read
from fits.names import FORMATS
from tests.helpers.data_files import FILES
from tests.helpers.mutations import mutated

BINARY = ("merl", "rgl")
TEXT = sorted(set(FILES) - set(BINARY))

pytestmark = pytest.mark.filterwarnings("ignore:.*more than 3 standard deviations:UserWarning")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], bytes]:
    """The bytes of a file, made once."""
    folder, kept = tmp_path_factory.mktemp("files"), {}

    def of(kind: str) -> bytes:
        if kind not in kept:
            kept[kind] = FILES[kind][1](folder)
        return kept[kind]

    return of


def with_last_number(raw: bytes, number: str) -> bytes:
    last = list(re.finditer(rb"(?<![\w.+-])[-+]?\d+(\.\d*)?([eE][-+]?\d+)?(?![\w.])", raw))[-1]
    return raw[: last.start()] + number.encode() + raw[last.end() :]


def found(path: Path, raw: bytes, kind: str | None = None) -> Measurements | None:
    """What a file holds; None where it is refused on one line that names it."""
    path.write_bytes(raw)
    try:
        return read(path, format=kind)
    except ValueError as error:
        words = str(error)
    assert words.startswith(str(path)), words
    assert "\n" not in words
    return None


UNHURT: dict[str, Callable[[bytes], bytes]] = {
    "byte order mark": lambda raw: b"\xef\xbb\xbf" + raw,
    "byte order mark and blank line": lambda raw: b"\xef\xbb\xbf\r\n" + raw,
    "UTF-16": lambda raw: raw.decode("latin-1").encode("utf-16"),
    "leading blank lines": lambda raw: b"\n \n" + raw,
    "CRLF": lambda raw: raw.replace(b"\r\n", b"\n").replace(b"\n", b"\r\n"),
    "CR": lambda raw: raw.replace(b"\r\n", b"\n").replace(b"\n", b"\r"),
    "trailing blanks": lambda raw: raw.replace(b"\r\n", b"\n").replace(b"\n", b" \t\n") + b"\n\n",
    "no end of the last line": lambda raw: raw.rstrip(),
}


@pytest.mark.parametrize("kind", TEXT)
@pytest.mark.parametrize("change", UNHURT)
def test_what_is_not_content_changes_nothing(
    made: Callable[[str], bytes], tmp_path: Path, kind: str, change: str
) -> None:
    path, raw = tmp_path / FILES[kind][0], made(kind)
    whole, changed = found(path, raw), found(path, UNHURT[change](raw))
    assert whole is not None
    assert changed is not None
    assert changed.source.format == whole.source.format
    for name in ("wi", "wo", "values", "mask"):
        np.testing.assert_array_equal(getattr(changed, name), getattr(whole, name))


@pytest.mark.parametrize("kind", TEXT)
@pytest.mark.parametrize("number", ["1e300", "-1e300", "1e999", "nan", "inf", "1e-320", "", "1,5", "x"])
def test_no_number_passes_for_another(made: Callable[[str], bytes], tmp_path: Path, kind: str, number: str) -> None:
    raw = made(kind)
    whole, data = found(tmp_path / FILES[kind][0], raw), found(tmp_path / FILES[kind][0], with_last_number(raw, number))
    assert whole is not None
    if data is not None:  # unused, out of range of what is read, or left out and said so
        assert np.isfinite(data.values).all()
        assert np.abs(data.values).max() <= LARGEST
        if number in ("nan", "") and len(data) != len(whole):
            assert any(note.startswith("skipped: 1 data point") for note in data.source.notes)


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.9])
def test_a_truncated_file_is_refused_or_holds_less(
    made: Callable[[str], bytes], tmp_path: Path, kind: str, share: float
) -> None:
    raw = made(kind)
    whole, data = found(tmp_path / FILES[kind][0], raw), found(tmp_path / FILES[kind][0], raw[: int(share * len(raw))])
    assert whole is not None
    assert data is None or len(data) < len(whole)  # formats of lines without an end do not know


@pytest.mark.parametrize("kind", BINARY)
@pytest.mark.parametrize("number", [1e300, np.inf, np.nan])
def test_binary_values_are_limited_too(made: Callable[[str], bytes], tmp_path: Path, kind: str, number: float) -> None:
    raw, kept = made(kind), np.dtype("<f8" if kind == "merl" else "<f4")
    with np.errstate(over="ignore"):
        bad = np.array(number).astype(kept).tobytes()
    data = found(tmp_path / FILES[kind][0], raw[: -1000 * kept.itemsize] + 1000 * bad)
    if data is not None:
        assert np.abs(data.values).max() <= LARGEST
    assert found(tmp_path / FILES[kind][0], b"\xef\xbb\xbf" + raw) is None


@pytest.mark.parametrize("kind", sorted(set(FILES) - {"totals", "rxt", "merl", "rgl"}))
def test_whole_files_are_known_by_their_content(made: Callable[[str], bytes], tmp_path: Path, kind: str) -> None:
    assert set(FILES) == set(FORMATS)
    whole = found(tmp_path / "data.xyz", made(kind))
    assert whole is not None
    assert whole.source.format == kind


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("count", [40, pytest.param(500, marks=pytest.mark.slow)])
def test_damaged_files(made: Callable[[str], bytes], tmp_path: Path, kind: str, count: int) -> None:
    raw, random = made(kind), np.random.default_rng(len(kind))
    count = count if kind not in BINARY else count // 5
    head = 4000 if kind == "zemax" else 400
    read_again = [found(tmp_path / FILES[kind][0], mutated(raw, random, head), kind) for _ in range(count)]
    assert any(one is None for one in read_again)
