"""Rough diffuse surfaces beside each other: energy, saturation and shape of Lambertian, Oren-Nayar and VMF diffuse."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import fits
import layerjax as lj
from benchmarks.measuring import environment, timing
from benchmarks.measuring.writing import DIRECTORY, environment_lines, figure, table, write
from fits.data.geometry import Geometry
from layerjax.surfaces import Surface

NAME = "rough-diffuse"
ROUGHNESS = (0.0, 0.1, 0.3, 0.5, 0.7, 1.0)
ANGLES = (0.0, 45.0, 75.0, 89.0)
COLOUR = (0.9, 0.4, 0.2)
"""Albedo of the spheres of d'Eon & Weidlich 2024, Fig. 10."""
SHAPE_ALBEDO = 0.8
PAIRS = 100_000

SURFACES: dict[str, Callable[[Any, Any], Surface]] = {
    "Lambertian": lambda albedo, roughness: lj.Lambertian(albedo),
    "Oren-Nayar, classic": lambda albedo, roughness: lj.OrenNayar(albedo, roughness, form="classic"),
    "Oren-Nayar, energy preserving": lambda albedo, roughness: lj.OrenNayar(albedo, roughness),
    "VMF diffuse, paper": lambda albedo, roughness: lj.VMFDiffuse(albedo, roughness),
    "VMF diffuse, transport": lambda albedo, roughness: lj.VMFDiffuse(albedo, roughness, form="all_orders"),
}

TEXT = """\
# Rough diffuse surfaces

{environment}
The numbers of each surface are its own: a roughness of 0.5 is not the same width for Oren-Nayar as for VMF diffuse
(d'Eon & Weidlich 2024), whose flakes scatter light into the material and back. *VMF diffuse, transport* is a table of
the exact solution of that model, *paper* its published fit.

## Energy

Share of light that comes back from a surface whose facets absorb nothing (albedo 1), by the polar angle of the light.

{energy}
## Saturation

White-sky albedo of the colour ({colour}) and its saturation (largest less smallest channel, by the largest).

{saturation}
## Shape

The surface nearest to *VMF diffuse, transport* of albedo {albedo:g}, its albedo and roughness fitted to {values} values
(four incidences, two planes, each weighted by its cosines), and what is left: relative L2, in percent.

{shape}
## Cost

Compiled, {pairs:,} pairs at a time, float64, one channel.

{cost}"""


@dataclass(frozen=True)
class Energy:
    """Albedo of a lossless surface. albedo: at each of `ANGLES`."""

    surface: str
    roughness: float
    albedo: list[float]


@dataclass(frozen=True)
class Saturation:
    """White-sky albedo of `COLOUR`, by channel."""

    surface: str
    roughness: float
    white_sky: list[float]
    saturation: float


@dataclass(frozen=True)
class Shape:
    """The nearest surface of a kind. error: relative L2."""

    surface: str
    roughness: float
    error: float
    albedo: float
    nearest: float | None


def study(
    quick: bool = False, report: Callable[[str], None] = lambda line: None, directory: Path = DIRECTORY
) -> tuple[str, tuple[Path, ...]]:
    """Measure, and write ``rough-diffuse.json`` and ``.md``; returns markdown and paths. quick: three roughnesses."""
    steps = ROUGHNESS[::2] if quick else ROUGHNESS
    energies, saturations, shapes = [], [], []
    for name, make in SURFACES.items():
        for roughness in steps if name != "Lambertian" else (0.0,):
            energies.append(Energy(name, roughness, _albedos(make(1.0, roughness), ANGLES)[:, 0].tolist()))
            sky = white_sky(make(COLOUR, roughness))
            saturations.append(Saturation(name, roughness, sky.tolist(), float(1.0 - sky.min() / sky.max())))
        report(f"energy and saturation: {name}")
    for roughness in steps[1:]:
        for name in SURFACES:
            if name != "VMF diffuse, transport":
                shapes.append(nearest(name, roughness))
        report(f"shape: roughness {roughness:g}")
    cost = {name: _nanoseconds(make(0.8, 0.5)) for name, make in SURFACES.items()}
    surroundings = environment.describe()
    text = TEXT.format(
        environment=environment_lines(surroundings),
        colour=", ".join(f"{level:g}" for level in COLOUR),
        albedo=SHAPE_ALBEDO,
        values=len(_geometry().wi),
        pairs=PAIRS,
        energy=table(
            ("surface", "roughness", *(f"{angle:g} deg" for angle in ANGLES)),
            [[row.surface, f"{row.roughness:g}", *(f"{a:.4f}" for a in row.albedo)] for row in energies],
        ),
        saturation=table(
            ("surface", "roughness", "red", "green", "blue", "saturation"),
            [
                [row.surface, f"{row.roughness:g}", *(f"{a:.3f}" for a in row.white_sky), f"{row.saturation:.3f}"]
                for row in saturations
            ],
        ),
        shape=table(
            ("surface", "roughness of the truth", "L2 error, %", "albedo", "roughness"),
            [
                [
                    row.surface,
                    f"{row.roughness:g}",
                    figure(100 * row.error),
                    f"{row.albedo:.3f}",
                    "-" if row.nearest is None else f"{row.nearest:.3f}",
                ]
                for row in shapes
            ],
        ),
        cost=table(("surface", "ns a value"), [[name, figure(value)] for name, value in cost.items()]),
    )
    content = {
        "environment": surroundings,
        "quick": quick,
        "energy": [asdict(row) for row in energies],
        "saturation": [asdict(row) for row in saturations],
        "shape": [asdict(row) for row in shapes],
        "nanoseconds a value": cost,
    }
    return text, write(NAME, content, text, directory)


def white_sky(surface: Surface, nodes: int = 24) -> NDArray[np.float64]:
    """Share of an even sky's light that comes back, by channel: the mean of 2 cos E over the cosine."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    cosine = 0.5 * (x + 1)
    return (w * cosine) @ _albedos(surface, np.degrees(np.arccos(cosine)))


def nearest(name: str, roughness: float) -> Shape:
    """The surface of a kind that comes nearest to the exact solution of VMF diffuse with this roughness."""
    geometry, make = _geometry(), SURFACES[name]
    exact = lj.Stack([], lj.VMFDiffuse(SHAPE_ALBEDO, roughness, form="all_orders"))
    data = fits.simulate(exact, geometry)
    weight = np.abs(geometry.wi[:, 2:] * geometry.wo[:, 2:])
    free = (fits.Free(0.7, 0.0, 1.0), fits.Free(0.5, 0.0, 1.0))
    fit = fits.fit(lj.Stack([], make(*free)), replace(data, sigma=1.0 / weight), starts=4, seed=0)
    truth, found = data.values, fits.simulate(fit.stack, geometry).values
    error = float(np.sqrt(np.sum((weight * (found - truth)) ** 2) / np.sum((weight * truth) ** 2)))
    return Shape(name, roughness, error, fit.values["base.albedo"], fit.values.get("base.roughness"))


def _geometry() -> Geometry:
    return fits.slices(incidence=(10, 35, 60, 75), outgoing=np.arange(-80, 81, 5), azimuth=(0, 90))


def _albedos(surface: Surface, angles: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    wi = lj.direction(jnp.radians(jnp.asarray(angles)), 0.3)
    reflected, _ = lj.albedo(lj.Stack([], surface), wi, nodes=96)
    return np.asarray(reflected)


def _nanoseconds(surface: Surface) -> float:
    generator = np.random.default_rng(0)
    wi, wo = (
        lj.direction(jnp.arccos(jnp.asarray(generator.random(PAIRS))), jnp.asarray(generator.uniform(0, 6.0, PAIRS)))
        for _ in range(2)
    )
    stack = lj.Stack([], surface)

    def evaluate() -> None:
        jax.block_until_ready(lj.evaluate(stack, wi, wo))

    evaluate()
    return 1e9 * min(timing.once(evaluate) for _ in range(5)) / PAIRS
