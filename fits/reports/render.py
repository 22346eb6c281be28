"""A picture of a material without a renderer: spheres, lobes in the plane of incidence, and light in by light out."""

from typing import Literal

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import MaxNLocator
from scipy.interpolate import RegularGridInterpolator

import layerjax as lj
from fits.data.geometry import Floats
from fits.reports.plots.data import CYCLE, STYLE
from layerjax._checks import require_count
from layerjax.mixture import require_material, stacks_of

Prepared = lj.Prepared | lj.Mixture

# towards the light: x to the right, y up, z towards the viewer
LIGHTS = {
    "lit from the front": (-0.4, 0.5, 0.77),
    "from the side": (-0.85, 0.35, 0.1),
    "from behind": (0.5, 0.45, -0.74),
}
SUN, SKY = 0.8, 0.2  # what a white diffuse surface shows of the light at normal incidence, and of the sky all around
SAMPLES = 2  # points along each side of a pixel
SKY_COSINES, SKY_AZIMUTHS = 24, 24  # directions at which the reflected sky is tabulated
INCIDENT, OUTGOING = np.linspace(0.0, 90.0, 91), np.linspace(-90.0, 90.0, 181)  # edges of cells of the BSDF's map


def render(
    stack: lj.Stack | lj.Mixture,
    transport: lj.Transport | Literal["auto"] | None = None,
    *,
    title: str = "",
    size: int = 256,
) -> Figure:
    """Picture of a material: spheres under a directional light and a constant sky, lobes, and a map of the BSDF.

    The sphere is a thin sheet with the sky on both sides: where it transmits, light from behind shines through. Of
    three channels the picture is in colour (red, green, blue), else grey by their mean.

    Args:
        stack: the material, without free parameters.
        transport: see `layerjax.prepare`; None: `AddingDoubling`, all orders of scattering.
        title: title of the picture.
        size: pixels of a sphere's diameter, in [16, 1024].

    Raises:
        ValueError: a size out of range, a stack that ends in another index than air, or a transport that is random.
    """
    require_material(stack)
    require_count("size", size, 16, 1024)  # more take several GB, and the picture has no more across
    for part in stacks_of(stack):
        indices = [float(layer.ior) for layer in part.layers if isinstance(layer, lj.Interface)]
        if part.base is None and indices and indices[-1] != 1.0:
            words = "the picture is of a sheet in air: close it with an Interface of ior 1, or give it a base"
            raise ValueError(f"layers: the stack ends in a medium of index {indices[-1]:g}, and {words}")
    chosen = lj.AddingDoubling() if transport is None else transport
    if isinstance(chosen, lj.Transport) and chosen.random:
        raise ValueError(f"transport: {type(chosen).__name__} is random; use a deterministic one: AddingDoubling()")
    prepared = lj.prepare(stack, chosen)
    transmits = any(part.base is None for part in stacks_of(stack))
    lights = [name for name in LIGHTS if transmits or name != "from behind"]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10.5, 7.2), layout="constrained")
        if title:
            figure.suptitle(title)
        above, below = np.ravel(figure.subfigures(2, 1, height_ratios=(1.0, 1.15), squeeze=False))
        for axes, name in zip(above.subplots(1, len(lights), squeeze=False)[0], lights, strict=True):
            axes.imshow(to_screen(sphere(stack, prepared, LIGHTS[name], size)), interpolation="none")
            axes.set_title(name)
            axes.set_axis_off()
        left, right = np.ravel(below.subfigures(1, 2, width_ratios=(1.0, 1.25), squeeze=False))
        _lobes(left.subplots(subplot_kw={"projection": "polar"}), prepared, transmits)
        _maps(right, prepared, transmits)
    return figure


def sphere(stack: lj.Stack | lj.Mixture, prepared: Prepared, light: tuple[float, float, float], size: int) -> Floats:
    """Radiance of the pixels of a sphere, (size, size, 3), linear, each the mean of `SAMPLES` by `SAMPLES` points.

    An irradiance of pi `SUN` across the light (see `LIGHTS`), a sky of radiance `SKY`, and a viewer far away.
    """
    number = SAMPLES * size
    place = ((np.arange(number) + 0.5) / number * 2.0 - 1.0) * 1.04
    x, y = np.meshgrid(place, -place)
    inside = x * x + y * y < 1.0
    normal = np.stack([x[inside], y[inside], np.sqrt(1.0 - x[inside] ** 2 - y[inside] ** 2)], axis=-1)
    # fibers along x run around the sphere, as lines of equal height
    tangent = np.stack([normal[:, 2], np.zeros(len(normal)), -normal[:, 0]], axis=-1)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    frame = np.stack([tangent, np.cross(normal, tangent), normal], axis=-2)
    wi = frame @ (np.asarray(light) / np.linalg.norm(light))
    wo = frame[:, :, 2]
    direct = np.pi * np.asarray(lj.evaluate(prepared, wi, wo)) * np.abs(wi[:, 2:])
    seen = SUN * direct + SKY * _sky(stack, prepared, wo)
    colour = seen if seen.shape[-1] == 3 else np.repeat(seen.mean(axis=-1, keepdims=True), 3, axis=-1)
    picture = np.full((number, number, 3), SKY)
    picture[inside] = colour
    return picture.reshape(size, SAMPLES, size, SAMPLES, 3).mean(axis=(1, 3))


def _sky(stack: lj.Stack | lj.Mixture, prepared: Prepared, wo: Floats) -> Floats:
    """Of a sky of radiance 1 all around, what reaches the viewer: by reciprocity what light from there scatters."""
    cosine = np.sin(0.5 * np.pi * (np.arange(SKY_COSINES) + 0.5) / SKY_COSINES)
    azimuth = np.linspace(-np.pi, np.pi, SKY_AZIMUTHS + 1)
    towards = lj.direction(np.arccos(cosine)[:, None], azimuth)
    energy = sum(np.asarray(part) for part in (*lj.albedo(prepared, towards), *lj.specular(stack, towards)))
    table = RegularGridInterpolator((cosine, azimuth), energy, bounds_error=False, fill_value=None)
    near = np.clip(wo[:, 2], cosine[0], cosine[-1])
    return np.asarray(table(np.stack([near, np.arctan2(wo[:, 1], wo[:, 0])], axis=-1)))


def to_screen(radiance: Floats) -> Floats:
    """Linear values to those of a screen (IEC 61966-2-1), highlights rolled off above 0.8."""
    bright = np.maximum(radiance - 0.8, 0.0)
    shown = np.minimum(radiance, 0.8) + 0.2 * bright / (bright + 0.2)
    return np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * np.maximum(shown, 0.0031308) ** (1 / 2.4) - 0.055)


def _lobes(axes: Axes, prepared: Prepared, transmits: bool) -> None:
    """Lobes in the plane of incidence: mean f |cos| by the angle from the normal, the light coming from the left."""
    angle = np.radians(np.linspace(-180.0, 180.0, 721) if transmits else np.linspace(-90.0, 90.0, 361))
    wo = lj.direction(angle, 0.0)
    for incidence, colour in zip((0.0, 30.0, 60.0, 80.0), CYCLE, strict=False):
        wi = lj.direction(-np.radians(incidence), 0.0)
        value = np.asarray(lj.evaluate(prepared, wi, wo) * jnp.abs(wo[:, 2:])).mean(axis=-1)
        axes.plot(angle, np.sqrt(value), color=colour, label=f"{incidence:.0f}°")
    axes.set(theta_zero_location="N", theta_direction=-1, **({} if transmits else {"thetamin": -90, "thetamax": 90}))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.set_title("√(f |cos θₒ|), 1/√sr, in the plane of incidence", pad=14)
    axes.legend(title="incidence", loc="lower left", bbox_to_anchor=(-0.3, -0.05))


def _maps(figure: SubFigure, prepared: Prepared, transmits: bool) -> None:
    """The BSDF by incident and outgoing angle in the plane of incidence, a map for each side to which light goes.

    Colours are of the values below 75 degrees, four decades at most.
    """
    incident, outgoing = (np.radians(0.5 * (edges[1:] + edges[:-1])) for edges in (INCIDENT, OUTGOING))
    below = np.where(outgoing > 0.0, np.pi, -np.pi) - outgoing
    sides = {"reflected": outgoing} | ({"transmitted": below} if transmits else {})
    wi, panels = lj.direction(-incident, 0.0)[:, None], figure.subplots(len(sides), 1, sharex=True, squeeze=False)[:, 0]
    maps = [np.asarray(lj.evaluate(prepared, wi, lj.direction(side, 0.0))).mean(axis=-1) for side in sides.values()]
    inner = [values[:75, 15:-15] for values in maps]
    largest = max(float(values.max()) for values in inner) or 1.0
    least = max(min(float(values.min()) for values in inner), 1e-4 * largest)
    norm = LogNorm(min(least, 0.5 * largest), largest)
    for axes, name, values in zip(panels, sides, maps, strict=True):
        within = np.clip(values, norm.vmin, norm.vmax)
        image = axes.pcolormesh(OUTGOING, INCIDENT, within, norm=norm, cmap="viridis", rasterized=True)
        axes.set(ylabel="incidence, degrees", title=f"BSDF in the plane of incidence, {name}")
        axes.grid(visible=False)
        figure.colorbar(image, ax=axes, label="1/sr", extend="both")
    panels[-1].set_xlabel("outgoing angle, degrees (+ forward, $-$ backward)")
