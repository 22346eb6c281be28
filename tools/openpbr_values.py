"""Values of OpenPBR surfaces by MaterialX's own shaders, which tests compare with: python -m tools.openpbr_values.

MaterialX generates the shader of a document in GLSL for WebGL; a browser without a screen (chromium) runs it for single
directions of light and view. Needs the extra `materialx` and chromium.
"""

import argparse
import html
import json
import re
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import MaterialX
import numpy as np
from MaterialX import PyMaterialXGenGlsl, PyMaterialXGenShader

from fits.exports.contents import pairs

OUT = Path(__file__).parents[1] / "tests" / "data" / "openpbr_values.json"
PAGE = Path(__file__).with_suffix(".html")
PAIRS, SEED = 16, 5

RED, METAL = (0.5, 0.3, 0.1), {"base_color": (0.91, 0.6, 0.5), "specular_color": (0.86, 0.9, 0.95)}
COAT = {"coat_weight": 1.0, "coat_ior": 1.4, "coat_roughness": 0.3, "coat_darkening": 0.0}
CASES: dict[str, dict[str, Any]] = {
    "metal": {"base_metalness": 1.0, "specular_roughness": 0.5, **METAL},
    "diffuse": {
        "base_color": (0.8, 0.4, 0.1),
        "base_diffuse_roughness": 0.7,
        "specular_weight": 0.0,
        "specular_roughness": 1.0,
    },
    "gloss over black": {"base_color": (0.0, 0.0, 0.0), "specular_ior": 1.5, "specular_roughness": 0.4},
    "gloss over diffuse": {"base_color": RED, "specular_ior": 1.5, "specular_roughness": 0.4},
    "coat over metal": {"base_metalness": 1.0, "specular_roughness": 0.5, **METAL, **COAT},
    "coat over gloss over diffuse": {"base_color": RED, "specular_ior": 1.9, "specular_roughness": 0.5, **COAT},
    "coat over metal and diffuse": {
        "base_metalness": 0.6,
        "specular_ior": 1.4,
        "specular_roughness": 0.5,
        **METAL,
        **COAT,
    },
}


def main() -> None:
    """Write the values beside the parameters and directions that they are for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--browser", default="chromium", help="default: %(default)s")
    browser = parser.parse_args().browser
    wi, wo = (np.round(w, 6) for w in pairs(PAIRS, SEED))
    vertex, pixel = shaders()
    given = {"vertex": vertex, "pixel": pixel, "wi": wi.tolist(), "wo": wo.tolist()}
    radiance = run({**given, "cases": [{**defaults(), **case} for case in CASES.values()]}, browser)
    values = np.asarray(radiance) / wi[:, 2:]
    cases = [
        {"name": name, "inputs": case, "values": np.round(found, 7).tolist()}
        for (name, case), found in zip(CASES.items(), values, strict=True)
    ]
    source = f"MaterialX {MaterialX.__version__}, its shaders in GLSL, albedos by 1,024 of its samples"
    OUT.write_text(json.dumps({"source": source, "wi": wi.tolist(), "wo": wo.tolist(), "cases": cases}) + "\n")


def shaders() -> tuple[str, str]:
    """Vertex and pixel shader of a surface with all inputs open, lit by one distant light."""
    library = standard_library()
    document = MaterialX.createDocument()
    document.importLibrary(library)
    surface = document.addNode("open_pbr_surface", "s", "surfaceshader")
    surface.setInputValue("base_weight", 1.0)
    material = document.addMaterialNode("m", surface)
    light = document.addNode("directional_light", "light", "lightshader")
    generator = PyMaterialXGenGlsl.EsslShaderGenerator.create()
    context = PyMaterialXGenShader.GenContext(generator)
    context.registerSourceCodeSearchPath(MaterialX.getDefaultDataSearchPath())
    options = context.getOptions()
    method = PyMaterialXGenShader.HwSpecularEnvironmentMethod
    options.hwSpecularEnvironmentMethod = method.SPECULAR_ENVIRONMENT_NONE
    options.hwMaxActiveLightSources = 1
    options.hwSrgbEncodeOutput = False
    PyMaterialXGenShader.HwShaderGenerator.bindLightShader(light.getNodeDef(), 1, context)
    made = generator.generate("surface", material, context)
    pixel = made.getSourceCode("pixel").replace("u_refractionTwoSided", "false")  # which it forgets to declare
    pixel = pixel.replace("#define DIRECTIONAL_ALBEDO_METHOD 0", "#define DIRECTIONAL_ALBEDO_METHOD 2")
    return made.getSourceCode("vertex"), pixel.replace("SAMPLE_COUNT = 64", "SAMPLE_COUNT = 1024")


def standard_library() -> Any:
    """MaterialX's."""
    library = MaterialX.createDocument()
    MaterialX.loadLibraries(MaterialX.getDefaultDataLibraryFolders(), MaterialX.getDefaultDataSearchPath(), library)
    return library


def defaults() -> dict[str, Any]:
    """Inputs of the node as the standard library has them."""
    library = standard_library()  # kept: nodes do not live without it
    inputs = library.getNodeDef("ND_open_pbr_surface_surfaceshader").getInputs()
    values = {one.getName(): one.getValue() for one in inputs if one.getValue() is not None}
    return {name: list(value.asTuple()) if hasattr(value, "asTuple") else value for name, value in values.items()}


def run(inputs: dict[str, Any], browser: str) -> Any:
    """Values that the page computes: radiance under a light of 1, (cases, pairs, 3)."""
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "page.html"
        page.write_text(PAGE.read_text().replace("GIVEN", json.dumps(inputs).replace("</", "<\\/")))
        words = [browser, "--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"]
        words += ["--enable-unsafe-swiftshader", "--virtual-time-budget=600000", "--dump-dom", page.as_uri()]
        shown = subprocess.run(words, capture_output=True, text=True, timeout=500, check=True).stdout
    found = re.search(r'<pre id="out">(.*?)</pre>', shown, re.DOTALL)
    text = html.unescape(found.group(1)) if found else shown
    if not text.startswith("[["):
        raise SystemExit(f"{browser}: {text[:1000]}")
    return json.loads(text)


if __name__ == "__main__":
    main()
