"""Instruments: means over cones beside dense quadrature, samples that lean, gains, and what they cost."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

import fits
import layerjax as lj
from benchmarks.measuring.cones import mean_over_cones
from benchmarks.measuring.repeats import fit_many
from fits.data.geometry import direction
from fits.data.measurements import Measurements
from fits.problem.instrument import Instrument
from fits.problem.model import Model
from fits.problem.parameters import Free, LogNormal
from fits.problem.problem import Problem

SINGLE = lj.SingleScattering()
GEOMETRY = fits.slices([10.0, 40.0, 65.0], np.arange(-80.0, 81.0, 4.0))
EXACT = fits.Noise(relative=0.02, floor=1e-4)


def metal(alpha) -> lj.Stack:
    return lj.Stack([], lj.Conductor(0.2, 3.0, alpha))


def readings(geometry: fits.Geometry = GEOMETRY) -> Measurements:
    values = np.ones((len(geometry), 1))
    return Measurements(geometry.wi, geometry.wo, values, None, np.ones(len(values), bool), ("value",))


def problem(instrument: Instrument | None, low: float = 0.02, geometry: fits.Geometry = GEOMETRY) -> Problem:
    return Problem(metal(Free(max(0.2, low), low, 1.0)), readings(geometry), SINGLE, EXACT, instrument=instrument)


@pytest.mark.parametrize(("source", "detector"), [(0.0, 2.0), (1.5, 0.0), (1.0, 3.0), (3.0, 3.0)])
@pytest.mark.parametrize("alpha", [0.06, 0.15, 0.5])
def test_readings_are_means_over_cones(source: float, detector: float, alpha: float) -> None:
    of = problem(Instrument(source, detector))
    found = np.asarray(of.predict([alpha]))
    expected = mean_over_cones(metal(alpha), GEOMETRY.wi, GEOMETRY.wo, source, detector)
    # 1e-3 is allowed for each of lobe and cosines where no mean is taken
    inside = np.abs(GEOMETRY.wo[:, 2]) > np.cos(np.radians(78.0))
    assert np.all((np.abs(found / expected - 1.0)[:, 0] < 2e-3)[inside])


def test_means_are_taken_only_where_a_lobe_may_be_narrow() -> None:
    """By directions: more for each reading near the mirror, one for what no bound lets be narrow."""
    count = len(GEOMETRY)
    kinds = (Instrument(), 0.02), (Instrument(detector_aperture=1.0), 0.2), (Instrument(detector_aperture=1.0), 0.02)
    plain, wide, narrow = (problem(*kind).model.optics for kind in kinds)
    assert plain.row is None
    assert len(wide.wi) < len(narrow.wi) <= 14 * count
    half = GEOMETRY.wi + GEOMETRY.wo
    tilt = np.degrees(np.arctan2(np.hypot(half[:, 0], half[:, 1]), half[:, 2]))
    steep = GEOMETRY.wo[:, 2] < 0.5
    counts = [np.bincount(np.asarray(one.row), minlength=count) for one in (wide, narrow)]
    assert set(counts[0]) == {1, 4}
    assert set(counts[1]) == {1, 4, 14}
    assert np.all(counts[0][(readings().theta_i < 11.0) & ~steep] == 1)
    assert np.all(counts[1][tilt < 5.0] >= 4)
    assert np.all(counts[1][(tilt > 30.0) & ~steep] == 1)


def test_means_cost_four_readings_where_a_lobe_is_narrow_and_nothing_where_it_is_wide() -> None:
    """By operations."""

    def operations(instrument: Instrument | None, low: float) -> float:
        of = problem(instrument, low, fits.slices([10.0, 40.0], np.arange(-60.0, 61.0, 4.0)))
        lowered = jax.jit(lambda vector: of.model.predict(vector)).lower(of.start)
        return float(lowered.cost_analysis()["flops"])

    assert operations(Instrument(detector_aperture=3.0), 0.06) < 4.2 * operations(None, 0.06)
    assert operations(Instrument(detector_aperture=0.5), 0.5) == operations(None, 0.5)


def test_readings_in_the_tangent_plane_are_dark() -> None:
    """As they are without an aperture: a mean would be divided by a cosine of nothing."""
    geometry = fits.slices([30.0], [80.0, 90.0])
    found = problem(Instrument(source_aperture=1.0, detector_aperture=2.0), geometry=geometry).predict([0.3])
    assert np.isfinite(found).all()
    assert found[1, 0] == 0.0


@pytest.mark.parametrize("free", [False, True])
def test_a_sample_that_leans_is_seen_at_other_angles(free: bool) -> None:
    lean = 1.5
    offset = Free(0.0, -5.0, 5.0) if free else lean
    of = problem(Instrument(tilt=offset))
    found = of.predict([0.3, lean] if free else [0.3])
    signed = np.degrees(np.arctan2(GEOMETRY.wo[:, 0], GEOMETRY.wo[:, 2]))
    wi, wo = (lj.direction(np.radians(of.data.theta_i + lean), np.pi), lj.direction(np.radians(signed - lean), 0.0))
    np.testing.assert_allclose(found, lj.evaluate(metal(0.3), wi, wo, SINGLE), rtol=1e-9)
    assert of.names[1:] == (("instrument.tilt",) if free else ())
    assert of.units.get("instrument.tilt", "deg") == "deg"


def test_leaning_out_of_the_plane_keeps_angles_between() -> None:
    geometry = fits.slices([0.0, 30.0], [20.0, 50.0], [0.0, 60.0])
    optics = problem(Instrument(tilt=4.0), geometry=geometry).model.optics
    wi, wo = np.asarray(optics.wi), np.asarray(optics.wo)
    np.testing.assert_allclose(np.sum(wi * wo, axis=-1), np.sum(geometry.wi * geometry.wo, axis=-1), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(wo, axis=-1), 1.0, atol=1e-12)
    expected = np.degrees(np.arccos(geometry.wi[:, 2])) + 4.0
    np.testing.assert_allclose(np.degrees(np.arccos(wi[:, 2])), expected, atol=1e-9)


@pytest.mark.parametrize("free", [False, True])
def test_means_are_taken_about_the_peak_of_a_sample_that_leans(free: bool) -> None:
    """Also where light comes along the normal, and rays of the source's cone from all sides."""
    lean, alpha, geometry = 4.0, 0.1, fits.slices([0.0, 40.0], np.arange(-60.0, 61.0, 4.0))
    offset = Free(0.0, -5.0, 5.0) if free else lean
    found = problem(Instrument(1.5, 0.5, offset), 0.1, geometry).predict([alpha, lean] if free else [alpha])
    leaning = problem(Instrument(tilt=lean), geometry=geometry).model.optics
    expected = mean_over_cones(metal(alpha), np.asarray(leaning.wi), np.asarray(leaning.wo), 1.5, 0.5)
    np.testing.assert_allclose(found, expected, rtol=2e-3)


def test_derivatives_by_the_offset() -> None:
    of = problem(Instrument(detector_aperture=1.0, tilt=Free(0.0, -5.0, 5.0)))

    def slope(model: Model, vector: jax.Array) -> jax.Array:
        return jax.jacfwd(model.predict)(vector)[..., 1]

    for offset in (0.0, 0.4, -5.0):
        found = np.asarray(of.call(slope, [0.3, offset]))
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
    gap = float(of.log_prior([0.3, 1.0, 1.0, 1.0]) - of.log_prior([0.3, 1.0, 1.0, 1.05]))
    assert gap == pytest.approx(0.5 * (np.log(1.05) / 0.03) ** 2 + np.log(1.05))


def test_light_at_one_polar_angle_has_one_gain() -> None:
    """From all azimuths, and where angles were measured, a hundredth of a degree apart."""
    given = fits.slices([10.0, 40.0], np.arange(-60.0, 61.0, 20.0))
    theta, phi = np.degrees(np.arccos(given.wi[:, 2])), np.tile([0.0, 90.0, 180.0], len(given))[: len(given)]
    wi = direction(theta + 0.05 * np.sin(7.0 * np.arange(len(given))), phi)
    optics = problem(Instrument(gain_sd=0.03), geometry=fits.Geometry(wi, given.wo)).model.optics
    np.testing.assert_array_equal(optics.incidence, theta > 25.0)


def test_readings_at_other_incidences_have_a_gain_that_is_not_known() -> None:
    data = fits.simulate(metal(0.3), GEOMETRY, SINGLE, 0.01, 1e-5)
    gains = Instrument(gain_sd=0.1)
    found = fits.fit(metal(Free(0.2, 0.05, 1.0)), data, transport=SINGLE, starts=1, instrument=gains)
    known, other = (fits.predict(found, fits.slices([angle], [5.0])) for angle in (40.0, 50.0))
    assert known.predictive.sd / known.predictive.mean == pytest.approx(0.01, rel=0.3)
    assert other.predictive.sd / other.predictive.mean == pytest.approx(0.1, rel=0.2)


def test_numbers_are_recovered_by_the_model_of_the_instrument() -> None:
    """A detector of 3 degrees, a sample that leans by 0.3 and gains of 3 %: of 100 repeats 98 lie within three standard
    errors. Without the model of the instrument not one does."""
    truth, gains = 0.05, np.array([1.03, 0.98, 1.01])
    leaning = problem(Instrument(tilt=0.3)).model.optics
    seen = mean_over_cones(metal(truth), np.asarray(leaning.wi), np.asarray(leaning.wo), 0.0, 3.0)
    seen = seen * gains[np.searchsorted([10.0, 40.0, 65.0], readings().theta_i - 0.1)][:, None]
    generator = np.random.default_rng(5)
    values = seen * (1.0 + 0.02 * generator.standard_normal((100, *seen.shape)))
    noise = fits.Noise(relative=0.02, floor=1e-4)
    model = Instrument(detector_aperture=3.0, tilt=Free(0.0, -2.0, 2.0), gain_sd=0.03)
    stack = metal(Free(0.1, 0.02, 0.5, LogNormal(0.1, 1.0)))
    data = Measurements(GEOMETRY.wi, GEOMETRY.wo, values[0], None, np.ones(len(seen), bool), ("value",))
    of, blind = (Problem(stack, data, SINGLE, noise, instrument=one) for one in (model, None))
    found, without = (fit_many(one, values, starts=2) for one in (of, blind))
    pulls = (found.vectors[:, :2] - [truth, 0.3]) / found.standard_errors[:, :2]
    assert np.all(np.sum(np.abs(pulls) < 3.0, axis=0) >= 98)
    biased = (without.vectors[:, 0] - truth) / without.standard_errors[:, 0]
    assert np.all(np.abs(biased) > 3.0)


def test_instruments_are_kept_with_a_fit(tmp_path: Path) -> None:
    given = Instrument(0.5, 1.0, Free(0.0, -2.0, 2.0), 0.03, 1e-3)
    data = fits.simulate(metal(0.3), GEOMETRY, SINGLE, 0.02)
    stack = metal(Free(0.2, 0.05, 1.0))
    fits.write_problem(tmp_path / "problem.toml", stack, transport=SINGLE, instrument=given)
    assert fits.read_problem(tmp_path / "problem.toml").instrument == given
    found = fits.fit(stack, data, transport=SINGLE, starts=1, instrument=given)
    fits.save_fit(found, tmp_path / "result")
    loaded = fits.load_fit(tmp_path / "result")
    assert loaded.problem.instrument == found.problem.instrument == replace(given, rings=1)
    assert loaded.chi_square == pytest.approx(found.chi_square, rel=1e-9)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"detector_aperture": -1.0}, r"Instrument.detector_aperture is -1.0; it must be a number in \[0, 30\]"),
        ({"source_aperture": 31.0}, r"Instrument.source_aperture is 31.0; it must be a number in \[0, 30\]"),
        (
            {"source_aperture": Free(1.0, 0.0, 2.0)},
            r"Instrument.source_aperture is Free.*; it must be a number in \[0, 30\]",
        ),
        ({"tilt": Free(0.0, -20.0, 5.0)}, r"Instrument.tilt.low is -20.0; it must be a number in \[-10, 10\]"),
        ({"gain_sd": 0.0}, r"Instrument.gain_sd is 0.0; it must be a number in \[0.0001, 1\]"),
        ({"rings": 9}, r"Instrument.rings is 9; it must be an integer in \[1, 8\]"),
        ({"rings": 1.5}, r"Instrument.rings is 1.5; it must be an integer in \[1, 8\]"),
        ({"gain_sd": True}, "Instrument.gain_sd is True"),
    ],
)
def test_bad_instruments_are_refused(given: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Instrument(**given)


def test_bad_tables_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "problem.toml"
    fits.write_problem(path, metal(0.3))
    whole = path.read_text()
    for table, message in (
        ("detector_aperture = 31.0", r"instrument.detector_aperture is 31.0; it must be a number in \[0, 30\]"),
        ("rings = 0", r"instrument.rings is 0; it must be an integer in \[1, 8\]"),
        ("aperture = 1.0", "instrument has an unknown key 'aperture'"),
        ("tilt = { start = 0.0, low = -1.0 }", "instrument.tilt has no high"),
    ):
        path.write_text(f"{whole}\n[instrument]\n{table}\n")
        with pytest.raises(ValueError, match=message):
            fits.read_problem(path)
    with pytest.raises(ValueError, match=r"Noise.floor and Instrument.floor are both given"):
        problem(Instrument(floor=1e-3))
