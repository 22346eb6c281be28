"""A chain that survives being killed at any moment.

Each step is appended to a journal as one record of fixed size, in a single write, with a checksum. Now and then the
whole chain goes to an HDF5 file, written beside the old one and renamed over it, in the layout of
`emcee.backends.HDFBackend`, which opens it. Opening reads the HDF5 file, then the journal's records beyond it up to the
first that is not whole: what is lost is at most the step that was being written, and since the random state is part of
a record, the chain goes on as if nothing had happened. One process writes, and holds a lock (``.lock``) while it does;
others read what is there. How the chain is moved is decided before its first step and stored with it, so that it goes
on in the same way. The HDF5 file begins with a user block, which HDF5 skips, with a checksum of what follows: a
damaged file is recognised before HDF5, which may never return from one, sees it.
"""

import glob
import io
import os
import secrets
import zlib
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import emcee
import numpy as np
from emcee.backends import Backend
from numpy.typing import NDArray

from fits._files import locked, named, write_bytes, write_whole

GROUP = "mcmc"
MOVES = "layerjax_moves"
IDENTITY = "layerjax_"
TITLE, USER_BLOCK = b"chain of layerjax", 512
BEFORE_CHECKSUMS = b"\x89HDF"
"""What a chain of layerjax 0.1.0 begins with."""
RandomState = tuple[str, NDArray[np.uint32], int, int, float]


class MemoryChain(Backend):
    """A chain in memory that grows in blocks; the same interface as `FileChain` without the files.

    moves: how it is moved, in numbers, words and arrays; empty where that is not decided, or was before it could be.
    """

    def __init__(self, walkers: int, count: int):
        super().__init__()
        self.reset(walkers, count)
        self.moves: dict[str, Any] = {}

    def decide(self, moves: Mapping[str, Any]) -> None:
        """How the chain is moved from its first step on."""
        self.moves = dict(moves)

    def grow(self, ngrow: int, blobs: Any) -> None:
        """Room for `ngrow` more steps, at least doubling, so that growing stays cheap."""
        free = len(self.chain) - self.iteration
        if free < ngrow:
            super().grow(max(ngrow, self.iteration), blobs)

    def restore(self, stored: Mapping[str, Any], journal: bytes) -> tuple[int, int]:
        """Take in what `read_chain` gave, and the whole records of a journal that continue it.

        Returns the number of the chain, and the length of these records in bytes.
        """
        self.chain, self.log_prob, self.accepted = stored["chain"], stored["log_prob"], stored["accepted"]
        self.iteration, self.random_state, self.moves = len(self.chain), stored["random_state"], stored["moves"]
        number, whole = int(stored["number"]), 0
        kind = _record_type(*self.shape)
        records = np.frombuffer(journal[: len(journal) // kind.itemsize * kind.itemsize], kind)
        self.grow(len(records), None)
        for record in records:
            if record["chain"] != number or record["checksum"] != zlib.crc32(record.tobytes()[:-4]):
                break
            whole += kind.itemsize
            if record["step"] != self.iteration + 1:  # written before the checkpoint that was read
                continue
            random_state = tuple(record[name].item() for name in ("position", "has_gauss", "cached"))
            state = emcee.State(record["coords"], log_prob=record["log_prob"])
            state.random_state = ("MT19937", record["keys"].copy(), *random_state)
            Backend.save_step(self, state, record["accepted"])
        return number, whole

    def checkpoint(self) -> None:
        """Nothing to write."""

    def close(self) -> None:
        """Nothing to close."""


class FileChain(MemoryChain):
    """A chain kept in `path` (HDF5) and a journal beside it (``chain.journal`` of ``chain.h5``), by one process.

    identity: numbers and strings that tell problems apart, stored with the chain. Opening a chain whose identity
    differs raises ValueError, and so do a file that is not a chain and one that another process is writing;
    `resume=False` replaces whatever is there. On a full disk the last whole step is kept.
    """

    def __init__(self, path: str | Path, walkers: int, count: int, identity: Mapping[str, Any], resume: bool = True):
        super().__init__(walkers, count)
        self.path = Path(path)
        self.journal_path = beside(self.path, ".journal")
        self.identity = dict(identity)
        self._open = ExitStack()
        self._open.enter_context(locked(beside(self.path, ".lock"), str(self.path)))
        try:
            self._take(resume)
        except BaseException:
            self._open.close()
            raise

    def _take(self, resume: bool) -> None:
        for left in self.path.parent.glob(f".{glob.escape(self.path.name)}.????????"):
            left.unlink()  # what a process wrote as it was killed
        if resume and self.path.exists():
            stored = read_chain(self.path)
            _refuse_others(self.path, stored["identity"], self.identity)
            self.number, whole = self.restore(stored, _content(self.journal_path))
            self.stored = int(stored["iteration"])
        else:
            self.number, whole = secrets.randbits(63), 0
            self._write_file()
        with named(self.journal_path):
            # unbuffered: a step is in the kernel's hands once `write` returns, whatever happens to this process
            descriptor = os.open(self.journal_path, os.O_RDWR | os.O_CREAT, 0o666)
            self._journal = self._open.enter_context(os.fdopen(descriptor, "r+b", buffering=0))
            self._journal.truncate(whole)
            self._journal.seek(whole)

    def decide(self, moves: Mapping[str, Any]) -> None:
        """How the chain is moved from its first step on, kept in the file."""
        super().decide(moves)
        self._write_file()

    def save_step(self, state: emcee.State, accepted: NDArray[np.bool_]) -> None:
        """Keep a step, in memory and in the journal."""
        super().save_step(state, accepted)
        _, keys, position, has_gauss, cached = state.random_state
        record = np.zeros((), _record_type(*self.shape))
        record["chain"], record["step"] = self.number, self.iteration
        record["coords"], record["log_prob"], record["accepted"] = state.coords, state.log_prob, accepted
        record["keys"], record["position"], record["has_gauss"], record["cached"] = keys, position, has_gauss, cached
        record["checksum"] = zlib.crc32(record.tobytes()[:-4])
        write_whole(self._journal, record.tobytes(), self.journal_path)

    def checkpoint(self) -> None:
        """Write the whole chain to the HDF5 file, if it has grown; the journal starts again."""
        if self.stored != self.iteration:
            self._write_file()
        self._journal.truncate(0)
        self._journal.seek(0)

    def close(self) -> None:
        """Close the journal, and remove it if every step is in the HDF5 file; others may write."""
        if self._journal.tell() == 0:
            self.journal_path.unlink(missing_ok=True)
        self._open.close()

    def _write_file(self) -> None:
        import h5py

        walkers, count = self.shape
        # made in memory: HDF5 does not survive a disk that is full
        with h5py.File("chain", "w", driver="core", backing_store=False) as file:
            group = file.create_group(GROUP)
            attributes = {"version": emcee.__version__, "nwalkers": walkers, "ndim": count, "has_blobs": False}
            group.attrs.update(attributes | {"iteration": self.iteration, f"{IDENTITY}number": self.number})
            for index, part in enumerate(self.random_state or ()):
                group.attrs[f"random_state_{index}"] = part
            for name, value in self.identity.items():
                group.attrs[IDENTITY + name] = value
            for name, value in self.moves.items():
                file[f"{MOVES}/{name}"] = value
            group["accepted"] = self.accepted
            group.create_dataset("chain", data=self.chain[: self.iteration], maxshape=(None, walkers, count))
            group.create_dataset("log_prob", data=self.log_prob[: self.iteration], maxshape=(None, walkers))
            file.flush()
            content = file.id.get_file_image()
        write_bytes(self.path, _user_block(content) + content, force=True, durable=True)
        self.stored = self.iteration


def beside(path: Path, suffix: str) -> Path:
    """A file that belongs to a chain: what says that it is HDF5 gives way to the suffix, not the 2 of ``chain_0.2``."""
    return path.with_suffix(suffix) if path.suffix in (".h5", ".hdf5") else path.with_name(path.name + suffix)


def stored_chain(path: str | Path, identity: Callable[[dict[str, Any]], Mapping[str, Any]]) -> MemoryChain:
    """A chain as far as it got, from its file and its journal, which are only read: a sampler may be writing them.

    identity: of the identity that is stored, what it should be; ValueError where they differ.
    """
    path = Path(path)
    journal = _content(beside(path, ".journal"))  # before the file, which may take in what is in it at any moment
    stored = read_chain(path)
    _refuse_others(path, stored["identity"], identity(stored["identity"]))
    chain = MemoryChain(*stored["chain"].shape[1:])
    chain.restore(stored, journal)
    return chain


def read_chain(path: str | Path) -> dict[str, Any]:
    """What an HDF5 chain holds: chain, log_prob, accepted, random_state, number, moves, identity.

    Raises ValueError for a file that is no chain, or a damaged one.
    """
    import h5py

    content = Path(path).read_bytes()
    image = content if content.startswith(BEFORE_CHECKSUMS) else content[USER_BLOCK:]
    if image is not content and content[:USER_BLOCK] != _user_block(image):
        if content.startswith(TITLE):
            raise ValueError(
                f"{path} is damaged: its checksum is not that of its content; "
                "sampling with --force, or resume=False, starts it again"
            )
        raise ValueError(f"{path} is not a chain of layerjax: it does not begin as one")
    try:
        with h5py.File(io.BytesIO(image), "r") as file:
            group = file[GROUP]
            attributes = dict(group.attrs)
            count = int(attributes["iteration"])
            stored = {
                "iteration": count,
                "chain": group["chain"][:count],
                "log_prob": group["log_prob"][:count],
                "accepted": group["accepted"][...],
                "random_state": _native([attributes[f"random_state_{index}"] for index in range(5)]) if count else None,
                "number": attributes[f"{IDENTITY}number"],
                "moves": {name: _plain(part[()]) for name, part in file.get(MOVES, {}).items()},
                # before there was a choice, it was emcee
                "identity": {"sampler": "emcee"}
                | {
                    name.removeprefix(IDENTITY): value
                    for name, value in attributes.items()
                    if name.startswith(IDENTITY)
                },
            }
    except Exception as error:  # HDF5 fails in many ways on what is damaged
        raise ValueError(f"{path} is not a chain of layerjax: {error}") from None
    return stored


def _refuse_others(path: Path, stored: Mapping[str, Any], identity: Mapping[str, Any]) -> None:
    for name, value in identity.items():
        if not _agrees(stored.get(name), value):
            raise ValueError(another(path, name))


def another(path: str | Path, name: str) -> str:
    """The message that a file holds a chain of something else, by the name of what differs."""
    return (
        f"{path} holds a chain of another problem or setting ({name} differs): "
        "give another path, or resume=False to replace it"
    )


def _content(journal: Path) -> bytes:
    return journal.read_bytes() if journal.exists() else b""


def _user_block(image: bytes) -> bytes:
    return (b"%b; CRC-32 of what follows these 512 bytes: %08x\n" % (TITLE, zlib.crc32(image))).ljust(USER_BLOCK, b"\0")


def _plain(value: Any) -> Any:
    return value.decode() if isinstance(value, bytes) else value


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
