"""OpenPBR: the model beside MaterialX's own shaders and known limits, and the documents that are written."""

import json
import sys
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import fits
import layerjax as lj
from fits.cli.parser import main
from fits.exports.openpbr import surface as model
from fits.exports.openpbr.document import inputs
from fits.exports.openpbr.surface import Surface
from tests.helpers.commands import refused

evaluate, albedo = eqx.filter_jit(model.evaluate), eqx.filter_jit(model.albedo)

COPPER = lj.Conductor([0.2, 0.9, 1.1], [3.9, 2.4, 2.2], 0.16)
METAL = {"base_color": (0.91, 0.6, 0.5), "specular_color": (0.86, 0.9, 0.95), "specular_roughness": 0.5}
COAT, GLOSS = {"coat_ior": 1.4, "coat_roughness": 0.3}, {"specular_ior": 1.5, "specular_roughness": 0.4}
DENSE = {"specular_ior": 1.9, "specular_roughness": 0.5}
RED = (0.5, 0.3, 0.1)
PLASTIC = lj.Stack([lj.Interface(1.5, 0.09)], lj.Lambertian(RED))

SURFACES = {
    "metal": (Surface(("metal",), base_metalness=1.0, **METAL), 1e-3),
    # below a lobe MaterialX takes the albedo of Schlick's reflectance, even below one without weight
    "diffuse": (Surface(("diffuse",), (0.8, 0.4, 0.1), 0.7), 0.02),
    "gloss over black": (Surface(("gloss", "diffuse"), 0.0, **GLOSS), 1e-3),
    "gloss over diffuse": (Surface(("gloss", "diffuse"), RED, **GLOSS), 0.02),
    "coat over metal": (Surface(("coat", "metal"), base_metalness=1.0, **METAL, **COAT), 0.02),
    "coat over gloss over diffuse": (Surface(("coat", "gloss", "diffuse"), RED, **DENSE, **COAT), 0.02),
    "coat over metal and diffuse": (Surface(("coat", "metal", "diffuse"), base_metalness=0.6, **METAL, **COAT), 0.1),
}
SHADERS = json.loads((Path(__file__).parents[2] / "data" / "openpbr_values.json").read_text())
"""Values by MaterialX's own (see `tools.openpbr_values`)."""

ALL = "coat", "metal", "gloss", "diffuse"


@pytest.mark.parametrize("name", SURFACES)
def test_values_are_those_of_materialx(name):
    surface, tolerance = SURFACES[name]
    case = next(case for case in SHADERS["cases"] if case["name"] == name)
    given = inputs(surface)
    for key, value in case["inputs"].items():
        np.testing.assert_allclose(given[key], value, err_msg=key)
    wi, wo, true = (np.array(one) for one in (SHADERS["wi"], SHADERS["wo"], case["values"]))
    # of rough diffuse surfaces its shaders cut the cosine between light and viewer off at 0
    used = (wi * wo).sum(axis=1) > 0 if name == "diffuse" else np.full(len(wi), True)
    assert used.sum() > 10
    own = np.asarray(evaluate(surface, jnp.asarray(wi), jnp.asarray(wo)))
    np.testing.assert_allclose(np.broadcast_to(own, true.shape)[used], true[used], rtol=tolerance, atol=1e-6)


def towards(*degrees):
    return lj.direction(np.radians(degrees), 0.3)


def test_a_white_surface_loses_no_light():
    for white in (
        Surface(("metal",), 1.0, base_metalness=1.0, specular_roughness=0.9),
        Surface(("gloss", "diffuse"), 1.0, specular_roughness=0.35),
        Surface(ALL, 1.0, 0.3, base_metalness=0.5, coat_roughness=0.5),
    ):
        np.testing.assert_allclose(albedo(white, towards(0.0, 30.0, 60.0, 80.0)), 1.0, atol=1e-3)


@pytest.mark.slow
def test_albedo_is_the_integral_over_light():
    rough = {"coat_roughness": 0.6, "specular_roughness": 0.7}
    surface = Surface(ALL, RED, 0.3, base_metalness=0.5, specular_ior=1.9, **rough)
    # plain midpoints over the hemisphere: every lobe is wide
    theta, phi = np.meshgrid((np.arange(64) + 0.5) * np.pi / 128, (np.arange(64) + 0.5) * np.pi / 32)
    wi = lj.direction(theta.ravel(), phi.ravel())
    weight = (np.sin(theta) * np.cos(theta)).ravel() * (np.pi / 128) * (np.pi / 32)
    whole = (evaluate(surface, wi, jnp.broadcast_to(towards(40.0), wi.shape)) * weight[:, None]).sum(axis=0)
    np.testing.assert_allclose(albedo(surface, towards(0.0, 30.0, 40.0, 80.0))[2], whole, rtol=1e-3)


def read(path):
    """Inputs of the surface of a document, by MaterialX, which must find it valid."""
    materialx = pytest.importorskip("MaterialX")
    library, document = materialx.createDocument(), materialx.createDocument()
    materialx.loadLibraries(materialx.getDefaultDataLibraryFolders(), materialx.getDefaultDataSearchPath(), library)
    materialx.readFromXmlFile(document, str(path))
    document.setDataLibrary(library)
    assert document.validate() == (True, "")
    (material,) = document.getMaterialNodes()
    (surface,) = materialx.getShaderNodes(material)
    assert surface.getCategory() == "open_pbr_surface"
    assert document.getColorSpace() == "lin_rec709"
    values = {one.getName(): one.getValue() for one in surface.getInputs()}
    return {name: value.asTuple() if hasattr(value, "asTuple") else value for name, value in values.items()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stack", "expected", "off"),
    [
        (lj.Stack([], COPPER), {"base_color": ((0.93, 0.63, 0.55), 0.05), "specular_roughness": (0.4, 0.03)}, 5.0),
        (PLASTIC, {"specular_ior": (1.5, 0.05), "specular_roughness": (0.3, 0.03)}, 12.0),
    ],
    ids=["copper", "plastic"],
)
def test_a_stack_is_found_again(tmp_path, stack, expected, off):
    """off: by what percentage values are at most off, by the median."""
    made = fits.export(stack, tmp_path / "x.mtlx", "openpbr", transport=lj.AddingDoubling())
    found = read(made.path)
    for name, (value, tolerance) in expected.items():
        np.testing.assert_allclose(found[name], value, atol=tolerance, err_msg=name)
    medians = [float(note.split("off by ")[1].split(" %")[0]) for note in made.notes if note.startswith("light from")]
    assert len(medians) == 4
    assert max(medians) < off


def test_without_the_extra_the_command_says_how_to_install_it(work, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "MaterialX", None)
    said = refused(["export", "coat.toml", "--to", "openpbr", "--out", "coat.mtlx"], capsys, work)
    assert said == 'layerjax: error: to "openpbr" needs MaterialX: pip install "layerjax[materialx]"\n'


def test_a_diffuse_stack_is_written_as_it_is_on_the_command_line(work, capsys):
    pytest.importorskip("MaterialX")
    (work / "2 red.toml").write_text('[base]\nkind = "Lambertian"\nalbedo = [0.5, 0.3, 0.1]\n')
    assert main(["export", "2 red.toml", "--to", "openpbr", "--out", "2 red paint.mtlx"]) == 0
    told = capsys.readouterr()
    assert told.err.startswith("layerjax: diffuse: fit ")
    assert told.out.startswith("2 red paint.mtlx: 2 red.toml\n")
    assert "\nLight from 70 degrees: values are off by 0" in told.out
    found = read(work / "2 red paint.mtlx")
    np.testing.assert_allclose(found["base_color"], RED, atol=1e-5)
    assert found["base_diffuse_roughness"] == pytest.approx(0.0, abs=1e-3)
    weights = {"base_weight": 1.0, "coat_weight": 0.0, "specular_weight": 0.0, "base_metalness": 0.0}
    assert weights.items() <= found.items()
