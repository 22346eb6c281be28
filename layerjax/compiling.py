"""Options of the compiler by which programs of this library compile faster."""

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
from jax.core import Tracer

P = ParamSpec("P")
T = TypeVar("T")

OPTIONS: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False, "xla_cpu_prefer_vector_width": 512}
"""Of XLA on a CPU: kernels go to LLVM without MLIR's passes before it, in vectors as wide as the processor has."""


def compiler_options() -> dict[str, Any]:
    """Options for `jax.jit` by which this library compiles in two thirds of the time, and runs 3 to 5 % slower.

    They belong to one program and change nothing global. JAX takes them at the outermost `jit` only, and gradients of
    `Statistical` over large batches run a quarter slower with them.

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
    return dict(_known())


@cache
def _known() -> dict[str, Any]:
    return {name: value for name, value in OPTIONS.items() if jax.default_backend() == "cpu" and _is_known(name, value)}


def _is_known(name: str, value: Any) -> bool:
    try:
        jax.jit(lambda x: x + 1.0, compiler_options={name: value})(0.0)
    except Exception as error:  # XLA's own kinds differ between versions
        if name in str(error):
            return False
        raise
    return True


def filter_jit(function: Callable[P, T]) -> Callable[P, T]:
    """`eqx.filter_jit` with `compiler_options` where it is the outermost: a program within another one takes none."""
    inner = eqx.filter_jit(function)

    @cache
    def outermost() -> Callable[P, T]:
        given: dict[str, Any] = {"compiler_options": compiler_options() or None}
        return eqx.filter_jit(function, **given)

    @wraps(function)
    def call(*arguments: P.args, **options: P.kwargs) -> T:
        return (outermost() if is_outermost(arguments, options) else inner)(*arguments, **options)

    return call


def is_outermost(*inputs: Any) -> bool:
    """Whether a program of these inputs would be the outermost: not within one that is traced, even if all is known."""
    return not is_traced(*inputs, jax.lax.full((), 0.0))


def is_traced(*inputs: Any) -> bool:
    """Whether any leaf of these is traced."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(inputs))
