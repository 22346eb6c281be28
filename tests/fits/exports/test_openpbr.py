"""OpenPBR: the model beside MaterialX's own shaders and known limits, and the documents that are written."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import fits
import layerjax as lj
from fits.cli.parser import main
from fits.exports.openpbr import surface as model
from fits.exports.openpbr.document import inputs
from fits.exports.openpbr.start import starts
from fits.exports.openpbr.surface import EDGE, Surface, metal_reflectance
from tests.helpers.commands import refused

evaluate, albedo = eqx.filter_jit(model.evaluate), eqx.filter_jit(model.albedo)

COPPER = lj.Conductor([0.2, 0.9, 1.1], [3.9, 2.4, 2.2], 0.16)
METAL: dict[str, Any] = {"base_color": (0.91, 0.6, 0.5), "specular_color": (0.86, 0.9, 0.95), "specular_roughness": 0.5}
COAT: dict[str, Any] = {"coat_ior": 1.4, "coat_roughness": 0.3}
RED = (0.5, 0.3, 0.1)

SURFACES = {
    "metal": (Surface(("metal",), base_metalness=1.0, **METAL), 1e-3),
    # below a lobe MaterialX takes the albedo of Schlick's reflectance, even below one without weight
    "diffuse": (Surface(("diffuse",), (0.8, 0.4, 0.1), 0.7), 0.02),
    "gloss over black": (Surface(("gloss", "diffuse"), 0.0, specular_ior=1.5, specular_roughness=0.4), 1e-3),
    "gloss over diffuse": (Surface(("gloss", "diffuse"), RED, specular_ior=1.5, specular_roughness=0.4), 0.02),
    "coat over metal": (Surface(("coat", "metal"), base_metalness=1.0, **METAL, **COAT), 0.02),
    "coat over gloss over diffuse": (
        Surface(("coat", "gloss", "diffuse"), RED, specular_ior=1.9, specular_roughness=0.5, **COAT),
        0.02,
    ),
    "coat over metal and diffuse": (Surface(("coat", "metal", "diffuse"), base_metalness=0.6, **METAL, **COAT), 0.1),
}


SHADERS: dict[str, Any] = json.loads((Path(__file__).parents[2] / "data" / "openpbr_values.json").read_text())
"""Values by MaterialX's own (see `tools.openpbr_values`)."""


@pytest.mark.parametrize("name", SURFACES)
def test_values_are_those_of_materialx(name: str) -> None:
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


def towards(*degrees: float) -> jnp.ndarray:
    return lj.direction(np.radians(degrees), 0.3)


WHITE = {
    "rough diffuse": Surface(("diffuse",), 1.0, 1.0),
    "rough metal": Surface(("metal",), 1.0, base_metalness=1.0, specular_roughness=0.9),
    "gloss": Surface(("gloss", "diffuse"), 1.0, specular_roughness=0.35),
    "coat over metal": Surface(("coat", "metal"), 1.0, base_metalness=1.0, specular_roughness=0.3, coat_roughness=0.6),
    "all": Surface(("coat", "metal", "gloss", "diffuse"), 1.0, 0.3, base_metalness=0.5, coat_roughness=0.5),
}


@pytest.mark.parametrize("name", WHITE)
def test_a_white_surface_loses_no_light(name: str) -> None:
    np.testing.assert_allclose(albedo(WHITE[name], towards(0.0, 30.0, 60.0, 80.0)), 1.0, atol=1e-3)


def test_albedo_is_the_integral_over_light() -> None:
    surface = Surface(("coat", "gloss", "diffuse"), RED, specular_ior=1.9, coat_roughness=0.6, specular_roughness=0.7)
    # plain midpoints over the hemisphere: every lobe is wide
    theta, phi = np.meshgrid((np.arange(64) + 0.5) * np.pi / 128, (np.arange(64) + 0.5) * np.pi / 32)
    wi = lj.direction(theta.ravel(), phi.ravel())
    wo = jnp.broadcast_to(towards(40.0), wi.shape)
    weight = (np.sin(theta) * np.cos(theta)).ravel() * (np.pi / 128) * (np.pi / 32)
    whole = (evaluate(surface, wi, wo) * weight[:, None]).sum(axis=0)
    np.testing.assert_allclose(albedo(surface, towards(40.0))[0], whole, rtol=1e-3)


def test_a_smooth_metal_is_a_conductor_of_microfacets() -> None:
    """Where all is reflected and hardly anything twice, a lobe is that of Walter et al. 2007."""
    surface = Surface(("metal",), 1.0, base_metalness=1.0, specular_roughness=0.1)
    conductor = lj.Stack([], lj.Conductor(0.01, 20.0, 0.01))
    wi, wo = towards(0.0, 20.0, 40.0, 60.0), lj.direction(np.radians([1.0, 21.0, 39.0, 60.5]), 0.31 + np.pi)
    true = lj.evaluate(conductor, wi, wo, lj.SingleScattering())
    np.testing.assert_allclose(evaluate(surface, wi, wo), true, rtol=2e-3)


def test_a_coat_of_no_index_is_none() -> None:
    wi, wo = towards(10.0, 50.0, 75.0), lj.direction(np.radians([20.0, 60.0, 70.0]), 2.0)
    bare = Surface(("metal",), base_metalness=1.0, **METAL)
    coated = Surface(("coat", "metal"), base_metalness=1.0, coat_ior=1.0, coat_roughness=0.01, **METAL)
    np.testing.assert_allclose(evaluate(coated, wi, wo), evaluate(bare, wi, wo), rtol=1e-6)


def test_only_what_lies_below_a_lobe_breaks_reciprocity() -> None:
    wi, wo = towards(10.0, 50.0), lj.direction(np.radians([70.0, 20.0]), 2.0)
    diffuse = Surface(("diffuse",), RED, 0.5)
    np.testing.assert_allclose(evaluate(diffuse, wi, wo), evaluate(diffuse, wo, wi), rtol=1e-12)
    gloss = Surface(("gloss", "diffuse"), RED)
    assert np.all(abs(evaluate(gloss, wi, wo) / evaluate(gloss, wo, wi) - 1.0) > 0.01)


def test_a_metal_has_its_colors_at_0_and_82_degrees() -> None:
    color, tint = jnp.array([0.9, 0.5]), jnp.array([0.8, 0.6])
    np.testing.assert_allclose(metal_reflectance(jnp.ones(1), color, tint), color)
    schlick = color + (1.0 - color) * (1.0 - EDGE) ** 5
    np.testing.assert_allclose(metal_reflectance(jnp.array([EDGE]), color, tint), tint * schlick)


def test_layers_say_where_the_fit_starts() -> None:
    (metal,) = starts((lj.Stack([lj.Interface(1.5, 0.04)], COPPER),))
    assert metal.lobes == ("coat", "metal")
    n, k = np.array([0.2, 0.9, 1.1]) / 1.5, np.array([3.9, 2.4, 2.2]) / 1.5
    np.testing.assert_allclose(metal.base_color, ((n - 1) ** 2 + k**2) / ((n + 1) ** 2 + k**2), rtol=1e-5)
    assert (metal.coat_ior, metal.coat_roughness) == pytest.approx((1.5, 0.2))
    assert metal.specular_roughness == pytest.approx(0.4)
    (two,) = starts((lj.Stack([lj.Interface(1.3, 0.04), lj.Interface(1.6, 0.25)], lj.Lambertian(RED)),))
    assert two.lobes == ("coat", "gloss", "diffuse")
    assert (two.coat_ior, two.specular_ior, two.specular_roughness) == pytest.approx((1.3, 1.6, 0.5))
    (one,) = starts((lj.Stack([lj.Interface(1.5, 0.04)], lj.Lambertian(RED)),))
    assert one.lobes == ("gloss", "diffuse")
    assert [one.lobes for one in starts((lj.gallery.stack("rough_copper"),))] == [("gloss", "diffuse"), ("metal",)]
    flakes = lj.Stack([lj.Interface(1.5, 0.04), lj.Medium(1.0, phase=lj.SGGX("surface", 0.3))], lj.Lambertian(RED))
    assert [one.lobes for one in starts((flakes,))] == [("coat", "gloss", "diffuse"), ("coat", "metal", "diffuse")]


def read(path: Path) -> dict[str, Any]:
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


def test_a_diffuse_stack_is_written_as_it_is(tmp_path: Path) -> None:
    pytest.importorskip("MaterialX")
    made = fits.export(lj.Stack([], lj.Lambertian(RED)), tmp_path / "2 red paint.mtlx", "openpbr")
    found = read(made.path)
    np.testing.assert_allclose(found["base_color"], RED, atol=1e-5)
    assert found["base_diffuse_roughness"] == pytest.approx(0.0, abs=1e-3)
    assert (found["coat_weight"], found["specular_weight"], found["base_metalness"]) == (0.0, 0.0, 0.0)
    assert any(note.startswith("light from 70 degrees: values are off by 0") for note in made.notes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stack", "expected", "off"),
    [
        (lj.Stack([], COPPER), {"base_color": ((0.93, 0.63, 0.55), 0.05), "specular_roughness": (0.4, 0.03)}, 5.0),
        (
            lj.Stack([lj.Interface(1.5, 0.09)], lj.Lambertian(RED)),
            {"specular_ior": (1.5, 0.05), "specular_roughness": (0.3, 0.03)},
            12.0,
        ),
    ],
    ids=["copper", "plastic"],
)
def test_a_stack_is_found_again(
    tmp_path: Path, stack: lj.Stack, expected: dict[str, tuple[Any, float]], off: float
) -> None:
    """off: by what percentage values are at most off, by the median."""
    made = fits.export(stack, tmp_path / "x.mtlx", "openpbr", transport=lj.AddingDoubling())
    found = read(made.path)
    for name, (value, tolerance) in expected.items():
        np.testing.assert_allclose(found[name], value, atol=tolerance, err_msg=name)
    medians = [float(note.split("off by ")[1].split(" %")[0]) for note in made.notes if note.startswith("light from")]
    assert len(medians) == 4
    assert max(medians) < off


FAULTS = {
    "axis": (lj.Stack([lj.Medium(1.0, 0.9, lj.SGGX("fiber", 0.5, (1.0, 0.0, 0.0)))], lj.Lambertian(0.3)), "no lobe"),
    "light that passes": (lj.Stack([lj.Medium(0.7, 0.9)]), "% of the light is transmitted"),
    "channels": (lj.Stack([], lj.Lambertian([0.1, 0.2])), "this stack has 2 channels"),
}


@pytest.mark.parametrize(("stack", "message"), FAULTS.values(), ids=FAULTS)
def test_what_has_no_counterpart_is_refused(tmp_path: Path, stack: lj.Stack, message: str) -> None:
    pytest.importorskip("MaterialX")
    with pytest.raises(ValueError, match=message):
        fits.export(stack, tmp_path / "x.mtlx", "openpbr", transport=lj.SingleScattering())
    assert not list(tmp_path.iterdir())


def test_without_the_extra_the_command_says_how_to_install_it(
    work: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "MaterialX", None)
    said = refused(["export", "coat.toml", "--to", "openpbr", "--out", "coat.mtlx"], capsys, work)
    assert said == 'layerjax: error: to "openpbr" needs MaterialX: pip install "layerjax[materialx]"\n'


def test_materialx_is_imported_only_where_it_is_used() -> None:
    code = (
        "import sys, fits.exports.export; "
        "assert 'fits.exports.openpbr.document' in sys.modules; sys.exit('MaterialX' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_on_the_command_line(work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("MaterialX")
    (work / "paint.toml").write_text('[base]\nkind = "Lambertian"\nalbedo = [0.5, 0.3, 0.1]\n')
    assert main(["export", "paint.toml", "--to", "openpbr", "--out", "paint.mtlx"]) == 0
    told = capsys.readouterr()
    assert told.err.startswith("layerjax: diffuse: fit ")
    said = told.out.splitlines()
    assert said[0] == "paint.mtlx: paint.toml"
    assert len(said) == 6
    assert read(work / "paint.mtlx")["base_weight"] == 1.0
    assert "must end in .mtlx" in refused(["export", "paint.toml", "--to", "openpbr", "--out", "x.xml"], capsys, work)
