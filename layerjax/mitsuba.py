"""A BSDF plugin for Mitsuba 3: any stack, by any transport, with derivatives with respect to its numbers.

Importing this module registers the plugin "layerjax" for the variant that is set, ``llvm_ad`` or ``cuda_ad`` in rgb or
mono (import it after `mi.set_variant`, and call `register` after another). From then on Dr.Jit evaluates calls and
loops as they come: JAX needs numbers, where a symbolic call has none to give.

Needs the extra ``mitsuba``. Values are as Mitsuba has them, with the cosine; where radiance is carried its wi points to
the viewer, and wo to the light.
"""

import dataclasses
from collections.abc import Callable
from functools import cache, reduce
from operator import or_
from typing import Any

import drjit as dr
import equinox as eqx
import jax
import jax.numpy as jnp
import mitsuba as mi
import numpy as np
from jax import Array

from layerjax import gallery
from layerjax._parameters import leaves_with_names
from layerjax._shapes import map_shape
from layerjax.evaluate import draw, evaluate, pdf, specular, unscattered
from layerjax.mixture import Mixture, stacks_of
from layerjax.preparation import choose_transport, prepare
from layerjax.stack import Interface, Stack, is_tilted, require_numbers, simplify
from layerjax.transport.specular import has_specular

NAME = "layerjax"
BATCHES = (1 << 8, 1 << 12, 1 << 15)
"""Batches are cut to the largest of these sizes that they hold, and the last piece is filled up: each size is compiled
once, where every bounce has another number of rays."""

materials: dict[str, tuple[Stack | Mixture, Any]] = {}
"""Stacks and their transports by the name that scenes have for them in ``material``, besides those of the gallery."""


def bsdf(stack: Stack | Mixture, transport: Any = "auto", id: str = "layerjax") -> Any:
    """A Mitsuba BSDF of a stack, for the dictionary of a scene.

    Args:
        stack: of 1 channel, or 3 (rgb variants); no map. It is lit and seen from both sides.
        transport: see `layerjax.prepare`.
        id: how names of its numbers begin in `mi.traverse`, such as ``coat.layers[0].alpha``.

    Raises:
        ValueError: a map, channels or a placeholder that it cannot take; or as `layerjax.prepare`.
    """
    properties = mi.Properties(NAME)
    properties.set_id(id)
    return _plugin(mi.variant())(properties, PluginMaterial(stack, transport))


def register() -> None:
    """Register the plugin for the variant of Mitsuba that is set.

    Raises:
        ValueError: none is set, one without derivatives, a spectral or a polarized one.
    """
    variant = mi.variant() or "None"
    if not variant.startswith(("llvm_ad_", "cuda_ad_")) or "spectral" in variant or "polarized" in variant:
        raise ValueError(f"mitsuba: the variant is {variant}; it must be llvm_ad or cuda_ad, in rgb or mono")
    for flag in (dr.JitFlag.SymbolicCalls, dr.JitFlag.SymbolicLoops):
        dr.set_flag(flag, False)
    mi.register_bsdf(NAME, _plugin(variant))


class PluginMaterial:
    """A stack as the plugin holds it. numbers: arrays of Dr.Jit, by the names that `mi.traverse` shows."""

    def __init__(self, stack: Stack | Mixture, transport: Any):
        require_numbers(stack)
        if map_shape(stack):
            raise ValueError(f"mitsuba: the stack is a map of shape {map_shape(stack)}; it must be a single one")
        self.colours = 1 if "_mono" in mi.variant() else 3
        if stack.channels not in (1, self.colours):
            raise ValueError(f"mitsuba: the stack has {stack.channels} channels, {mi.variant()} takes {self.colours}")
        self.transport = choose_transport(stack, transport=transport)
        self.numbers = {name: _array(name, leaf) for name, leaf in leaves_with_names(stack)}
        self.is_random = self.transport.random
        self._set_stack(stack)

    def _set_stack(self, stack: Stack | Mixture) -> None:
        self.stack, self.prepared = stack, prepare(stack, self.transport)
        parts = [simplify(part) for part in stacks_of(stack)]
        layers = [part.layers for part in parts if part.base is None]
        interfaces = [[layer.ior for layer in one if isinstance(layer, Interface)] for one in layers]
        self.is_open = bool(layers)
        self.has_null = not all(interfaces)
        self.has_delta = any(map(has_specular, parts))
        self.is_anisotropic = any(is_tilted(part) for one in parts for part in (*one.layers, one.base))
        self.eta = next((float(found[-1]) for found in reversed(interfaces) if found), 1.0)

    def update(self) -> None:
        """Take over numbers that were changed.

        Raises:
            ValueError: one is out of its range.
        """
        found = self.replace_numbers({name: jnp.asarray(np.array(value)) for name, value in self.numbers.items()})
        _check(found)
        self._set_stack(found)

    def replace_numbers(self, values: dict[str, Array]) -> Any:
        """The stack with these numbers, each in the shape that it has there, and its own where there is none."""
        leaves = [jnp.reshape(values.get(name, leaf), leaf.shape) for name, leaf in leaves_with_names(self.stack)]
        return jax.tree.unflatten(jax.tree.structure(self.stack), leaves)

    def value(self, light: Any, viewer: Any, place: Any) -> Any:
        """The BSDF in 1/sr without the cosine, a spectrum; place: what the key of a random transport is made of too."""

        def values_of(numbers: Any, light: Any, viewer: Any, *place: Any) -> tuple[Array, ...]:
            key = _key(light, viewer, *place) if self.is_random else None
            if numbers:
                values = evaluate(self.replace_numbers(numbers), _rows(light), _rows(viewer), self.transport, key=key)
            else:
                values = evaluate(self.prepared, _rows(light), _rows(viewer), key=key)
            return self._split_colours(values)

        places = [place] if self.is_random and dr.width(place) else []
        return mi.Spectrum(*_call_in_batches(values_of, self._differentiable(), light, viewer, *places))

    def null_transmission(self, wi: Any) -> Any:
        """Share of the light that passes without being scattered, a spectrum."""

        def shares_of(numbers: Any, wi: Any) -> tuple[Array, ...]:
            return self._split_colours(unscattered(self.replace_numbers(numbers), _rows(wi)))

        return mi.Spectrum(*_call_in_batches(shares_of, self._differentiable(), wi))

    def delta(self, wi: Any) -> tuple[Any, Any]:
        """Energies along the mirror and the refracted direction, spectra."""

        def shares_of(numbers: Any, wi: Any) -> tuple[Array, ...]:
            mirrored, passed = specular(self.replace_numbers(numbers), _rows(wi))
            return (*self._split_colours(mirrored), *self._split_colours(passed))

        found = _call_in_batches(shares_of, self._differentiable(), wi)
        return mi.Spectrum(*found[: self.colours]), mi.Spectrum(*found[self.colours :])

    def density(self, wi: Any, wo: Any) -> Any:
        """Density of `draw`, in 1/sr, without derivatives."""

        def densities_of(_: Any, wi: Any, wo: Any) -> tuple[Array, ...]:
            return (pdf(self.prepared, _rows(wi), _rows(wo)),)

        return _call_in_batches(densities_of, {}, dr.detach(wi), dr.detach(wo))[0]

    def draw(self, wi: Any, uniform: Any) -> tuple[Any, Any, Any]:
        """Directions and their densities, and which are along a delta, without derivatives; uniform: numbers that the
        key is made of."""

        def draws_of(_: Any, wi: Any, uniform: Any) -> tuple[Array, ...]:
            drawn = draw(self.prepared, _rows(wi), _key(wi, uniform))
            return (*drawn.wo.T, drawn.density, drawn.specular.astype(drawn.density.dtype))

        *wo, density, along = _call_in_batches(draws_of, {}, dr.detach(wi), dr.detach(uniform))
        return mi.Vector3f(*wo), density, along > 0.5

    def _differentiable(self) -> dict[str, Any]:
        """The numbers that gradients are enabled for."""
        return {name: number for name, number in self.numbers.items() if dr.grad_enabled(number)}

    def _split_colours(self, values: Array) -> tuple[Array, ...]:
        return tuple(jnp.broadcast_to(values, (*values.shape[:-1], self.colours)).T)


@cache
def _plugin(variant: str) -> type:
    """The class for this variant, which is that which is set."""

    class Layered(mi.BSDF):
        def __init__(self, properties: Any, material: PluginMaterial | None = None):
            mi.BSDF.__init__(self, properties)
            self.material = _scene_material(properties) if material is None else material
            self._name_components()

        def _name_components(self) -> None:
            self.m_components = _components(self.material)
            self.m_flags = reduce(or_, self.m_components)

        def traverse(self, callback: Any) -> None:
            for name, number in self.material.numbers.items():
                callback.put(name, number, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: Any) -> None:
            self.material.update()
            self._name_components()

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            return _sample(self.material, ctx, si, sample1, sample2, active)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return _evaluate(self.material, ctx, si, wo, active)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return _evaluate_with_pdf(self.material, ctx, si, wo, active)[1]

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            return _evaluate_with_pdf(self.material, ctx, si, wo, active)

        def eval_null_transmission(self, si: Any, active: Any = True) -> Any:
            share = self.material.null_transmission(si.wi) if self.material.has_null else mi.Spectrum(0.0)
            return dr.select(active, share, 0.0)

        def to_string(self) -> str:
            return f"{NAME}[{self.material.stack}, {self.material.transport}]"

    return Layered


def _components(material: PluginMaterial) -> list[int]:
    """Flags of the components: reflection, transmission, what passes unscattered, and the deltas of smooth surfaces."""
    flags = mi.BSDFFlags
    kinds = [flags.GlossyReflection]
    kinds += [flags.GlossyTransmission] if material.is_open else []
    kinds += [flags.Null] if material.has_null else []
    if material.has_delta:
        kinds += [flags.DeltaReflection, flags.DeltaTransmission] if material.is_open else [flags.DeltaReflection]
    turned = flags.Anisotropic if material.is_anisotropic else 0
    return [kind | flags.FrontSide | flags.BackSide | turned for kind in kinds]


def _scene_material(properties: Any) -> PluginMaterial:
    """The material that a scene names."""
    name = properties.get("material", "")
    if name not in (*materials, *gallery.names()):
        known = ", ".join((*materials, *gallery.names()))
        raise ValueError(f"material: {name!r} is neither in layerjax.mitsuba.materials nor in the gallery: {known}")
    return PluginMaterial(*(materials[name] if name in materials else (gallery.stack(name), "auto")))


def _evaluate(material: PluginMaterial, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
    light, viewer = (wo, si.wi) if ctx.mode == mi.TransportMode.Radiance else (si.wi, wo)
    active = active & _is_enabled(material, ctx, si.wi, wo)
    value = material.value(light, viewer, si.p) * dr.abs(mi.Frame3f.cos_theta(wo))
    return dr.select(active, value, 0.0)


def _evaluate_with_pdf(material: PluginMaterial, ctx: Any, si: Any, wo: Any, active: Any) -> tuple[Any, Any]:
    """Value and density. Where light cannot go there is none of either: what is drawn there counts as not drawn."""
    value = _evaluate(material, ctx, si, wo, active)
    density = material.density(si.wi, wo) * (1.0 - _null_probability(material, ctx, si))
    active = active & _is_enabled(material, ctx, si.wi, wo) & (material.is_random | (dr.max(value) > 0.0))
    return value, dr.select(active, density, 0.0)


def _sample(material: PluginMaterial, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any) -> tuple[Any, Any]:
    """Directions are drawn without derivatives, and the value over their density has those of the value."""
    null = _null_probability(material, ctx, si)
    wo, density, along = material.draw(si.wi, mi.Vector3f(sample1, *sample2))
    density *= 1.0 - null
    value = dr.select(density > 0.0, _evaluate(material, ctx, si, wo, active) / density, 0.0)
    drawn = mi.BSDFSample3f(wo)
    drawn.pdf = density
    passes = wo.z * si.wi.z < 0.0
    down = dr.select(si.wi.z > 0.0, material.eta, 1.0 / material.eta)
    drawn.eta = dr.select(passes, down, 1.0)
    glossy = dr.select(passes, +mi.BSDFFlags.GlossyTransmission, +mi.BSDFFlags.GlossyReflection)
    drawn.sampled_type, drawn.sampled_component = mi.UInt32(glossy), dr.select(passes, mi.UInt32(1), mi.UInt32(0))
    if material.has_delta:
        place = 1 + material.is_open + material.has_null
        enabled = [
            mi.Bool(ctx.is_enabled(kind, place + side))
            for side, kind in enumerate((mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission))
        ]
        mirrored, passed = material.delta(si.wi)
        # radiance that crosses to another index changes with its square
        scale = dr.rcp(drawn.eta * drawn.eta) if ctx.mode == mi.TransportMode.Radiance else 1.0
        energy = dr.select(passes, passed * scale, mirrored)
        energy = dr.select(dr.select(passes, enabled[1], enabled[0]), energy, 0.0)
        value = dr.select(along, energy / dr.maximum(density, 1e-12), value)
        kind = dr.select(passes, +mi.BSDFFlags.DeltaTransmission, +mi.BSDFFlags.DeltaReflection)
        drawn.sampled_type = dr.select(along, mi.UInt32(kind), drawn.sampled_type)
        component = dr.select(passes, mi.UInt32(place + 1), mi.UInt32(place))
        drawn.sampled_component = dr.select(along, component, drawn.sampled_component)
    if material.has_null:
        passes_through = sample1 < null
        drawn.wo = dr.select(passes_through, -si.wi, drawn.wo)
        drawn.pdf = dr.select(passes_through, null, drawn.pdf)
        drawn.eta = dr.select(passes_through, 1.0, drawn.eta)
        drawn.sampled_type = dr.select(passes_through, +mi.BSDFFlags.Null, drawn.sampled_type)
        drawn.sampled_component = dr.select(passes_through, mi.UInt32(2), drawn.sampled_component)
        value = dr.select(passes_through, material.null_transmission(si.wi) / null, value)
    drawn.pdf = dr.select(active, drawn.pdf, 0.0)
    return drawn, dr.select(active & (drawn.pdf > 0.0), value, 0.0)


def _is_enabled(material: PluginMaterial, ctx: Any, wi: Any, wo: Any) -> Any:
    """Whether a context enables the component that scatters light from wi to wo."""
    reflects = ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0)
    passes = material.is_open and ctx.is_enabled(mi.BSDFFlags.GlossyTransmission, 1)
    return dr.select(wi.z * wo.z > 0.0, mi.Bool(reflects), mi.Bool(passes))


def _null_probability(material: PluginMaterial, ctx: Any, si: Any) -> Any:
    """Share of samples that pass through without scattering."""
    if not (material.has_null and ctx.is_enabled(mi.BSDFFlags.Null, 2)):
        return mi.Float(0.0)
    if not (ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0) or ctx.is_enabled(mi.BSDFFlags.GlossyTransmission, 1)):
        return mi.Float(1.0)
    return dr.detach(dr.mean(material.null_transmission(si.wi)))


def _call_in_batches(function: Callable[..., tuple[Array, ...]], numbers: dict[str, Any], *batches: Any) -> list[Any]:
    """What a function of numbers and batches of vectors, lists of three arrays (N,), gives: arrays (N,)."""
    if dr.flag(dr.JitFlag.SymbolicScope):
        raise ValueError(
            "mitsuba: a symbolic call; layerjax.mitsuba.register() turns calls and loops to evaluated ones"
        )
    count = max(dr.width(batch) for batch in batches)
    size = max((size for size in BATCHES if size <= count), default=BATCHES[0])
    padded = -(-count // size) * size
    place = dr.arange(mi.UInt32, padded)
    filled = [[dr.gather(mi.Float, part, place % dr.width(part)) for part in batch] for batch in batches]

    @dr.wrap(source="drjit", target="jax")
    def wrapped(values: list[Array], *filled: list[Array]) -> tuple[Array, ...]:
        given = dict(zip(numbers, values, strict=True))  # a dict on its way would be sorted
        found = [
            function(given, *([part[first : first + size] for part in batch] for batch in filled))
            for first in range(0, padded, size)
        ]
        return tuple(jnp.concatenate(parts) for parts in zip(*found, strict=True))

    found = wrapped(list(numbers.values()), *filled)
    return [dr.gather(mi.Float, one.array, dr.arange(mi.UInt32, count)) for one in found]


def _rows(vector: list[Array]) -> Array:
    return jnp.stack(vector, axis=-1)


def _key(*batches: list[Array]) -> Array:
    """A random key of all bits of some numbers."""
    bits = [jax.lax.bitcast_convert_type(jax.lax.stop_gradient(part), jnp.uint32) for one in batches for part in one]
    seed = sum(jnp.sum(part, dtype=jnp.uint32) * jnp.uint32(2 * place + 1) for place, part in enumerate(bits))
    return jax.random.key(seed)


def _array(name: str, leaf: Array) -> Any:
    """A number as Dr.Jit has it: one, or three, of a colour or an axis."""
    kind = mi.Float if leaf.size == 1 else mi.Vector3f if name.endswith("axis") else mi.Color3f
    return kind(*(float(number) for number in np.ravel(leaf)))


def _check(module: Any) -> None:
    """Refuse numbers out of range, as on construction."""
    for field in dataclasses.fields(module):
        value = getattr(module, field.name)
        if "converter" in field.metadata:
            field.metadata["converter"](value)
        parts = value.values() if isinstance(value, dict) else value if isinstance(value, tuple) else (value,)
        for part in parts:
            if isinstance(part, eqx.Module):
                _check(part)
    if hasattr(module, "__check_init__"):
        module.__check_init__()


if mi.variant() is not None:
    register()
