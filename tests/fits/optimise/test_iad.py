"""Absorption and scattering of slabs from totals, beside inverse adding-doubling."""

import numpy as np
import pytest

import layerjax as lj
from fits import Free, LogUniform, Problem, fit, read_slab

WITHIN = 0.02  # what is asked of coefficients, relative to iad's
PDMS = """\
IAD1
1.41  # Index of refraction of sample
1.00  # Index of refraction of slides
2.65  # [mm] Thickness of sample
0     # [mm] Thickness of slides
10    # [mm] Diameter of illumination beam
0.98  # Reflectance of calibration standard
1     # Number of spheres
100 21.8 18.3 8 0.98
100 18.3 0 8 0.98
 L      r         t         n
1500.0  0.29950   0.35218   1.41832
"""
"""A row of `docs/phantom_with_no_slides.rxt` of github.com/scottprahl/iad (A. Bahl, King's College London), measured by
comparing two beams at 8 degrees. iad's own results (mu_a 0.0416, mu_s' 0.580) count light lost at the edges of the
sample as well, which it follows by Monte Carlo; iadpython does not, and neither does this."""
G = 0.9

TWO_BEAMS = """\
# Measurements made by Anisha Bahl at King's College of a PDMS
# without glass slides using a dual beam spectrometer
# Process this file as 'iad -X -i 8 -g 0.9 filename'
 L      r         t         n
600.0  0.64189   0.17381   1.42970
"""
"""Comments of that file, and the row of which iad makes mu_s' 2.9135 and mu_a 0.0195 per mm; by spheres as the header
describes them mu_s' would be 4.05."""


def coefficients(slab, g):
    stack = slab.stack(Free(1.0, 0.1, 50.0, LogUniform()), Free(0.05, 1e-3, 5.0, LogUniform()), lj.HenyeyGreenstein(g))
    found = fit(stack, slab.totals, starts=1)
    mu_s, mu_a = (next(v for k, v in found.values.items() if k.endswith(name)) for name in ("mu_s", "mu_a"))
    return {"mu_a": mu_a, "mu_s'": mu_s * (1.0 - g)}


def inverted(read, **sample):
    """What iadpython makes of a reflectance and a transmittance: albedo and optical depth."""
    iad = pytest.importorskip("iadpython")
    reflected, passed = read
    slab = iad.Sample(a=None, b=None, quad_pts=16, **sample)
    return iad.Experiment(sample=slab, r=reflected, t=passed, default_g=sample["g"]).invert_rt()[:2]


@pytest.mark.slow
def test_a_file_of_two_beams_is_what_iad_makes_of_it(tmp_path):
    """Its coefficients give the readings within what is lost at the edges, and with spheres none that is near."""
    path = tmp_path / "pdms.rxt"
    path.write_text(PDMS.partition(" L ")[0] + TWO_BEAMS)

    def predicted(corrected, reduced, mu_a):
        slab = read_slab(path, incidence=8.0, corrected=corrected)
        stack = slab.stack(Free(20.0, 1.0, 100.0), Free(0.05, 1e-3, 5.0), lj.HenyeyGreenstein(G))
        problem = Problem(stack, slab.totals, transport=lj.AddingDoubling(nodes=12, modes=1))
        return np.asarray(problem.predict([reduced / (1.0 - G), mu_a])) / slab.totals.values - 1.0

    assert np.max(np.abs(predicted(None, 2.9135, 0.0195))) < WITHIN
    assert np.min(np.abs(predicted(None, 4.05, 0.0168))) > 0.08
    assert np.min(np.abs(predicted(False, 2.9135, 0.0195))) > 0.08
    assert np.max(np.abs(predicted(False, 4.05, 0.0168))) < 0.005


def assert_found(folder, text, mu_a, mu_s, g, **reading):
    """The coefficients of a slab are these, where its file holds this."""
    path = folder / "slab.rxt"
    path.write_text(text)
    found = coefficients(read_slab(path, sigma=0.001, **reading), g)
    expected = {"mu_a": mu_a, "mu_s'": mu_s * (1.0 - g)}
    np.testing.assert_allclose([found[name] for name in expected], list(expected.values()), rtol=WITHIN)


@pytest.mark.peers
def test_a_measured_slab_is_what_it_inverts_it_to(tmp_path):
    (tmp_path / "pdms.rxt").write_text(PDMS)
    reading = {"incidence": 8.0, "corrected": True}
    slab = read_slab(tmp_path / "pdms.rxt", sigma=0.001, **reading)
    a, b = inverted(slab.totals.values[:, 0], g=G, n=slab.ior)
    thickness = slab.thickness_mm
    assert_found(tmp_path, PDMS, b * (1 - a) / thickness, a * b / thickness, G, **reading)


@pytest.mark.peers
@pytest.mark.parametrize(
    ("albedo", "depth", "g", "ior", "slides"),
    [(0.9, 1.0, 0.0, 1.0, 1.0), (0.98, 5.0, 0.7, 1.33, 1.5)],
)
def test_slabs_of_its_forward_model_are_what_it_inverts_them_to(tmp_path, albedo, depth, g, ior, slides):
    iad = pytest.importorskip("iadpython")
    sample = iad.Sample(a=albedo, b=depth, g=g, n=ior, n_above=slides, n_below=slides, quad_pts=16)
    reflected, passed = (float(part) for part in sample.rt()[:2])
    a, b = inverted((reflected, passed), g=g, n=ior, n_above=slides, n_below=slides)
    assert (a, b) == (pytest.approx(albedo, rel=WITHIN), pytest.approx(depth, rel=WITHIN))
    glass = f"{slides} 1 1" if slides > 1 else "1 1 0"
    text = f"IAD1 {ior} {glass} 5 1 0 200 25 12 1 .96 200 25 12 1 .96 2 {reflected} {passed}"
    assert_found(tmp_path, text, b * (1 - a), a * b, g)
