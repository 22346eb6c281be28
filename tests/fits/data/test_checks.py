"""What measurements say of themselves: of data whose answers are known."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

import fits
from fits.reports.data_summary import data_statements, energies, reciprocity, repeats, sides
from tests.helpers.models import along

ANGLES = [10.0, 30.0, 50.0, 70.0]
HEMISPHERE = fits.slices(ANGLES, np.arange(-85.0, 86.0, 5.0), np.arange(0.0, 180.0, 10.0))
SCANS = fits.slices(ANGLES)
SIGNED = np.degrees(np.arctan2(SCANS.wo[:, 0], SCANS.wo[:, 2]))


def measured(values, geometry=HEMISPHERE) -> fits.Measurements:
    return along(geometry, np.broadcast_to(values, len(geometry))[:, None])


def statement(data: fits.Measurements, of: str) -> str:
    return " ".join(words for words in data_statements(data) if words.startswith(f"{of}:"))


def test_how_far_measurements_are_from_reciprocal() -> None:
    between = np.sum(HEMISPHERE.wi * HEMISPHERE.wo, axis=1)
    together = np.cos(np.radians(HEMISPHERE.theta_i + HEMISPHERE.theta_o))
    found = reciprocity(measured(0.1 + 0.01 * together + 0.02 * between))
    assert found.number == 6 * 36  # of each two incidences a pair at every azimuth in steps of 10
    assert found.p95 < 1e-9
    # a factor of 1 + a theta_i: pairs differ by a (i - o) over their mean
    found = reciprocity(measured(1.0 + 0.001 * HEMISPHERE.theta_i))
    low, high = 1.0 + 0.001 * np.array(list(combinations(ANGLES, 2))).T
    assert found.median == pytest.approx(np.median((high - low) / (0.5 * (low + high))), rel=1e-6)


def test_energy_is_the_integral() -> None:
    """Of a Lambertian surface its albedo over what is covered: up to 85 degrees, sin^2 of it."""
    half = fits.slices([30.0], np.arange(0.0, 86.0, 5.0), np.arange(0.0, 181.0, 10.0))
    too_much = measured(1.2 / np.pi, half)  # the other half is its mirror image
    for one in (*energies(measured(1.2 / np.pi)), *energies(too_much)):
        assert one.covered == pytest.approx(np.sin(np.radians(85.0)) ** 2, rel=0.01)
        assert one.share[0] == pytest.approx(1.2 * one.covered, rel=1e-6)
    assert energies(measured(1.0, SCANS)) == []
    assert "It exceeds 1 at 30°" in statement(too_much, "Energy")


def test_repeats_tell_the_noise() -> None:
    once = measured(1.0)
    assert repeats(once) is None
    noise = 1.0 + 0.02 * np.random.default_rng(0).standard_normal((2, len(once), 1))
    both = {name: np.concatenate([getattr(once, name)] * 2) for name in ("wi", "wo", "mask")}
    found = repeats(twice := replace(once, values=np.concatenate(noise), **both))
    assert found.number == len(once)
    # the median of |x - y| is 0.6745 sqrt(2) sigma, known to some percent
    assert found.median == pytest.approx(0.6745 * np.sqrt(2.0) * 0.02, rel=0.1)
    assert "a noise of about 2" in data_statements(twice)[-1]


def test_a_peak_on_the_side_of_the_light_is_told_of() -> None:
    """Azimuths that count from the mirror direction: what is read is mirrored."""
    peaks = ((SIGNED - sign * SCANS.theta_i) / 8.0 for sign in (1, -1))
    right, turned = (measured(0.05 + np.exp(-(peak**2)), SCANS) for peak in peaks)
    assert "the brightest side is the light's: at 10° up to 1.05 there" in statement(turned, "Sides")
    assert "phi_o = phi_i + 180" in statement(turned, "Sides")
    one_side = turned.where(SIGNED < 1.0).used()
    assert "all measurements in the plane of incidence lie on the light's side" in statement(one_side, "Sides")
    assert statement(right.where(SIGNED > -1.0).used(), "Sides") == statement(right, "Sides") == ""
    assert not len(sides(turned.where((SIGNED > -6.0) & (np.abs(SIGNED - 8.0) > 8.0)).used()))  # nothing to compare


def test_angles_in_radians_are_asked_about(reading) -> None:
    said = "Angles: none is above {}: are they radians? They were read as degrees."
    for text, expected in (
        ("theta_i,theta_o,brdf\n0.5236,0.7854,1\n0.5236,-1.4,1\n", said.format("1.4°")),
        ("theta_i,total_reflectance\n0.1396,0.3\n", said.format("0.1396°")),
        ("theta_i,theta_o,brdf\n0,0,1\n", ""),
        ("theta_i,theta_o,brdf\n0,2,1\n", ""),
    ):
        assert statement(reading(text), "Angles") == expected
