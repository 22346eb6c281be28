"""Compilation made cheaper: options of the compiler, and a cache of compiled programs in the user's cache folder."""

import hashlib
import os
import platform
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, wraps
from importlib import metadata
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
from jax.core import Tracer

P = ParamSpec("P")
T = TypeVar("T")

CACHE_DIRECTORY, CACHE_LEAST_TIME = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"
"""JAX's settings of its persistent compilation cache."""

LEAST_COMPILE = 0.1
"""Seconds of compilation from which a program is cached."""

OPTIONS: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False, "xla_cpu_prefer_vector_width": 512}
"""Of XLA on a CPU: kernels go to LLVM without MLIR's passes before it, in vectors as wide as the processor has."""

SLOW_IN_LOOPS = frozenset({"xla_cpu_use_fusion_emitters"})
"""Options not taken for random walks: without MLIR's passes their loops run 2.5 times slower."""


def compiler_options() -> dict[str, Any]:
    """Options for `jax.jit` by which this library compiles in two thirds of the time, and runs 3 to 5 % slower.

    They belong to one program and change nothing global. JAX takes them at the outermost `jit` only. Gradients of
    `Statistical` over large batches run a quarter slower with them, and `RandomWalk` takes 2.5 times as long: leave
    them out there.

    Returns:
        What this version of XLA knows of them; nothing where programs do not run on a CPU.

    Example:
        >>> import jax
        >>> import layerjax as lj
        >>> stack = lj.Stack([lj.Interface(1.5, 0.2)], lj.Lambertian(0.5))
        >>> wi, wo = lj.direction(0.5, 0.0), lj.direction(0.6, 3.1)
        >>> program = jax.jit(lambda stack: lj.evaluate(stack, wi, wo), compiler_options=lj.compiler_options())
        >>> program(stack).shape
        (1,)
    """
    return dict(_supported_options())


@cache
def _supported_options() -> dict[str, Any]:
    return {
        name: value for name, value in OPTIONS.items() if jax.default_backend() == "cpu" and _is_supported(name, value)
    }


def _is_supported(name: str, value: Any) -> bool:
    try:
        jax.jit(lambda x: x + 1.0, compiler_options={name: value})(0.0)
    except Exception as error:  # XLA's own kinds differ between versions
        if name in str(error):
            return False
        raise
    return True


def filter_jit(function: Callable[P, T], *, walks: bool = False) -> Callable[P, T]:
    """`eqx.filter_jit` with `compiler_options` where it is the outermost: a program within another one takes none.

    walks: whether it is a random walk, for which some of the options do not pay.
    """
    inner = eqx.filter_jit(function)

    @cache
    def outermost() -> Callable[P, T]:
        omitted = SLOW_IN_LOOPS if walks else frozenset()
        options = {name: value for name, value in compiler_options().items() if name not in omitted}
        settings: dict[str, Any] = {"compiler_options": options or None}
        return eqx.filter_jit(function, **settings)

    @wraps(function)
    def call(*arguments: P.args, **options: P.kwargs) -> T:
        return (outermost() if is_outermost(arguments, options) else inner)(*arguments, **options)

    return call


def is_outermost(*inputs: Any) -> bool:
    """Whether a program of these inputs would be the outermost: not within one that is traced, even if all is known."""
    return not is_traced(*inputs, _zero())


@jax.jit
def _zero() -> jax.Array:  # traced within a program; compiled, it tells so in microseconds
    return jax.lax.full((), 0.0)


def is_traced(*inputs: Any) -> bool:
    """Whether any leaf of these is traced."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(inputs))


def keep_programs() -> str | None:
    """Cache compiled programs on disk, for later processes: call it once, at the top of a notebook.

    This turns on JAX's persistent compilation cache for the process, in the user's cache folder (``XDG_CACHE_HOME``,
    else ``~/.cache``), apart for every host, processor and version of jaxlib. All programs of JAX that take a tenth of
    a second or longer to compile are cached, until the folder is deleted. If a cache is set already, nothing changes.

    Returns:
        The folder of the cache. None: there is none that may be written to, and nothing is cached.

    Example:
        >>> import layerjax as lj
        >>> folder = lj.keep_programs()
    """
    if jax.config.values[CACHE_DIRECTORY] or not (folder := compile_cache()):
        return jax.config.values[CACHE_DIRECTORY]
    jax.config.update(CACHE_DIRECTORY, folder)
    jax.config.update(CACHE_LEAST_TIME, LEAST_COMPILE)
    return folder


@contextmanager
def program_cache() -> Iterator[None]:
    """`keep_programs` within the block alone; arrays of different ranks broadcast in it (see `allow_broadcasting`)."""
    from jax.experimental.compilation_cache.compilation_cache import reset_cache

    before = {name: jax.config.values[name] for name in (CACHE_DIRECTORY, CACHE_LEAST_TIME)}
    if before[CACHE_DIRECTORY] or not keep_programs():
        with jax.numpy_rank_promotion("allow"):
            yield
        return
    try:
        with jax.numpy_rank_promotion("allow"):
            yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
        reset_cache()


def compile_cache() -> str | None:
    """Folder of programs that this JAX compiled for this processor, on this host only; None: there can be none."""
    try:
        key = "\n".join((metadata.version("jaxlib"), socket.gethostname(), _processor()))
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = home / "layerjax" / "compiled" / hashlib.sha256(key.encode()).hexdigest()[:16]
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError, metadata.PackageNotFoundError):  # no home, or one that may not be written to
        return None
    return str(folder) if os.access(folder, os.W_OK) else None


def _processor() -> str:
    """Kind and features of the processor."""
    with suppress(OSError), open("/proc/cpuinfo") as file:
        for line in file:
            if line.startswith(("flags", "Features")):
                return line
    return f"{platform.machine()} {platform.processor()}"
