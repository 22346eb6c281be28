"""How finely a stack has to be solved, by what is known of it before tracing: see `chosen`.

Light that an interface lets in, a medium scatters and a base reflects is smooth in direction where one of them
scatters widely. What nodes and modes must resolve are narrow lobes behind one another: the number of nodes goes with
one over the width of the narrowest. Errors of random stacks, as they were measured along known directions: paint under
an interface of any roughness 5e-4 at 6 nodes; metal of alpha 0.13 1e-3 at 16 nodes, of 0.06 2e-3 at 32; flakes of alpha
0.07 to 0.14 1e-3 at 16 nodes. Read off tables, haze over paint has 2e-3 at 12 nodes.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from layerjax.stack import Medium, Stack, is_known
from layerjax.surfaces import Conductor

LADDER = ((6, 8), (8, 12), (12, 16), (16, 24), (24, 32), (32, 48), (48, 64), (64, 96))
"""Resolutions (nodes, modes) that are chosen from, and that a tolerance climbs."""

ORDINATES_LADDER = ((6, 8), (8, 12), (10, 16), (12, 20), (14, 24), (16, 28))
"""The same for ordinates, (cosines, azimuths)."""

FINEST = (48, 64)
"""What is chosen without a tolerance, at most: more takes minutes and gigabytes."""

FOLLOWED, READ = 6, 12
"""Nodes at least: where light is followed along known directions, and where values are read off tables."""

ACROSS = 2.4
"""Nodes needed, times the width of the narrowest lobe."""

ASSUMED = 0.15
"""Width of lobes of which nothing is known while tracing."""


class Resolution(NamedTuple):
    """Nodes and modes where media are symmetric about the normal, (cosines, azimuths) where one is not."""

    nodes: int
    modes: int
    ordinates: tuple[int, int]

    def coarser(self) -> "Resolution":
        """About two thirds of it."""
        cosines, azimuths = self.ordinates
        return Resolution(
            max(2, 2 * self.nodes // 3),
            max(1, 2 * self.modes // 3),
            (max(2, 3 * cosines // 4), max(4, 3 * azimuths // 8 * 2)),
        )

    def finer(self) -> "Resolution":
        """About four thirds of it: small steps, as the work grows with a power above the second."""
        cosines, azimuths = self.ordinates
        return Resolution(-(-4 * self.nodes // 3), -(-4 * self.modes // 3), (cosines + 2, azimuths + 4))


def suiting(nodes: int) -> int:
    """Modes for so many nodes."""
    return max(1, 3 * nodes // 2)


def chosen(stack: Stack, followed: bool) -> Resolution:
    """The coarsest resolution that is expected to give errors of 1e-3, up to `FINEST`.

    Args:
        stack: a simplified stack; of what is traced in it, `ASSUMED` is taken for roughnesses.
        followed: whether light is followed along the directions asked for, so that nothing is read off tables.
    """
    needed = max(FOLLOWED if followed else READ, *(ACROSS / width for width in (1.0, *_widths(stack))))
    rung = next((rung for rung in LADDER if rung[0] >= needed), FINEST)
    nodes, modes = min(rung, FINEST)
    ordinates = next((rung for rung in ORDINATES_LADDER if rung[0] >= needed), ORDINATES_LADDER[-1])
    return Resolution(nodes, modes, ordinates)


def _widths(stack: Stack) -> Iterator[float]:
    """Of every lobe that has to be resolved."""
    for layer in stack.layers:
        if isinstance(layer, Medium) and not is_known(layer.albedo, 0.0):
            yield _least(layer.phase.width)
    if isinstance(stack.base, Conductor) and stack.layers:
        yield _least(stack.base.alpha)


def _least(width: Any) -> float:
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(width)):
        return ASSUMED
    return max(float(np.min(np.asarray(width))), 1e-4)


def rungs(stack: Stack) -> Iterator[Resolution]:
    """All resolutions, from coarse to fine, of the kind that the stack is solved at."""
    tilted = any(map(is_tilted, stack.layers))
    for rung in ORDINATES_LADDER if tilted else LADDER:
        yield Resolution(*LADDER[0], rung) if tilted else Resolution(*rung, ORDINATES_LADDER[0])


def is_tilted(layer: Any) -> bool:
    """Whether the layer is a medium that is not symmetric about the normal (as far as is known while tracing)."""
    return isinstance(layer, Medium) and not layer.phase.is_upright
