"""Large batches over all devices: cores that `jax_num_cpu_devices` makes devices of, or several GPUs.

XLA keeps the body of a loop on one core, and large batches run in loops over chunks that stay in the cache. Where the
process has several devices, each of them loops over its own share; gradients are summed over the shares.
"""

from collections.abc import Callable
from contextvars import ContextVar
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.core import Tracer
from jax.sharding import AxisType, Mesh, PartitionSpec

from layerjax.compiling import filter_jit

P = ParamSpec("P")
T = TypeVar("T")

ROWS = "rows"
_device_count: ContextVar[int] = ContextVar("devices", default=1)  # by the program that this thread is tracing


def exact_products(function: Callable[P, T]) -> Callable[P, T]:
    """The function with matrix products of float32 numbers in float32: GPUs may round factors to eleven bits."""

    @wraps(function)
    def call(*arguments: P.args, **options: P.kwargs) -> T:
        with jax.default_matmul_precision("highest"):
            return function(*arguments, **options)

    return call


def compile_for_devices(function: Callable[P, T]) -> Callable[P, T]:
    """The function compiled, as by `filter_jit`, with what it hands to `shard_rows` split over all of them."""

    @exact_products
    def program(devices: int, *arguments: P.args, **options: P.kwargs) -> T:
        before = _device_count.set(devices)
        try:
            return function(*arguments, **options)
        finally:
            _device_count.reset(before)

    deterministic, random = filter_jit(program), filter_jit(program, walks=True)

    @wraps(function)
    def call(*arguments: P.args, **options: P.kwargs) -> T:
        compiled = random if any(map(_is_random, arguments)) else deterministic
        return compiled(_count_devices(arguments, options), *arguments, **options)

    return call


def _is_random(argument: Any) -> bool:
    """Whether it is a transport that draws, or is prepared for one."""
    return bool(getattr(getattr(argument, "transport", argument), "random", False))


def _count_devices(*inputs: Any) -> int:
    """Devices to split over: one where inputs are kept on some, the user has chosen one, or has a mesh of their own."""
    everywhere = jax.local_device_count()
    if everywhere == 1 or jax.default_device.value is not None or jax.sharding.get_abstract_mesh().axis_names:
        return 1
    kept = [leaf for leaf in jax.tree.leaves(inputs) if isinstance(leaf, Array) and not isinstance(leaf, Tracer)]
    if any(leaf.committed and len(leaf.sharding.device_set) < everywhere for leaf in kept):
        return 1
    return everywhere


def shard_rows(function: Callable[[Any], Any], rows: Any, least: int, filled: bool = False) -> Any:
    """function over arrays that share their first axis, and whose results do: as many of its rows on every device.

    function: closes over what all rows need. least: rows of a share below which it does not pay. filled: whether shares
    that are not even are filled up; where a row is cheap, to gather what they found takes longer than to find it.
    """
    count = jax.tree.leaves(rows)[0].shape[0]
    devices = _device_count.get()
    missing = -count % devices
    if devices == 1 or count < devices * least or (missing and not filled):
        return function(rows)
    split = PartitionSpec(ROWS)
    shared = jax.shard_map(function, mesh=_mesh(devices), in_specs=split, out_specs=split, check_vma=False)
    if not missing:
        return shared(rows)
    more = jax.tree.map(lambda row: jnp.concatenate([row, row[:missing]]), rows)
    return jax.tree.map(lambda part: part[:count], shared(more))


@cache
def _mesh(devices: int) -> Mesh:
    return jax.make_mesh((devices,), (ROWS,), axis_types=(AxisType.Auto,), devices=jax.local_devices()[:devices])
