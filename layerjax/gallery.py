"""Named materials: metals with brushed surfaces and with a film, and the scenes of Wang et al. 2022.

Of the paper's Table 2 the shifted labels are put right. Where it has a map (of orientation, thickness or colour) a
constant stands, and the remark says which.
"""

from collections.abc import Callable
from dataclasses import dataclass

from layerjax.optical_constants import RGB_NM, metal
from layerjax.phase import SGGX, HenyeyGreenstein
from layerjax.stack import Interface, Medium, Stack
from layerjax.surfaces import Conductor, Lambertian, ThinFilm

ALONG_X = (1.0, 0.0, 0.0)


@dataclass(frozen=True)
class Material:
    """A material. source: where it comes from; remark: what was assumed; build: makes the stack, of 1 or 3 channels."""

    name: str
    source: str
    remark: str
    build: Callable[[], Stack]


def names() -> tuple[str, ...]:
    """Names of all materials."""
    return tuple(_MATERIALS)


def material(name: str) -> Material:
    """A material by its name.

    Raises:
        ValueError: no material has that name.
    """
    if name not in _MATERIALS:
        raise ValueError(f"gallery: {name!r} is not one of {', '.join(_MATERIALS)}")
    return _MATERIALS[name]


def stack(name: str) -> Stack:
    """The stack of a material; raises as `material` does."""
    return material(name).build()


def _index(name: str) -> tuple[list[float], list[float]]:
    """n and k of a metal, to three digits behind the point."""
    ior, k = metal(name, "rgb")
    return ior.round(3).tolist(), k.round(3).tolist()


def _brushed_aluminium() -> Stack:
    return Stack([], Conductor(*_index("aluminium"), 0.12, alpha_y=0.4))


def _lacquered_copper() -> Stack:
    return Stack([Interface(1.5, 0.08)], Conductor(*_index("copper"), 0.2, alpha_y=0.45))


def _tinted_titanium() -> Stack:
    return Stack([], Conductor(*_index("titanium"), 0.25, film=ThinFilm(2.4, 45.0, RGB_NM)))


def _window_shade() -> Stack:
    threads, weave = SGGX("fiber", 0.1, ALONG_X), SGGX("fiber", 1.0)
    return Stack([Medium(1.0, [0.9, 0.9, 0.7], threads), Medium(1.0, [0.9, 0.9, 0.7], weave)])


def _fabric(alpha: float) -> Stack:
    red = [0.7, 0.1, 0.1]
    return Stack([Medium(1.0, red, SGGX("fiber", alpha, ALONG_X)), Medium(5.0, red, SGGX("surface", 0.8))])


def _plant(albedo: float | list[float], axis: tuple[float, float, float] | None) -> Stack:
    front = Medium(0.05, 1.0, SGGX("surface", 0.05, axis), f0=0.1)
    return Stack([front, Medium(1.0, albedo, HenyeyGreenstein(0.7)), Medium(0.002, 1.0, SGGX("surface", 0.05))])


def _wood(albedo: list[float], axis: tuple[float, float, float]) -> Stack:
    coat = Medium(0.1, 1.0, SGGX("surface", 0.05), f0=0.1)
    return Stack([coat, Medium(1.0, albedo, SGGX("fiber", 0.2, axis)), Medium(5.0, 1.0, SGGX("surface", 0.8))])


def _copper() -> Stack:
    colour = [0.95, 0.64, 0.54]
    return Stack([Medium(1e4, 1.0, SGGX("surface", 0.5), f0=colour)])


def _sheen() -> Stack:
    return Stack([Medium(0.3, 0.9, SGGX("fiber", 0.2))], Lambertian([0.7, 0.35, 0.25]))


_TABLE = "Wang et al. 2022, Table 2 and Fig. "
_MATERIALS = {
    each.name: each
    for each in (
        Material(
            "brushed_aluminium",
            "Facets of two widths, GGX",
            "brushed along x, so that slopes across are wider; index of Rakic 1995",
            _brushed_aluminium,
        ),
        Material(
            "lacquered_copper",
            "The same under a clear lacquer",
            "brushed along x, index of Johnson & Christy 1972",
            _lacquered_copper,
        ),
        Material(
            "tinted_titanium",
            "A film of 45 nm of titanium dioxide",
            "the oxide has index 2.4 at all wavelengths, the metal that of Johnson & Christy 1974",
            _tinted_titanium,
        ),
        Material("window_shade", _TABLE + "1", "fibers along x in place of the orientation map", _window_shade),
        Material("fabric", _TABLE + "17", "fibers of alpha 0.1 as in the table, along x", lambda: _fabric(0.1)),
        Material("fabric_as_in_the_text", _TABLE + "17", "fibers of alpha 0.5, along x", lambda: _fabric(0.5)),
        Material("plant", _TABLE + "18", "white, thickness 1, orientation the normal", lambda: _plant(1.0, None)),
        Material(
            "plant_tilted",
            _TABLE + "18",
            "green, thickness 1, the flakes of the top tilted",
            lambda: _plant([0.4, 0.9, 0.2], (0.2, 0.1, 1.0)),
        ),
        Material("padauk", _TABLE + "19", "red wood, fibers along x", lambda: _wood([0.75, 0.28, 0.15], ALONG_X)),
        Material("walnut", _TABLE + "19", "brown wood, fibers along x", lambda: _wood([0.75, 0.5, 0.3], ALONG_X)),
        Material(
            "curly_maple",
            _TABLE + "19",
            "pale wood, fibers that dip into the surface",
            lambda: _wood([0.85, 0.7, 0.5], (1.0, 0.0, 0.2)),
        ),
        Material(
            "rough_copper",
            "Wang et al. 2022, Fig. 20",
            "deep flakes of alpha 0.5; the paper states no parameters",
            _copper,
        ),
        Material(
            "sheen",
            "Wang et al. 2022, Fig. 16",
            "upright fibers over a diffuse base; the paper states no parameters",
            _sheen,
        ),
    )
}
