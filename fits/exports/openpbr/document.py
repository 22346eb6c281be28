"""A stack as a MaterialX document with an OpenPBR surface. MaterialX is an extra, and imported on first use."""

from typing import Any

import numpy as np

import layerjax as lj
from fits.data.geometry import Floats, direction
from fits.exports.contents import Contents
from fits.exports.material import Material
from fits.exports.openpbr.start import COLORS, RANGES, used_by
from fits.exports.openpbr.surface import Surface
from fits.exports.openpbr.translation import INCIDENCE, Error, translated
from layerjax._parameters import leaves_with_names
from layerjax.mixture import stacks_by_name

NODE = "open_pbr_surface"
LINEAR = "lin_rec709"
"""MaterialX's name of linear red, green and blue of IEC 61966-2-1."""

CHANNELS = (1, 3)
LEAST_THROUGH = 0.01
"""Transmittance above which a stack cannot be written as opaque."""


def contents(material: Material, wavelengths: Floats | None = None) -> Contents:
    """The file: a surface, and a material that has it."""
    require_materialx()
    _require_counterpart(material)
    found = translated(material)
    values = inputs(found.surface)
    notes = [
        f"{NODE} 1.1, {' and '.join(found.surface.lobes)}, fitted: {_fitted(found.surface)}",
        *(_error(one) for one in found.errors),
        *(
            f"absorbed by the fitted values, as the surface has no such parameter: {', '.join(names)}"
            for names in [_without_counterpart(material)]
            if names
        ),
    ]
    return Contents(_document(material.name, values, notes).encode(), tuple(notes))


def require_materialx() -> None:
    """ValueError if the extra is not installed."""
    try:
        import MaterialX  # noqa: F401
    except ImportError:
        raise ValueError('to "openpbr" needs MaterialX: pip install "layerjax[materialx]"') from None


def inputs(surface: Surface) -> dict[str, float | tuple[float, float, float]]:
    """Inputs of the node: those of the lobes that the surface has, and weights of 0 for the others.

    Inter-reflection below the coat is switched off: renderers differ in it, and the fitted base color includes it.
    """
    lobes = surface.lobes
    values: dict[str, Any] = {
        "base_weight": 1.0,
        "base_metalness": _number(surface.base_metalness),
        "specular_weight": float("metal" in lobes or "gloss" in lobes),
        "coat_weight": float("coat" in lobes),
        "coat_darkening": 0.0,
    }
    for name in RANGES:
        if name in used_by(surface):
            values[name] = _color(getattr(surface, name)) if name in COLORS else _number(getattr(surface, name))
    if "gloss" not in lobes and "diffuse" in lobes:
        # MaterialX's shaders dim what lies below a gloss even where it has no weight, but little below the roughest
        values.setdefault("specular_roughness", 1.0)
        values["specular_ior"] = values.get("coat_ior", 1.0)  # as what lies above
    return values


def _require_counterpart(material: Material) -> None:
    if material.channels not in CHANNELS:
        raise ValueError(f"an OpenPBR surface has red, green and blue, this stack has {material.channels} channels")
    if not material.isotropic:
        raise ValueError(
            "this stack is not symmetric about the normal (an axis of a medium, or facets of two widths), and what is "
            "fitted here of OpenPBR is"
        )
    if material.is_mirror:
        raise ValueError(
            "a smooth surface of this stack mirrors along single directions, where no value is fitted: give it an "
            "alpha, such as 0.01"
        )
    if material.opaque:
        return
    wi = direction(np.array(INCIDENCE), 0.0)
    through = float((material.albedos(wi)[1] + material.specular(wi)[1]).max())
    if through > LEAST_THROUGH:
        raise ValueError(
            f"{100 * through:.2g} % of the light is transmitted, and OpenPBR has no lobe that scatters it: "
            "give it a base"
        )


def _document(name: str, values: dict[str, Any], notes: list[str]) -> str:
    import MaterialX

    library = MaterialX.createDocument()
    MaterialX.loadLibraries(MaterialX.getDefaultDataLibraryFolders(), MaterialX.getDefaultDataSearchPath(), library)
    document = MaterialX.createDocument()
    document.setDataLibrary(library)
    document.setColorSpace(LINEAR)
    valid_name = MaterialX.createValidName(name)
    shader = document.addNode(NODE, f"{valid_name}_surface", "surfaceshader")
    shader.setDocString("; ".join(notes))
    for key, value in values.items():
        if isinstance(value, tuple):
            shader.setInputValue(key, MaterialX.Color3(*value))
        else:
            shader.setInputValue(key, value)
    document.addMaterialNode(valid_name, shader)
    valid, why = document.validate()
    if not valid:
        raise ValueError(f"openpbr: MaterialX {MaterialX.__version__} refuses the document: {why.strip()}")
    return str(MaterialX.writeToXmlString(document))


def _fitted(surface: Surface) -> str:
    values = inputs(surface)
    return ", ".join(f"{name} {_numbers(values[name], '.4g')}" for name in RANGES if name in used_by(surface))


def _error(one: Error) -> str:
    median, most = (f"{float(f'{100 * part:.2g}'):g} %" for part in (one.median, one.most))
    return (
        f"light from {one.incidence:g} degrees: values are off by {median} in the median, by less than {most} in 95 of "
        f"100; reflected {_numbers(one.surface, '.3f')}, by the stack {_numbers(one.stack, '.3f')}"
    )


def _numbers(values: Any, form: str) -> str:
    return " ".join(format(value, form) for value in np.atleast_1d(np.asarray(values)))


def _without_counterpart(material: Material) -> list[str]:
    """Names of numbers of the stack without a counterpart among the parameters."""
    names: list[str] = []
    for prefix, stack in stacks_by_name(material.stack).items():
        names += (
            name
            for name, _ in leaves_with_names(stack, prefix)
            if not _has_counterpart(stack, name.removeprefix(prefix))
        )
    return names


def _has_counterpart(stack: lj.Stack, name: str) -> bool:
    if name.startswith("base."):
        return True
    interfaces = [f"layers[{place}]." for place, layer in enumerate(stack.layers) if isinstance(layer, lj.Interface)]
    held = interfaces[:1] if isinstance(stack.base, lj.Conductor) else [*interfaces[:1], *interfaces[1:][-1:]]
    return name.startswith(tuple(held)) if held else False


def _color(value: Any) -> tuple[float, float, float]:
    red, green, blue = np.broadcast_to(np.asarray(value, float), (3,)).tolist()
    return red, green, blue


def _number(value: Any) -> float:
    return float(np.asarray(value))
