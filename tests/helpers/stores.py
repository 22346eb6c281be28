"""What lies in a store, as tests count it."""

from fits.store import Store


def keys(store: Store) -> list[str]:
    """Keys of all records but the fingerprint, in the order in which they were first written."""
    rows = store._select("SELECT key FROM records ORDER BY number") if store.fingerprint else []
    return [key for key in dict.fromkeys(key for (key,) in rows) if key != "fingerprint"]
