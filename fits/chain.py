"""A chain that survives being killed at any moment.

Each step is appended to a journal as one record of fixed size, in a single write, with a checksum. Now and then the
whole chain goes to an HDF5 file, written beside the old one and renamed over it, in the layout of
`emcee.backends.HDFBackend`, which opens it. Opening reads the HDF5 file, then the journal's records beyond it up to the
first that is not whole: what is lost is at most the step that was being written, and since the random state is part of
a record, the chain goes on as if nothing had happened.
"""

import os
import secrets
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import emcee
import numpy as np
from emcee.backends import Backend
from numpy.typing import NDArray

GROUP = "mcmc"
IDENTITY = "layerjax_"
RandomState = tuple[str, NDArray[np.uint32], int, int, float]


class MemoryChain(Backend):
    """A chain in memory that grows in blocks; the same interface as `FileChain` without the files."""

    def __init__(self, walkers: int, count: int):
        super().__init__()
        self.reset(walkers, count)

    def grow(self, ngrow: int, blobs: Any) -> None:
        """Room for `ngrow` more steps, at least doubling, so that growing stays cheap."""
        free = len(self.chain) - self.iteration
        if free < ngrow:
            super().grow(max(ngrow, self.iteration), blobs)

    def checkpoint(self) -> None:
        """Nothing to write."""

    def close(self) -> None:
        """Nothing to close."""


class FileChain(MemoryChain):
    """A chain kept in `path` (HDF5) and a journal beside it (`path` with the suffix ``.journal``).

    identity: numbers and strings that tell problems apart, stored with the chain. Opening a chain whose identity
    differs raises ValueError, and so does a file that is not a chain; `resume=False` replaces whatever is there.
    """

    def __init__(self, path: str | Path, walkers: int, count: int, identity: Mapping[str, Any], resume: bool = True):
        super().__init__(walkers, count)
        self.path = Path(path)
        self.journal_path = self.path.with_suffix(".journal")
        self.identity = dict(identity)
        if resume and self.path.exists():
            self.number = self._read_file()
            self.stored = self.iteration
            whole = self._read_journal()
        else:
            self.number, whole = secrets.randbits(63), 0
            self._write_file()
        # unbuffered: a step is in the kernel's hands once `write` returns, whatever happens to this process
        descriptor = os.open(self.journal_path, os.O_RDWR | os.O_CREAT, 0o666)
        self._journal = os.fdopen(descriptor, "r+b", buffering=0)
        self._journal.truncate(whole)
        self._journal.seek(whole)

    def save_step(self, state: emcee.State, accepted: NDArray[np.bool_]) -> None:
        """Keep a step, in memory and in the journal."""
        super().save_step(state, accepted)
        _, keys, position, has_gauss, cached = state.random_state
        record = np.zeros((), _record_type(*self.shape))
        record["chain"], record["step"] = self.number, self.iteration
        record["coords"], record["log_prob"], record["accepted"] = state.coords, state.log_prob, accepted
        record["keys"], record["position"], record["has_gauss"], record["cached"] = keys, position, has_gauss, cached
        record["checksum"] = zlib.crc32(record.tobytes()[:-4])
        self._journal.write(record.tobytes())

    def checkpoint(self) -> None:
        """Write the whole chain to the HDF5 file, if it has grown; the journal starts again."""
        if self.stored != self.iteration:
            self._write_file()
        self._journal.truncate(0)
        self._journal.seek(0)

    def close(self) -> None:
        """Close the journal, and remove it if every step is in the HDF5 file."""
        empty = self._journal.tell() == 0
        self._journal.close()
        if empty:
            self.journal_path.unlink(missing_ok=True)

    def _read_file(self) -> int:
        stored = read_chain(self.path)
        for name, value in self.identity.items():
            if not _agrees(stored["identity"].get(name), value):
                raise ValueError(
                    f"{self.path} holds a chain of another problem or setting ({name} differs): "
                    "give another path, or resume=False to replace it"
                )
        self.chain, self.log_prob, self.accepted = stored["chain"], stored["log_prob"], stored["accepted"]
        self.iteration, self.random_state = len(self.chain), stored["random_state"]
        return int(stored["number"])

    def _read_journal(self) -> int:
        """Take in the whole records that continue the chain; returns their length in bytes."""
        if not self.journal_path.exists():
            return 0
        content = self.journal_path.read_bytes()
        kind = _record_type(*self.shape)
        whole = 0
        self.grow(len(content) // kind.itemsize, None)
        for record in np.frombuffer(content[: len(content) // kind.itemsize * kind.itemsize], kind):
            if record["chain"] != self.number or record["checksum"] != zlib.crc32(record.tobytes()[:-4]):
                break
            whole += kind.itemsize
            if record["step"] != self.iteration + 1:  # written before the checkpoint that was read
                continue
            random_state = tuple(record[name].item() for name in ("position", "has_gauss", "cached"))
            state = emcee.State(record["coords"], log_prob=record["log_prob"])
            state.random_state = ("MT19937", record["keys"].copy(), *random_state)
            super().save_step(state, record["accepted"])
        return whole

    def _write_file(self) -> None:
        import h5py

        temporary = self.path.with_suffix(".partial")
        walkers, count = self.shape
        try:
            with h5py.File(temporary, "w") as file:
                group = file.create_group(GROUP)
                attributes = {"version": emcee.__version__, "nwalkers": walkers, "ndim": count, "has_blobs": False}
                group.attrs.update(attributes | {"iteration": self.iteration, f"{IDENTITY}number": self.number})
                for index, part in enumerate(self.random_state or ()):
                    group.attrs[f"random_state_{index}"] = part
                for name, value in self.identity.items():
                    group.attrs[IDENTITY + name] = value
                group["accepted"] = self.accepted
                chain, log_prob = self.chain[: self.iteration], self.log_prob[: self.iteration]
                group.create_dataset("chain", data=chain, maxshape=(None, walkers, count))
                group.create_dataset("log_prob", data=log_prob, maxshape=(None, walkers))
            with open(temporary, "rb") as written:
                os.fsync(written.fileno())
            os.replace(temporary, self.path)
            self.stored = self.iteration
        finally:
            temporary.unlink(missing_ok=True)


def read_chain(path: str | Path) -> dict[str, Any]:
    """What an HDF5 chain holds: chain, log_prob, accepted, random_state, number, identity. ValueError if it is none."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            group = file[GROUP]
            attributes = dict(group.attrs)
            count = int(attributes["iteration"])
            chain, log_prob = group["chain"][:count], group["log_prob"][:count]
            random_state = [attributes[f"random_state_{index}"] for index in range(5)] if count else None
            return {
                "chain": chain,
                "log_prob": log_prob,
                "accepted": group["accepted"][...],
                "random_state": None if random_state is None else _native(random_state),
                "number": attributes[f"{IDENTITY}number"],
                "identity": {
                    name.removeprefix(IDENTITY): value
                    for name, value in attributes.items()
                    if name.startswith(IDENTITY)
                },
            }
    except (OSError, KeyError) as error:
        raise ValueError(f"{path} is not a chain of layerjax: {error}") from None


def _native(state: list[Any]) -> RandomState:
    return str(state[0]), np.asarray(state[1], np.uint32), int(state[2]), int(state[3]), float(state[4])


def _agrees(stored: Any, value: Any) -> bool:
    if stored is None:
        return False
    stored, value = np.asarray(stored), np.asarray(value)
    if stored.shape != value.shape:
        return False
    if value.dtype.kind == "f":  # the same problem evaluated elsewhere may differ by rounding
        return bool(np.allclose(stored, value, rtol=1e-6, atol=0.0))
    return bool(np.all(stored == value))


def _record_type(walkers: int, count: int) -> np.dtype[Any]:
    return np.dtype(
        [
            ("chain", "<i8"),
            ("step", "<i8"),
            ("coords", "<f8", (walkers, count)),
            ("log_prob", "<f8", (walkers,)),
            ("accepted", "?", (walkers,)),
            ("keys", "<u4", (624,)),
            ("position", "<i8"),
            ("has_gauss", "<i8"),
            ("cached", "<f8"),
            ("checksum", "<u4"),
        ]
    )
