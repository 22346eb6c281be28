"""Files of materials as others read them: Mitsuba's measured materials, and Radiance's matrices."""

import contextlib
import io

import numpy as np
import pytest

import fits
import layerjax as lj
from fits.exports.contents import pairs

pytestmark = pytest.mark.peers

ROUGH = lj.Stack([], lj.Conductor([0.2, 0.9, 1.1], [3.9, 2.4, 2.2], 0.3))
GLOSSY = lj.Stack([lj.Interface(1.5, 0.05)], lj.Lambertian([0.5, 0.3, 0.1]))
SHEET = lj.Stack([lj.Medium(0.3, 0.0), lj.Medium(0.7, 0.9, lj.SGGX("fiber", 0.4, (1.0, 0.5, 0.6)))])


@pytest.fixture(scope="module", params=["rough", "glossy"])
def measured(request, tmp_path_factory):
    """A stack, its transport, and its file."""
    stack, transport = (ROUGH, lj.SingleScattering()) if request.param == "rough" else (GLOSSY, lj.Statistical())
    path = tmp_path_factory.mktemp("rgl") / f"{request.param}.bsdf"
    fits.export(stack, path, "rgl", transport=transport)
    return stack, transport, path


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


def test_radiance_finds_sides_and_shares(tmp_path):
    """What its library sums over all that leaves, from patches 10 degrees wide; its z points where the room is."""
    bsdf = pytest.importorskip("pyradiance").bsdf
    path = tmp_path / "sheet.xml"
    fits.export(SHEET, path, "klems", transport=lj.SingleScattering())
    read = bsdf.load_file(str(path))
    every = bsdf.SAMPLE_ALL
    for theta in (20.0, 40.0, 140.0, 160.0):
        for phi in (0.0, 90.0, 200.0, 290.0):
            t, p = np.radians([theta, phi])
            wi = np.array([-np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), -np.cos(t)])
            reflected, passed = (float(share[0]) for share in lj.albedo(SHEET, wi, lj.SingleScattering()))
            passed += float(lj.unscattered(SHEET, wi)[0])
            assert bsdf.direct_hemi(read, theta, phi, every & ~bsdf.SAMPLE_T) == pytest.approx(reflected, abs=0.02)
            assert bsdf.direct_hemi(read, theta, phi, every & ~bsdf.SAMPLE_R) == pytest.approx(passed, abs=0.02)
