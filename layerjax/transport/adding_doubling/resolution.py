"""How finely a stack has to be solved, by what is known of it before tracing: see `choose_resolution`.

Light that an interface lets in, a medium scatters and a base reflects is smooth in direction where one of them
scatters widely. What nodes and modes must resolve are narrow lobes behind the first interface, each by itself: nodes go
with one over the width of the narrowest in elevation, modes in azimuth, which is steeper the more the light inside is
inclined (a lower index lets it in closer to grazing).

What is traced has no numbers to go by. Under `grad` and `vmap` alone they are still read (`concrete_values`), so that
these solve what a plain call solves. Under ``jit`` a lobe counts as `ASSUMED_WIDTH` wide: right for what is wider, at
the cost of what is as narrow. `choose_transport` outside of ``jit`` knows better.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from layerjax._concrete import concrete_values
from layerjax.compiling import is_traced
from layerjax.stack import Interface, Medium, Stack, is_known, is_tilted
from layerjax.surfaces import Conductor

RESOLUTIONS = ((6, 8), (8, 12), (12, 16), (16, 24), (24, 32), (32, 48), (48, 64), (64, 96), (96, 128), (128, 192))
"""Resolutions (nodes, modes) that are chosen from, and that a tolerance climbs."""

ORDINATES = ((6, 8), (8, 12), (10, 16), (12, 20), (14, 24), (16, 28), (20, 36), (24, 44))
"""Ordinates (cosines, azimuths) that are chosen from, and that a tolerance climbs."""

MOST_NUMBERS, MOST_OF_ORDINATES = 6e6, 1.2e6
"""In an operator of what is chosen without a tolerance, at most: more takes minutes and gigabytes."""

SHORT = 1.25
"""A resolution by so much less than the expected one gives a warning."""

LEAST_KNOWN, LEAST_TABULATED = RESOLUTIONS[0], RESOLUTIONS[2]
"""At least: where light is followed along known directions, and where values are read off tables."""

NODES, MODES = 1.7, 4.5
"""Needed of either, times the width of the narrowest lobe in elevation and in azimuth.

Measured with an interface of alpha 0.05 over metal, errors relative to |f| and a tenth of its mean: index 1.1,
alpha 0.3, 12 nodes and 32 modes, 9e-4; index 1.5, alpha 0.3, 8 and 16, 7e-4, and alpha 0.15, 16 and 32, 7e-4; index
1.8, alpha 0.15, 12 and 24, 1e-3. With a third less of either they are 3 to 20 times larger.
"""

ASSUMED_WIDTH, ASSUMED_INDEX = 0.05, 1.5
"""Width of lobes, and the index around them, where nothing is known while tracing."""

NARROW = 1e-4
"""Width of lobes below which none counts."""

NODES_AS_UNDER = 1.5
"""Media that stand bare need no more nodes than under this index, but the modes of light of any inclination.

Measured on flakes over paint: alpha 0.2, 12 nodes and 64 modes, 9e-4 (24 and 32: 2e-2), alpha 0.1, 7e-3 (1.5e-1).
"""

FORWARD, FORWARD_TO_BASE, MODES_OF_PEAKS = 5.0, 3.6, 4 / 3
"""Nodes needed times the width of a forward peak: seen through, and over a base; and modes for each of them.

Measured on bare media, the worst of all directions. Seen through, that is along the beam: g 0.8, 16 nodes, 9e-3, 24,
4e-4; g 0.9, 32, 1e-2, 48, 8e-4, 64, 3e-5. Over paint: g 0.8, 16, 2e-3, 24, 5e-5; g 0.9, 16, 7e-3, 24, 5e-4.
"""

FORWARD_WITHIN, BACKWARD_WITHIN, BLUR = 2.5, 6.3, 1.75
"""Behind interfaces: nodes needed times the width of a forward peak, of which moments up to twice the nodes are
carried, and of a backward one; and that by which facets widen either, over how far they deflect what passes.

Light scattered once is not known in closed form there. Measured over paint, the worst of all directions, which is
backwards. Index 1.5, alpha 0.05: g 0.8, 12 nodes, 5e-4; g 0.9, 16, 2e-3, 24, 4e-4; g -0.5, 8, 2e-3, 12, 9e-5;
g -0.9, 48, 4e-3. Alpha 0.3: g 0.9, 8, 5e-3, 12, 7e-4; g 0.95, 12, 2e-3, 16, 3e-4; g -0.9, 24, 3e-3, 32, 3e-4.
"""

NODES_INSIDE = 32
"""Where light inside meets a rough interface to a lower index: facets reflect all of it beyond their critical angle,
whose edge no panel follows. A slab of index 1.4, alpha 0.3 and thickness 0.1: 12 nodes, 5e-3, 24, 5e-4; clear slabs of
index 1.26 to 1.9: 12, up to 2e-2, 24, 3e-3, 32, 2e-3. Towards a higher index 8 nodes leave 1e-6.
"""

FRINGES = 0.4
"""Nodes needed for each radian by which the phase of light in a film on an interface changes with the angle.

Measured over paint, index 1.5: a film of index 1.6, 2 um thick, at 500 nm (26 radians), 8 nodes, 5e-4; 3 um at 465 nm
(42 radians), 12 nodes, 2e-3, 24, 2e-5.
"""

COSINES, COSINES_UNDER = 5.0, 3.2
"""Needed where azimuths are ordinates too, times the width of the narrowest lobe, bare and behind an interface.

Measured on lying fibers over paint, up to 80 degrees: alpha 0.3, 16 cosines and 28 azimuths, 3e-3; alpha 0.2, 16 and
28, 2e-2, under an interface of alpha 0.1 1e-3; alpha 0.1, 20 and 48, 9e-3.
"""

LEAST_COSINE, LEAST_BARE = 0.4, 0.25
"""Cosine of light inside a stack, as far as its lobes are to be resolved, and where media stand bare: flakes of alpha
0.1 at 80 degrees, 24 nodes, are off by 6e-3 with 128 modes, by 3e-4 with 192."""


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


def modes_for(nodes: int) -> int:
    """Modes for so many nodes."""
    return max(1, 3 * nodes // 2)


def choose_resolution(stack: Stack, directions_known: bool) -> Resolution:
    """The coarsest resolution that is expected to give errors of 1e-3, as far as it fits into memory.

    Args:
        stack: a simplified stack; where it is traced, `ASSUMED_WIDTH` and `ASSUMED_INDEX` are taken.
        directions_known: whether light is followed along the requested directions, so that nothing is read off tables.
    """
    needed, panels = _requirement(stack, directions_known), _panels(stack)
    last = len(RESOLUTIONS) - 1
    steps = [next((k for k, step in enumerate(RESOLUTIONS) if needed[part] <= step[part]), last) for part in (0, 1)]
    while max(steps) and RESOLUTIONS[steps[1]][1] * (RESOLUTIONS[steps[0]][0] * panels) ** 2 > MOST_NUMBERS:
        steps[steps[1] > steps[0]] -= 1
    place = next((k for k, step in enumerate(ORDINATES) if step[0] >= needed.cosines), len(ORDINATES) - 1)
    while place and (math.prod(ORDINATES[place]) * panels) ** 2 > MOST_OF_ORDINATES:
        place -= 1
    return Resolution(RESOLUTIONS[steps[0]][0], RESOLUTIONS[steps[1]][1], ORDINATES[place])


def shortage(stack: Stack, directions_known: bool) -> str | None:
    """What is chosen and what would be needed, in words, where that is clearly more; None where it is not.

    Of what is traced nothing is said.
    """
    (nodes, modes, cosines), found = (
        _requirement(stack, directions_known, assumed=1.0),
        choose_resolution(stack, directions_known),
    )
    if has_tilted(stack):
        if cosines <= SHORT * found.ordinates[0]:
            return None
        return f"{found.ordinates[0]} x {found.ordinates[1]} ordinates, where about {cosines:.0f} cosines are needed"
    if nodes <= SHORT * found.nodes and modes <= SHORT * found.modes:
        return None
    return f"{found.nodes} nodes and {found.modes} modes, where about {nodes:.0f} and {modes:.0f} are needed"


def is_guessed(stack: Stack, directions_known: bool) -> bool:
    """Whether a lobe has to be resolved of whose width nothing is known while tracing, as under ``jit``."""
    if not is_traced(stack):
        return False
    media = [layer for layer in stack.layers if not isinstance(layer, Interface) and not is_known(layer.albedo, 0.0)]
    # phase functions assume a g by themselves
    if any(concrete_values(leaf) is None for layer in media for leaf in jax.tree.leaves(layer.phase)):
        return True
    return _requirement(stack, directions_known, assumed=NARROW) != _requirement(stack, directions_known, assumed=1.0)


class Requirement(NamedTuple):
    """Nodes and modes, or cosines, for an error of 1e-3."""

    nodes: float
    modes: float
    cosines: float


def _requirement(stack: Stack, directions_known: bool, assumed: float = ASSUMED_WIDTH) -> Requirement:
    """assumed: width of lobes of which nothing is known while tracing."""
    nodes, modes = map(float, LEAST_KNOWN if directions_known else LEAST_TABULATED)
    cosines = nodes
    for width, index in (*_lobes(stack, assumed), *_refracted_lobes(stack, assumed)):
        if width >= 1.0:  # broad: smooth at any resolution
            continue
        nodes = max(nodes, NODES / (width * _steepest_cosine(index or NODES_AS_UNDER)))
        modes = max(modes, MODES / (width * (LEAST_BARE if index is None else _steepest_cosine(index) * index)))
        cosines = max(cosines, (COSINES if index is None else COSINES_UNDER) / width)
    for least in _peak_nodes(stack, assumed):
        nodes, modes = max(nodes, least), max(modes, MODES_OF_PEAKS * least)
    fringes = max(_film_nodes(stack), default=0.0)
    nodes, cosines = max(nodes, fringes), max(cosines, fringes)
    return Requirement(max(nodes, NODES_INSIDE) if _traps_light(stack) else nodes, modes, cosines)


def _panels(stack: Stack) -> int:
    """Panels of the grid, at most."""
    return 1 + sum(isinstance(layer, Interface) for layer in stack.layers)


def _steepest_cosine(index: float) -> float:
    """Cosine of the most inclined light that counts where the index is this one."""
    return max(LEAST_COSINE, math.sqrt(max(0.0, 1.0 - 1.0 / index**2)))


def _lobes(stack: Stack, assumed: float) -> Iterator[tuple[float, float | None]]:
    """Width of every lobe that has to be resolved, and the index around it; None for what stands bare."""
    index: float | None = None
    within = False
    for layer in stack.layers:
        if isinstance(layer, Interface):
            if within and not layer.is_smooth:  # what is behind another interface is seen by reflection
                yield _least_width(layer, assumed), index
            index, within = max(1.0, _least(layer.ior, ASSUMED_INDEX)), True
        elif not is_known(layer.albedo, 0.0):
            yield _least(layer.phase.width, assumed), index
    if isinstance(stack.base, Conductor) and stack.layers and not stack.base.is_smooth:
        yield _least_width(stack.base, assumed), index


def _peak_nodes(stack: Stack, assumed: float) -> Iterator[float]:
    """Nodes that the peaks of media need; those backward of media that stand bare are among `_lobes`."""
    bare = FORWARD if stack.base is None else FORWARD_TO_BASE
    index, blur, within = 1.0, 0.0, False
    for layer in stack.layers:
        if isinstance(layer, Interface):
            below = concrete_values(layer.ior)
            if below is not None:  # of what is not known nothing is widened
                bent = abs(1.0 - index / float(np.min(below)))
                width = 0.0 if layer.is_smooth else _least_width(layer, assumed)
                blur, index = math.hypot(blur, BLUR * bent * width), float(np.min(below))
            within = True
        elif not is_known(layer.albedo, 0.0):
            onward = _least(layer.phase.ballistic_width, assumed)
            if onward < 1.0:
                yield FORWARD_WITHIN / math.hypot(onward, blur) if within else bare / onward
            backward = _least(layer.phase.width, assumed)
            if within and backward < 1.0 and layer.phase.moments(1) is not None:
                yield BACKWARD_WITHIN / math.hypot(backward, blur)


def _film_nodes(stack: Stack) -> Iterator[float]:
    """Nodes that the fringes of films on interfaces need, as far as their numbers are known while tracing."""
    above = 1.0
    for layer in stack.layers:
        if not isinstance(layer, Interface):
            continue
        below = _least(layer.ior, ASSUMED_INDEX)
        film, index = layer.film, max(1.0, above, below)
        above = below
        numbers = (
            [None] * 3 if film is None else [*map(concrete_values, (film.ior, film.thickness_nm, film.wavelengths_nm))]
        )
        if any(number is None for number in numbers):
            continue
        iors, thicknesses, wavelengths = (np.asarray(number) for number in numbers)
        ior = float(np.clip(index, np.min(iors), np.max(iors)))  # at which the phase changes most
        phase = 2.0 * math.pi * float(np.max(thicknesses)) / float(np.min(wavelengths))
        yield FRINGES * phase * (ior - math.sqrt(max(0.0, ior * ior - index * index)))


def _traps_light(stack: Stack) -> bool:
    """Whether light inside meets an interface to a lower index, as far as is known while tracing."""
    indices = [concrete_values(layer.ior) for layer in stack.layers if isinstance(layer, Interface)]
    return any(
        here is not None and there is not None and bool(np.min(there) < np.max(here))
        for here, there in itertools.pairwise(indices)
    )


def _refracted_lobes(stack: Stack, assumed: float) -> Iterator[tuple[float, float | None]]:
    """The same of what passes one interface to the next, or to a smooth surface that mirrors it back.

    Light through interfaces is as narrow as facets deflect it. Through two rough ones alone it is known in closed form;
    on the grid a slab of alpha 0.14 and index 1.5 is off by 7e-2 at 24 nodes, by 1e-3 at 48.
    """
    faces = [layer for layer in stack.layers if isinstance(layer, Interface)]
    smooth = [face.is_smooth for face in faces]
    mirror = isinstance(stack.base, Conductor) and stack.base.is_smooth
    if mirrors_in_closed_form(stack.layers, mirror):  # what is left of it has met the facets from inside
        yield _least_width(faces[0], assumed), max(1.0, _least(faces[0].ior, ASSUMED_INDEX))
        return
    if not (any(smooth) or mirror) and (stack.base is not None or len(faces) <= 2):
        return
    indices = [1.0, *(_least(face.ior, ASSUMED_INDEX) for face in faces)]
    known = [True, *(concrete_values(face.ior) is not None for face in faces)]
    for place, face in enumerate(faces):
        for here, there in ((place, place + 1), (place + 1, place)):
            beyond = smooth[:place] if here == place else [*smooth[place + 1 :], mirror]
            between = stack.base is None and 0 < here < len(faces)  # between two of them
            if face.is_smooth or not (between or any(beyond)):
                continue
            width = _least_width(face, assumed) * abs(1.0 - indices[there] / indices[here])
            if not (known[here] and known[there]):
                yield assumed, max(1.0, indices[here])
            elif width > 0.0:  # none is deflected at equal indices
                yield width, max(1.0, indices[here])


def _least_width(part: Interface | Conductor, assumed: float) -> float:
    """Smallest width of the facets of an interface or a metal."""
    least = _least(part.alpha, assumed)
    return least if part.alpha_y is None else min(least, _least(part.alpha_y, assumed))


def _least(value: Any, assumed: float) -> float:
    values = concrete_values(value)
    return assumed if values is None else max(float(np.min(values)), NARROW)


def resolutions(stack: Stack) -> Iterator[Resolution]:
    """All resolutions, from coarse to fine, of the kind that the stack is solved at."""
    tilted = has_tilted(stack)
    for step in ORDINATES if tilted else RESOLUTIONS:
        yield Resolution(*RESOLUTIONS[0], step) if tilted else Resolution(*step, ORDINATES[0])


def mirrors_in_closed_form(layers: Sequence[Interface | Medium], is_mirror: bool) -> bool:
    """Whether the base is a mirror and lies under a single interface, which is rough: what it sends back through the
    facets is known in closed form, see `ballistic`."""
    faces = [layer for layer in layers if isinstance(layer, Interface)]
    return is_mirror and len(faces) == 1 and not faces[0].is_smooth


def has_tilted(stack: Stack) -> bool:
    """Whether any part of a stack is not symmetric about the normal, so that azimuths are ordinates."""
    return any(map(is_tilted, (*stack.layers, stack.base)))
