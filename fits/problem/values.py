"""What users write, checked: TOML files as tables, and the values in them; an error is a ValueError on one line.

Errors name the place (``layers[0].thickness``), what stands there, shortened to a few words, and what may.
"""

import difflib
import math
import re
import reprlib
import sys
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from fits._files import require_file

Range = tuple[float, float]
ANY: Range = (-math.inf, math.inf)
MOST = 2**31 - 1  # of a whole number: counts are kept in 32 bits
DEEPEST = 5  # layers, a layer, its phase function, a free number, its prior
_LONGEST = 60  # letters of a value that an error shows
_LONGEST_MESSAGE = 300
_LONG_NUMBER = re.compile(r"[0-9](?:_?[0-9]){400,}")


def read_tables(path: Path) -> tuple[str, dict[str, Any]]:
    """The text of a TOML file, without a byte order mark, and its tables. ValueError that names the file."""
    require_file(path)
    try:
        text = path.read_bytes().decode("utf-8-sig")
        return text, _parse(text)
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not a text file (byte {error.start} is not UTF-8)") from None
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path}: not valid TOML: {_shortened(str(error), _LONGEST_MESSAGE)}") from None
    except RecursionError:
        raise ValueError(
            f"{path}: arrays or tables are nested too deeply to be read, must be at most {DEEPEST} deep"
        ) from None


def _parse(text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except ValueError:
        # Python turns down whole numbers of thousands of digits without saying where they stand. With fewer, but still
        # too many, the field that holds one is found, and refuses it.
        return tomllib.loads(_LONG_NUMBER.sub(_with_fewer_digits, text))


def _with_fewer_digits(number: re.Match[str]) -> str:
    digits = number[0].replace("_", "")
    return digits[:200] + digits[-200:]


class _Shown(reprlib.Repr):
    """Python's notation, with the middle omitted where it is long."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel, self.maxlist, self.maxtuple, self.maxdict = 2, 6, 6, 4
        self.maxstring = self.maxother = self.maxlong = _LONGEST

    def repr_int(self, x: int, level: int) -> str:
        try:
            return super().repr_int(x, level)
        except ValueError:  # too many digits for Python to write out
            return _shortened(hex(x), _LONGEST)

    def repr_datetime(self, x: Any, level: int) -> str:
        return str(x)

    repr_date = repr_time = repr_datetime


def shown(value: Any) -> str:
    """A value as an error shows it: on one line and short, whatever it is."""
    return _shortened(" ".join(_Shown().repr(value).split()), 3 * _LONGEST)


def _shortened(text: str, most: int) -> str:
    half = most // 2
    return text if len(text) <= most else f"{text[:half]}...{text[-half:]}"


def numbers(where: str, value: Any, allowed: Range = ANY) -> float | tuple[float, ...]:
    """One finite number, or a list of them, within the closed range `allowed`."""
    low, high = allowed
    wanted = "a finite number" if allowed == ANY else f"a number in [{low:g}, {high:g}]"
    given = value if isinstance(value, list) else [value]
    for number in given:
        if isinstance(number, bool) or not isinstance(number, int | float):
            raise ValueError(f"{where} is {shown(number)}, must be {wanted}")
        # whole numbers may be beyond what float can hold
        if not (abs(number) <= sys.float_info.max and low <= number <= high):
            word = f"{number:g}" if isinstance(number, float) else shown(number)
            raise ValueError(f"{where} is {word}, must be {wanted}")
    if not given:
        raise ValueError(f"{where} is an empty list, must be {wanted} or one a channel")
    return tuple(float(number) for number in given) if isinstance(value, list) else float(value)


def one_number(where: str, value: Any, allowed: Range = ANY) -> float:
    """One finite number within the closed range `allowed`."""
    number = numbers(where, value, allowed)
    if isinstance(number, tuple):
        raise ValueError(f"{where} is {shown(value)}, must be one number")
    return number


def whole_number(where: str, value: Any) -> int:
    """A whole number of at most 32 bits; what it may be beyond that is for its owner to say."""
    if type(value) is not int or abs(value) > MOST:
        raise ValueError(f"{where} is {shown(value)}, must be a whole number up to {MOST}")
    return value


def whole_numbers(where: str, value: Any, count: int) -> tuple[int, ...]:
    """A list of `count` whole numbers of at most 32 bits each, as a tuple; ValueError for anything else."""
    if not isinstance(value, list) or len(value) != count or any(type(number) is not int for number in value):
        raise ValueError(f"{where} is {shown(value)}, must be a list of {count} whole numbers")
    return tuple(whole_number(f"{where}[{index}]", number) for index, number in enumerate(value))


def truth(where: str, value: Any) -> bool:
    """The value itself, if it is true or false; ValueError for anything else."""
    if not isinstance(value, bool):
        raise ValueError(f"{where} is {shown(value)}, must be true or false")
    return value


def choice(where: str, value: Any, allowed: Iterable[str]) -> str:
    """The value itself, if it is one of the allowed words; ValueError, with a likely one, for anything else."""
    allowed = tuple(allowed)
    if not (isinstance(value, str) and value in allowed):
        raise ValueError(f"{where} is {shown(value)}{_suggestion(value, allowed)}, must be one of {', '.join(allowed)}")
    return value


def check_keys(where: str, table: Mapping[str, Any], allowed: tuple[str, ...]) -> None:
    """Raise a ValueError for a key of the table that is not among the allowed ones."""
    for key in table:
        if key not in allowed:
            raise ValueError(
                f"{where} has an unknown key {shown(key)}{_suggestion(key, allowed)}; allowed: {', '.join(allowed)}"
            )


def require_table(where: str, table: Any) -> dict[str, Any]:
    """The value itself, if it is a table; ValueError for anything else."""
    if not isinstance(table, dict):
        raise ValueError(f"{where} is {shown(table)}, must be a table")
    return table


def _suggestion(value: Any, allowed: Iterable[str]) -> str:
    close = difflib.get_close_matches(value, allowed, n=1) if isinstance(value, str) and len(value) < _LONGEST else []
    return f" (did you mean {close[0]!r}?)" if close else ""
