"""Numeric fields of the material classes: conversion to arrays, and validation of concrete values by name and range."""

import dataclasses
import re
from collections.abc import Iterator
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from layerjax._checks import abbreviate

RANGES: dict[str, tuple[float, float]] = {
    "Interface.ior": (0.25, 4.0),
    "Interface.alpha": (1e-4, 1.0),
    "Interface.alpha, beckmann": (1e-4, 1.0),
    "Interface.alpha, vmf": (1e-4, 15.0),
    "Interface.alpha_y": (1e-4, 1.0),
    "Interface.alpha, gtr": (1e-4, 1.0),
    "Interface.gamma": (1.75, 40.0),
    "Interface.tangent": (-3.1415926536, 3.1415926536),
    "Medium.thickness": (0.0, 1e4),
    "Medium.albedo": (0.0, 1.0),
    "Medium.f0": (0.0, 1.0),
    "TurbidMedium.thickness_mm": (0.0, 1e4),
    "TurbidMedium.mu_s": (0.0, 1e4),
    "TurbidMedium.mu_a": (0.0, 1e4),
    "TurbidMedium.f0": (0.0, 1.0),
    "HenyeyGreenstein.g": (-0.999, 0.999),
    "SGGX.alpha": (1e-4, 1.0),
    "Lambertian.albedo": (0.0, 1.0),
    "OrenNayar.albedo": (0.0, 1.0),
    "OrenNayar.roughness": (0.0, 1.0),
    "VMFDiffuse.albedo": (0.0, 1.0),
    "VMFDiffuse.roughness": (0.0, 1.0),
    "Conductor.ior": (0.01, 10.0),
    "Conductor.k": (0.0, 20.0),
    "Conductor.alpha": (1e-4, 1.0),
    "Conductor.alpha, beckmann": (1e-4, 1.0),
    "Conductor.alpha, vmf": (1e-4, 15.0),
    "Conductor.alpha_y": (1e-4, 1.0),
    "Conductor.alpha, gtr": (1e-4, 1.0),
    "Conductor.gamma": (1.75, 40.0),
    "Conductor.tangent": (-3.1415926536, 3.1415926536),
    "ThinFilm.ior": (0.25, 4.0),
    "ThinFilm.thickness_nm": (0.0, 5000.0),
    "ThinFilm.wavelengths_nm": (100.0, 1e5),
}
"""The documented box: the range of every numeric field; of widths, for every distribution of normals."""

PER_CHANNEL = frozenset(
    {
        "Medium.thickness",
        "Medium.albedo",
        "Medium.f0",
        "TurbidMedium.mu_s",
        "TurbidMedium.mu_a",
        "TurbidMedium.f0",
        "Lambertian.albedo",
        "OrenNayar.albedo",
        "VMFDiffuse.albedo",
        "Conductor.ior",
        "Conductor.k",
        "ThinFilm.ior",
        "ThinFilm.wavelengths_nm",
    }
)
"""Fields that take a value a channel, shape (C,), as well as one for all, shape (). Maps: see `layerjax._shapes`."""

VECTORS = frozenset({"SGGX.axis"})
"""Fields that take a vector, shape (3,)."""


_PART, _WEIGHT = re.compile(r"\bparts\['([^']+)'\]"), re.compile(r"\bweights\['([^']+)'\]")

Parameter = Any
"""Type of a numeric field: numbers, sequences, traced arrays and placeholders go in, arrays or placeholders stay."""


def is_placeholder(value: object) -> bool:
    """Whether the value stands for a number that is not known yet (as ``fits.Free`` does)."""
    return getattr(value, "__layerjax_placeholder__", False) is True


def parameter(
    name: str,
    *,
    default: Any = dataclasses.MISSING,
    optional: bool = False,
    ranged: bool = True,
    absent_at_zero: bool = False,
    limits: tuple[float, float] | None = None,
) -> Any:
    """A dataclass field called `name` ("Class.field"), converted to a floating array and checked against `RANGES`.

    Traced values are not checked (they have no value yet), placeholders pass as they are. Not `ranged`: the range
    depends on other fields, and is checked by the class. `absent_at_zero`: a known 0 is None, by structure. `limits`:
    the range of a class that is not in `RANGES`, such as one's own; it joins them.
    """
    if limits is not None:
        RANGES[name] = limits

    def convert(value: Any) -> Any:
        if (optional and value is None) or is_placeholder(value):
            return value
        array = _check_shape(name, value)
        if absent_at_zero and not isinstance(array, jax.core.Tracer) and not np.any(np.asarray(array)):
            return None
        if ranged:
            check_range(name, array)
        return array

    if default is dataclasses.MISSING:
        return eqx.field(converter=convert)
    return eqx.field(converter=convert, default=default)


def as_floating(name: str, value: Any) -> jax.Array:
    """The value as an array of the default floating type, or of its own if it is a floating JAX array.

    A plain number stays one under ``jit``, where it would be traced like all else: what is known of it still counts.
    """
    if isinstance(value, str | bytes | bool | None):
        raise ValueError(f"{name}: {value!r} is not a number")
    try:
        with jax.ensure_compile_time_eval():
            array = jnp.asarray(value)
            if not jnp.issubdtype(array.dtype, jnp.floating):
                if not jnp.issubdtype(array.dtype, jnp.integer):
                    raise TypeError
                array = array.astype(jnp.result_type(float))
            return jax.lax.convert_element_type(array, array.dtype)  # drops the weak type: one program for all numbers
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name}: {abbreviate(value)} is not a number or an array of real numbers") from None


def takes_several(name: str) -> bool:
    """Whether a field of a single stack takes more than one number; a plain field of one's own counts channels."""
    return name in PER_CHANNEL or name in VECTORS or name not in RANGES


def _check_shape(name: str, value: Any) -> jax.Array:
    array = as_floating(name, value)
    if array.ndim and 0 in array.shape:
        raise ValueError(f"{name}: shape {array.shape} given, which holds no number")
    if isinstance(value, list | tuple) and not takes_several(name):
        raise ValueError(f"{name}: {abbreviate(value)} given, must be one number; of a map of stacks it is an array")
    return array


def check_range(name: str, array: jax.Array) -> None:
    """Refuse concrete values outside the range of that name."""
    low, high = RANGES[name]
    if not isinstance(array, jax.core.Tracer):
        concrete = np.asarray(array, dtype=np.float64)
        slack = 1e-6 if array.dtype != np.float64 else 1e-12  # the bounds themselves round when converted
        outside = ~((concrete >= low - slack * abs(low)) & (concrete <= high + slack * abs(high)))
        if outside.any():
            bad = concrete[outside] if concrete.ndim else concrete
            raise ValueError(f"{name}: {float(np.ravel(bad)[0]):g} is outside [{low:g}, {high:g}]")


def leaves_with_names(tree: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every leaf of the tree with its name as a user would write it, such as ``layers[0].phase.alpha``."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree, is_leaf=is_placeholder):
        yield prefix + plain_name(jax.tree_util.keystr(path)), leaf


def plain_name(path: str) -> str:
    """The name of a leaf from JAX's: ``parts['coat'].layers[0].ior`` of a mixture is ``coat.layers[0].ior``."""
    return _WEIGHT.sub(r"weights.\1", _PART.sub(r"\1", path)).lstrip(".")


def cast_arrays(tree: Any, dtype: jnp.dtype) -> Any:
    """Arrays of the tree in the floating type of the directions, which decide the precision of the computation."""
    cast = partial(jax.lax.convert_element_type, new_dtype=dtype)
    return jax.tree.map(lambda leaf: cast(leaf) if eqx.is_inexact_array(leaf) and leaf.dtype != dtype else leaf, tree)
