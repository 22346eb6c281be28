"""Numbers that all texels of a map have in common: which they are, and the stack once they are known."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fits.problem.discrepancy.parameters import Discrepancy
from fits.problem.parameters import is_free, split
from fits.problem.problem import Problem
from fits.problem.spectra import is_law
from layerjax._parameters import plain_name


def shared_names(problem: Problem) -> tuple[str, ...]:
    """Names of a problem whose `Free` is `shared`, in its order; one a channel where there is a number a channel."""
    noise, instrument = problem.noise, problem.instrument
    parts = {"": problem.stack, "scale": problem.scale, "noise.relative": noise.relative, "noise.floor": noise.floor}
    if isinstance(noise.discrepancy, Discrepancy):
        parts |= {f"noise.discrepancy.{one.name}": getattr(noise.discrepancy, one.name) for one in fields(Discrepancy)}
    if instrument is not None:
        parts["instrument.tilt"] = instrument.tilt
        if instrument.floor is not None:  # it stands in for that of the noise
            parts["noise.floor"] = instrument.floor
    marked = {name for where, part in parts.items() for name in _marked(part, where)}
    return tuple(name for name in problem.names if name in marked)


def hold(stack: Any, values: Mapping[str, float]) -> Any:
    """The stack with numbers in place of its shared `Free`, an array where there was a number a channel.

    Args:
        stack: a stack, a mixture or any other pytree.
        values: of every shared name of it, as `shared_names` gives them; others are not looked at.

    Raises:
        ValueError: a shared parameter has no value, or one that is not finite.
    """
    leaves, structure = jax.tree.flatten(stack, is_leaf=is_free)
    template, names, _ = split(stack, plain_name)
    for leaf, offset, shape in template.slots:
        if leaves[leaf].same_for_all_texels:
            own = names[offset : offset + leaves[leaf].arrays()[0].size]
            leaves[leaf] = jnp.asarray(np.reshape([_number(name, values) for name in own], shape))
    return _lawful(jax.tree.unflatten(structure, leaves))


def _number(name: str, values: Mapping[str, float]) -> float:
    if name not in values:
        raise ValueError(f"values has no {name!r}, which is shared; it has {', '.join(values) or 'none'}")
    if not np.isfinite(values[name]):
        raise ValueError(f"values[{name!r}] is {values[name]}; it must be finite")
    return float(values[name])


def _marked(part: Any, where: str) -> list[str]:
    """Names of what is shared in a part of a problem, which stands at this place."""
    template, names, free = split(part, lambda path: plain_name(where + path))
    ends = [*(offset for _, offset, _ in template.slots), len(names)]
    return [name for k, entry in enumerate(free) if entry.same_for_all_texels for name in names[ends[k] : ends[k + 1]]]


def _lawful(stack: Any) -> Any:
    """The stack with the numbers of each channel in place of power laws in which nothing is free any more."""
    return jax.tree.map(
        lambda leaf: leaf.values() if is_law(leaf) and not any(map(is_free, (leaf.amplitude, leaf.exponent))) else leaf,
        stack,
        is_leaf=lambda leaf: is_law(leaf) or is_free(leaf),
    )
