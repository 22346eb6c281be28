"""A whole stack on the grid: its layers one by one, added from the bottom up.

Layers that are symmetric about the normal are solved as Fourier modes. Where a medium has an axis of its own, what lies
below it is turned into ordinates first, and so is every layer on top.
"""

from collections import defaultdict
from functools import partial
from operator import itemgetter
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import fresnel
from layerjax._parameters import cast_arrays
from layerjax.normals.facets import Distribution
from layerjax.normals.widths import OneWidth, Widths, cast_width, narrowest
from layerjax.stack import Interface, Medium, Stack, is_tilted
from layerjax.surfaces import Conductor, Lambertian, Surface
from layerjax.surfaces.thin_film import films_of
from layerjax.transport.adding_doubling.anisotropic import anisotropic_interface, anisotropic_metal
from layerjax.transport.adding_doubling.ballistic import subtract_ballistic
from layerjax.transport.adding_doubling.bases import base_layer
from layerjax.transport.adding_doubling.elements import Make, Scalars, build_element, element
from layerjax.transport.adding_doubling.energies import OuterFace, outer_faces
from layerjax.transport.adding_doubling.facet_scattering import Normals
from layerjax.transport.adding_doubling.grid import Grid, Region, make_grid
from layerjax.transport.adding_doubling.interfaces import NextEvent, interface_layer, smooth_layer
from layerjax.transport.adding_doubling.media import Kernel, kernel_modes, kernel_ordinates, medium_layer
from layerjax.transport.adding_doubling.moments import terms
from layerjax.transport.adding_doubling.operators import Layer, add
from layerjax.transport.adding_doubling.requested_directions import requested_region
from layerjax.transport.adding_doubling.resolution import Resolution, has_tilted, mirrors_in_closed_form
from layerjax.transport.known_directions import DirectionLookup, KnownDirections
from layerjax.transport.specular import is_smooth

MANY = 3
"""Interfaces of a kind from which on they share a program."""

DISTINCT, LEAST_ALPHA, MOST_ALPHA, STEP = 0.02, 2e-4, 0.99, 6e-6
"""An interface is differentiated by differences where any two indices differ by more than the first, relative to the
smallest, and alpha lies between the next two. The step is the last times alpha: the cube root of the rounding in double
precision, where truncation and rounding are least together."""


class Plan(eqx.Module):
    """What is decided before tracing. azimuths: ordinates in azimuth, or None for Fourier modes."""

    nodes: int = eqx.field(static=True)
    modes: int = eqx.field(static=True)
    azimuths: int | None = eqx.field(static=True)
    ranks: tuple[int, ...] | None = eqx.field(static=True)
    multiple: bool = eqx.field(static=True)
    common: bool = eqx.field(static=True, default=False)
    """Whether all regions have the same nodes, which smooth interfaces refract to each other."""
    mirrored: bool = eqx.field(static=True, default=False)
    """Whether a smooth surface sends back what rough interfaces let pass, and not in closed form."""


def make_plan(stack: Stack, resolution: Resolution, multiple: bool) -> Plan:
    """The plan for a simplified stack."""
    common = any(map(is_smooth, stack.layers))
    mirrored = (common or is_smooth(stack.base)) and not mirrors_in_closed_form(stack.layers, is_smooth(stack.base))
    if has_tilted(stack):
        nodes, azimuths = resolution.ordinates
        return Plan(nodes, azimuths // 2 + 1, azimuths, ranks(stack), multiple, common, mirrored)
    return Plan(resolution.nodes, resolution.modes, None, ranks(stack), multiple, common, mirrored)


def solve(
    stack: Stack, plan: Plan, requested: KnownDirections | None = None
) -> tuple[Grid, Layer, Layer, tuple[OuterFace | None, OuterFace | None]]:
    """The grid, the whole stack as one layer, that less what is known in closed form, see `ballistic`, and its outer
    faces, see `outer_faces`.

    requested: directions outside in the place of the grid's, see `interface_layer`; the stack then begins (and if light
    passes it, ends) with an interface.
    """
    return assemble(stack, plan, make_elements(stack, plan, requested))


def make_elements(stack: Stack, plan: Plan, requested: KnownDirections | None, make: Make = build_element) -> list[Any]:
    """An element for every layer, and for a base: the `Layer` of what is a surface, the `Kernel` of a medium."""
    dtype = _dtype(stack)
    indices = _indices(stack, dtype)
    faces = iter(_interfaces(stack, plan, indices, requested, make))
    elements: list[Any] = []
    region = 0
    for layer in stack.layers:
        if isinstance(layer, Interface):
            elements.append(next(faces))
            region += 1
        else:
            tilted = plan.azimuths is not None and is_tilted(layer)
            options = plan, region, layer.f0 is not None, tilted, dtype
            elements.append(make(_kernel, options, (indices, layer.phase), None, dtype))
    if stack.base is not None:
        elements.append(make(_base, (plan, region, dtype), (indices, stack.base), None, dtype))
    return elements


def assemble(
    stack: Stack, plan: Plan, elements: list[Any]
) -> tuple[Grid, Layer, Layer, tuple[OuterFace | None, OuterFace | None]]:
    """See `solve`; elements: see `make_elements`. Of a base it only matters whether there is one."""
    dtype = _dtype(stack)
    grid = _grid(plan, _indices(stack, dtype), dtype)
    solved: list[tuple[Layer, bool]] = []
    for layer, found in zip((*stack.layers, stack.base), elements, strict=False):
        tilted = plan.azimuths is not None and is_tilted(layer)
        solved.append((medium_layer(layer, found) if isinstance(layer, Medium) else found, tilted))
    whole, is_expanded = solved[-1]
    for found, tilted in reversed(solved[:-1]):
        if tilted and not is_expanded:
            whole, is_expanded = expand_modes(whole, plan.azimuths), True
        whole = add(expand_modes(found, plan.azimuths) if is_expanded and not tilted else found, whole)
    layers = [found for found, _ in solved]
    joined = layers
    if is_expanded:
        joined = [found if tilted else expand_modes(found, plan.azimuths) for found, tilted in solved]
    return grid, whole, subtract_ballistic(stack, joined, whole), outer_faces(stack, layers)


def can_be_split(stack: Stack) -> bool:
    """Whether every element has a program of its own, which many interfaces share."""
    return sum(isinstance(layer, Interface) for layer in stack.layers) < MANY


class Layers(eqx.Module):
    """All that `assemble` needs of a stack: the layers, whether there is a base, and whether that is on ordinates."""

    layers: tuple[Interface | Medium, ...]
    opaque: bool = eqx.field(static=True)
    tilted_base: bool = eqx.field(static=True)
    dtype: Any = eqx.field(static=True)

    def stack(self) -> Stack:
        """A stack of these layers, over a base that stands for any of its symmetry."""
        if not self.opaque:
            return Stack(self.layers)
        one = jnp.ones((), self.dtype)
        return Stack(self.layers, Conductor(one, one, one, alpha_y=one) if self.tilted_base else Lambertian(one))


def without_base(stack: Stack) -> Layers:
    """The stack without its base, so that programs do not depend on it."""
    return Layers(stack.layers, stack.base is not None, is_tilted(stack.base), _dtype(stack))


def _grid(plan: Plan, indices: Scalars, dtype: Any) -> Grid:
    return make_grid(indices, plan.ranks, plan.nodes, dtype, common=plan.common, mirrored=plan.mirrored)


def _indices(stack: Stack, dtype: Any) -> Scalars:
    """Refractive indices of all regions."""
    faces = [layer for layer in stack.layers if isinstance(layer, Interface)]
    return tuple(jnp.asarray(n, dtype) for n in (1.0, *(layer.ior for layer in faces)))


def _dtype(stack: Stack) -> Any:
    return jnp.result_type(*(leaf for leaf in jax.tree.leaves(stack) if eqx.is_array(leaf)), jnp.float32)


def _interfaces(
    stack: Stack, plan: Plan, indices: Scalars, requested: KnownDirections | None, make: Make
) -> list[Layer]:
    """Every interface of a stack as a layer. Many of a kind share one program, which is compiled once."""
    interfaces = [layer for layer in stack.layers if isinstance(layer, Interface)]
    next_event: NextEvent = "narrow" if stack.base is None or isinstance(stack.base, Conductor) else "diffuse"
    if stack.base is None and len(interfaces) > 1:
        next_event = "faces"
    dtype = indices[0].dtype

    def join(layer: Interface, function: Any, options: Any, numbers: Any, along: Any, step: Any = None) -> Layer:
        """An element for each channel that a film distinguishes, joined along the axis of the channels."""
        films = films_of(layer.film)
        found = [make(function, options, (*numbers, film), along, dtype, step) for film in films]
        return found[0] if len(found) == 1 else jax.tree.map(lambda *parts: jnp.concatenate(parts), *found)

    layers: dict[int, Layer] = {}
    by_kind: dict[tuple[Distribution, bool], list[int]] = defaultdict(list)
    for region, layer in enumerate(interfaces):
        if layer.is_smooth:
            layers[region] = join(layer, _smooth_interface, (plan, region), (indices,), None)
            continue
        leaves = stack.base is None and 1 < region + 1 == len(interfaces)
        if requested is not None and (layer is stack.layers[0] or leaves):
            options = plan, layer.distribution, not leaves, next_event, region
            along = requested.below if leaves else requested.above
            layers[region] = join(layer, _interface, options, (indices, layer.width), along, _interface_step)
        elif layer.is_anisotropic:
            face = plan, layer.distribution, not leaves, region
            layers[region] = join(layer, _anisotropic_interface, face, (indices, layer.width), None)
        elif layer.film is not None:
            options = plan, layer.distribution, not leaves, next_event, region
            layers[region] = join(layer, _interface, options, (indices, layer.width), None, _interface_step)
        else:
            by_kind[layer.distribution, not leaves].append(region)
    for kind, regions in by_kind.items():
        widths = [cast_width(cast(OneWidth, interfaces[region].width), dtype) for region in regions]
        if len(regions) < MANY:
            for region, width in zip(regions, widths, strict=True):
                options = plan, *kind, next_event, region
                layers[region] = make(_interface, options, (indices, width, None), None, dtype, _interface_step)
        else:
            build = partial(_numbered_interface, plan, *kind, next_event)
            together = jax.lax.map(
                lambda each, build=build: element(build, (indices, each[1], None), each[0], dtype),
                (jnp.asarray(regions), jax.tree.map(lambda *leaves: jnp.stack(leaves), *widths)),
            )
            layers.update((region, jax.tree.map(itemgetter(k), together)) for k, region in enumerate(regions))
    return [layers[region] for region in range(len(interfaces))]


def _interface(
    plan: Plan,
    distribution: Distribution,
    enters: bool,
    next_event: NextEvent,
    region: int | Array,
    numbers: tuple[Scalars, OneWidth, fresnel.Film | None],
    requested: Array | None,
) -> Layer:
    indices, width, film = numbers
    dtype = indices[0].dtype
    grid = _grid(plan, indices, dtype)
    above, below = (_region(grid, place) for place in (region, region + 1))
    outside = None if requested is None else requested_region(requested, (above if enters else below).ior)
    normals = Normals(cast_width(width, dtype), distribution)
    return interface_layer(
        grid,
        above,
        below,
        normals,
        plan.modes,
        plan.multiple,
        enters=enters,
        requested=outside,
        next_event=next_event,
        film=film,
    )


def _anisotropic_interface(
    plan: Plan,
    distribution: Distribution,
    enters: bool,
    region: int,
    numbers: tuple[Scalars, Widths, fresnel.Film | None],
    _: None,
) -> Layer:
    indices, widths, film = numbers
    grid = _grid(plan, indices, indices[0].dtype)
    normals = Normals(cast_arrays(widths, indices[0].dtype), distribution)
    assert plan.azimuths is not None
    return anisotropic_interface(
        grid, grid.regions[region], grid.regions[region + 1], normals, plan.azimuths, enters=enters, film=film
    )


def _smooth_interface(plan: Plan, region: int, numbers: tuple[Scalars, fresnel.Film | None], _: None) -> Layer:
    indices, film = numbers
    grid = _grid(plan, indices, indices[0].dtype)
    return smooth_layer(grid.regions[region], grid.regions[region + 1], film)


def _numbered_interface(
    plan: Plan,
    distribution: Distribution,
    enters: bool,
    next_event: NextEvent,
    numbers: tuple[Scalars, OneWidth, None],
    region: Array,
) -> Layer:
    """An interface under a region whose number is traced."""
    return _interface(plan, distribution, enters, next_event, region, numbers, None)


def _interface_step(numbers: tuple[Scalars, OneWidth, fresnel.Film | None]) -> float | None:
    """See `linearize_element`: an interface varies with alpha and the indices like a lobe does, over its width.

    None where indices meet or the width ends: there its derivatives are one-sided.
    """
    indices, width = np.asarray(numbers[0], float), float(narrowest(numbers[1]))
    steps = np.diff(np.sort(indices)) / np.min(indices)
    if np.min(steps) < DISTINCT or not LEAST_ALPHA < width < MOST_ALPHA:
        return None
    return STEP * width


def _region(grid: Grid, place: int | Array) -> Region:
    """Region of the grid, by a place that may be traced."""
    if isinstance(place, int):
        return grid.regions[place]
    return jax.tree.map(lambda *parts: jnp.stack(parts)[place], *grid.regions)


def _kernel(plan: Plan, region: int, fresnel: bool, tilted: bool, dtype: Any, numbers: Any, _: None) -> Kernel:
    indices, phase = numbers
    here = _grid(plan, indices, dtype).regions[region]
    if not tilted:
        carried = terms(plan.nodes, len(indices) > 1)
        return kernel_modes(phase, fresnel, here, plan.modes, carried, grazing=plan.common)
    assert plan.azimuths is not None
    return kernel_ordinates(phase, fresnel, here, plan.azimuths)


def _base(plan: Plan, region: int, dtype: Any, numbers: Any, _: None) -> Layer:
    indices, base = numbers
    here = _grid(plan, indices, dtype).regions[region]
    base = _relative_conductor(base, here.ior)
    if is_tilted(base) and isinstance(base, Conductor) and plan.azimuths is not None:
        return anisotropic_metal(here, base, plan.azimuths)
    return base_layer(here, base, plan.modes, plan.multiple, grazing=plan.common)


def requested_stack(stack: Stack, known: DirectionLookup) -> tuple[Stack, KnownDirections] | None:
    """The stack with directions that can stand in the place of the grid's outer ones, if there are such.

    What ends with a medium is closed where nothing is requested below: light that leaves it there does not come back.
    A smooth interface lets in none that is not along the nodes.
    """
    outer = [layer for layer in (*stack.layers[:1], *stack.layers[-1:]) if isinstance(layer, Interface)]
    if has_tilted(stack) or not stack.layers or not isinstance(stack.layers[0], Interface):
        return None
    if outer[0].is_smooth or (stack.base is None and outer[-1].is_smooth):
        return None
    directions = known()
    if directions is None:
        return None
    if stack.base is not None or (len(stack.layers) > 1 and isinstance(stack.layers[-1], Interface)):
        return stack, directions
    black = Lambertian(jnp.zeros((), directions.above.dtype))
    return (Stack(stack.layers, black), directions) if directions.all_above else None


def expand_modes(layer: Layer, azimuths: int | None) -> Layer:
    """Fourier modes to ordinates."""
    assert azimuths is not None
    count = azimuths
    modes = np.arange(count // 2 + 1)
    share = np.where((modes == 0) | (2 * modes == count), 1.0, 2.0) / count
    between = np.cos(2.0 * np.pi * np.outer(modes, np.arange(count)) / count) * share[:, None]
    apart = (np.arange(count)[:, None] - np.arange(count)) % count

    def operator(flux: Array) -> Array:
        circulant = jnp.einsum("cmij,md->cijd", flux, jnp.asarray(between, flux.dtype))[..., apart]
        channels, nodes = flux.shape[0], flux.shape[-1]
        return jnp.swapaxes(circulant, 2, 3).reshape(channels, 1, nodes * count, nodes * count)

    return layer.map(operator, lambda direct: jnp.repeat(direct, count, axis=-1))


def _relative_conductor(base: Surface, above: Array) -> Surface:
    """A conductor's index counted from what surrounds the stack, as one counted from what lies on it."""
    if not isinstance(base, Conductor):
        return base
    return base.relative_to(above)


def ranks(stack: Stack) -> tuple[int, ...] | None:
    """Place of every region's index among the distinct ones, if they are known."""
    indices: list[Any] = [1.0]
    for layer in stack.layers:
        if isinstance(layer, Interface):
            if isinstance(layer.ior, jax.core.Tracer):
                return None
            indices.append(np.asarray(layer.ior, dtype=np.float64))
    return tuple(int(rank) for rank in np.unique(np.array(indices, dtype=np.float64), return_inverse=True)[1])
