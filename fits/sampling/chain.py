"""A chain in memory that also survives being killed: emcee's backend, whose steps go to a store block by block.

A block is written every second and at every check, with the state of the random generator, so that a resumed chain is
the one that it would have been; a kill costs at most a second of steps. How the chain is moved is decided before its
first step and kept with it.
"""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import emcee
import numpy as np
from emcee.backends import Backend
from numpy.typing import NDArray

from fits.store import Store

SECONDS = 1.0  # between two blocks


class Chain(Backend):
    """Steps (steps, walkers, P) of unconstrained coordinates, and their log-posteriors.

    moves: how it is moved, numbers, words and arrays; empty before that is decided. options: of the last run.
    """

    def __init__(self, walkers: int, count: int, store: Store | None = None):
        super().__init__()
        self.reset(walkers, count)
        self.moves: dict[str, Any] = {}
        self.options: dict[str, Any] = {}
        self._store, self._stored, self._written = store, 0, time.monotonic()
        if store is None:
            return
        self.moves, self.options = store.get("moves") or {}, store.get("options") or {}
        if blocks := store.all("steps"):
            self.chain = np.concatenate([block["coords"] for block in blocks])
            self.log_prob = np.concatenate([block["log_prob"] for block in blocks])
            self.accepted, self.random_state = blocks[-1]["accepted"], tuple(blocks[-1]["random_state"])
            self.iteration = self._stored = len(self.chain)

    def decide(self, moves: Mapping[str, Any]) -> None:
        """How the chain is moved from its first step on."""
        self.moves = dict(moves)
        if self._store is not None:
            self._store.put("moves", self.moves)

    def keep_options(self, options: Mapping[str, Any]) -> None:
        """Store the options that the next steps are made with."""
        if self._store is not None and self.options != options:
            self._store.put("options", options)
        self.options = dict(options)

    def steps(self) -> NDArray[np.float64]:
        """What there is of the chain, (steps, walkers, P)."""
        return np.asarray(self.chain[: self.iteration])

    def grow(self, ngrow: int, blobs: Any) -> None:
        """Room for `ngrow` more steps, at least doubling, so that growing stays cheap."""
        if len(self.chain) - self.iteration < ngrow:
            super().grow(max(ngrow, self.iteration), blobs)

    def save_step(self, state: emcee.State, accepted: NDArray[np.bool_]) -> None:
        """Keep a step."""
        super().save_step(state, accepted)
        if time.monotonic() - self._written > SECONDS:
            self.write()

    def write(self) -> None:
        """Keep what is new in the store, if there is one."""
        if self._store is not None and self._stored < self.iteration:
            new = slice(self._stored, self.iteration)
            block = {"coords": self.chain[new], "log_prob": self.log_prob[new], "accepted": self.accepted}
            self._store.append("steps", block | {"random_state": list(self.random_state)})
            self._stored = self.iteration
        self._written = time.monotonic()


@contextmanager
def opened(
    path: str | Path | None, walkers: int, count: int, identity: Mapping[str, str], resume: bool
) -> Iterator[Chain]:
    """A chain to go on with, kept in a file if there is a path; see `Store.open` for what is refused."""
    if path is None:
        yield Chain(walkers, count)
        return
    with Store.open(path, identity, fresh=not resume) as store:
        chain = Chain(walkers, count, store)
        try:
            yield chain
        finally:
            chain.write()
