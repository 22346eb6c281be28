"""What readings say of themselves: of data whose answers are known, and of those that are shipped."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fits
from fits.data.checks import energies, peaks, reciprocity, repeats, sides, symmetry
from fits.data.measurements import Measurements
from fits.reports.data_summary import data_statements

SHIPPED = Path(__file__).parents[3] / "examples" / "arizona_black_coatings"
ANGLES = [10.0, 30.0, 50.0, 70.0]
HEMISPHERE = fits.slices(ANGLES, np.arange(-85.0, 86.0, 5.0), np.arange(0.0, 180.0, 10.0))


def data(values, geometry: fits.Geometry = HEMISPHERE, sigma: float | None = None) -> Measurements:
    """values: of (theta_i, theta_o, cosine of the angle between light and viewer)."""
    theta_i, theta_o = (np.degrees(np.arccos(w[:, 2])) for w in (geometry.wi, geometry.wo))
    found = values(theta_i, theta_o, np.sum(geometry.wi * geometry.wo, axis=-1))[:, None]
    everywhere = np.ones(len(found), bool)
    known = None if sigma is None else sigma * found
    return Measurements(geometry.wi, geometry.wo, found, known, everywhere, ("value",))


def test_reciprocal_readings_are() -> None:
    found = reciprocity(data(lambda i, o, between: 0.1 + 0.01 * np.cos(np.radians(i + o)) + 0.02 * between))
    # of each two incidences a pair at every azimuth in steps of 10
    assert found.count == 6 * 36
    assert found.p95 < 1e-9


def test_how_far_readings_are_from_reciprocal_is_told() -> None:
    """A factor of 1 + a x theta_i: pairs differ by a (i - o) over their mean."""
    readings = data(lambda i, o, between: 1.0 + 0.001 * i, sigma=0.01)
    found = reciprocity(readings)
    gaps = [abs(a - b) for a in ANGLES for b in ANGLES if a < b]
    means = [0.5 * (a + b) for a in ANGLES for b in ANGLES if a < b]
    expected = [0.001 * gap / (1.0 + 0.001 * mean) for gap, mean in zip(gaps, means, strict=True)]
    assert found.median == pytest.approx(np.median(expected), rel=1e-6)
    assert found.bias > 0.0  # steeper light is brighter
    squares = [
        (0.1 * gap) ** 2 / ((1.0 + 0.001 * (mean - 0.5 * gap)) ** 2 + (1.0 + 0.001 * (mean + 0.5 * gap)) ** 2)
        for gap, mean in zip(gaps, means, strict=True)
    ]
    assert found.z == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-6)


def test_energy_is_the_integral() -> None:
    """Of a Lambertian surface its albedo over what is covered: up to 85 degrees, sin^2 of it."""
    for one in energies(data(lambda i, o, between: np.full_like(i, 0.6 / np.pi))):
        assert one.covered == pytest.approx(np.sin(np.radians(85.0)) ** 2, rel=0.01)
        assert one.share[0] == pytest.approx(0.6 * one.covered, rel=1e-6)
    assert energies(data(lambda i, o, between: 1.0 + 0.0 * i, fits.slices(ANGLES))) == []
    half = fits.slices([30.0], np.arange(0.0, 86.0, 5.0), np.arange(0.0, 181.0, 10.0))
    too_much = data(lambda i, o, between: np.full_like(i, 1.2 / np.pi), half)
    (mirrored,) = energies(too_much)
    assert mirrored.covered > 0.95
    assert "It exceeds 1 at 30°" in " ".join(data_statements(too_much))


def test_sides_are_compared() -> None:
    assert symmetry(data(lambda i, o, between: 1.0 + between)).p95 < 1e-9
    whole = data(lambda i, o, between: np.ones_like(i))
    brushed = replace(whole, values=1.0 + 0.1 * np.sign(np.round(whole.wo[:, 1:2], 9)))
    assert symmetry(brushed).median == pytest.approx(0.2)
    assert symmetry(data(lambda i, o, between: np.ones_like(i), fits.slices(ANGLES))) is None


def test_repeats_tell_the_noise() -> None:
    once = data(lambda i, o, between: np.ones_like(i))
    noise = 1.0 + 0.02 * np.random.default_rng(0).standard_normal((2, *once.values.shape))
    twice = Measurements(
        np.concatenate([once.wi] * 2), np.concatenate([once.wo] * 2), np.concatenate(noise), None,
        np.ones(2 * len(once), bool), ("value",),
    )  # fmt: skip
    found = repeats(twice)
    assert found.count == len(once)
    # the median of |x - y| is 0.6745 sqrt(2) sigma, known to some percent
    assert found.median == pytest.approx(0.6745 * np.sqrt(2.0) * 0.02, rel=0.1)
    assert "a noise of about 2" in data_statements(twice)[-1]
    assert repeats(once) is None


@pytest.mark.parametrize(("width", "readings"), [(1.0, 1), (5.0, 5), (20.0, 19)])
def test_readings_in_the_peak_are_counted(width: float, readings: int) -> None:
    """Of a box as wide as `width` about the mirror direction, in steps of a degree."""
    scan = fits.slices([30.0], np.arange(-80.0, 81.0, 1.0))
    signed = np.degrees(np.arctan2(scan.wo[:, 0], scan.wo[:, 2]))
    peaked = data(lambda i, o, between: 0.1 + (np.abs(signed - 30.0) < 0.5 * width - 0.25), scan)
    (found,) = peaks(peaked)
    assert (found.theta, found.step, found.count) == (30.0, pytest.approx(1.0), readings)
    assert ("may be narrower than the steps" in data_statements(peaked)[3]) == (readings < 3)


def test_what_the_shipped_readings_say() -> None:
    """Their own README: reciprocal to some percent, reflectances of 0.06 to 0.10."""
    steel = fits.read(SHIPPED / "nite_on_blasted_steel1008_650nm_hemisphere.csv")
    assert 0.01 < reciprocity(steel).median < 0.05
    assert all(0.06 < one.share[0] / one.covered < 0.11 for one in energies(steel))
    paint = fits.read(SHIPPED / "aeroglaze_650nm_inplane.csv")
    assert energies(paint) == []
    assert min(one.count for one in peaks(paint)) >= 3
    assert len(data_statements(paint)) == 5
    assert not any(
        words.startswith(("Sides", "Angles")) for words in (*data_statements(paint), *data_statements(steel))
    )


SCANS = fits.slices(ANGLES)
SIGNED = np.degrees(np.arctan2(SCANS.wo[:, 0], SCANS.wo[:, 2]))


def statement(readings: Measurements, of: str) -> str:
    return " ".join(words for words in data_statements(readings) if words.startswith(f"{of}:"))


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_no_peak_is_told_of_where_there_is_none(noise: float) -> None:
    flat = 0.2 * (1.0 + noise * np.random.default_rng(0).standard_normal(len(SCANS)))
    readings = data(lambda i, o, between: flat, SCANS)
    assert "no peak stands out about the mirror direction" in statement(readings, "Sampling")
    assert not any(one.stands_out for one in peaks(readings))
    assert statement(readings, "Sides") == ""


@pytest.mark.parametrize("width", [4.0, 10.0])
def test_a_peak_on_the_side_of_the_light_is_told_of(width: float) -> None:
    """Azimuths that count from the mirror direction: what is read is mirrored."""

    def lobe(sign: float) -> Measurements:
        return data(lambda i, o, between: 0.05 + np.exp(-(((SIGNED - sign * i) / width) ** 2)), SCANS)

    turned = lobe(-1.0)
    assert "the brightest side is the light's: at 10° up to 1.05 there" in statement(turned, "Sides")
    assert "phi_o = phi_i + 180" in statement(turned, "Sides")
    assert "no peak stands out" in statement(turned, "Sampling")
    assert all(one.light > one.mirror for one in sides(turned))
    assert sides(turned.where((SIGNED > -6.0) & (np.abs(SIGNED - 8.0) > 8.0)).used()) == []  # nothing to compare
    one_side = turned.where(SIGNED < 1.0).used()
    assert "all measurements in the plane of incidence lie on the light's side" in statement(one_side, "Sides")
    assert statement(lobe(1.0).where(SIGNED > -1.0).used(), "Sides") == ""
    assert statement(lobe(1.0), "Sides") == ""
    assert "above half the height of the peak about the mirror direction" in statement(lobe(1.0), "Sampling")


def test_angles_in_radians_are_asked_about(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("theta_i,theta_o,brdf\n0.5236,0.7854,1\n0.5236,-1.4,1\n")
    assert statement(fits.read(path), "Angles") == (
        "Angles: none is above 1.4°: are they radians? They were read as degrees."
    )
    path.write_text("theta_i,total_reflectance\n0.1396,0.3\n")
    assert "none is above 0.1396°: are they radians?" in statement(fits.read(path), "Angles")
    for text in (
        "theta_i,theta_o,brdf\n0,0,1\n",
        "theta_i,theta_o,brdf\n0,2,1\n",
        "theta_i,total_reflectance\n8,0.3\n",
    ):
        path.write_text(text)
        assert statement(fits.read(path), "Angles") == ""
