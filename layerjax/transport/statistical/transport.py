"""Directional statistics of layered materials (Belcour 2018), with diffuse bases (de Dinechin & Belcour 2022).

Each group of paths (reflected at the same layer, any number of turns above) is one GGX lobe, of which energy and width
follow from adding. Over a diffuse base the light that has reached it leaves as a product of two transmittances.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import channels
from layerjax._checks import require_choice
from layerjax._devices import exact_products
from layerjax._numerics import horizon, safe_div, safe_sqrt
from layerjax._parameters import is_placeholder
from layerjax.channels import Channels, map_channels
from layerjax.directions import Vector, add, dot, flip, half_vector, reflect, sanitise, select
from layerjax.microsurface.energy_tables import LARGEST_INDEX
from layerjax.normals.ggx import ggx_area, ggx_density
from layerjax.normals.width_matrix import WidthMatrix, matrix_area, matrix_density
from layerjax.quadrature import gauss_legendre
from layerjax.stack import Interface, Medium, Stack
from layerjax.surfaces import Conductor, Surface
from layerjax.surfaces.interface import interface_reflection
from layerjax.transport.contract import TEXELS, DeterministicTransport, Side, refuse_film, refuse_other_normals
from layerjax.transport.known_directions import DirectionLookup, KnownPairs
from layerjax.transport.lobes.microfacet import (
    Facet,
    LobeWidth,
    MicrofacetLobes,
    fold,
    index_below,
    microfacet_lobes,
    reference_index,
    unfold,
)
from layerjax.transport.lobes.sampling import facet_pdf, sample_facet
from layerjax.transport.lobes.statistics import Options, Plane, Scattering, bound_alpha, is_anisotropic, smooth_parts
from layerjax.transport.specular import density_with_deltas, is_smooth, sample_with_deltas, specular_draws
from layerjax.transport.statistical.brushed_base import with_one_width
from layerjax.transport.statistical.coated_base import is_coated, make_coated
from layerjax.transport.statistical.diffuse_base import make_diffuse
from layerjax.transport.statistical.diffuse_lobe import make_diffuse_lobe, why_no_lobe
from layerjax.transport.statistical.hazy_base import is_hazy, make_hazy
from layerjax.transport.statistical.sampling import (
    DiffusePart,
    density,
    diffuse_energy,
    diffuse_part,
    draw,
)
from layerjax.transport.statistical.streamed_base import is_streamed, make_streamed

INDEX_SLACK = 1e-6
"""Of the logarithm of a ratio of indices: those that are given in single precision are rounded."""

LEAST_PAIRS = 8
"""Pairs of directions from which on channels are an axis of the lobes' program. Of fewer (a texel has one), processors,
which work on so many numbers at once, would run along the channels, of which there are 3."""

Diffuse = Literal["tables", "exact", "lobe"]
Energies = tuple[Channels, Channels]


class StatisticalState(eqx.Module):
    """A stack, the diffuse part of its light, and the indices below it and of where transmitted lobes are described.

    pairs: of the directions that alone are evaluated, if they are known.
    """

    stack: Stack
    diffuse: DiffusePart | None
    below: Array
    reference: Array
    smooth: tuple[bool, ...] = eqx.field(static=True)
    pairs: KnownPairs | None = None

    @property
    def is_open(self) -> bool:
        """Whether there is no base."""
        return self.stack.base is None

    @property
    def is_anisotropic(self) -> bool:
        """Whether any facets have two widths."""
        return is_anisotropic(self.stack)


class Statistical(DeterministicTransport):
    """Layered statistics: energy and width of the lobes of interfaces and media over a conductor, a diffuse base or
    none.

    Belcour 2018, and de Dinechin & Belcour 2022 for diffuse bases. Supports `Interface`, smooth ones as well, `Medium`
    with a Henyey-Greenstein phase function (forward scattering only), and every base. Under layers, a diffuse base that
    is not Lambertian counts as f = A(i) A(o) / (pi rho), with its directional albedo A and the mean rho of A.

    GGX facets may have two widths (`alpha_y`, `tangent`): variances are then tensors in the tangent plane, which are
    rotated by the tangents before they add, and lobes have two widths. Energies are those of one width: that along the
    azimuth of the light at an interface (the root mean square of the two at normal incidence), the root mean square for
    metals, lobes, and interfaces over diffuse light. Beside `AddingDoubling`, without multiple scattering on facets,
    the relative L2 error at widths (.2, .5) was that of the model with one width (in brackets, at their root mean
    square): a coat of 0.1 on metal 9 % (9 %), of 0.3 29 % (30 %), brushed coats on metal of 0.1 34 % (33 %), on metal
    brushed at another tangent 39 % (39 %), on a Lambertian base 1 % (0 %), slabs 33 % (30 %). Near the mirror direction
    of a coat on metal of (.15, .4) values were 4 % too low along the tangent and 13 % across it (4 and 3 %). Energies
    with ``facet_multiple_scattering`` have no reference: no other transport has it with two widths.

    The index of an `Interface` has to be 1/4 to 4 times that above it; a traced index beyond that counts as the nearer
    end. Derivatives by indices within 1e-4 of each other are finite but follow the interpolation error of the tables:
    3e-4 and less as a rule, 3e-3 under dyed coats of a lower index.

    Args:
        symmetric: the Symmetric model (statistics at the angle between light and half vector: reciprocal, energy
            approximately conserved) or the Forward model (at the angle of the light: conserves energy, not reciprocal);
            Sec. 6.
        facet_multiple_scattering: whether interfaces conserve energy (FGD-infinity of the paper, by the walk of Heitz
            et al. 2016); otherwise light that is blocked by masking is lost (Walter 2007).
        scattering: ``"orders"``, lobes for 0, 1 and more collisions; or ``"single"``, one lobe and at most one
            collision per crossing, as in the paper (Eqs. 20-24). In media without interface or base that lobe cannot be
            distinguished from unscattered light, and both are omitted.
        diffuse: how light from a diffuse base is computed: ``"tables"``, a closed form with tabulated transmittances,
            for a `Lambertian` with ``facet_multiple_scattering=True`` (other bases as ``"exact"``); ``"exact"``, an
            adding-doubling solution for every stack; or ``"lobe"``, one GGX lobe from tables (2022), for interfaces and
            absorbing media over a `Lambertian`.
        angles: whether the width of a refracted lobe depends on the angle (Eq. 10) or is that at normal incidence.
        own_side: whether light from inside has the reflectance of the inside, or by reciprocity that from outside.

    Raises:
        ValueError: an option has an unknown value.
    """

    uses_known_pairs: ClassVar[bool] = True

    symmetric: bool = eqx.field(static=True, default=True)
    facet_multiple_scattering: bool = eqx.field(static=True, default=True)
    scattering: Scattering = eqx.field(static=True, default="orders")
    diffuse: Diffuse = eqx.field(static=True, default="tables")
    angles: bool = eqx.field(static=True, default=False)
    own_side: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        for name in ("symmetric", "facet_multiple_scattering", "angles", "own_side"):
            require_choice(f"Statistical.{name}", getattr(self, name), (True, False))
        for name, choices in (("scattering", Scattering), ("diffuse", Diffuse)):
            value = getattr(self, name)
            if value not in get_args(choices):
                allowed = ", ".join(map(repr, get_args(choices)))
                raise ValueError(f"Statistical.{name}: {value!r} is not one of {allowed}")

    def check(self, stack: Stack, names: Sequence[str]) -> None:
        refuse_other_normals(stack, names, "Statistical")
        refuse_film(stack, names, "Statistical")
        _check_indices(stack, names)
        for name, layer in zip(names, stack.layers, strict=True):
            if isinstance(layer, Medium) and layer.phase.forward_lobe is None:
                raise ValueError(
                    f"{name}: Statistical carries no {type(layer.phase).__name__} medium (HenyeyGreenstein only); "
                    "AddingDoubling and RandomWalk do"
                )
            if isinstance(layer, Medium) and layer.f0 is not None:
                raise ValueError(
                    f"{name}.f0: Statistical carries no Fresnel term of a medium; AddingDoubling and RandomWalk do"
                )
        if self.diffuse == "lobe" and _is_diffuse(stack.base):
            reason = why_no_lobe(stack, names)
            if reason is not None:
                raise ValueError(f'{reason}; Statistical(diffuse="exact") takes any')

    def prepare(self, stack: Stack) -> StatisticalState:
        diffuse: DiffusePart | None = None
        if stack.base is not None and _is_diffuse(stack.base):
            if not stack.layers:
                diffuse = stack.base
            elif self.diffuse == "lobe":
                diffuse = make_diffuse_lobe(with_one_width(stack))
            elif self._needs_solver(stack):
                diffuse = make_diffuse(with_one_width(stack), stack.base, self.facet_multiple_scattering)
            else:
                diffuse = _closed_form(with_one_width(stack))
        return StatisticalState(stack, diffuse, index_below(stack), reference_index(stack), smooth_parts(stack))

    def with_known_pairs(self, state: StatisticalState, pairs: KnownPairs) -> StatisticalState:
        return dataclasses.replace(state, pairs=pairs) if self.symmetric and not state.is_anisotropic else state

    def traceable_equivalent(self, stack: Stack, known: DirectionLookup) -> "Statistical | None":
        """Itself, but where alphas are known to be as narrow as can be, which are traced as any others would be."""
        return None if any(smooth_parts(stack)) or self._needs_solver(stack) else self

    def evaluate(self, state: StatisticalState, wi: Vector, wo: Vector, side: Side) -> Channels:
        def lobes(stack: Stack) -> Channels:
            one = dataclasses.replace(state, stack=stack)
            parts: list[Channels] = [(jnp.zeros_like(wi[2] * wo[2]),)]
            if side != "transmission":
                parts += self._reflections(one, wi, wo, upward=False)
            if side == "all" and state.is_open:
                parts += self._reflections(one, flip(wi), flip(wo), upward=True)
            if side != "reflection" and state.is_open:
                parts += self._transmissions(one, wi, wo)
            return channels.total(parts)

        few = jnp.size(wi[2] * wo[2]) < LEAST_PAIRS
        found = lobes(state.stack) if few else channels.vmap_channels(lambda stack: lobes(stack)[0], state.stack)
        if state.diffuse is None or side == "transmission":
            return found
        return channels.total([found, diffuse_part(state.diffuse, wi, wo)])

    def sample(self, state: StatisticalState, wi: Vector, uniforms: tuple[Array, Array, Array]) -> Vector:
        return sample_with_deltas(state.stack, wi, uniforms, partial(self._draw, state, wi))

    def pdf(self, state: StatisticalState, wi: Vector, wo: Vector) -> Array:
        return density_with_deltas(state.stack, wi, self._density(state, wi, wo))

    def specular_draws(
        self, state: StatisticalState, wi: Vector, uniforms: tuple[Array, Array, Array]
    ) -> tuple[Array, Array, Channels] | None:
        return specular_draws(state.stack, wi, uniforms[0])

    def _draw(self, state: StatisticalState, wi: Vector, uniforms: tuple[Array, Array, Array]) -> Vector:
        """Directions that are no delta's."""
        down = draw(self._lobes(state, wi, False), state.diffuse, wi, uniforms, *_ratios(state))
        if not state.is_open:
            return down
        wi_below = flip(wi)
        up = draw(self._lobes(state, wi_below, True), None, wi_below, uniforms, *_ratios(state)[::-1])
        return select(wi[2] > 0, down, flip(up))

    def _density(self, state: StatisticalState, wi: Vector, wo: Vector) -> Array:
        """Density of `_draw`."""
        down = density(self._lobes(state, wi, False), state.diffuse, wi, wo, *_ratios(state))
        if not state.is_open:
            return down
        wi_below = flip(wi)
        up = density(self._lobes(state, wi_below, True), None, wi_below, flip(wo), *_ratios(state)[::-1])
        return jnp.where(wi[2] > 0, down, up)

    def albedo(self, state: StatisticalState, wi: Vector, nodes: int) -> Energies:
        """Forward: the energies of the lobes. Symmetric: by quadrature, 2 nodes^2 points a lobe."""
        above = wi[2] > horizon(wi[2].dtype)
        near, far = self._energies(state, sanitise(wi, above), nodes, upward=False)
        if state.diffuse is not None:
            near = channels.total([near, diffuse_energy(state.diffuse, sanitise(wi, above), nodes)])
        if not state.is_open:
            return channels.select(above, near), (jnp.zeros_like(wi[2]),)
        below = wi[2] < -horizon(wi[2].dtype)
        other = self._energies(state, sanitise(flip(wi), below), nodes, upward=True)
        sides = []
        for down, up in zip((near, far), other, strict=True):
            sides.append(channels.select(above, down, channels.select(below, up)))
        return sides[0], sides[1]

    def texel_batch_size(self, stack: Stack) -> int:
        return 1 if self._needs_solver(stack) else TEXELS

    def _needs_solver(self, stack: Stack) -> bool:
        """Whether the diffuse part of a simplified stack needs a solve of its own."""
        if stack.base is None or not _is_diffuse(stack.base) or not stack.layers:
            return False
        if any(map(is_smooth, stack.layers)):
            return True
        return (
            self.diffuse != "tables" or not self.facet_multiple_scattering or not (is_streamed(stack) or is_hazy(stack))
        )

    def _microfacet_lobes(
        self, state: StatisticalState, cosine: Array, upward: bool, plane: Plane | None
    ) -> MicrofacetLobes:
        options = Options(self.facet_multiple_scattering, self.scattering, self.angles, self.own_side, state.smooth)
        return microfacet_lobes(state.stack, options, cosine, upward, plane).without_deltas()

    def _lobes(self, state: StatisticalState, wi: Vector, upward: bool) -> MicrofacetLobes:
        """For light along wi, above (`upward`: turned up); of light that comes from elsewhere, whatever is finite."""
        lit = wi[2] > horizon(wi[2].dtype)
        return self._microfacet_lobes(state, jnp.where(lit, wi[2], 1.0), upward, _plane(state, wi))

    def _energies(self, state: StatisticalState, wi: Vector, nodes: int, upward: bool) -> Energies:
        if self.symmetric:
            return self._integrate(state, wi, nodes, upward)
        return self._lobes(state, wi, upward).energies(jnp.zeros_like(wi[2]))

    def _reflections(self, state: StatisticalState, wi: Vector, wo: Vector, upward: bool) -> list[Channels]:
        """Every lobe, for light and viewer above (`upward`: turned up)."""
        edge = horizon(wi[2].dtype)
        valid = (wi[2] > edge) & (wo[2] > edge)
        wi, wo = sanitise(wi, valid), sanitise(wo, valid)
        h, cosine = half_vector(wi, wo, same_side=True)
        if state.pairs is not None:  # many pairs have the same lobes
            found = self._microfacet_lobes(state, state.pairs.cosines, upward, None).at(state.pairs.index)
        elif self.symmetric:
            found = self._microfacet_lobes(state, cosine, upward, _common_plane(state, wi, wo, 1.0))
        else:
            found = self._microfacet_lobes(state, wi[2], upward, _plane(state, wi))
        lobes = []
        for lobe in found.reflected:
            if lobe.alpha is None:
                assert found.facet is not None
                shape = _facet(found.facet, wi, wo)
            else:
                shape = tuple(_lobe(h, wi, wo, alpha) for alpha in lobe.alpha)
            lobes.append(channels.select(valid, channels.multiply(lobe.scale, shape)))
        return lobes

    def _transmissions(self, state: StatisticalState, wi: Vector, wo: Vector) -> list[Channels]:
        """Every lobe that passes, for light and viewer on different sides: lobes of a reflection, folded over."""
        edge = horizon(wi[2].dtype)
        downward = wi[2] > 0
        over, under = select(downward, wi, wo), flip(select(downward, wo, wi))
        valid = (over[2] > edge) & (under[2] > edge)
        over, under = sanitise(over, valid), sanitise(under, valid)
        ratio_over, ratio_under = _ratios(state)
        a, b = fold(over, ratio_over), fold(under, ratio_under)
        valid = valid & (a[2] > edge) & (b[2] > edge)
        a, b = sanitise(a, valid), sanitise(b, valid)
        h, _ = half_vector(a, b, same_side=True)
        if self.symmetric:
            sine = _half_sine(a, b) * state.reference
            plane = _common_plane(state, a, b, state.reference)
            found = [self._microfacet_lobes(state, safe_sqrt(1.0 - sine * sine), False, plane)] * 2
        else:
            found = [
                self._microfacet_lobes(state, w[2], upward, _plane(state, w))
                for w, upward in ((over, False), (under, True))
            ]
        leaving = jnp.where(downward, ratio_under, ratio_over)
        lobes = []
        for above, below in zip(found[0].transmitted, found[1].transmitted, strict=True):
            assert above.alpha is not None
            assert below.alpha is not None
            scale = channels.select(downward, above.scale, below.scale)
            alphas = map_channels(partial(_select_width, downward), above.alpha, below.alpha)
            shape = tuple(leaving * leaving * _lobe(h, a, b, alpha) for alpha in alphas)  # per solid angle outside
            lobes.append(channels.select(valid, channels.multiply(scale, shape)))
        return lobes

    def _integrate(self, state: StatisticalState, wi: Vector, nodes: int, upward: bool) -> Energies:
        """Energy of every lobe by a quadrature over the facets seen from wi, above (`upward`: turned up)."""
        s, w = (jnp.asarray(array, wi[2].dtype) for array in gauss_legendre(nodes))
        turn = (jnp.arange(2 * nodes, dtype=s.dtype) + 0.5) / (2 * nodes)
        u1, u2 = (u.ravel() for u in jnp.meshgrid(turn, s, indexing="ij"))
        weight = jnp.tile(w, 2 * nodes) / (2 * nodes)
        edge = horizon(wi[2].dtype)
        reflected, transmitted = self._lobes(state, wi, upward).widths()
        wi = (wi[0][..., None], wi[1][..., None], wi[2][..., None])
        near: list[Channels] = [(jnp.zeros_like(wi[2][..., 0]),)]
        far = list(near)
        for j, width in enumerate(reflected):
            alpha = jax.tree.map(lambda entry: jnp.asarray(entry)[..., None], width)
            m = sample_facet(wi, alpha, u1, u2)
            wo = reflect(wi, m)
            share = weight * safe_div(jnp.where(wo[2] > edge, wo[2], 0.0), facet_pdf(m, wi, alpha))
            lobe = self._reflections(state, wi, wo, upward)[j]
            near.append(tuple(jnp.sum(share * value, axis=-1) for value in lobe))
        entry, exit = _ratios(state)[::-1] if upward else _ratios(state)
        turned = flip if upward else _identity
        for j, width in enumerate(transmitted):
            alpha = jax.tree.map(lambda entry: entry[..., None], width)
            a = fold(wi, entry)
            m = sample_facet(a, alpha, u1, u2)
            b = reflect(a, m)
            share = weight * safe_div(jnp.where(b[2] > edge, b[2], 0.0), exit * exit * facet_pdf(m, a, alpha))
            lobe = self._transmissions(state, turned(wi), turned(unfold(b, exit)))[j]
            far.append(tuple(jnp.sum(share * value, axis=-1) for value in lobe))
        return channels.total(near), channels.total(far)


@eqx.filter_jit
@exact_products
def _closed_form(stack: Stack) -> DiffusePart:
    """The diffuse part from tables and streams, in one program: loops alone are compiled every time."""
    make = make_coated if is_coated(stack) else make_streamed if is_streamed(stack) else make_hazy
    return make(stack)


def _is_diffuse(base: Surface | None) -> bool:
    return base is not None and not isinstance(base, Conductor)


def _check_indices(stack: Stack, names: Sequence[str]) -> None:
    """Refuse steps of the index that are known to lie beyond the tables of energies."""
    above: Any = 1.0
    for name, layer in zip(names, stack.layers, strict=True):
        if not isinstance(layer, Interface):
            continue
        if not any(isinstance(ior, jax.core.Tracer) or is_placeholder(ior) for ior in (above, layer.ior)):
            ratios = np.asarray(layer.ior, float) / np.asarray(above, float)
            beyond = np.abs(np.log(ratios)) > np.log(LARGEST_INDEX) + INDEX_SLACK
            if beyond.any():
                raise ValueError(
                    f"{name}.ior: {ratios[beyond][0]:g} times the index above it; Statistical carries "
                    f"{1.0 / LARGEST_INDEX:g} to {LARGEST_INDEX:g} times"
                )
        above = layer.ior


def _identity(w: Vector) -> Vector:
    return w


def _ratios(state: StatisticalState) -> tuple[Array, Array]:
    """Indices above and below over that of the medium in which transmitted lobes are described."""
    return 1.0 / state.reference, state.below / state.reference


def _half_sine(wi: Vector, wo: Vector) -> Array:
    """Sine of the angle between the directions and their half vector."""
    apart = add(wi, (-wo[0], -wo[1], -wo[2]))
    return 0.5 * safe_sqrt(dot(apart, apart))


def _plane(state: StatisticalState, w: Vector) -> Plane | None:
    """Components by which light along w sees facets of two widths; None if there are none."""
    return w[:2] if state.is_anisotropic else None


def _common_plane(state: StatisticalState, wi: Vector, wo: Vector, index: Array | float) -> Plane | None:
    """Those of the symmetric model, by half the difference of the directions (as long as the sine of their angle to
    the half vector), outside a medium of this index."""
    if not state.is_anisotropic:
        return None
    return 0.5 * index * (wi[0] - wo[0]), 0.5 * index * (wi[1] - wo[1])


def _select_width(chosen: Array, width: LobeWidth, other: LobeWidth) -> Any:
    return jax.tree.map(partial(jnp.where, chosen), width, other)


def _lobe(h: Vector, wi: Vector, wo: Vector, alpha: LobeWidth) -> Array:
    """GGX lobe of facets that reflect all, D G / (4 cos cos), 1/sr."""
    if isinstance(alpha, WidthMatrix):
        area_i, area_o = matrix_area(wi, alpha), matrix_area(wo, alpha)
        return matrix_density(h, alpha) / ((wi[2] + area_i) * (wo[2] + area_o))
    alpha = bound_alpha(alpha)
    area_i, area_o = ggx_area(wi, alpha), ggx_area(wo, alpha)
    return ggx_density(h, alpha) / ((wi[2] + area_i) * (wo[2] + area_o))


def _facet(facet: Facet, wi: Vector, wo: Vector) -> Channels:
    """The first interface or base itself, with Fresnel reflectance at its own facets."""
    what, relative, _ = facet
    if isinstance(what, Interface):
        return (interface_reflection(wi, wo, relative, what.width),)
    return what.relative_to(relative).evaluate(wi, wo)
