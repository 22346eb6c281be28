"""Stacks as Mitsuba scenes: `volpath` carries light through them, single surfaces stand alone.

A medium is a slab 1 unit deep between two rectangles, much wider than light can spread, with a null BSDF where no
interface lies; one directional emitter is the light. What differs from layerjax, and how it is translated:

- Mitsuba traces from the viewer (its wi) to the light (its wo), multiplies by the light's cosine, and carries radiance;
- `sggx` takes the matrix S, whose largest eigenvalue is 1 for both kinds of flake; extinction is sigma_t times the
  projected area sqrt(w' S w), as in layerjax (see `mitsuba_flakes` for what is wrong with the plugin);
- `max_depth` counts the light as well: max_depth = order + 1;
- a spawned ray starts up to 2e-4 of the depth off its surface, which changes optical depths by as much.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

import layerjax as lj
from benchmarks.peers.functions import VARIANT
from benchmarks.peers.mitsuba_flakes import flakes

WIDTH = 1e4
"""Half width of the rectangles, in depths of a medium."""

FAR = 1e3
"""Distance of a light with an extent."""

LANES = 1 << 20
"""Paths that are traced together."""

Values = NDArray[np.float64]


class Volpath:
    """A stack of media and interfaces over a Lambertian, a conductor or nothing, lit from one direction.

    Args:
        stack: what it holds must have a counterpart in Mitsuba.
        wi: unit direction towards the light, (3,).
        order: events that a path may have, at most; None: any number.
        cone: half angle of the light, in radians: values are then means over its directions, weighted by their
            cosines. No path finds light from a single direction through a smooth surface.
        roulette: events after which Russian roulette ends paths; Mitsuba's default is 5, and from then on at least one
            path in twenty ends at every event.

    Raises:
        ValueError: a medium has a Fresnel term or a thickness that depends on the channel, an interface joins equal
            indices, or the base is another surface.
    """

    def __init__(
        self, stack: lj.Stack, wi: Values, order: int | None = None, cone: float | None = None, roulette: int = 5
    ) -> None:
        import mitsuba as mi

        mi.set_variant(VARIANT)
        self.mi, self.channels = mi, stack.channels
        self.cosine, self.side = abs(float(wi[2])), float(np.sign(wi[2]))
        shapes, self.bottom = _shapes(mi, stack)
        sun = {"type": "directional", "direction": [-float(c) for c in wi], "irradiance": _rgb(1.0)}
        if cone is not None:  # of irradiance 1 across wi
            sun = _disc(mi, wi, cone)
        self.scene = mi.load_dict({"type": "scene", "sun": sun, **shapes}, optimize=False)
        depth = -1 if order is None else order + 1
        self.integrator = mi.load_dict({"type": "volpath", "max_depth": depth, "rr_depth": roulette})

    def values(self, wo: Values, paths: int, seed: int = 0) -> tuple[Values, Values]:
        """BSDF towards the viewers wo (N, 3) and its standard errors, (N, C) each, from so many paths a direction."""
        count = len(wo)
        share = max(min(paths, LANES // count), 1)
        rounds = -(-paths // share)
        sums = np.zeros((2, self.channels, count))
        for index in range(rounds):
            light = self._light(np.tile(wo, (share, 1)), seed + index).reshape(self.channels, share, count)
            sums += np.stack([light, light**2]).sum(axis=2)
        return _estimate(sums / self.cosine ** np.array([1, 2])[:, None, None], rounds * share)

    def energies(self, paths: int, seed: int = 0) -> tuple[tuple[Values, Values], tuple[Values, Values]]:
        """Reflected and transmitted albedo, each (C,) with its standard error, by random outgoing directions."""
        random = np.random.default_rng(seed)
        found = []
        for side in (self.side, -self.side):
            sums = np.zeros((2, self.channels))
            rounds = -(-paths // LANES)
            for index in range(rounds):
                squared, phi = random.random(LANES), 2 * np.pi * random.random(LANES)
                radius = np.sqrt(squared)
                wo = np.stack([radius * np.cos(phi), radius * np.sin(phi), side * np.sqrt(1 - squared)], axis=-1)
                light = np.pi / self.cosine * self._light(wo, seed + 2 * index + int(side > 0))
                sums += np.stack([light, light**2]).sum(axis=-1)
            mean, error = _estimate(sums[..., None], rounds * LANES)
            found.append((mean[0], error[0]))
        return found[0], found[1]

    def mean(self, wo: Values, paths: int, seed: int = 0) -> float:
        """BSDF towards one viewer (3,), its channels averaged: the work and nothing beside it, for a clock."""
        import drjit as dr

        radiance = self._trace(self.mi.Vector3f(*map(float, wo)), paths, seed)
        dr.eval(radiance)  # all channels at once: a mean would trace the paths again for each
        return float(np.mean([dr.mean(channel)[0] for channel in radiance])) / self.cosine

    def _light(self, wo: Values, seed: int) -> Values:
        columns = [np.ascontiguousarray(wo[:, c], dtype=np.float32) for c in range(3)]
        radiance = self._trace(self.mi.Vector3f(*map(self.mi.Float, columns)), len(wo), seed)
        return np.array(radiance, dtype=float)[: self.channels]

    def _trace(self, wo: Any, paths: int, seed: int) -> Any:
        """Radiance towards the viewers, one path a lane."""
        import drjit as dr

        mi = self.mi
        exit_height = dr.select(wo.z > 0, 0.0, self.bottom)
        origin = mi.Point3f(0.0, 0.0, exit_height) + wo
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, paths)
        radiance, _, _ = self.integrator.sample(self.scene, sampler, mi.Ray3f(origin, -wo))
        return radiance


def _disc(mi: Any, wi: Values, cone: float) -> dict[str, Any]:
    """A distant disc, which the stack sees as this cone; its mean cosine is that of its middle."""
    place = mi.ScalarTransform4f().look_at(
        origin=[FAR * float(c) for c in wi], target=[0.0, 0.0, 0.0], up=[0.3, 0.9, 0.1]
    )
    place = place.scale([FAR * np.tan(cone), FAR * np.tan(cone), 1.0])
    emitter = {"type": "area", "radiance": _rgb(1.0 / (np.pi * np.sin(cone) ** 2))}
    return {"type": "disk", "to_world": place, "emitter": emitter}


def surface_values(stack: lj.Stack, wi: Values, wo: Values) -> Values:
    """BSDF (N, C) of a stack that is one interface or one base and nothing else, by Mitsuba's BSDF, in float32."""
    import mitsuba as mi

    mi.set_variant(VARIANT)
    bsdf = mi.load_dict(_base(stack.base, 1.0) if stack.base is not None else _interface(stack.layers[0], 1.0))
    interaction = mi.SurfaceInteraction3f()
    interaction.wi, light = (
        mi.Vector3f(*[mi.Float(np.ascontiguousarray(w[:, c], dtype=np.float32)) for c in range(3)]) for w in (wo, wi)
    )
    value = bsdf.eval(mi.BSDFContext(), interaction, light)
    return (np.array(value, dtype=float) / np.abs(wi[:, 2])).T[:, : stack.channels]


def _shapes(mi: Any, stack: lj.Stack) -> tuple[dict[str, Any], float]:
    """The rectangles from top to bottom, and the height of the lowest."""
    shapes: dict[str, Any] = {}
    bsdf: dict[str, Any] | None = None
    above, ior, height = None, 1.0, 0.0

    def close(below: dict[str, Any] | None) -> None:
        nonlocal bsdf, above
        media = {"interior": below, "exterior": above}
        place = mi.ScalarTransform4f().translate([0.0, 0.0, height]).scale([WIDTH, WIDTH, 1.0])
        rectangle = {"type": "rectangle", "to_world": place, "bsdf": bsdf or {"type": "null"}}
        shapes[f"boundary_{len(shapes)}"] = rectangle | {k: m for k, m in media.items() if m is not None}
        bsdf, above = None, below

    for index, layer in enumerate(stack.layers):
        if isinstance(layer, lj.Interface):
            if bsdf is not None:  # two interfaces in a row: nothing lies between them
                close(None)
                height -= 1.0
            bsdf = _interface(layer, ior)
            ior = float(layer.ior)
        else:
            close(mi.load_dict(_medium(mi, layer, index)))
            height -= 1.0
    if stack.base is not None and bsdf is not None:
        close(None)
        height -= 1.0
    if stack.base is not None:
        bsdf = _base(stack.base, ior)
    close(None)
    return shapes, height


def _medium(mi: Any, medium: lj.Medium, index: int) -> dict[str, Any]:
    if medium.f0 is not None and not np.all(np.asarray(medium.f0) == 1.0):
        raise ValueError(f"layers[{index}]: Mitsuba's media have no Fresnel term")
    if np.ptp(np.asarray(medium.thickness)) > 0:  # one channel's free flights weigh the others without bound
        raise ValueError(
            f"layers[{index}]: volpath's errors have no meaning where the thickness depends on the channel"
        )
    return {
        "type": "homogeneous",
        "sigma_t": _volume(medium.thickness),
        "albedo": _volume(medium.albedo),
        "phase": _phase(mi, medium.phase),
    }


def _phase(mi: Any, phase: lj.PhaseFunction) -> dict[str, Any]:
    if isinstance(phase, lj.HenyeyGreenstein):
        return {"type": "hg", "g": float(phase.g)}
    if not isinstance(phase, lj.SGGX):
        raise ValueError(f"phase: {type(phase).__name__} has no counterpart here")
    axis = np.array([0.0, 0.0, 1.0]) if phase.axis is None else np.asarray(phase.axis, float)
    along = np.outer(axis, axis) / (axis @ axis)
    alpha2 = float(phase.alpha) ** 2
    radial, axial = (alpha2, 1.0) if phase.kind == "surface" else (1.0, alpha2)
    s = radial * (np.eye(3) - along) + axial * along
    return flakes(mi, s)


def _interface(interface: Any, above: float) -> dict[str, Any]:
    below = float(interface.ior)
    if below == above:
        raise ValueError("Mitsuba's roughdielectric needs two different indices")
    if interface.is_smooth:
        return {"type": "dielectric", "int_ior": below, "ext_ior": above}
    return {
        "type": "roughdielectric",
        **_facets(interface),
        "int_ior": below,
        "ext_ior": above,
    }


def _base(base: Any, above: float) -> dict[str, Any]:
    if isinstance(base, lj.Lambertian):
        return {"type": "diffuse", "reflectance": _rgb(base.albedo)}
    if isinstance(base, lj.Conductor):
        index = {"eta": _rgb(base.ior / above), "k": _rgb(base.k / above)}
        if base.is_smooth:
            return {"type": "conductor", **index}
        return {"type": "roughconductor", **_facets(base), **index}
    raise ValueError(f"base: Mitsuba has no {type(base).__name__}")


def _facets(surface: Any) -> dict[str, Any]:
    """Normals and widths; Mitsuba's first width is along +x, here, and its second along y."""
    kind = type(surface).__name__
    if surface.distribution == "vmf":
        raise ValueError(f"{kind}.distribution: Mitsuba has no 'vmf' normals")
    if not surface.is_anisotropic:
        return {"distribution": surface.distribution, "alpha": float(surface.alpha)}
    quarters = 0.0 if surface.tangent is None else float(surface.tangent) / (0.5 * np.pi)
    if abs(quarters - round(quarters)) > 1e-6:
        raise ValueError(f"{kind}.tangent: {float(surface.tangent):g}, must be along x or y")
    widths = [float(surface.alpha), float(surface.alpha_y)][:: -1 if round(quarters) % 2 else 1]
    return {"distribution": surface.distribution, "alpha_u": widths[0], "alpha_v": widths[1]}


def _volume(value: Any) -> dict[str, Any]:
    return {"type": "constvolume", "value": _rgb(value)}


def _rgb(value: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": np.broadcast_to(np.asarray(value, float), 3).tolist()}


def _estimate(sums: Values, count: int) -> tuple[Values, Values]:
    """Mean and standard error, (N, C), from the sums of values and of squares, (2, C, N)."""
    mean, square = sums / count
    error = np.sqrt(np.maximum(square - mean**2, 0.0) / (count - 1))
    return mean.T, error.T
