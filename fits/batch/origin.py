"""What a result was made of, kept in its directory, so that what is done already is not done again."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fits._files import read_json
from fits.batch.rows import Row, stored_row
from fits.reports.results import FIT

ORIGIN = "origin.json"


@dataclass(frozen=True)
class Origin:
    """file, stack: fingerprints of their content. settings: all else that a result depends on, by name."""

    file: str
    stack: str
    settings: Mapping[str, Any]

    def plain(self, row: Row) -> dict[str, Any]:
        """The content of `ORIGIN`."""
        return {
            "layerjax_origin": 1,
            "file": self.file,
            "stack": self.stack,
            "settings": dict(self.settings),
            "row": row.plain(),
        }

    def differs(self, stored: Mapping[str, Any]) -> str:
        """What a stored one differs in, in words; empty if in nothing."""
        if stored["file"] != self.file:
            return "what the file held before it was changed"
        if stored["stack"] != self.stack:
            return "another stack of this name"
        there = stored["settings"]
        for name, value in self.settings.items():
            if there.get(name) != value:
                return f"other settings ({name} {_shown(there.get(name))}, not {_shown(value)})"
        return ""


def fingerprint(content: bytes) -> str:
    """Of a file, whatever its line ends."""
    return hashlib.sha256(content.replace(b"\r\n", b"\n")).hexdigest()


def done_before(directory: Path, origin: Origin) -> Row | None:
    """The row of a result that is there already; None: there is none.

    Raises:
        Other: it is of something else.
        ValueError: it is damaged.
    """
    if not directory.exists() or not any(directory.iterdir()):
        return None
    if not (directory / ORIGIN).is_file():
        raise Foreign(f"{directory}: holds something that fit-many did not make")
    content = read_json(directory / ORIGIN)
    try:
        difference = origin.differs(content)
        row = stored_row(content["row"])
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{directory / ORIGIN}: damaged: {error!r}") from None
    if difference:
        raise Other(f"{directory}: holds a fit of {difference}")
    if not (directory / FIT).is_file():
        raise ValueError(f"{directory}: damaged, it holds no {FIT}")
    read_json(directory / FIT)
    return row


class Other(ValueError):
    """A directory that holds another result than the one that is asked for."""


class Foreign(Other):
    """A directory that holds something else altogether."""


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(map(str, value)) or "none"
    return "default" if value is None else str(value)
