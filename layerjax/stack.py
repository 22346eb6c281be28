"""What a layered material is made of: `Interface`, `Medium`, and the `Stack` that holds them over a base.

All are pytrees whose numeric leaves are arrays (concrete or traced); what is not a number is static. Constructors
refuse concrete values outside the documented box (`layerjax.RANGES`) by name.
"""

import operator
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from layerjax._checks import abbreviate, require_kind
from layerjax._diagram import DiagramRow, diagram
from layerjax._numerics import safe_div
from layerjax._parameters import Parameter, is_placeholder, leaves_with_names, parameter
from layerjax._repr import ReprModule, describe
from layerjax._shapes import channel_count
from layerjax.channels import Channels, per_channel
from layerjax.directions import Vector
from layerjax.normals.facets import Distribution, Facets, check_facets
from layerjax.normals.widths import azimuth_of_tangent
from layerjax.phase import HenyeyGreenstein, PhaseFunction
from layerjax.surfaces import Conductor, Surface, ThinFilm
from layerjax.surfaces.interface import MATCHED

LEAST_EXTINCTION = 1e-10
"""In 1/mm, stands for 0 where derivatives by the coefficients of a turbid medium may be needed."""


class Interface(Facets, ReprModule):
    """Dielectric interface: rough, of microfacets (Walter et al. 2007), or smooth.

    With Fresnel term F, distribution of normals D and masking G = G1(wi) G1(wo), reflection and transmission are::

        F D G / (4 cos_i cos_o)
        eta_o^2 abs(wi.h wo.h) (1 - F) D G / (cos_i cos_o (eta_i wi.h + eta_o wo.h)^2)

    ============ ====== ===== ==== ============ ======== ============== ================================================
    parameter    symbol shape unit range        default  differentiable meaning
    ============ ====== ===== ==== ============ ======== ============== ================================================
    ior          eta    ()    1    [0.25, 4]    required yes            refractive index of the medium below, relative
                                                                        to the surroundings of the stack
    alpha        alpha  ()    1    [1e-4, 1]    None     yes            width of D; [1e-4, 15] for ``"vmf"``, where
                                                                        kappa = 2 / alpha^2; None and 0: smooth
    distribution D                 "ggx",       "ggx"    no             GGX, Beckmann (Gaussian slopes), von
                                   "beckmann",                          Mises-Fisher or Student-t slopes; the last three
                                   "vmf",                               in `AddingDoubling` and `RandomWalk` with
                                   "gtr"                                ``facet_multiple_scattering=False``, and but
                                                                        for ``"gtr"`` in `ENDF`
    alpha_y             ()    1    [1e-4, 1]    None     yes            width across the tangent (alpha is that along
                                                                        it); None: alpha. Not of ``"vmf"``
    tangent             ()    rad  [-pi, pi]    0        yes            azimuth of the tangent, or a vector along it
    gamma        gamma  ()    1    [1.75, 40]   None     yes            exponent of the slopes of ``"gtr"``, which needs
                                                                        it: small for long tails
    film                           `ThinFilm`   None     yes            transparent film on it, whose reflectance
                                                                        replaces F; in `AddingDoubling` and
                                                                        `RandomWalk`; of a rough interface with
                                                                        ``facet_multiple_scattering=False``
    ============ ====== ===== ==== ============ ======== ============== ================================================

    ``"gtr"``: slopes p, q are Student-t distributed, with the density
    (1 + (p^2 + q^2) / ((gamma - 1) alpha^2))^-gamma / (pi alpha^2) (Ribardiere et al. 2017). That is GGX at gamma = 2,
    and Beckmann of the same alpha in the limit. It is not Burley's formula of that name, but for gamma = 2. From
    gamma = 1.5 down facets would have no finite projected area, and little above that most of what is seen at grazing
    light is facets that stand upright, on which quadratures are not exact.

    With two widths, as of a brushed surface, it is in `AddingDoubling` and `RandomWalk`, with
    ``facet_multiple_scattering=False``, and with ``"ggx"`` normals in `Statistical`.

    A smooth interface reflects and refracts each ray by itself: see `layerjax.specular`. It is in `AddingDoubling`,
    `RandomWalk` and `Statistical`; a width that is traced or fitted stays rough.

    Light that is blocked by masking is lost, also where the index hardly changes: with ior 1.001 and alpha 0.3, light
    at 75 degrees loses 20 % at a crossing, and a base that is lit and viewed at 75 degrees is 36 % darker. Transports
    with ``facet_multiple_scattering=True`` include this light. Omit an interface where the index does not change; one
    with exactly the index above it, and no film, is omitted automatically. With a film it has to be smooth there: what
    rough facets pass unrefracted is a delta, and a `ValueError` says that no transport carries it.
    """

    ior: Parameter = parameter("Interface.ior")
    alpha: Parameter = parameter("Interface.alpha", default=None, optional=True, ranged=False, absent_at_zero=True)
    distribution: Distribution = eqx.field(static=True, default="ggx")
    alpha_y: Parameter = parameter("Interface.alpha_y", default=None, optional=True)
    tangent: Parameter = eqx.field(converter=partial(azimuth_of_tangent, "Interface.tangent"), default=None)
    gamma: Parameter = parameter("Interface.gamma", default=None, optional=True)
    film: ThinFilm | None = None

    def __check_init__(self) -> None:
        check_facets("Interface", self.distribution, self.alpha, self.alpha_y, self.tangent, self.gamma)
        require_kind("Interface.film", self.film, ThinFilm, None)

    @property
    def is_smooth(self) -> bool:
        """Whether it is without facets, by structure."""
        return self.alpha is None

    def relative_to(self, above: Any) -> "Interface":
        """The same interface, its index and its film counted in a medium of this index."""
        relative = eqx.tree_at(lambda face: face.ior, self, self.ior / above)
        if self.film is None:
            return relative
        return eqx.tree_at(lambda face: face.film, relative, self.film.relative_to(above))


class Medium(ReprModule):
    """Plane-parallel medium that absorbs and scatters.

    Light along w is attenuated by exp(-thickness sigma(w) / cos); a collision scatters it by albedo schlick(f0)
    p(wi, wo), with sigma and p of the phase function.

    ========= ====== ======== ==== =============== ========= ============== ============================================
    parameter symbol shape    unit range           default   differentiable meaning
    ========= ====== ======== ==== =============== ========= ============== ============================================
    thickness tau    (), (C,) 1    [0, 1e4]        required  yes            optical depth T rho
    albedo    gamma  (), (C,) 1    [0, 1]          1         yes            single-scattering albedo; 0: the medium only
                                                                            absorbs
    phase     p                    `PhaseFunction` isotropic yes            `HenyeyGreenstein`, `SGGX`, `Rayleigh` or a
                                                                            class of your own
    f0        F0     (), (C,) 1    [0, 1]          None      yes            Schlick reflectance of a flake at normal
                                                                            incidence; None and 1: no Fresnel term
    ========= ====== ======== ==== =============== ========= ============== ============================================
    """

    thickness: Parameter = parameter("Medium.thickness")
    albedo: Parameter = parameter("Medium.albedo", default=1.0)
    phase: PhaseFunction = eqx.field(default_factory=lambda: HenyeyGreenstein(g=0.0))
    f0: Parameter = parameter("Medium.f0", default=None, optional=True)

    def __check_init__(self) -> None:
        _check_phase("Medium", self.phase)


class TurbidMedium(ReprModule):
    """A `Medium` that is specified by its thickness and coefficients, as tissue and pigments are measured.

    Its optical depth is (mu_s + mu_a) d, at most 1e4, and its albedo mu_s / (mu_s + mu_a).

    ============ ====== ======== ==== =============== ========= ============== =======================================
    parameter    symbol shape    unit range           default   differentiable meaning
    ============ ====== ======== ==== =============== ========= ============== =======================================
    thickness_mm d      ()       mm   [0, 1e4]        required  yes            thickness
    mu_s         mu_s   (), (C,) 1/mm [0, 1e4]        required  yes            scattering coefficient; not the reduced
                                                                               one, which is mu_s (1 - g)
    mu_a         mu_a   (), (C,) 1/mm [0, 1e4]        0         yes            absorption coefficient
    phase        p                    `PhaseFunction` isotropic yes            as of a `Medium`
    f0           F0     (), (C,) 1    [0, 1]          None      yes            as of a `Medium`
    ============ ====== ======== ==== =============== ========= ============== =======================================
    """

    thickness_mm: Parameter = parameter("TurbidMedium.thickness_mm")
    mu_s: Parameter = parameter("TurbidMedium.mu_s")
    mu_a: Parameter = parameter("TurbidMedium.mu_a", default=0.0)
    phase: PhaseFunction = eqx.field(default_factory=lambda: HenyeyGreenstein(g=0.0))
    f0: Parameter = parameter("TurbidMedium.f0", default=None, optional=True)

    def __check_init__(self) -> None:
        _check_phase("TurbidMedium", self.phase)

    def as_medium(self) -> Medium:
        """The same medium by optical depth and albedo; ValueError for a concrete depth above 1e4."""
        thickness, mu_s, mu_a = (jnp.asarray(number) for number in (self.thickness_mm, self.mu_s, self.mu_a))
        extinction = mu_s + mu_a
        if isinstance(self.mu_s, jax.core.Tracer):  # the derivative of the depth times the albedo is d at 0 as well
            extinction = extinction + jnp.where(extinction > 0, 0.0, LEAST_EXTINCTION)
        albedo = safe_div(mu_s, extinction)
        # of a map of thicknesses the channels lie behind
        depth = (thickness[..., None] if thickness.ndim else thickness) * extinction
        return Medium(depth, 0.0 if is_known(self.mu_s, 0.0) else albedo, self.phase, self.f0)


def _check_phase(owner: str, phase: Any) -> None:
    if not isinstance(phase, PhaseFunction):
        raise ValueError(
            f"{owner}.phase: {abbreviate(phase)} is not a HenyeyGreenstein, an SGGX or another PhaseFunction"
        )


class Stack(ReprModule):
    """Layers from top to bottom over a base.

    Parameters of shape ``(N,)`` or ``(H, W)`` make it a map of stacks, one for each texel (see the guide on maps).

    Args:
        layers: any number of `Interface`, `Medium` and `TurbidMedium`, the topmost first.
        base: an opaque surface (`Lambertian`, `OrenNayar`, `VMFDiffuse`, `Conductor`), or None for a stack that
            transmits light.

    Raises:
        ValueError: a layer or the base has another type, or parameters disagree on the number of channels or the shape
            of the map.
    """

    layers: tuple[Interface | Medium, ...]  # and turbid media, until `simplify`
    base: Surface | None = None

    def __init__(self, layers: Iterable[Interface | Medium | TurbidMedium], base: Surface | None = None):
        if not isinstance(layers, Iterable) or isinstance(layers, str | Mapping):
            raise ValueError(f"Stack.layers: {abbreviate(layers)} is not a list of Interface, Medium and TurbidMedium")
        self.layers = cast(tuple[Interface | Medium, ...], tuple(layers))
        self.base = base

    def __check_init__(self) -> None:
        for index, layer in enumerate(self.layers):
            if not isinstance(layer, Interface | Medium | TurbidMedium):
                raise ValueError(
                    f"Stack.layers[{index}]: {abbreviate(layer)} is not an Interface, a Medium or a TurbidMedium"
                )
        if self.base is not None and not isinstance(self.base, Surface):
            raise ValueError(f"Stack.base: {abbreviate(self.base)} is not a surface or None")
        channel_count(self)

    @property
    def channels(self) -> int:
        """Number of channels C of the stack's values."""
        return channel_count(self)

    def _repr_html_(self) -> str:
        rows = [
            DiagramRow("interface" if isinstance(layer, Interface) else "medium", type(layer).__name__, describe(layer))
            for layer in self.layers
        ]
        last = "no base: light passes" if self.base is None else type(self.base).__name__
        rows.append(DiagramRow("nothing" if self.base is None else "base", last, describe(self.base)))
        return diagram(rows, f"A stack, from top to bottom: {', '.join(row.name for row in rows)}")


def require_numbers(stack: Any) -> None:
    """Refuse a stack that still holds placeholders (a family of stacks rather than one)."""
    free = [name for name, leaf in leaves_with_names(stack) if is_placeholder(leaf)]
    if free:
        raise ValueError(f"Stack: {', '.join(free)} not given a value: this stack describes a family (see fits.fit)")


def simplify(stack: Stack) -> Stack:
    """The same stack without what its concrete values say is not there.

    Turbid media become media. Media and films of thickness 0 go, and interfaces without a film whose index is that of
    what lies above them (all light passes); f0 = 1 becomes None; f0 = 0 and albedo = 0 or 1 become Python floats, known
    while tracing. Axes of media that are the normal go: what is symmetric about it is so by structure.
    Traced values are kept as they are, so derivatives with respect to them are exact.
    """
    return simplify_and_name(stack)[0]


def simplify_and_name(stack: Stack) -> tuple[Stack, tuple[str, ...]]:
    """See `simplify`; and the names that the layers left have in the stack as it was given, such as ``layers[2]``."""
    layers, names = [], []
    above: Any = 1.0
    for index, layer in enumerate(stack.layers):
        if isinstance(layer, Interface):
            layer = _drop_film(layer)
            if layer.film is None and _are_equal(layer.ior, above):
                continue
            _refuse_delta_of_facets(f"layers[{index}]", layer, above)
            above, layer = layer.ior, _merge_widths(layer)
        if isinstance(layer, TurbidMedium):
            layer = _make_turbid_static(layer).as_medium()
        if isinstance(layer, Medium):
            if _is_everywhere(layer.thickness, 0.0):
                continue
            phase, layer = layer.phase.simplify(), _make_static(layer)
            if phase is not layer.phase:
                layer = eqx.tree_at(lambda medium: medium.phase, layer, phase)
            if is_known(layer.f0, 1.0):
                layer = eqx.tree_at(lambda medium: medium.f0, layer, None)
        layers.append(layer)
        names.append(f"layers[{index}]")
    if isinstance(stack.base, Conductor):
        stack = eqx.tree_at(lambda s: s.base, stack, _merge_widths(_drop_film(stack.base)))
    if len(layers) < len(stack.layers) or any(map(operator.is_not, layers, stack.layers)):
        stack = eqx.tree_at(lambda s: s.layers, stack, tuple(layers))
    return stack, tuple(names)


def _refuse_delta_of_facets(name: str, face: Interface, above: Any) -> None:
    """Raise a ValueError for a rough interface with a film between indices that are known to be equal."""
    if face.is_smooth or face.film is None:
        return
    if any(isinstance(ior, jax.core.Tracer) or is_placeholder(ior) for ior in (face.ior, above)):
        return
    below, above = np.broadcast_arrays(np.asarray(face.ior), np.asarray(above))
    matched = np.abs(below / above - 1.0) <= MATCHED * np.finfo(np.float32).eps  # of either precision
    if np.any(matched):
        raise ValueError(
            f"{name}.ior: {below[matched][0]:g} is the index above it, and its facets have a film: what they pass is a "
            "delta, which no transport carries; it may have another index, or be smooth (no alpha)"
        )


def _drop_film(part: Any) -> Any:
    """An interface or a conductor without its film, if that is known to have no thickness."""
    if part.film is None or not _is_everywhere(part.film.thickness_nm, 0.0):
        return part
    return eqx.tree_at(lambda p: p.film, part, None)


def _merge_widths(part: Any) -> Any:
    """An interface or a conductor of two widths that are known to be equal, as one of a single width."""
    if part.alpha_y is None or not _are_equal(part.alpha, part.alpha_y):
        return part
    return eqx.tree_at(lambda p: (p.alpha_y, p.tangent), part, (None, None), is_leaf=lambda leaf: leaf is None)


def make_constants_static(stack: Stack) -> Stack:
    """The same stack with albedos and f0 that are 0 or 1 for all channels as Python floats: known also under `jit`."""
    layers = tuple(_make_layer_static(layer) for layer in stack.layers)
    return eqx.tree_at(lambda s: s.layers, stack, layers)


def is_tilted(part: Any) -> bool:
    """Whether a layer or a base is not symmetric about the normal, as far as is known while tracing: a medium with an
    axis, or facets of two widths."""
    if isinstance(part, Interface | Conductor):
        return part.is_anisotropic
    return isinstance(part, Medium | TurbidMedium) and not part.phase.is_axisymmetric


def media_of(stack: Stack) -> list[Medium]:
    """The media of a stack, from top to bottom."""
    return [layer for layer in stack.layers if isinstance(layer, Medium)]


def optical_depths(media: Sequence[Medium], w: Vector) -> list[Channels]:
    """Optical depth of each medium along w, tau sigma(w) / |cos|, one array a channel of its thickness."""
    inverse = 1.0 / jnp.abs(w[2])
    return [
        tuple(tau * (medium.phase.cross_section(w) * inverse) for tau in per_channel(medium.thickness))
        for medium in media
    ]


def is_known(value: Any, number: float) -> bool:
    """Whether the parameter is known while tracing to be that number (see `simplify`)."""
    return isinstance(value, float) and value == number


def _make_static(medium: Medium) -> Medium:
    known = [_static_constant(medium.albedo), None if medium.f0 is None else _static_constant(medium.f0)]
    if known[0] is medium.albedo and known[1] is medium.f0:
        return medium
    return eqx.tree_at(lambda m: (m.albedo, m.f0), medium, known, is_leaf=lambda leaf: leaf is None)


def _make_layer_static(layer: Any) -> Any:
    if isinstance(layer, TurbidMedium):
        return _make_turbid_static(layer)
    return _make_static(layer) if isinstance(layer, Medium) else layer


def _make_turbid_static(medium: TurbidMedium) -> TurbidMedium:
    """Without scattering: known also while tracing."""
    return eqx.tree_at(lambda m: m.mu_s, medium, 0.0) if _is_everywhere(medium.mu_s, 0.0) else medium


def _static_constant(value: Any) -> Any:
    return next((number for number in (0.0, 1.0) if _is_everywhere(value, number)), value)


def _are_equal(one: Any, other: Any) -> bool:
    """Whether both are known to be the same number."""
    known = not isinstance(one, jax.core.Tracer) and not isinstance(other, jax.core.Tracer)
    return known and np.array_equal(np.asarray(one), np.asarray(other))


def _is_everywhere(value: Any, known: float) -> bool:
    if isinstance(value, jax.core.Tracer | float) or is_placeholder(value):
        return False
    return bool(np.all(np.asarray(value) == known))
