"""Absorption and scattering of slabs from totals, beside inverse adding-doubling."""

import numpy as np
import pytest

import layerjax as lj
from fits import Free, LogUniform, Problem, fit, read_slab

WITHIN = 0.02  # what is asked of coefficients, relative to iad's
G = 0.9
TWO_BEAMS = """\
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
# Measurements made by Anisha Bahl at King's College of a PDMS
# without glass slides using a dual beam spectrometer
# Process this file as 'iad -X -i 8 -g 0.9 filename'
 L      r         t         n
600.0  0.64189   0.17381   1.42970
"""
"""A row of `docs/phantom_with_no_slides.rxt` of github.com/scottprahl/iad, of which iad makes mu_s' 2.9135 and mu_a
0.0195 per mm; by spheres as the header describes them mu_s' would be 4.05."""


@pytest.mark.slow
def test_a_file_of_two_beams_is_what_iad_makes_of_it(tmp_path):
    """Its coefficients give the readings within what is lost at the edges, and with spheres none that is near."""
    path = tmp_path / "pdms.rxt"
    path.write_text(TWO_BEAMS)

    def predicted(corrected, reduced, mu_a):
        slab = read_slab(path, incidence=8.0, corrected=corrected)
        stack = slab.stack(Free(20.0, 1.0, 100.0), Free(0.05, 1e-3, 5.0), lj.HenyeyGreenstein(G))
        problem = Problem(stack, slab.totals, transport=lj.AddingDoubling(nodes=12, modes=1))
        return np.asarray(problem.predict([reduced / (1.0 - G), mu_a])) / slab.totals.values - 1.0

    assert np.max(np.abs(predicted(None, 2.9135, 0.0195))) < WITHIN
    assert np.min(np.abs(predicted(None, 4.05, 0.0168))) > 0.08
    assert np.min(np.abs(predicted(False, 2.9135, 0.0195))) > 0.08
    assert np.max(np.abs(predicted(False, 4.05, 0.0168))) < 0.005


@pytest.mark.peers
@pytest.mark.parametrize(
    ("albedo", "depth", "g", "ior", "slides"),
    [(0.9, 1.0, 0.0, 1.0, 1.0), (0.98, 5.0, 0.7, 1.33, 1.5)],
)
def test_slabs_of_its_forward_model_are_what_it_inverts_them_to(tmp_path, albedo, depth, g, ior, slides):
    iad = pytest.importorskip("iadpython")
    sample = {"g": g, "n": ior, "n_above": slides, "n_below": slides, "quad_pts": 16}
    reflected, passed = (float(part) for part in iad.Sample(a=albedo, b=depth, **sample).rt()[:2])
    inverse = iad.Experiment(sample=iad.Sample(a=None, b=None, **sample), r=reflected, t=passed, default_g=g)
    a, b = inverse.invert_rt()[:2]
    assert (a, b) == (pytest.approx(albedo, rel=WITHIN), pytest.approx(depth, rel=WITHIN))
    path, glass = tmp_path / "slab.rxt", f"{slides} 1 1" if slides > 1 else "1 1 0"
    path.write_text(f"IAD1 {ior} {glass} 5 1 0 200 25 12 1 .96 200 25 12 1 .96 2 {reflected} {passed}")
    slab, phase = read_slab(path, sigma=0.001), lj.HenyeyGreenstein(g)
    stack = slab.stack(Free(1.0, 0.1, 50.0, LogUniform()), Free(0.05, 1e-3, 5.0, LogUniform()), phase)
    found = {name.rpartition(".")[2]: value for name, value in fit(stack, slab.totals, starts=1).values.items()}
    assert found == pytest.approx({"mu_s": a * b, "mu_a": b * (1 - a)}, rel=WITHIN)
