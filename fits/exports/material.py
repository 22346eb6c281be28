"""The material of an export: BSDF values of a stack along any directions, its albedos, symmetries and lobe widths."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

import layerjax as lj
from fits.data.geometry import Floats
from fits.progress import Progress, silent
from layerjax.mixture import stacks_of
from layerjax.phase.contract import Flakes
from layerjax.stack import is_tilted

BATCH = 1 << 16
"""Pairs of directions that are evaluated at a time."""

VALUES = "values of the material"
"""Stage of progress that evaluates them."""


@dataclass(frozen=True)
class Material:
    """A stack, or a mixture of several, prepared for its transport.

    name: its name in the file. parts: the stacks. progress: called by writers.
    """

    name: str
    stack: lj.Stack | lj.Mixture
    prepared: lj.Prepared | lj.Mixture
    parts: tuple[lj.Stack, ...]
    channels: int
    progress: Progress = silent

    def values(self, wi: Floats, wo: Floats, stage: str = "") -> Floats:
        """BSDF in 1/sr without the cosine, (N, C), at pairs of directions (N, 3). stage: of progress, "" for none."""
        values: list[Floats] = []
        count = -(-len(wi) // BATCH)
        for one, other in zip(_batches(wi), _batches(wo), strict=True):
            if stage:
                self.progress(stage, len(values), count)
            values.append(np.asarray(lj.evaluate(self.prepared, one, other), float))
        return np.concatenate(values)[: len(wi)]

    def albedos(self, wi: Floats) -> tuple[Floats, Floats]:
        """Hemispherical reflectance and scattered transmittance of light from directions (N, 3), (N, C) each."""
        reflected, transmitted = lj.albedo(self.prepared, wi)
        shape = (len(wi), self.channels)
        return np.broadcast_to(reflected, shape).astype(float), np.broadcast_to(transmitted, shape).astype(float)

    def specular(self, wi: Floats) -> tuple[Floats, Floats]:
        """Specular reflectance and collimated transmittance of light from directions (N, 3), (N, C) each."""
        reflected, transmitted = lj.specular(self.stack, wi)
        shape = (len(wi), self.channels)
        return np.broadcast_to(reflected, shape).astype(float), np.broadcast_to(transmitted, shape).astype(float)

    @property
    def is_mirror(self) -> bool:
        """Whether smooth surfaces send part of the light along a single direction."""
        surfaces = (layer for part in self.parts for layer in (*part.layers, part.base))
        return any(layer.is_smooth for layer in surfaces if isinstance(layer, lj.Interface | lj.Conductor))

    def require_air_below(self) -> None:
        """ValueError for a stack that ends in another index than that of air."""
        for part in self.parts:
            interfaces = [layer for layer in part.layers if isinstance(layer, lj.Interface)]
            if part.base is None and interfaces and float(interfaces[-1].ior) != 1.0:
                raise ValueError(
                    f"layers: the stack ends in a medium of index {float(interfaces[-1].ior):g}, and the file is of a "
                    "sheet in air: close it with an Interface of ior 1, or give it a base"
                )

    @property
    def opaque(self) -> bool:
        """Whether no light is transmitted."""
        return all(part.base is not None for part in self.parts)

    @property
    def widths(self) -> tuple[float, ...]:
        """Roughness alpha of all surfaces and flakes about the normal, each once."""
        widths = {width for part in self.parts for width in _widths(part)}
        return tuple(sorted(widths))

    @property
    def isotropic(self) -> bool:
        """Whether the BSDF is invariant to rotations about the normal."""
        return not any(is_tilted(one) for part in self.parts for one in (*part.layers, part.base))

    @property
    def turns_by_half(self) -> bool:
        """Whether the BSDF is invariant to half a turn about the normal: every axis is parallel or normal to it.

        Facets of two widths are. Only flakes and fibers have a known axis.
        """
        media = [layer for part in self.parts for layer in part.layers if not isinstance(layer, lj.Interface)]
        return all(medium.phase.is_axisymmetric or _lies_flat(medium.phase.flakes) for medium in media)


def material_of(
    stack: lj.Stack | lj.Mixture,
    transport: lj.Transport | Literal["auto"] = "auto",
    name: str = "stack",
    progress: Progress = silent,
) -> Material:
    """Prepare a stack; ValueError for placeholders, a map, and a transport that is random or does not support it."""
    if isinstance(transport, lj.Transport) and transport.random:
        raise ValueError(f"transport: {type(transport).__name__} is random; use a deterministic one: AddingDoubling()")
    parts = tuple(stacks_of(stack))
    prepared = lj.prepare(stack, transport)
    return Material(name, stack, prepared, parts, max(part.channels for part in parts), progress)


def _batches(w: Floats) -> Iterator[Floats]:
    """Batches of one length, the last filled up with its last direction: one program serves all."""
    length = min(BATCH, len(w))
    for start in range(0, len(w), length):
        batch = w[start : start + length]
        yield np.concatenate([batch, np.repeat(batch[-1:], length - len(batch), axis=0)])


def _widths(stack: lj.Stack) -> Iterator[float]:
    for layer in stack.layers:
        if isinstance(layer, lj.Interface):
            yield from _of_facets(layer)
        elif layer.phase.flakes is not None and layer.phase.flakes.kind == "surface" and layer.phase.is_axisymmetric:
            yield _number(layer.phase.flakes.alpha)
    if isinstance(stack.base, lj.Conductor):
        yield from _of_facets(stack.base)


def _of_facets(surface: lj.Interface | lj.Conductor) -> Iterator[float]:
    for width in (surface.alpha, surface.alpha_y):
        if width is not None:
            yield _number(width)


def _lies_flat(flakes: Flakes | None) -> bool:
    return flakes is not None and not np.any(np.asarray(flakes.axis)[..., 2] != 0.0)


def _number(value: object) -> float:
    return float(np.min(np.asarray(value)))  # the narrowest of the channels
