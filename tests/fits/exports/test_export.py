"""Files of materials: what each says when it is read again, by us and by Mitsuba, beside what the stack gives."""

import contextlib
import io

import numpy as np
import pytest

import fits
import layerjax as lj
from fits.data.formats.rgl_table import read_table
from fits.exports import merl
from fits.exports.contents import pairs
from fits.exports.export import ENDINGS
from fits.exports.material import Material, material_of
from tests.helpers.commands import refused

METAL = lj.Stack([], lj.Conductor([0.2, 0.9, 1.1], [3.9, 2.4, 2.2], 0.15))
GLOSSY = lj.Stack([lj.Interface(1.5, 0.05)], lj.Lambertian([0.5, 0.3, 0.1]))
FIBERS = lj.Stack([lj.Medium(1.0, 0.9, lj.SGGX("fiber", 0.5, (1.0, 0.4, 0.0)))], lj.Lambertian(0.3))
TILTED = lj.Stack([lj.Medium(1.0, 0.9, lj.SGGX("surface", 0.5, (0.3, 0.1, 1.0)))], lj.Lambertian(0.3))
LYING = (1.0, 0.4, 0.0)
ROUGH = lj.Stack([], lj.Conductor([0.2, 0.9, 1.1], [3.9, 2.4, 2.2], 0.3))
HAZE = lj.Stack([lj.Medium(0.7, [0.9, 0.8, 0.7], lj.HenyeyGreenstein(0.3))])
TWO = lj.Stack([], lj.Lambertian([0.1, 0.2]))
SINGLE = {"transport": lj.SingleScattering()}


def written(material, tmp_path, to, **options):
    """Also that what takes long says how far it is."""
    path, told = tmp_path / f"material{ENDINGS[to]}", []
    done = fits.export(material, path, to, progress=lambda *told_of: told.append(told_of[:3]), **options)
    assert (done.path, bool(told)) == (path, to != "csv")
    for stage, total in {(stage, total) for stage, _, total in told}:
        assert [(stage, step, total) for step in range(total)] == [one for one in told if one[0] == stage]
    return path, done.notes


def agrees(data, stack, transport, tolerance):
    true = np.asarray(lj.evaluate(stack, data.wi, data.wo, transport))
    np.testing.assert_allclose(data.values, np.broadcast_to(true, data.values.shape), rtol=tolerance)


def error_of(path, stack, transport):
    """The largest relative error among channels, at pairs of directions between those of the file."""
    wi, wo = pairs()
    true = np.asarray(lj.evaluate(stack, wi, wo, transport))
    found = fits.read(path, geometry=fits.Geometry(wi, wo)).values[:, : true.shape[1]]
    return np.max(abs(found / true - 1.0), axis=1)


@pytest.mark.parametrize(
    ("stack", "transport", "share", "azimuths"),
    [
        (METAL, lj.SingleScattering(), 1.0, (1, 1)),
        pytest.param(GLOSSY, lj.Statistical(), 1.0, (1, 1), marks=pytest.mark.slow),
        (FIBERS, lj.SingleScattering(), 0.98, (25, 2)),
        pytest.param(TILTED, lj.SingleScattering(), 0.98, (49, 1), marks=pytest.mark.slow),
    ],
    ids=["metal", "glossy", "fibers", "tilted flakes"],
)
def test_an_rgl_file_holds_the_stack(tmp_path, stack, transport, share, azimuths):
    """To 1 % of a share of pairs, 0.3 % in the median, with as many azimuths of the light as the stack needs."""
    path, notes = written(stack, tmp_path, "rgl", transport=transport)
    table = read_table(path)
    assert (len(table.phi_i), table.turns) == azimuths
    agrees(fits.read(path, bins=500), stack, transport, 2e-5)  # at its nodes, of float32
    error = error_of(path, stack, transport)
    assert np.median(error) < 0.003
    assert np.mean(error < 0.01) >= share
    assert any("in the median" in note for note in notes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("phase", "median", "most"),
    [
        (lj.SGGX("fiber", 0.3, LYING), 0.002, 0.023),
        (lj.SGGX("fiber", 0.1, LYING), 0.009, 0.18),
        (lj.HenyeyGreenstein(-0.9), 0.0024, 0.085),
        (lj.SGGX("fiber", 0.5, LYING), 0.001, 0.013),
        (lj.SGGX("fiber", 0.05, LYING), 0.021, 0.6),
        (lj.SGGX("surface", 0.3, (0.3, 0.2, 0.9)), 0.002, 0.012),
        (lj.SGGX("surface", 0.1, (0.3, 0.2, 0.9)), 0.004, 0.039),
        (lj.HenyeyGreenstein(0.9), 0.001, 0.007),
    ],
    ids=lambda value: repr(value) if isinstance(value, lj.PhaseFunction) else "",
)
def test_narrow_lobes_are_held_as_well_as_the_page_says(tmp_path, phase, median, most):
    """Of lobes that are not about the mirror direction: the figures of docs/formats.md, to what they are rounded to."""
    path, _ = written(lj.Stack([lj.Medium(1.0, 0.9, phase)]), tmp_path, "rgl", transport=lj.SingleScattering())
    error = error_of(path, lj.Stack([lj.Medium(1.0, 0.9, phase)]), lj.SingleScattering())
    assert np.median(error) < 1.05 * median
    assert 0.5 * most < np.quantile(error, 0.99) < 1.05 * most


def test_a_spectral_file_has_its_wavelengths(tmp_path):
    path, _ = written(METAL, tmp_path, "rgl", transport=lj.SingleScattering(), wavelengths=[450, 550, 650])
    data = fits.read(path, bins=100)
    assert data.channels == ("450 nm", "550 nm", "650 nm")
    agrees(data, METAL, lj.SingleScattering(), 2e-5)


def test_a_merl_table_holds_the_stack_at_its_bins_and_says_that_light_passes(tmp_path, monkeypatch):
    path, notes = written(METAL, tmp_path, "merl", transport=lj.SingleScattering())
    view = fits.slices((10.0, 40.0, 65.0), azimuth=(0.0, 40.0, 110.0))
    agrees(fits.read(path, geometry=view), METAL, lj.SingleScattering(), 1e-9)
    assert any("in the median" in note for note in notes)
    assert not any("passes through" in note for note in notes)
    monkeypatch.setattr(Material, "values", lambda self, wi, wo, stage="": np.ones((len(wi), 3)))
    notes = merl.contents(material_of(HAZE, lj.SingleScattering())).notes
    assert any("transmission is omitted" in note for note in notes)


@pytest.mark.parametrize(
    ("stack", "total"), [(HAZE, 1), pytest.param(FIBERS, 24, marks=pytest.mark.slow)], ids=["haze", "fibers"]
)
def test_a_zemax_file_holds_the_stack(tmp_path, stack, total):
    path, notes = written(stack, tmp_path, "zemax", transport=lj.SingleScattering())
    data = fits.read(path)
    true = np.asarray(lj.evaluate(stack, data.wi, data.wo, lj.SingleScattering()))
    if data.channels == ("X", "Y", "Z"):
        # white of D65 by the matrix that the standard gives (IEC 61966-2-1)
        white = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
        true = true @ white.T
        assert any("transmission is omitted" in note for note in notes)
    used = data.mask
    np.testing.assert_allclose(data.values[used], true[used], rtol=1e-5)
    totals = [float(line.split()[1]) for line in path.read_text().splitlines() if line.startswith("TIS")]
    assert len(totals) == total * 18 * len(data.channels)
    if total == 24:
        reflected, _ = lj.albedo(stack, lj.direction(0.0, np.pi), lj.SingleScattering())
        assert totals[0] == pytest.approx(float(reflected[0]), abs=1e-6)


def test_slices_hold_the_stack_or_the_best_of_a_fit_on_both_sides(tmp_path, coat_fit):
    path, _ = written(HAZE, tmp_path, "csv", transport=lj.SingleScattering())
    data = fits.read(path)
    assert (data.theta_o > 90).any()
    agrees(data, HAZE, lj.SingleScattering(), 1e-12)
    path, _ = written(coat_fit, tmp_path, "csv", force=True)
    agrees(fits.read(path), coat_fit.stack, coat_fit.problem.transport, 1e-12)


def test_what_cannot_be_written_is_named(tmp_path):
    for material, name, to, options, message in (
        (METAL, "x.bsdf", "obj", {}, "to is 'obj', must be one of rgl, merl"),
        (METAL, "x.bsdf", "merl", {}, "must end in .binary"),
        (TILTED, "x.binary", "merl", {}, "axes are the normal, and facets have one width"),
        (TWO, "x.bsdf", "rgl", {}, "this stack has 2 channels: give"),
        (TWO, "x.binary", "merl", {}, "has 2 channels"),
        (TWO, "x.bsdf", "zemax", {}, "this stack has 2"),
        (TWO, "x.xml", "klems", {}, "one channel or three"),
        (lj.Stack([lj.Interface(1.5, 0.1)]), "x.xml", "klems", {"transport": lj.ENDF()}, r"in a medium of index 1\.5"),
        (METAL, "x.bsdf", "rgl", {"wavelengths": [450, 550]}, "2 given, must be one for each of 3"),
        (METAL, "x.bsdf", "rgl", {"wavelengths": [650, 550, 450]}, "must be above 0 and ascend"),
        (METAL, "x.bsdf", "zemax", {"wavelengths": [450, 550, 650]}, "a file for 'zemax' has none"),
        (METAL, "x.bsdf", "rgl", {"transport": lj.RandomWalk(paths=8)}, "RandomWalk is random"),
        (lj.Stack([], lj.Lambertian(fits.Free(0.5, 0.0, 1.0))), "x.bsdf", "rgl", {}, "this stack describes a family"),
        (lj.Stack([], lj.Conductor(0.2, 3.9, np.full((2, 2, 1), 0.1))), "x.bsdf", "rgl", {}, "map"),
        ("copper", "x.bsdf", "rgl", {}, "material is 'copper', must be a Stack, a Mixture or a Fit"),
        (TWO, "x.mtlx", "openpbr", {}, "this stack has 2 channels"),
        (FIBERS, "x.mtlx", "openpbr", SINGLE, "not symmetric about the normal"),
        (lj.Stack([lj.Medium(0.7, 0.9)]), "x.mtlx", "openpbr", SINGLE, "% of the light is transmitted"),
    ):
        if to == "openpbr":
            pytest.importorskip("MaterialX")
        with pytest.raises(ValueError, match=message):
            fits.export(material, tmp_path / name, to, **options)
        assert not list(tmp_path.iterdir())


def test_on_the_command_line(work, capsys, layerjax):
    assert "data points" in layerjax("export coat.toml --to csv --out coat.csv").out
    assert len(fits.read(work / "coat.csv")) > 1000
    assert "exists already" in refused(["export", "coat.toml", "--to", "csv", "--out", "coat.csv"], capsys, work)


@pytest.fixture(scope="module", params=["rough", "glossy"])
def measured(request, tmp_path_factory):
    stack, transport = (ROUGH, lj.SingleScattering()) if request.param == "rough" else (GLOSSY, lj.Statistical())
    path = tmp_path_factory.mktemp("rgl") / f"{request.param}.bsdf"
    fits.export(stack, path, "rgl", transport=transport)
    return stack, transport, path


@pytest.mark.peers
def test_mitsuba_finds_the_stack(measured):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    stack, transport, path = measured
    bsdf = mi.load_dict({"type": "measured", "filename": str(path)})
    wi, wo = (w[::8] for w in pairs())
    true = np.asarray(lj.evaluate(stack, wi, wo, transport)) * wo[:, 2:]
    found = []
    for one, other in zip(wi, wo, strict=True):
        at = mi.SurfaceInteraction3f()
        at.wi = mi.ScalarVector3f(*one)
        found.append(np.array(bsdf.eval(mi.BSDFContext(), at, mi.ScalarVector3f(*other))))
    error = np.max(abs(np.array(found) / true - 1.0), axis=1)
    assert np.median(error) < 0.003
    assert np.max(error) < 0.01


@pytest.mark.peers
@pytest.mark.parametrize("light", [(0.3, 0.2, 0.93), (0.8, 0.0, 0.6)])
def test_mitsuba_draws_as_the_file_says(measured, light):
    mi = pytest.importorskip("mitsuba")
    try:
        mi.set_variant("llvm_ad_rgb")
    except Exception as error:
        pytest.skip(f"no LLVM: {error}")
    _, _, path = measured
    wi = (np.array(light) / np.linalg.norm(light)).tolist()
    sample, density = mi.chi2.BSDFAdapter("measured", f'<string name="filename" value="{path}"/>', wi=wi)
    test = mi.chi2.ChiSquareTest(
        domain=mi.chi2.SphericalDomain(), sample_func=sample, pdf_func=density, sample_dim=3, res=201
    )
    with contextlib.redirect_stdout(io.StringIO()):
        passed = test.run()
    assert passed
