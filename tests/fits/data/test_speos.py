"""Speos tables: a file of Speos' own, and files written from formulas."""

import numpy as np
import pytest

from fits.data.reading import read
from tests.helpers.places import STORED
from tests.helpers.refusals import refuses

GAUSSIAN = STORED / "gaussian_fresnel_30.anisotropicbsdf"
THETA, PHI = np.linspace(0, 90, 31), np.linspace(0, 360, 25)


def lobe(incidence, theta, phi):
    """About the direction (incidence, 20 degrees off the plane): no mirror symmetry."""
    t, p, i = np.radians(theta), np.radians(phi - 20.0), np.radians(incidence)
    return 0.05 + 0.2 * np.exp(-8 * (1 - np.sin(t) * np.cos(p) * np.sin(i) - abs(np.cos(t)) * np.cos(i)))


def table(theta, values, phi=PHI):
    rows = np.broadcast_to(values, (len(theta), len(phi))).tolist()
    body = "".join(f"{t}\t" + "\t".join(map(repr, row)) + "\n" for t, row in zip(theta.tolist(), rows, strict=True))
    return f"{len(theta)} {len(phi)}\n\t" + "\t".join(map(str, phi.tolist())) + f"\n{body}"


def anisotropic(tables, spectrum="10\t0\nwhite\n1\n550\t25\n", rotations="0", incidences="10"):
    """A file of BSDFs, its text in a Latin alphabet."""
    turns, angles = rotations.split(), incidences.split()
    counted = f"{len(turns)}\n{rotations}\n" + f"{len(angles)}\n{incidences}\n" * len(turns)
    head = "OPTIS - Anisotropic BSDF surface file v8.0\n0\na comment\n11\ntwo\nlines è\n0\t1\t0\n1\t0\n"
    return f"{head}1\n{counted}{spectrum}{tables}End of file\n".encode("latin-1")


def share(data, which):
    """The integral over the hemisphere of f |cos theta|, by a fine rule in theta over values looked up in the grid."""
    theta = np.unique(data.theta_o[which].round(6))
    turns = [data.values[which & (abs(data.theta_o - t) < 1e-5), 0].mean() for t in theta]
    fine = np.radians(np.linspace(theta[0], theta[-1], 20001))
    f = np.interp(fine, np.radians(theta), turns)
    return float(2 * np.pi * np.trapezoid(f * abs(np.cos(fine)) * np.sin(fine), fine))


def test_a_file_of_speos():
    data = read(GAUSSIAN)
    np.testing.assert_allclose(data.theta_i, 30)
    np.testing.assert_allclose(data.phi_i, 180)
    for sign, theta in ((1, 30.0), (-1, 180 - np.degrees(np.arcsin(0.5 / 1.5)))):
        # a Gaussian of intensity about that direction
        peak = np.argmax(data.values[:, 0] * np.maximum(sign * data.wo[:, 2], 0) * data.mask)
        assert data.theta_o[peak] == pytest.approx(theta, abs=1.0)
        assert data.phi_o[peak] == 0
    refuses("quantity is 'brdf', this speos file says 'brdf_cos'", read, GAUSSIAN, quantity="brdf")
    # 4 % above and 95 % below at perpendicular incidence, and here at 30 degrees: integrals of the intensities
    lines = GAUSSIAN.read_text().splitlines()
    starts = [number for number, line in enumerate(lines) if line == "41 95"]
    for start, stated, theta in zip(starts, (0.04, 0.95), (30, 160), strict=True):
        phi, rows = np.loadtxt(lines[start + 1 : start + 2]), np.loadtxt(lines[start + 2 : start + 43])
        polar = np.radians(rows[:, 0])
        found = np.trapezoid(np.trapezoid(rows[:, 1:], np.radians(phi), axis=1) * np.sin(polar), polar)
        assert found == pytest.approx(stated, rel=0.06)
        at = rows[rows[:, 0] == theta, 1][0] * stated / found / abs(np.cos(np.radians(theta)))
        here = (abs(data.theta_o - theta) < 1e-6) & (data.phi_o == 0)
        np.testing.assert_allclose(data.values[here, 0], at, rtol=1e-2)  # trapezoids of a product, here


def test_anisotropic_by_formula(reading):
    """Two rotations and incidences; the one factor is that of the incidence at which the spectrum was measured."""
    places = [(rotation, incidence) for rotation in (0.0, 30.0) for incidence in (10.0, 50.0)]
    tables = "".join(table(THETA, 100 * (1 + turn) * lobe(i, THETA[:, None], PHI)) for turn, i in places)
    data = reading(anisotropic(tables, "10\t0\nwhite\n2\n400\t30\n700\t60\n", "0 30", "10 50"))
    assert data.channels == ("400 nm", "700 nm")
    np.testing.assert_allclose(data.values[:, 1], 2 * data.values[:, 0])
    assert sorted(set(data.phi_i)) == [150, 180]
    assert share(data, (data.phi_i == 180) & (abs(data.theta_i - 10) < 1e-6)) == pytest.approx(0.3, rel=1e-3)
    # relative to the light's travel, values are those of the formula, whatever the rotation
    for turn, incidence in places:
        here = (data.phi_i == 180 - turn) & (abs(data.theta_i - incidence) < 1e-6)
        here &= data.theta_o > 0  # at the normal the file has no azimuth
        ratio = data.values[here, 0] / lobe(incidence, data.theta_o[here], data.phi_o[here] + turn) / (1 + turn)
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-6)


def test_azimuths_may_be_left_to_symmetry(reading):
    for phi in (np.array([0.0]), np.linspace(0, 180, 7), np.linspace(0, 345, 24), PHI):
        data = reading(anisotropic(table(THETA, 3.0, phi), "0\t0\n\n1\n550\t20\n"))
        np.testing.assert_allclose(data.values, 0.2 / np.pi, rtol=1e-5)  # linear between nodes 3 degrees apart


def test_isotropic_by_formula(reading):
    """Each table is scaled to its own percentage; sides are told by the polar angles."""
    text = "OPTIS - brdf surface file v9.0\n0\nScattering surface\n0\n\n1\t1\n1\n2\t2\n5 40\n450 650\n"
    shares = {(sign, i, w): 13 + 10 * w + i / 10 - 1.5 * sign for sign in (1, -1) for i in (5, 40) for w in (0, 1)}
    for (sign, i, _), percentage in shares.items():
        theta = THETA + 90 * (sign < 0)
        text += f"{percentage}\n{table(theta, lobe(i, theta[:, None], PHI))}"
    data = reading(text)
    np.testing.assert_array_equal(reading(f"{text}End of file\n").values, data.values)
    assert data.channels == ("450 nm", "650 nm")
    for (sign, i, w), percentage in shares.items():
        here = (abs(data.theta_i - i) < 1e-6) & (sign * data.wo[:, 2] > 1e-9)
        assert share(data.of_channels([data.channels[w]]), here) == pytest.approx(percentage / 100, rel=5e-3)
    assert (data.phi_i == 180).all()
    peak = np.argmax(data.values[:, 0] * (abs(data.theta_i - 40) < 1e-6) * (data.wo[:, 2] > 0))
    assert (data.theta_o[peak], data.phi_o[peak]) == (pytest.approx(39), pytest.approx(15))


def test_a_long_spectrum_may_stand_for_more_than_there_is_room_for(reading):
    """A small file: all values of its tables at each of 30,000 wavelengths would be 23 million."""
    spectrum = "10\t0\nwhite\n30000\n" + "".join(f"{400 + 0.01 * k:.2f} {20 + k % 7}\n" for k in range(30_000))
    text = anisotropic(table(THETA, lobe(10.0, THETA[:, None], PHI)), spectrum)
    refuses("30000 channels are 23,250,000 numbers, must be 20,000,000", reading, text)
