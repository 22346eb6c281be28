"""python -m tools.gallery: write docs/gallery.md; with --pictures the pictures too, which takes some minutes."""

import argparse
import io
from pathlib import Path
from typing import Any

import jax
import numpy as np
from PIL import Image

from fits.problem.stack_file import material_to_dict
from fits.reports.plots.data import as_png
from fits.reports.render import LIGHTS, render, sphere, to_screen
from layerjax import AddingDoubling, gallery, prepare

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "gallery.md"
PICTURES = ROOT / "docs" / "gallery"

METALS = ("brushed_aluminium", "lacquered_copper", "tinted_titanium")
METALS_PICTURE = ROOT / "docs" / "metals.jpg"
"""The metals of the README, and their picture."""

SPHERE, WIDTH, QUALITY = 256, 1000, 88
"""Pixels of a sphere and of a picture, and how well a JPEG keeps it: about 70 kB each."""

COLUMNS = 70
"""Width of the code, which stands beside the picture on a wide screen."""

BEGINNING = """\
# Gallery

The materials of `layerjax.gallery`: metals with brushed surfaces and with a thin film, and the scenes of Wang et al.
2022. Where that paper has a texture map (of orientation, thickness or colour), the material has a constant, and its
remark says so.

In Python, `layerjax.gallery.stack("padauk")` returns the stack. In a stack file, `gallery = "padauk"` replaces the
layers and the base. Commands take the name in place of a file:

```sh
layerjax render padauk --out padauk.png
layerjax export padauk --to rgl --out padauk.bsdf
```

Each picture shows spheres lit from the front, from the side and, if the material transmits light, from behind; the
lobes in the plane of incidence; and the BSDF in that plane as a function of the angles of light and viewer. All
orders of scattering are included. `python -m tools.gallery --pictures` generates this page and its pictures.
"""


def page() -> str:
    """The text of docs/gallery.md."""
    parts = [BEGINNING]
    for name in gallery.names():
        material = gallery.material(name)
        tables = material_to_dict(material.build())
        alt = f"{name}: spheres, lobes and a map of the BSDF"
        parts.append(f"## {name}\n\n{material.source}: {material.remark}.\n\n![{alt}](gallery/{name}.jpg)\n")
        parts.append(f"```python\n{_stack(tables)}\n```\n")
    return "\n".join(parts)


def _stack(tables: dict[str, Any]) -> str:
    layers = "".join(f"        {_call(layer, 8)},\n" for layer in tables.get("layers", []))
    base = _call(tables["base"], 4, "base=") if "base" in tables else "None"
    held = f"[\n{layers}    ]" if layers else "[]"
    return f"lj.Stack(\n    layers={held},\n    base={base},\n)"


def _call(table: dict[str, Any], indent: int, name: str = "") -> str:
    """The code of a part of a stack file, an argument a line where one line would be longer than COLUMNS."""
    omitted = {"kind", *(["distribution"] if table.get("distribution") == "ggx" else [])}  # the default
    keys = sorted(table.keys() - omitted, key=lambda key: (key != "shape", list(table).index(key)))
    items = [(key, "" if key == "shape" else f"{key}=") for key in keys]
    words = [word + _value(table[key], indent + 4, word) for key, word in items]
    line = f"lj.{table['kind']}({', '.join(words)})"
    if "\n" not in line and indent + len(name) + len(line) < COLUMNS:
        return line
    body = "".join(f"{' ' * (indent + 4)}{word},\n" for word in words)
    return f"lj.{table['kind']}(\n{body}{' ' * indent})"


def _value(value: Any, indent: int, name: str = "") -> str:
    if isinstance(value, dict):
        return _call({"kind": "ThinFilm"} | value, indent, name)
    if isinstance(value, list):
        return f"[{', '.join(_value(part, indent) for part in value)}]"
    return repr(value).removesuffix(".0").replace("'", '"')


def picture(name: str) -> bytes:
    """The picture of a material, a JPEG."""
    drawn = Image.open(io.BytesIO(as_png(render(gallery.stack(name), size=SPHERE))))
    height = round(drawn.height * WIDTH / drawn.width)
    small = drawn.convert("RGB").resize((WIDTH, height), Image.Resampling.LANCZOS)
    file = io.BytesIO()
    small.save(file, "jpeg", quality=QUALITY, subsampling=0, optimize=True)
    return file.getvalue()


def metals() -> bytes:
    """The picture of the README, a JPEG: spheres of the metals, side by side."""
    shown = []
    for name in METALS:
        stack = gallery.stack(name)
        shown.append(to_screen(sphere(stack, prepare(stack, AddingDoubling()), LIGHTS["lit from the front"], SPHERE)))
    file = io.BytesIO()
    pixels = np.round(255.0 * np.concatenate(shown, axis=1)).astype(np.uint8)
    Image.fromarray(pixels).save(file, "jpeg", quality=QUALITY, subsampling=0, optimize=True)
    return file.getvalue()


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tools.gallery", description=__doc__)
    parser.add_argument("--pictures", action="store_true", help="draw the pictures as well")
    if parser.parse_args().pictures:
        jax.config.update("jax_enable_x64", True)
        PICTURES.mkdir(exist_ok=True)
        for name in gallery.names():
            path = PICTURES / f"{name}.jpg"
            path.write_bytes(picture(name))
            print(path.relative_to(ROOT))
        METALS_PICTURE.write_bytes(metals())
    PAGE.write_text(page())
    print(PAGE.relative_to(ROOT))


if __name__ == "__main__":
    main()
