"""Result directories: where one may be written, and written whole or not at all."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fits._files import locked

FIT, LOCK = "fit.json", "chain.lock"


def check_directory(directory: Path, force: bool) -> None:
    """Refuses a place where a result cannot be written, or is being sampled: ValueError that says why."""
    if not directory.resolve().parent.is_dir():
        raise ValueError(f"{directory}: there is no directory {directory.resolve().parent}")
    if not directory.exists() or (directory.is_dir() and not any(directory.iterdir())):
        return
    if not (directory / FIT).is_file():
        raise ValueError(f"{directory}: exists and is not a result directory (it holds no {FIT}), will not be replaced")
    if not force:
        raise ValueError(f"{directory}: holds a result already (--force, or force=True, replaces it)")
    if (directory / LOCK).exists():
        with locked(directory / LOCK, str(directory)):
            pass


@contextmanager
def reserved(directory: str | Path, force: bool = False) -> Iterator[None]:
    """While the block lasts, no other process writes this result: a ValueError where one does, or as `replacing`."""
    directory = Path(directory)
    check_directory(directory, force)
    target = directory.resolve()
    with locked(target.with_name(f".{target.name}.lock"), str(directory)):
        new, old = _beside(target)  # as a killed process left them
        if old.exists() and not target.exists():
            old.rename(target)
        for left in (new, old):
            shutil.rmtree(left, ignore_errors=True)
        yield


def _beside(target: Path) -> tuple[Path, Path]:
    return target.with_name(f".{target.name}.layerjax-new"), target.with_name(f".{target.name}.layerjax-old")


@contextmanager
def replacing(directory: str | Path, force: bool = False) -> Iterator[Path]:
    """A new folder beside `directory` that takes its place when the block ends well, and is removed when it does not.

    The directory must be `reserved`. Raises ValueError for one that is not empty, unless `force` is given and it is an
    earlier result.
    """
    directory = Path(directory)
    check_directory(directory, force)
    target = directory.resolve()
    folder, old = _beside(target)
    try:
        folder.mkdir()
        yield folder
        check_directory(directory, force)  # someone else may have written there in the meantime
        if not target.exists():
            folder.rename(target)
            return
        with locked(target / LOCK, str(directory)):
            target.rename(old)
            try:
                folder.rename(target)
            except OSError:
                old.rename(target)
                raise
        shutil.rmtree(old)
    except BaseException as error:
        shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, OSError) and str(error.filename).startswith(f"{folder}"):
            error.filename = f"{directory}{str(error.filename).removeprefix(str(folder))}"  # which the user knows
        raise
