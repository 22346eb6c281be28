"""Every format, as programs and people leave files behind, and damaged: each reads right, or is refused on one line."""

import os
import re

import numpy as np
import pytest

from fits import Measurements, ReadOptions, read, slices
from fits.data.measurements import LARGEST
from fits.names import FORMATS
from tests.helpers.data_files import FILES, NAMES, written
from tests.helpers.mutations import mutated

BINARY = ("merl", "rgl")
TEXT = sorted(set(FILES) - set(BINARY))
NUMBER = rb"(?<![\w.+-])[-+]?\d+(\.\d*)?([eE][-+]?\d+)?(?![\w.])"


@pytest.fixture
def found(tmp_path):
    """What a file of a format holds; the words of its refusal where it is refused, on one line that names it."""

    def of(kind: str, raw: bytes, format: str | None = None) -> Measurements | str:
        path = written(tmp_path, raw, NAMES.get(kind, "data.xyz"))
        try:
            return read(path, format=format)
        except ValueError as error:
            words = str(error)
        assert words.startswith(str(path)), words
        assert "\n" not in words
        return words

    return of


UNHURT = {
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
def test_what_is_not_content_changes_nothing(made, found, kind):
    assert set(FILES) == set(FORMATS)
    raw = made(kind)
    whole = found(kind, raw)
    assert kind in (whole.source.format, "totals")  # which are a CSV
    for name, change in UNHURT.items():
        changed = found(kind, change(raw))
        for part in ("wi", "wo", "values", "mask"):
            np.testing.assert_array_equal(getattr(changed, part), getattr(whole, part), name)


@pytest.mark.parametrize("kind", TEXT)
def test_no_number_passes_for_another(made, found, kind):
    raw = made(kind)
    whole, last = found(kind, raw), list(re.finditer(NUMBER, raw))[-1]
    line = raw[: last.start()].count(b"\n") + 1
    for number in ("1e300", "-1e300", "1e999", "nan", "inf", "1e-320", "", "1,5", "x"):
        data = found(kind, raw[: last.start()] + number.encode() + raw[last.end() :])
        if isinstance(data, Measurements):  # unused, out of range of what is read, or left out and said so
            assert np.isfinite(data.values).all()
            assert np.abs(data.values).max() <= LARGEST
            if number in ("nan", "") and len(data) != len(whole):
                assert any(note.startswith("skipped: 1 data point") for note in data.source.notes)
        elif number in ("x", "inf", "1e999") and kind not in ("klems", "tensortree"):
            assert f", line {line}, column" in data
            assert number in data


@pytest.mark.parametrize("kind", FILES)
def test_a_truncated_file_is_refused_or_holds_less(made, found, kind):
    raw = made(kind)
    whole = found(kind, raw)
    for share in (0.0, 0.02, 0.5, 0.9):
        data = found(kind, raw[: int(share * len(raw))])
        assert isinstance(data, str) or len(data) < len(whole)  # formats of lines without an end do not know


@pytest.mark.parametrize("kind", BINARY)
def test_binary_values_are_limited_too(made, found, kind):
    raw, kept = made(kind), np.dtype("<f8" if kind == "merl" else "<f4")
    for number in (1e300, np.inf, np.nan):
        with np.errstate(over="ignore"):
            bad = np.array(number).astype(kept).tobytes()
        data = found(kind, raw[: -1000 * kept.itemsize] + 1000 * bad)
        assert isinstance(data, str) or np.abs(data.values).max() <= LARGEST
    assert isinstance(found(kind, b"\xef\xbb\xbf" + raw), str)


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("count", [40, pytest.param(500, marks=pytest.mark.slow)])
def test_damaged_files(made, found, kind, count):
    raw, random = made(kind), np.random.default_rng(len(kind))
    head = 4000 if kind == "zemax" else 400
    changed = (mutated(raw, random, head) for _ in range(count if kind not in BINARY else count // 5))
    assert any(isinstance(found(kind, one, kind), str) for one in changed)


def test_bad_arguments(reading, tmp_path):
    text = "theta_i,theta_o,brdf\n10,20,0.5\n"
    for given, message in (
        ({"format": "xls"}, f"format is 'xls', must be one of {', '.join(FORMATS)}"),
        ({"quantity": "f"}, "quantity is 'f', must be one of"),
        ({"geometry": slices()}, "geometry and bins apply to MERL and RGL files only"),
        ({"hold_out": ["incidence=50"]}, "hold_out: it is for a fit"),
    ):
        with pytest.raises(ValueError, match=message):
            reading(text, **given)
    with pytest.raises(TypeError, match="bin"):
        reading(text, bin=4)
    os.mkfifo(tmp_path / "pipe")
    for place, message in {"": "is a directory", "pipe": "is a pipe or a device", "none": "no such file"}.items():
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            read(tmp_path / place)


def test_what_is_masked_selected_and_held_out(reading, tmp_path):
    rows = [f"{incidence},180,{theta},0,0.1" for incidence in (10, 50) for theta in range(0, 90, 10)]
    text = "\n".join(["theta_i,phi_i,theta_o,phi_o,brdf", *rows])
    assert len(reading(text, max_polar_angle=60.0, select=["incidence=10"]).used()) == 7
    fitted, held_out = ReadOptions(hold_out=["incidence=50"]).split(tmp_path / "data.txt")
    assert (len(fitted.used()), len(held_out.used())) == (9, 9)
