"""Lobes that an instrument does not resolve are reported as such, not as numbers with errors."""

from dataclasses import replace

import numpy as np
import pytest

import fits
import layerjax as lj
from benchmarks.measuring.cones import mean_over_cones
from fits.optimise.limits import finest_step, instrument_limits
from fits.reports import verdicts
from fits.reports.tables import parameter_table

SINGLE = lj.SingleScattering()


def metal(alpha):
    return lj.Stack([], lj.Conductor(0.2, 3.0, alpha))


def fitted(alpha, step=1.0, instrument=None):
    geometry = fits.slices([30.0], np.arange(-80.0, 80.5, step))
    data = fits.simulate(metal(alpha), geometry, SINGLE, 0.02, 1e-4)
    if instrument is not None:
        seen = mean_over_cones(metal(alpha), geometry.wi, geometry.wo, 0.0, instrument.detector_aperture)
        data = replace(data, values=seen * data.values / lj.evaluate(metal(alpha), geometry.wi, geometry.wo, SINGLE))
    free = metal(fits.Free(0.1, 1e-3, 1.0, fits.LogUniform()))
    return fits.fit(free, data, transport=SINGLE, starts=4, instrument=instrument)


@pytest.mark.parametrize(
    ("alpha", "step", "detector", "limited"),
    [(0.1, 1.0, 0.0, False), (0.1, 10.0, 0.0, True), (0.005, 0.5, 4.0, True)],
)
def test_a_lobe_narrower_than_steps_or_aperture_is_limited(alpha, step, detector, limited):
    found = fitted(alpha, step, fits.Instrument(detector_aperture=detector) if detector else None)
    limits = instrument_limits(found)
    assert bool(limits) == limited
    assert ("base.alpha is limited by the instrument" in verdicts.verdict(found).sentences[2]) == limited
    if limited:
        # GGX falls to a half where the tangent of the half vector is 0.6436 alpha; the viewer turns twice as fast
        half = np.tan(np.radians(max(detector, 2.0 * step) / 4.0)) / 0.6436
        assert limits["base.alpha"] == pytest.approx(half, rel=1e-3)
        row = parameter_table(found).rows[0]
        assert row[1:3] == (f"< {half:.2g}", "-")
        assert row[-1] == f"limited by the instrument: alpha below {half:.2g}"
    else:
        assert abs(found.values["base.alpha"] - alpha) < 4.0 * found.standard_errors["base.alpha"]


def test_the_finest_scan_about_the_mirror_counts():
    fine = np.concatenate([np.arange(-80.0, 20.0, 5.0), np.arange(20.0, 40.0, 0.25), np.arange(40.0, 81.0, 5.0)])
    behind = np.arange(-80.0, 20.0, 2.0)  # no measurement beyond the mirror direction
    for incidence, outgoing, step in (([10.0, 30.0], fine, 0.25), ([30.0], behind, 0.0)):
        data = fits.simulate(metal(0.3), fits.slices(incidence, outgoing), SINGLE)
        assert finest_step(data) == pytest.approx(step)


def test_parts_of_mixtures_have_limits_of_their_own():
    geometry = fits.slices([30.0], np.arange(-80.0, 81.0, 1.0))
    parts = {"smooth": metal(fits.Free(0.02, 1e-3, 0.1)), "rough": metal(fits.Free(0.3, 0.1, 1.0))}
    truth = lj.Mixture({"smooth": metal(0.005), "rough": metal(0.4)}, [0.2, 0.8])
    data = fits.simulate(truth, geometry, SINGLE, 0.01, 1e-4)
    found = fits.fit(lj.Mixture(parts, [0.2, 0.8]), data, transport=SINGLE, starts=4)
    assert list(instrument_limits(found)) == ["smooth.base.alpha"]
