"""Instruments: means over cones beside dense quadrature, tilted samples, gains, and what they cost."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import fits
import layerjax as lj
from benchmarks.measuring.cones import mean_over_cones
from fits import Free, Instrument, LogUniform, Problem
from fits.data.geometry import direction
from tests.helpers.models import along

SINGLE = lj.SingleScattering()
GEOMETRY = fits.slices([10.0, 40.0, 65.0], np.arange(-80.0, 81.0, 4.0))
EXACT = fits.Noise(relative=0.02, floor=1e-4)
INCIDENCE = 30.0


def metal(alpha, k=3.0) -> lj.Stack:
    return lj.Stack([], lj.Conductor(0.2, k, alpha))


def problem(instrument: Instrument | None, low: float = 0.02, geometry: fits.Geometry = GEOMETRY) -> Problem:
    return Problem(metal(Free(max(0.2, low), low, 1.0)), along(geometry), SINGLE, EXACT, instrument=instrument)


@pytest.mark.parametrize(("source", "detector"), [(0.0, 2.0), (1.5, 0.0), (1.0, 3.0)])
@pytest.mark.parametrize("alpha", [0.06, 0.5])
def test_readings_are_means_over_cones(source: float, detector: float, alpha: float) -> None:
    of = problem(Instrument(source, detector))
    found = np.asarray(of.predict([alpha]))
    expected = mean_over_cones(metal(alpha), GEOMETRY.wi, GEOMETRY.wo, source, detector)
    # 1e-3 is allowed for each of lobe and cosines where no mean is taken
    inside = np.abs(GEOMETRY.wo[:, 2]) > np.cos(np.radians(78.0))
    assert np.all((np.abs(found / expected - 1.0)[:, 0] < 2e-3)[inside])
    # in the tangent plane they are dark, as without an aperture: a mean would be divided by a cosine of nothing
    flat = problem(Instrument(source, detector), geometry=fits.slices([30.0], [90.0]))
    assert float(flat.predict([alpha])[0, 0]) == 0.0


@pytest.mark.parametrize("free", [False, True])
def test_a_sample_that_leans_is_seen_at_other_angles(free: bool) -> None:
    lean = 1.5
    of = problem(Instrument(tilt=Free(0.0, -5.0, 5.0) if free else lean))
    signed = np.degrees(np.arctan2(GEOMETRY.wo[:, 0], GEOMETRY.wo[:, 2]))
    wi, wo = lj.direction(np.radians(of.data.theta_i + lean), np.pi), lj.direction(np.radians(signed - lean), 0.0)
    expected = lj.evaluate(metal(0.3), wi, wo, SINGLE)
    np.testing.assert_allclose(of.predict([0.3, lean] if free else [0.3]), expected, rtol=1e-9)
    assert of.units == {"base.alpha": "1"} | ({"instrument.tilt": "deg"} if free else {})


def test_leaning_out_of_the_plane_keeps_angles_between() -> None:
    geometry = fits.slices([0.0, 30.0], [20.0, 50.0], [0.0, 60.0])
    optics = problem(Instrument(tilt=4.0), geometry=geometry).model.optics
    wi, wo = np.asarray(optics.wi), np.asarray(optics.wo)
    np.testing.assert_allclose(np.sum(wi * wo, axis=-1), np.sum(geometry.wi * geometry.wo, axis=-1), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(wo, axis=-1), 1.0, atol=1e-12)
    expected = np.degrees(np.arccos(geometry.wi[:, 2])) + 4.0
    np.testing.assert_allclose(np.degrees(np.arccos(wi[:, 2])), expected, atol=1e-9)


def test_derivatives_by_the_offset() -> None:
    of = problem(Instrument(detector_aperture=1.0, tilt=Free(0.0, -5.0, 5.0)))
    for offset in (0.0, 0.4, -5.0):
        found = of.call(lambda model, vector: jax.jacfwd(model.predict)(vector)[..., 1], [0.3, offset])
        ends = [np.asarray(of.predict([0.3, offset + step])) for step in (1e-4, -1e-4)]
        np.testing.assert_allclose(found, (ends[0] - ends[1]) / 2e-4, rtol=1e-5, atol=1e-7)


def test_every_incidence_has_a_gain() -> None:
    of = problem(Instrument(gain_sd=0.03))
    assert of.names == ("base.alpha", "instrument.gains[0]", "instrument.gains[1]", "instrument.gains[2]")
    gains = np.array([0.97, 1.0, 1.05])
    found, plain = of.predict([0.3, *gains]), problem(None).predict([0.3])
    which = np.searchsorted([10.0, 40.0, 65.0], of.data.theta_i - 0.1)
    np.testing.assert_allclose(found, plain * gains[which][:, None], rtol=1e-12)
    # LogNormal(1, 0.03): the density of a gain of 1.05 is lower by (log 1.05 / 0.03)^2 / 2 + log 1.05
    gap = float(np.subtract(*(of.model.box.log_prior(np.array([0.3, 1.0, 1.0, gain])) for gain in (1.0, 1.05))))
    assert gap == pytest.approx(0.5 * (np.log(1.05) / 0.03) ** 2 + np.log(1.05))


def test_light_at_one_polar_angle_has_one_gain() -> None:
    """From all azimuths, and where angles were measured, a hundredth of a degree apart."""
    given = fits.slices([10.0, 40.0], np.arange(-60.0, 61.0, 20.0))
    theta, phi = np.degrees(np.arccos(given.wi[:, 2])), np.tile([0.0, 90.0, 180.0], len(given))[: len(given)]
    wi = direction(theta + 0.05 * np.sin(7.0 * np.arange(len(given))), phi)
    optics = problem(Instrument(gain_sd=0.03), geometry=fits.Geometry(wi, given.wo)).model.optics
    np.testing.assert_array_equal(optics.incidence, theta > 25.0)


def test_the_floor_may_be_the_instrument_s() -> None:
    data = along(GEOMETRY)
    model = Problem(metal(Free(0.2, 0.02, 1.0)), data, SINGLE, fits.Noise(0.0), instrument=Instrument(floor=1e-3)).model
    np.testing.assert_allclose(model.sigma_at(np.array([0.2]), data.values), 1e-3)


def width_of(alpha: float) -> float:
    """Full width of a lobe at half maximum, degrees of the viewer."""
    return 4.0 * np.degrees(np.arctan(0.6436 * alpha))


@pytest.mark.parametrize("ratio", [0.2, 1.0, 1.4, 3.0])
@pytest.mark.parametrize("split", [(0.0, 1.0), (0.6, 0.8)])
def test_readings_are_right_to_a_thousandth_of_the_peak(ratio: float, split: tuple[float, float]) -> None:
    alpha = 0.02
    source, detector = (ratio * width_of(alpha) * part for part in split)
    geometry = fits.slices([INCIDENCE], INCIDENCE + width_of(alpha) * np.array([-3.0, -1.0, -0.5, 0.0, 0.25, 1.0, 2.0]))
    stack, instrument = metal(alpha, Free(3.5, 2.0, 5.0)), Instrument(source, detector)
    of = Problem(stack, along(geometry), SINGLE, EXACT, instrument=instrument)
    expected = mean_over_cones(metal(alpha, 3.5), geometry.wi, geometry.wo, source, detector)
    error = np.max(np.abs(np.asarray(of.predict([3.5])) - expected)) / expected.max()
    # of two cones three widths wide rays would be too many: what a fit says then is in `numerical_error`
    assert error < (1e-3 if min(split) == 0.0 or ratio < 2.0 else 1e-2)


def through(alpha: float, ratio: float) -> tuple[fits.Measurements, Instrument]:
    """Readings of a metal through a detector that is so many widths of its lobe wide, with noise."""
    width = width_of(alpha)
    geometry = fits.slices([INCIDENCE], INCIDENCE + width * np.linspace(-3.0, 3.0, 33))
    exact = mean_over_cones(metal(alpha, 3.5), geometry.wi, geometry.wo, 0.0, ratio * width)
    values = exact * (1.0 + 0.01 * np.random.default_rng(3).standard_normal(exact.shape))
    return along(geometry, values), Instrument(detector_aperture=ratio * width)


def fitted(data: fits.Measurements, instrument: Instrument) -> fits.Fit:
    free = metal(Free(0.1, 1e-3, 1.0, LogUniform()), Free(3.0, 1.0, 8.0))
    noise = fits.Noise(relative=0.01, floor=1e-4, discrepancy=False)
    return fits.fit(free, data, transport=SINGLE, noise=noise, instrument=instrument, starts=4)


@pytest.mark.slow
def test_a_fit_takes_the_rays_that_the_lobe_asks_for_and_counts_what_is_left() -> None:
    """At 1.4 widths of the lobe four rays made k 2.78 +- 0.12 of 3.5."""
    data, seen = through(0.02, 1.4)
    found = fitted(data, seen)
    for name, truth in (("base.alpha", 0.02), ("base.k", 3.5)):
        assert abs(found.values[name] - truth) < 3.0 * found.standard_errors[name]
    expected = mean_over_cones(found.stack, data.wi, data.wo, 0.0, seen.detector_aperture)
    error = np.abs(found.predicted - expected)
    assert np.max(error) < 1e-3 * np.max(expected)
    # the error that the fit tells holds what there is, in standard deviations of the noise
    assert np.max(error / (0.01 * expected + 1e-4)) <= found.numerical_error + 1e-3
    assert found.numerical_error <= 0.1
    assert "rings of rays a cone" in found.status
    # few rays again, as given: the error is told, and is what they lack
    few = fitted(data, replace(seen, rings=1))
    exact = mean_over_cones(few.stack, data.wi, data.wo, 0.0, seen.detector_aperture)
    lack = np.max(np.abs(few.predicted - exact) / (0.01 * few.predicted + 1e-4))
    assert few.numerical_error == pytest.approx(lack, rel=0.2)
    assert lack > 2.0


@pytest.mark.slow
def test_a_broad_lobe_keeps_four_rays() -> None:
    data, seen = through(0.1, 0.2)
    found = fitted(data, seen)
    assert found.problem.instrument == replace(seen, rings=1)
    assert np.max(np.bincount(np.asarray(found.problem.model.optics.row))) == 4
