"""What lies in a store, as tests count it."""

import sqlite3
from contextlib import closing, suppress

from fits.store import Store


def keys(store: Store) -> list[str]:
    """Keys of all records but the fingerprint, in the order in which they were first written; none, if it is gone."""
    rows = []
    with suppress(sqlite3.OperationalError), closing(sqlite3.connect(f"file:{store.path}?mode=ro", uri=True)) as found:
        rows = found.execute("SELECT key FROM records ORDER BY number").fetchall()
    return [key for key in dict.fromkeys(key for (key,) in rows) if key != "fingerprint"]
