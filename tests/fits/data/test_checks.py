"""What readings say of themselves: of data whose answers are known, and of those that are shipped."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

import fits
from fits.data.checks import energies, peaks, reciprocity, repeats, sides, symmetry
from fits.data.measurements import Measurements
from fits.reports.data_summary import data_statements
from tests.helpers.places import COATINGS

ANGLES = [10.0, 30.0, 50.0, 70.0]
HEMISPHERE = fits.slices(ANGLES, np.arange(-85.0, 86.0, 5.0), np.arange(0.0, 180.0, 10.0))
SCANS = fits.slices(ANGLES)
SIGNED = np.degrees(np.arctan2(SCANS.wo[:, 0], SCANS.wo[:, 2]))


def measured(values, geometry=HEMISPHERE, sigma=None):
    """Data of one channel: a number for all, or one for each."""
    values = np.broadcast_to(values, len(geometry))[:, None]
    known = None if sigma is None else sigma * values
    return Measurements(geometry.wi, geometry.wo, values, known, np.ones(len(values), bool), ("value",))


def statement(data, of):
    return " ".join(words for words in data_statements(data) if words.startswith(f"{of}:"))


def test_how_far_readings_are_from_reciprocal_is_told():
    between = np.sum(HEMISPHERE.wi * HEMISPHERE.wo, axis=1)
    found = reciprocity(
        measured(0.1 + 0.01 * np.cos(np.radians(HEMISPHERE.theta_i + HEMISPHERE.theta_o)) + 0.02 * between)
    )
    assert found.count == 6 * 36  # of each two incidences a pair at every azimuth in steps of 10
    assert found.p95 < 1e-9
    # a factor of 1 + a theta_i: pairs differ by a (i - o) over their mean
    found = reciprocity(measured(1.0 + 0.001 * HEMISPHERE.theta_i, sigma=0.01))
    low, high = 1.0 + 0.001 * np.array(list(combinations(ANGLES, 2))).T
    assert found.median == pytest.approx(np.median((high - low) / (0.5 * (low + high))), rel=1e-6)
    assert found.bias > 0.0  # steeper light is brighter
    assert found.z == pytest.approx(np.sqrt(np.mean((high - low) ** 2 / (low**2 + high**2))) / 0.01, rel=1e-6)


def test_energy_is_the_integral():
    """Of a Lambertian surface its albedo over what is covered: up to 85 degrees, sin^2 of it."""
    for one in energies(measured(0.6 / np.pi)):
        assert one.covered == pytest.approx(np.sin(np.radians(85.0)) ** 2, rel=0.01)
        assert one.share[0] == pytest.approx(0.6 * one.covered, rel=1e-6)
    assert energies(measured(1.0, SCANS)) == []
    half = fits.slices([30.0], np.arange(0.0, 86.0, 5.0), np.arange(0.0, 181.0, 10.0))
    too_much = measured(1.2 / np.pi, half)
    (mirrored,) = energies(too_much)
    assert mirrored.covered > 0.95
    assert "It exceeds 1 at 30°" in " ".join(data_statements(too_much))


def test_sides_are_compared():
    assert symmetry(measured(1.0 + np.sum(HEMISPHERE.wi * HEMISPHERE.wo, axis=1))).p95 < 1e-9
    brushed = measured(1.0 + 0.1 * np.sign(np.round(HEMISPHERE.wo[:, 1], 9)))
    assert symmetry(brushed).median == pytest.approx(0.2)
    assert symmetry(measured(1.0, SCANS)) is None


def test_repeats_tell_the_noise():
    once = measured(1.0)
    assert repeats(once) is None
    noise = 1.0 + 0.02 * np.random.default_rng(0).standard_normal((2, len(once), 1))
    both = {name: np.concatenate([getattr(once, name)] * 2) for name in ("wi", "wo", "mask")}
    twice = replace(once, values=np.concatenate(noise), **both)
    found = repeats(twice)
    assert found.count == len(once)
    # the median of |x - y| is 0.6745 sqrt(2) sigma, known to some percent
    assert found.median == pytest.approx(0.6745 * np.sqrt(2.0) * 0.02, rel=0.1)
    assert "a noise of about 2" in data_statements(twice)[-1]


@pytest.mark.parametrize(("width", "readings"), [(1.0, 1), (5.0, 5), (20.0, 19)])
def test_readings_in_the_peak_are_counted(width, readings):
    """Of a box as wide as `width` about the mirror direction, in steps of a degree."""
    scan = fits.slices([30.0], np.arange(-80.0, 81.0, 1.0))
    signed = np.degrees(np.arctan2(scan.wo[:, 0], scan.wo[:, 2]))
    peaked = measured(0.1 + (np.abs(signed - 30.0) < 0.5 * width - 0.25), scan)
    (found,) = peaks(peaked)
    assert (found.theta, found.step, found.count) == (30.0, pytest.approx(1.0), readings)
    assert ("may be narrower than the steps" in data_statements(peaked)[3]) == (readings < 3)


def test_what_the_shipped_readings_say():
    """Their own README: reciprocal to some percent, reflectances of 0.06 to 0.10."""
    steel = fits.read(COATINGS / "nite_on_blasted_steel1008_650nm_hemisphere.csv")
    assert 0.01 < reciprocity(steel).median < 0.05
    assert all(0.06 < one.share[0] / one.covered < 0.11 for one in energies(steel))
    paint = fits.read(COATINGS / "aeroglaze_650nm_inplane.csv")
    assert energies(paint) == []
    assert min(one.count for one in peaks(paint)) >= 3
    assert len(data_statements(paint)) == 5
    for data in (paint, steel):
        assert statement(data, "Sides") == statement(data, "Angles") == ""


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_no_peak_is_told_of_where_there_is_none(noise):
    flat = measured(0.2 * (1.0 + noise * np.random.default_rng(0).standard_normal(len(SCANS))), SCANS)
    assert "no peak stands out about the mirror direction" in statement(flat, "Sampling")
    assert not any(one.stands_out for one in peaks(flat))
    assert statement(flat, "Sides") == ""


@pytest.mark.parametrize("width", [4.0, 10.0])
def test_a_peak_on_the_side_of_the_light_is_told_of(width):
    """Azimuths that count from the mirror direction: what is read is mirrored."""
    right, turned = (
        measured(0.05 + np.exp(-(((SIGNED - sign * SCANS.theta_i) / width) ** 2)), SCANS) for sign in (1, -1)
    )
    assert "the brightest side is the light's: at 10° up to 1.05 there" in statement(turned, "Sides")
    assert "phi_o = phi_i + 180" in statement(turned, "Sides")
    assert "no peak stands out" in statement(turned, "Sampling")
    assert all(one.light > one.mirror for one in sides(turned))
    assert sides(turned.where((SIGNED > -6.0) & (np.abs(SIGNED - 8.0) > 8.0)).used()) == []  # nothing to compare
    one_side = turned.where(SIGNED < 1.0).used()
    assert "all measurements in the plane of incidence lie on the light's side" in statement(one_side, "Sides")
    assert statement(right.where(SIGNED > -1.0).used(), "Sides") == statement(right, "Sides") == ""
    assert "above half the height of the peak about the mirror direction" in statement(right, "Sampling")


@pytest.mark.parametrize(
    ("text", "highest"),
    [
        ("theta_i,theta_o,brdf\n0.5236,0.7854,1\n0.5236,-1.4,1\n", "1.4°"),
        ("theta_i,total_reflectance\n0.1396,0.3\n", "0.1396°"),
        ("theta_i,theta_o,brdf\n0,0,1\n", None),
        ("theta_i,theta_o,brdf\n0,2,1\n", None),
        ("theta_i,total_reflectance\n8,0.3\n", None),
    ],
)
def test_angles_in_radians_are_asked_about(reading, text, highest):
    said = f"Angles: none is above {highest}: are they radians? They were read as degrees."
    assert statement(reading(text), "Angles") == (said if highest else "")
