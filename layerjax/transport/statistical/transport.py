"""Directional statistics of layered materials (Belcour 2018), with diffuse bases (de Dinechin & Belcour 2022).

Each group of paths (reflected at the same layer, any number of turns above) is one GGX lobe, of which energy and width
follow from adding. Over a diffuse base the light that has reached it leaves as a product of two transmittances.
"""

from collections.abc import Sequence
from typing import Literal, get_args

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from layerjax import channels
from layerjax._numerics import at_least, horizon, safe_div, safe_sqrt
from layerjax.channels import Channels
from layerjax.directions import Vector, add, dot, flip, half_vector, reflect, sanitised, select
from layerjax.microsurface import Microfacets
from layerjax.normals.facets import reflection_pdf
from layerjax.normals.ggx import ggx_area, ggx_density, ggx_sample
from layerjax.quadrature import gauss_legendre
from layerjax.stack import Interface, Medium, Stack
from layerjax.surfaces import Conductor, Surface
from layerjax.surfaces.interface import interface_reflection
from layerjax.transport.contract import DeterministicTransport, Side, refuse_vmf
from layerjax.transport.statistical.diffuse_base import make_diffuse
from layerjax.transport.statistical.diffuse_lobe import make_diffuse_lobe, why_no_lobe
from layerjax.transport.statistical.drawing import (
    DiffusePart,
    density,
    diffuse_energy,
    diffuse_part,
    draw,
    planar,
    read_energies,
    take,
    widths,
)
from layerjax.transport.statistical.lobes import Options, Scattering, bounded
from layerjax.transport.statistical.tables import (
    Table,
    folded,
    index_below,
    look_up,
    make_table,
    reference_index,
    unfolded,
)

Diffuse = Literal["exact", "lobe"]
Energies = tuple[Channels, Channels]


class LobeTables(eqx.Module):
    """A stack made ready: tables for light from above and from below (None over a base), and the diffuse part."""

    top: Table
    bottom: Table | None
    diffuse: DiffusePart | None
    below: Array
    reference: Array


class Statistical(DeterministicTransport):
    """Layered statistics: any number of dielectric interfaces and media over a conductor, a diffuse base, or none.

    Carries `Interface`, `Medium` with a Henyey-Greenstein phase function (its forward lobe; backward scattering is not
    followed), and every base. One that is diffuse, but not Lambertian, counts under layers as f = A(i) A(o) / (pi rho)
    with its own directional albedo A, of mean rho: energies by its own, of its shape only what that product has.

    Args:
        symmetric: the Symmetric model (statistics at the angle between light and half vector: reciprocal, energy only
            near 1) or the Forward model (at the angle of the light: conserves energy, not reciprocal); Sec. 6.
        microfacets: ``"multiple"``, interfaces conserve energy (FGD-infinity of the paper, by the walk of Heitz et
            al. 2016), or ``"single"``, Walter 2007: light that a facet sends into another is lost.
        scattering: ``"orders"``, lobes for 0, 1 and more collisions, or ``"single"``, one lobe and at most one
            collision a crossing, as the paper has it (Eqs. 20-24); of media alone, with neither interface nor base,
            that lobe cannot be told from the light that nothing met, and both are left out.
        diffuse: light that has met a diffuse base: ``"exact"``, closed form with transmittances by adding-doubling; or
            ``"lobe"``, one GGX lobe from tables (2022), for interfaces and absorbing media over a `Lambertian`.
        angles: whether the width of a refracted lobe follows the angle (Eq. 10) or is that at normal incidence.
        own_side: whether light from inside meets the reflectance of its own side, or by reciprocity that from outside.

    Raises:
        ValueError: an option that is none.
    """

    symmetric: bool = eqx.field(static=True, default=True)
    microfacets: Microfacets = eqx.field(static=True, default="multiple")
    scattering: Scattering = eqx.field(static=True, default="orders")
    diffuse: Diffuse = eqx.field(static=True, default="exact")
    angles: bool = eqx.field(static=True, default=False)
    own_side: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        for name, choices in (("microfacets", Microfacets), ("scattering", Scattering), ("diffuse", Diffuse)):
            value = getattr(self, name)
            if value not in get_args(choices):
                allowed = ", ".join(map(repr, get_args(choices)))
                raise ValueError(f"Statistical.{name}: {value!r} is not one of {allowed}")

    def check(self, stack: Stack, names: Sequence[str]) -> None:
        refuse_vmf(stack, names, "Statistical")
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

    def prepare(self, stack: Stack) -> LobeTables:
        options = Options(self.microfacets, self.scattering, self.angles, self.own_side)
        diffuse: DiffusePart | None = None
        if stack.base is not None and _is_diffuse(stack.base):
            if not stack.layers:
                diffuse = stack.base
            elif self.diffuse == "exact":
                diffuse = make_diffuse(stack, stack.base, self.microfacets)
            else:
                diffuse = make_diffuse_lobe(stack)
        return LobeTables(
            top=make_table(stack, options, upward=False),
            bottom=None if stack.base is not None else make_table(stack, options, upward=True),
            diffuse=diffuse,
            below=index_below(stack),
            reference=reference_index(stack),
        )

    def evaluate(self, state: LobeTables, wi: Vector, wo: Vector, side: Side) -> Channels:
        parts: list[Channels] = [(jnp.zeros_like(wi[2] * wo[2]),)]
        if side != "transmission":
            parts += self._reflections(state.top, wi, wo)
            if state.diffuse is not None:
                parts.append(diffuse_part(state.diffuse, wi, wo))
            if side == "all" and state.bottom is not None:
                parts += self._reflections(state.bottom, flip(wi), flip(wo))
        if side != "reflection" and state.bottom is not None:
            parts += self._transmissions(state, wi, wo)
        return channels.total(parts)

    def sample(self, state: LobeTables, wi: Vector, uniforms: tuple[Array, Array, Array]) -> Vector:
        down = draw(state.top, state.diffuse, wi, uniforms, 1.0 / state.reference, state.below / state.reference)
        if state.bottom is None:
            return down
        up = draw(state.bottom, None, flip(wi), uniforms, state.below / state.reference, 1.0 / state.reference)
        return select(wi[2] > 0, down, flip(up))

    def pdf(self, state: LobeTables, wi: Vector, wo: Vector) -> Array:
        down = density(state.top, state.diffuse, wi, wo, 1.0 / state.reference, state.below / state.reference)
        if state.bottom is None:
            return down
        ratios = state.below / state.reference, 1.0 / state.reference
        return jnp.where(wi[2] > 0, down, density(state.bottom, None, flip(wi), flip(wo), *ratios))

    def albedo(self, state: LobeTables, wi: Vector, nodes: int) -> Energies:
        """Forward: the energies of the lobes. Symmetric: by quadrature, 2 nodes^2 points a lobe."""
        above = wi[2] > horizon(wi[2].dtype)
        near, far = self._energies(state, state.top, sanitised(wi, above), nodes, upward=False)
        if state.diffuse is not None:
            near = channels.total([near, diffuse_energy(state.diffuse, sanitised(wi, above), nodes)])
        if state.bottom is None:
            return channels.select(above, near), (jnp.zeros_like(wi[2]),)
        below = wi[2] < -horizon(wi[2].dtype)
        other = self._energies(state, state.bottom, sanitised(flip(wi), below), nodes, upward=True)
        sides = []
        for down, up in zip((near, far), other, strict=True):
            sides.append(channels.select(above, down, channels.select(below, up)))
        return sides[0], sides[1]

    def _energies(self, state: LobeTables, table: Table, wi: Vector, nodes: int, upward: bool) -> Energies:
        if self.symmetric:
            return self._integrated(state, table, wi, nodes, upward)
        return read_energies(table, wi)

    def _reflections(self, table: Table, wi: Vector, wo: Vector) -> list[Channels]:
        """Every lobe, for light and viewer above."""
        if not table.reflected:
            return []
        edge = horizon(wi[2].dtype)
        valid = (wi[2] > edge) & (wo[2] > edge)
        wi, wo = sanitised(wi, valid), sanitised(wo, valid)
        h, cosine = half_vector(wi, wo, same_side=True)
        row = look_up(table.rows, *(_halves(wi, wo, cosine) if self.symmetric else (wi[2], planar(wi))))
        lobes = []
        for columns in table.reflected:
            scale = take(row, columns.scale)
            if columns.alpha is None:
                shape = _facet(table, wi, wo)
            else:
                shape = tuple(_lobe(h, wi, wo, alpha) for alpha in take(row, columns.alpha))
            lobes.append(_product(scale, shape, valid))
        return lobes

    def _transmissions(self, state: LobeTables, wi: Vector, wo: Vector) -> list[Channels]:
        """Every lobe that passes, for light and viewer on different sides: lobes of a reflection, folded over."""
        assert state.bottom is not None
        edge = horizon(wi[2].dtype)
        downward = wi[2] > 0
        over, under = select(downward, wi, wo), flip(select(downward, wo, wi))
        valid = (over[2] > edge) & (under[2] > edge)
        over, under = sanitised(over, valid), sanitised(under, valid)
        ratio_over, ratio_under = 1.0 / state.reference, state.below / state.reference
        a, b = folded(over, ratio_over), folded(under, ratio_under)
        valid = valid & (a[2] > edge) & (b[2] > edge)
        a, b = sanitised(a, valid), sanitised(b, valid)
        h, cosine = half_vector(a, b, same_side=True)
        if self.symmetric:
            _, sine = _halves(a, b, cosine)
            sine = sine * state.reference
            rows = [look_up(state.top.rows, safe_sqrt(1.0 - sine * sine), sine)] * 2
            tables = [state.top] * 2
        else:
            rows = [look_up(state.top.rows, over[2], planar(over)), look_up(state.bottom.rows, under[2], planar(under))]
            tables = [state.top, state.bottom]
        leaving = jnp.where(downward, ratio_under, ratio_over)
        lobes = []
        for above, below in zip(tables[0].transmitted, tables[1].transmitted, strict=True):
            assert above.alpha is not None
            assert below.alpha is not None
            scales = channels.select(downward, take(rows[0], above.scale), take(rows[1], below.scale))
            alphas = channels.select(downward, take(rows[0], above.alpha), take(rows[1], below.alpha))
            shape = tuple(leaving * leaving * _lobe(h, a, b, alpha) for alpha in alphas)  # per solid angle outside
            lobes.append(_product(scales, shape, valid))
        return lobes

    def _integrated(self, state: LobeTables, table: Table, wi: Vector, nodes: int, upward: bool) -> Energies:
        """Energy of every lobe by a quadrature over the facets seen from wi, above (`upward`: turned up)."""
        s, w = (jnp.asarray(array, wi[2].dtype) for array in gauss_legendre(nodes))
        turn = (jnp.arange(2 * nodes, dtype=s.dtype) + 0.5) / (2 * nodes)
        u1, u2 = (u.ravel() for u in jnp.meshgrid(turn, s, indexing="ij"))
        weight = jnp.tile(w, 2 * nodes) / (2 * nodes)
        edge = horizon(wi[2].dtype)
        reflected, transmitted = widths(table, wi)
        wi = (wi[0][..., None], wi[1][..., None], wi[2][..., None])
        near: list[Channels] = [(jnp.zeros_like(wi[2][..., 0]),)]
        far = list(near)
        for j, width in enumerate(reflected):
            alpha = width[..., None]
            m = ggx_sample(wi, alpha, u1, u2)
            wo = reflect(wi, m)
            share = weight * safe_div(jnp.where(wo[2] > edge, wo[2], 0.0), reflection_pdf(m, wi, alpha))
            lobe = self._reflections(table, wi, wo)[j]
            near.append(tuple(jnp.sum(share * value, axis=-1) for value in lobe))
        ratios = 1.0 / state.reference, state.below / state.reference
        entry, exit = ratios[::-1] if upward else ratios
        turned = flip if upward else _same
        for j, width in enumerate(transmitted):
            alpha = width[..., None]
            a = folded(wi, entry)
            m = ggx_sample(a, alpha, u1, u2)
            b = reflect(a, m)
            share = weight * safe_div(jnp.where(b[2] > edge, b[2], 0.0), exit * exit * reflection_pdf(m, a, alpha))
            lobe = self._transmissions(state, turned(wi), turned(unfolded(b, exit)))[j]
            far.append(tuple(jnp.sum(share * value, axis=-1) for value in lobe))
        return channels.total(near), channels.total(far)


def _is_diffuse(base: Surface | None) -> bool:
    return base is not None and not isinstance(base, Conductor)


def _same(w: Vector) -> Vector:
    return w


def _halves(wi: Vector, wo: Vector, cosine: Array) -> tuple[Array, Array]:
    """Cosine and sine of the angle between the directions and their half vector."""
    apart = add(wi, (-wo[0], -wo[1], -wo[2]))
    return cosine, 0.5 * safe_sqrt(dot(apart, apart))


def _lobe(h: Vector, wi: Vector, wo: Vector, alpha: Array) -> Array:
    """GGX lobe of facets that reflect all, D G / (4 cos cos), 1/sr."""
    alpha = bounded(alpha)  # a cubic may leave the range of its points
    area_i, area_o = ggx_area(wi, alpha), ggx_area(wo, alpha)
    return ggx_density(h, alpha) / ((wi[2] + area_i) * (wo[2] + area_o))


def _facet(table: Table, wi: Vector, wo: Vector) -> Channels:
    """The first interface or base itself, with Fresnel reflectance at its own facets."""
    assert table.facet is not None
    what, relative = table.facet
    if isinstance(what, Interface):
        return (interface_reflection(wi, wo, relative, jnp.asarray(what.alpha)),)
    return eqx.tree_at(lambda c: (c.ior, c.k), what, (what.ior / relative, what.k / relative)).evaluate(wi, wo)


def _product(scale: Channels, shape: Channels, valid: Array) -> Channels:
    # a cubic may fall below its points
    scale = tuple(at_least(value, 0.0) for value in scale)
    return channels.select(valid, channels.times(scale, shape))
