"""Start values of an OpenPBR surface, from the layers of a stack, for the fit of its parameters."""

from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import jax.numpy as jnp
import numpy as np

import layerjax as lj
from fits.exports.openpbr.surface import EDGE, Lobe, Surface
from fits.problem.parameters import Free
from layerjax.fresnel import conductor, schlick
from layerjax.phase.contract import Flakes

IOR = (1.0, 3.0)
RANGES = {
    "base_color": (0.0, 1.0),
    "base_diffuse_roughness": (0.0, 1.0),
    "base_metalness": (0.0, 1.0),
    "specular_color": (0.0, 1.0),
    "specular_roughness": (0.01, 1.0),
    "specular_ior": IOR,
    "coat_roughness": (0.01, 1.0),
    "coat_ior": IOR,
}
"""In which parameters are fitted."""

COLORS = ("base_color", "specular_color")

USED = {
    "coat": {"coat_roughness", "coat_ior"},
    "gloss": {"specular_roughness", "specular_ior"},
    "metal": {"base_color", "specular_color", "specular_roughness"},
    "diffuse": {"base_color", "base_diffuse_roughness"},
}
"""The parameters of each lobe."""

MOSTLY = 0.8
"""Weight of a metal below a medium at the start; the rest is diffuse light of the medium."""


def starts(stacks: tuple[lj.Stack, ...]) -> list[Surface]:
    """One starting surface of each kind that may resemble one of the stacks."""
    kinds: dict[tuple[Lobe, ...], Surface] = {}
    for stack in stacks:
        for surface in _kinds(stack):
            kinds.setdefault(surface.lobes, surface)
    return list(kinds.values())


def freed(surface: Surface, channels: int) -> Surface:
    """The surface with all that its lobes use to be fitted, from where it is."""
    used = used_by(surface)
    values: dict[str, Any] = {field.name: getattr(surface, field.name) for field in fields(surface)}
    for name, (low, high) in RANGES.items():
        if name not in used:
            continue
        start = np.clip(np.asarray(values[name], float), low, high)
        if name in COLORS and channels > 1:
            start = np.broadcast_to(start, (channels,))
            values[name] = Free(tuple(start), (low,) * channels, (high,) * channels)
        else:
            values[name] = Free(float(np.mean(start)), low, high)
    return Surface(**values)


def used_by(surface: Surface) -> set[str]:
    """The parameters that its lobes use."""
    used = set().union(*(USED[lobe] for lobe in surface.lobes))
    return used | ({"base_metalness"} if {"metal", "diffuse"} <= set(surface.lobes) else set())


def _kinds(stack: lj.Stack) -> Iterator[Surface]:
    """Over a diffuse base one mirror is the gloss, and a second the coat above it; over a metal the first is the coat.

    A coat over diffuse without gloss has the same lobes by the specification, but MaterialX's shaders dim what lies
    below a gloss even where it has no weight.
    """
    mirrors = list(_mirrors(stack))
    metallic = isinstance(stack.base, lj.Conductor)
    coated = bool(mirrors) if metallic else len(mirrors) > 1
    coat: tuple[Lobe, ...] = ("coat",) if coated else ()
    parameters: dict[str, Any] = {"coat_ior": mirrors[0][0], "coat_roughness": mirrors[0][1]} if coated else {}
    if isinstance(stack.base, lj.Conductor):
        parameters |= _metal(stack.base, stack)
        if all(isinstance(layer, lj.Interface) for layer in stack.layers):
            yield Surface((*coat, "metal"), base_metalness=1.0, **parameters)
        else:
            yield Surface((*coat, "metal", "diffuse"), base_metalness=MOSTLY, **parameters)
        return
    parameters["base_color"] = np.asarray(getattr(stack.base, "albedo", 0.5))
    if mirrors:
        parameters["specular_ior"], parameters["specular_roughness"] = mirrors[-1]
    yield Surface((*coat, "gloss", "diffuse") if mirrors else ("diffuse",), **parameters)
    if any(_flat(layer) is not None for layer in stack.layers):  # flakes that lie flat look like a metal
        below: tuple[Lobe, ...] = ("metal",) if stack.base is None else ("metal", "diffuse")
        yield Surface(
            (*coat, *below), **parameters | {"base_color": 0.5, "base_metalness": 1.0 if stack.base is None else MOSTLY}
        )


def _mirrors(stack: lj.Stack) -> Iterator[tuple[float, float]]:
    """Index and roughness of all that mirrors light about the normal: interfaces, and flakes that lie flat."""
    for layer in stack.layers:
        if isinstance(layer, lj.Interface):
            yield _number(layer.ior), 0.0 if layer.is_smooth else _number(layer.alpha) ** 0.5
        elif (flakes := _flat(layer)) is not None:
            root = _number(0.04 if layer.f0 is None else layer.f0) ** 0.5
            yield (1.0 + root) / max(1.0 - root, 0.5), _number(flakes.alpha) ** 0.5


def _flat(layer: Any) -> Flakes | None:
    """The flakes of a medium, if they lie about the normal as the facets of a surface do."""
    flakes: Flakes | None = None if isinstance(layer, lj.Interface) else layer.phase.flakes
    return flakes if flakes is not None and flakes.kind == "surface" else None


def _metal(base: lj.Conductor, stack: lj.Stack) -> dict[str, Any]:
    interfaces = [layer for layer in stack.layers if isinstance(layer, lj.Interface)]
    outside = _number(interfaces[-1].ior) if interfaces else 1.0
    n, k = base.ior / outside, base.k / outside
    color, edge = conductor(jnp.asarray(1.0), n, k), conductor(jnp.asarray(EDGE), n, k)
    return {
        "base_color": np.asarray(color),
        "specular_color": np.asarray(edge / schlick(jnp.asarray(EDGE), color)),
        "specular_roughness": _number(base.alpha) ** 0.5,
    }


def _number(value: Any) -> float:
    return float(np.mean(np.asarray(value)))
