"""Where the store of a map is to be, and what is there: gone on with, refused, or thrown away."""

import glob
import os
import shutil
import uuid
from collections.abc import Mapping
from pathlib import Path

import zarr

from fits.maps.chunk_files import PARTIAL
from fits.maps.fitted_map import is_ours, is_store, open_map
from fits.maps.identity import require_same
from fits.maps.prepared import GROUP, is_whole
from fits.maps.store import clean


def require_folder(path: Path) -> None:
    """Refuse a place whose folder is not there, before any work."""
    if not path.resolve().parent.is_dir():
        raise ValueError(f"{path}: there is no directory {path.parent}")


def begun(path: Path, identity: Mapping[str, str], force: bool) -> zarr.Group | None:
    """The store that is there, if it is of the same fit, and nobody else writes it; None: there is none, or one to
    `throw_away`.

    What killed writers left is taken away, and what all chunks have in common if it is damaged: it is found again.

    Args:
        path: of the store.
        identity: fingerprints of what makes this fit, by name.
        force: throw away a map of another fit, or a damaged one.

    Raises:
        ValueError: something else is there, or a map of another fit, or a damaged one.
    """
    for unfinished in path.resolve().parent.glob(f".{glob.escape(path.name)}.*{PARTIAL}"):
        shutil.rmtree(unfinished, ignore_errors=True)
    if not os.path.lexists(path):
        return None
    if not is_store(path):
        raise ValueError(f"{path}: is there, and is no fitted map; it must be the store of one, or not be there")
    try:
        require_same(path, open_map(path).attributes.get("digests", {}), identity)
    except ValueError:
        if not (force and is_ours(path)):
            raise
        return None
    clean(path)
    root = zarr.open_group(path, mode="r+")
    if not is_whole(root):
        shutil.rmtree(path / GROUP, ignore_errors=True)
    return root


def throw_away(path: Path) -> None:
    """Remove the map that is there, if there is one; what is left of it where that is stopped `begun` takes away.

    Raises:
        OSError: it cannot be moved or removed.
    """
    if is_ours(path):
        old = path.with_name(f".{path.name}.{uuid.uuid4().hex}{PARTIAL}")
        os.rename(path, old)
        shutil.rmtree(old)
