"""Which files are fitted, by which stacks: found, named and read before any work begins."""

from collections.abc import Sequence
from pathlib import Path

from fits._files import require_there
from fits.data.formats import sniff
from fits.problem.stack_file import ProblemFile, read_problem

SEARCH, STACKS = "search", "search-stacks"
"""Directories of a search below that of a file: its best as a result, and all that it fitted."""

TABLE, TABLE_JSON, PAGE = "table.csv", "table.json", "report.html"

MEASURED = (".csv", ".tsv", ".binary", ".bsdf", ".brdf", ".anisotropicbsdf", ".astm", ".rxt", ".ssdd")
"""Endings that say of a file in a folder that it should hold measurements; others do if their content says so."""


def measurement_files(given: Sequence[str | Path], format: str | None) -> tuple[dict[str, Path], tuple[str, ...]]:
    """Files by name, those of folders among them; and what folders hold beside measurements.

    format: of all files; None: each says so itself.

    Raises:
        FileNotFoundError: no such file or folder.
        ValueError: a folder without measurements, or a name that is there twice.
    """
    found: dict[str, Path] = {}
    beside: list[str] = []
    for place in map(Path, given):
        require_there(place, "no such file or folder")
        files = [place]
        if place.is_dir():
            every = sorted(one for one in place.iterdir() if one.is_file() and not one.name.startswith("."))
            files = [one for one in every if format is not None or _measured(one)]
            beside += [str(one) for one in every if one not in files]
            if not files:
                raise ValueError(f"{place}: holds no measurement file")
        for path in files:
            if path.name in found:
                raise ValueError(f"{found[path.name]} and {path}: results go by the file's name, which must differ")
            if path.name in (TABLE, TABLE_JSON, PAGE):
                raise ValueError(f"{path}: its name must be another: fit-many writes a {path.name} of its own")
            found[path.name] = path
    if not found:
        raise ValueError("no file is given; there must be at least one")
    return found, tuple(beside)


def stack_files(given: Sequence[str | Path]) -> dict[str, ProblemFile]:
    """Stacks by name, as their files say.

    Raises:
        ValueError: as `read_problem`; a name that is there twice or that a search has.
    """
    found: dict[str, ProblemFile] = {}
    places: dict[str, Path] = {}
    for path in map(Path, given):
        name = path.stem
        if name in found:
            raise ValueError(f"{places[name]} and {path}: results go by the stack's name, which must differ")
        if name in (SEARCH, STACKS):
            raise ValueError(f"{path}: its name must be another: {name} is that of a search")
        found[name], places[name] = read_problem(path), path
    return found


def _measured(path: Path) -> bool:
    if path.suffix.lower() in MEASURED:
        return True
    try:
        sniff(path)
    except (ValueError, OSError):
        return False
    return True
