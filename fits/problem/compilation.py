"""One compiled program for every model of the same structure and shape: numbers are traced, the rest is its key."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from functools import cache
from itertools import islice
from threading import Lock
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import OpenBLASController, ThreadpoolController

from layerjax._numerics import allow_broadcasting
from layerjax.compiling import compiler_options, is_outermost

T = TypeVar("T")
U = TypeVar("U")

FULL = 0.5  # share of the maps that a process may have


class Static:
    """A tree without arrays as a hashable key: the hash is taken once, not at every call."""

    def __init__(self, tree: Any):
        leaves, structure = jax.tree.flatten(tree)
        self.tree, self.key = tree, (tuple(leaves), structure)
        self.hash = hash(self.key)

    def __hash__(self) -> int:
        return self.hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Static) and self.key == other.key


@allow_broadcasting
def run(function: Callable[..., Any], split_model: tuple[Any, Static], *arguments: Any) -> Any:
    """`function(model, *arguments)` compiled, and done; see `Problem.call`."""
    with one_thread():
        program = _program(is_outermost(split_model[0], arguments))
        return jax.block_until_ready(program(function, split_model[1], split_model[0], *arguments))


@cache
def _program(outermost: bool) -> Callable[..., Any]:
    options = compiler_options() if outermost else {}
    return jax.jit(_run, static_argnums=(0, 1), compiler_options=options or None)


def _run(function: Callable[..., Any], static: Static, arrays: Any, *arguments: Any) -> Any:
    return function(eqx.combine(arrays, static.tree), *arguments)


class _Limit:
    """How many calls run now, and what gives their libraries back the threads that they had before the first."""

    lock = Lock()
    calls = 0
    limited: Any = None


# threadpoolctl 3.7 and later ignores, without a word, all threads but the first that set a limit, until this is called
_free_limits = getattr(OpenBLASController, "clear_controlling_thread", lambda force: None)


@contextmanager
def one_thread() -> Iterator[None]:
    """LAPACK by one thread: those of a small matrix wait for each other busily, a hundredfold beside other work."""
    with _Limit.lock:
        if _Limit.calls == 0:
            _free_limits(force=True)
            _Limit.limited = _libraries().limit(limits=1)
        _Limit.calls += 1
    try:
        yield
    finally:
        with _Limit.lock:
            _Limit.calls -= 1
            if _Limit.calls == 0:
                _free_limits(force=True)
                _Limit.limited.restore_original_limits()
                _free_limits(force=True)


@cache
def _libraries() -> Any:
    import scipy.linalg  # noqa: F401 (what JAX's matrices are solved by, loaded by now)

    return ThreadpoolController().select(user_api="blas")


def cores() -> int:
    """That this process may use, of this machine."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def make_room() -> None:
    """Let go of all compiled programs where they take half of the maps that Linux allows a process: dozens each."""
    try:
        with open("/proc/self/maps", "rb") as maps, open("/proc/sys/vm/max_map_count", "rb") as most:
            full = sum(1 for _ in maps) > FULL * int(most.read())
    except OSError:  # another system, which counts no maps
        return
    if full:
        jax.clear_caches()


def devices_of_cores() -> None:
    """Make each core a device of JAX, over which layerjax splits large batches, if it is not too late for that and the
    user has not set devices."""
    if "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", ""):
        return
    if jax.config.values["jax_num_cpu_devices"] < 1:
        with suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", cores())


@cache
def _threads() -> ThreadPoolExecutor:
    """One for each core, kept for the next call."""
    return ThreadPoolExecutor(cores())


def on_all_cores(call: Callable[[T], U], items: Iterable[T]) -> list[U]:
    """What `call` gives of each, whose programs are compiled."""
    return list(_threads().map(allow_broadcasting(call), items))


def as_finished(call: Callable[[T], U], items: Iterable[T], threads: int | None = None) -> Iterator[tuple[int, U]]:
    """The place of each item and what `call` gives of it, as they finish, by so many threads, or one a core.

    The first runs by itself: it compiles the program, which keeps one core busy. With one thread the calling one works.
    """
    pending, most = iter(enumerate(items)), threads or cores()
    for index, item in islice(pending, None if most == 1 else 1):
        yield index, call(item)
    running: dict[Future[U], int] = {}
    pool = ThreadPoolExecutor(most)
    try:  # each is begun when there is room for it: an interrupt need not wait for the others
        while True:
            for index, item in islice(pending, most - len(running)):
                running[pool.submit(allow_broadcasting(call), item)] = index
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), future.result()
    finally:
        pool.shutdown(cancel_futures=True)  # waits for what has begun


def in_shares(
    call: Callable[[NDArray[Any]], Any], rows: NDArray[Any], share: int, compiled: bool = False
) -> list[NDArray[Any]]:
    """The arrays that call(rows) gives, by so many rows at a time, on all cores; the last share is padded, so that all
    have one program. Unless that is compiled, the first runs alone and does it."""

    def of(first: int) -> list[NDArray[Any]]:
        part = rows[first : first + share]
        padded = np.concatenate([part, np.repeat(part[-1:], share - len(part), axis=0)])
        return [np.asarray(result)[: len(part)] for result in call(padded)]

    firsts = range(0, len(rows), share)
    alone = 0 if compiled else 1
    parts = [*map(of, firsts[:alone]), *on_all_cores(of, firsts[alone:])]
    return [np.concatenate(results) for results in zip(*parts, strict=True)]
