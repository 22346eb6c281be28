"""Speos tables: a file of Speos' own, files written from formulas, and errors."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from fits.data.geometry import Floats
from fits.data.reading import read
from tests.helpers.places import ROOT

GAUSSIAN = ROOT / "tests" / "data" / "gaussian_fresnel_30.anisotropicbsdf"
THETA, PHI = np.linspace(0, 90, 31), np.linspace(0, 360, 25)
BELOW = np.linspace(90, 180, 31)


def _lobe(incidence: float, theta: Floats, phi: Floats) -> Floats:
    """About the direction (incidence, 20 degrees off the plane): no mirror symmetry."""
    t, p, i = np.radians(theta)[:, None], np.radians(phi - 20.0)[None], np.radians(incidence)
    facing = np.sin(t) * np.cos(p) * np.sin(i) + abs(np.cos(t)) * np.cos(i)
    return np.asarray(0.05 + 0.2 * np.exp(-8 * (1 - facing)))


def _table(theta: Floats, phi: Floats, values: Floats) -> str:
    body = "\n".join(
        f"{t}\t" + "\t".join(map(repr, row)) for t, row in zip(theta.tolist(), values.tolist(), strict=True)
    )
    return f"{len(theta)} {len(phi)}\n\t" + "\t".join(map(str, phi.tolist())) + f"\n{body}\n"


def _anisotropic(rotations: list[float], incidences: list[float], spectrum: str, tables: str, kind: int = 1) -> str:
    counted = f"{len(incidences)}\n{' '.join(map(str, incidences))}\n"
    return (
        f"OPTIS - Anisotropic BSDF surface file v8.0\n0\na comment\n11\ntwo\nlines è\n0\t1\t0\n1\t0\n{kind}\n"
        f"{len(rotations)}\n{' '.join(map(str, rotations))}\n{counted * len(rotations)}{spectrum}{tables}End of file\n"
    )


def _file(tmp_path: Path, text: str, name: str = "x.anisotropicbsdf") -> Path:
    path = tmp_path / name
    path.write_bytes(text.encode("latin-1"))
    return path


def _share(data, which) -> float:
    """The integral over the hemisphere of f |cos theta|, by Gauss' rule in theta over values looked up in the grid."""
    theta = np.unique(data.theta_o[which].round(6))
    turns = [data.values[which & (abs(data.theta_o - t) < 1e-5), 0].mean() for t in theta]
    fine = np.radians(np.linspace(theta[0], theta[-1], 20001))
    f = np.interp(fine, np.radians(theta), turns)
    return float(2 * np.pi * np.trapezoid(f * abs(np.cos(fine)) * np.sin(fine), fine))


def test_a_file_of_speos() -> None:
    """Peaks at the mirror direction and, refracted by an index of 1.5, below; shares are what the file states."""
    data = read(GAUSSIAN)
    assert data.source.format == "speos"
    np.testing.assert_allclose(data.theta_i, 30)
    np.testing.assert_allclose(data.phi_i, 180)
    for side, theta in ((data.wo[:, 2] > 1e-6, 30.0), (data.wo[:, 2] < -1e-6, 180 - np.degrees(np.arcsin(0.5 / 1.5)))):
        side &= data.mask
        lobe = data.values[:, 0] * abs(data.wo[:, 2])  # a Gaussian of intensity about that direction
        peak = np.argmax(np.where(side, lobe, 0))
        assert data.theta_o[peak] == pytest.approx(theta, abs=1.0)
        assert data.phi_o[peak] == 0


def test_a_file_of_speos_holds_the_shares_that_it_states() -> None:
    """4 % above and 95 % below at perpendicular incidence, and here at 30 degrees: integrals of the intensities."""
    lines = GAUSSIAN.read_text().splitlines()
    data = read(GAUSSIAN)
    starts = [number for number, line in enumerate(lines) if line == "41 95"]
    for start, stated, theta in zip(starts, (0.04, 0.95), (30, 160), strict=True):
        phi, table = np.loadtxt(lines[start + 1 : start + 2]), np.loadtxt(lines[start + 2 : start + 43])
        polar = np.radians(table[:, 0])
        share = np.trapezoid(np.trapezoid(table[:, 1:], np.radians(phi), axis=1) * np.sin(polar), polar)
        assert share == pytest.approx(stated, rel=0.06)
        at = table[table[:, 0] == theta, 1][0] * stated / share / abs(np.cos(np.radians(theta)))
        here = (abs(data.theta_o - theta) < 1e-6) & (data.phi_o == 0)
        np.testing.assert_allclose(data.values[here, 0], at, rtol=1e-2)  # trapezoids of a product, here


def test_anisotropic_by_formula(tmp_path: Path) -> None:
    """Two rotations and incidences; the one factor is that of the incidence at which the spectrum was measured."""
    rotations, incidences = [0.0, 30.0], [10.0, 50.0]
    tables = "".join(
        _table(THETA, PHI, 100 * (1 + rotation) * _lobe(i, THETA, PHI)) for rotation in rotations for i in incidences
    )
    path = _file(tmp_path, _anisotropic(rotations, incidences, "10\t0\nwhite\n2\n400\t30\n700\t60\n", tables))
    data = read(path)
    assert data.channels == ("400 nm", "700 nm")
    np.testing.assert_allclose(data.values[:, 1], 2 * data.values[:, 0])
    assert sorted(set(data.phi_i)) == [150, 180]
    first = (data.phi_i == 180) & (abs(data.theta_i - 10) < 1e-6)
    assert _share(data, first) == pytest.approx(0.3, rel=1e-3)
    # relative to the light's travel, values are those of the formula, whatever the rotation
    for rotation in rotations:
        for incidence in incidences:
            here = (data.phi_i == 180 - rotation) & (abs(data.theta_i - incidence) < 1e-6)
            phi = data.phi_o[here] + rotation
            true = np.array(
                [
                    _lobe(incidence, np.array([t]), np.array([p]))[0, 0]
                    for t, p in zip(data.theta_o[here], phi, strict=True)
                ]
            )
            ratio = data.values[here, 0] / (true * (1 + rotation))
            tilted = data.theta_o[here] > 0  # at the normal the file has no azimuth
            np.testing.assert_allclose(ratio[tilted], ratio[tilted][0], rtol=1e-6)


def test_intensities_are_divided_by_the_cosine(tmp_path: Path) -> None:
    f = _lobe(10.0, THETA, PHI)
    spectrum = "10\t0\nwhite\n1\n550\t25\n"
    plain = read(_file(tmp_path, _anisotropic([0.0], [10.0], spectrum, _table(THETA, PHI, f))))
    cosine = np.cos(np.radians(THETA))[:, None]
    other = read(_file(tmp_path, _anisotropic([0.0], [10.0], spectrum, _table(THETA, PHI, 7 * f * cosine), 0)))
    assert other.source.quantity == "brdf_cos"
    assert (~other.mask).sum() == len(PHI) - 1
    np.testing.assert_allclose(other.values[other.mask], plain.values[other.mask], rtol=2e-3)  # shares between nodes


@pytest.mark.parametrize("phi", [np.array([0.0]), np.linspace(0, 180, 7), np.linspace(0, 345, 24), PHI])
def test_azimuths_may_be_left_to_symmetry(tmp_path: Path, phi: Floats) -> None:
    """A Lambertian of 20 %: 0.2 / pi whatever part of the turn there is."""
    table = _table(THETA, phi, np.full((len(THETA), len(phi)), 3.0))
    data = read(_file(tmp_path, _anisotropic([0.0], [10.0], "0\t0\n\n1\n550\t20\n", table)))
    np.testing.assert_allclose(data.values, 0.2 / np.pi, rtol=1e-5)  # linear in theta between nodes 3 degrees apart


def test_isotropic_by_formula(tmp_path: Path) -> None:
    """Each table is scaled to its own percentage; sides are told by the polar angles."""
    head = "OPTIS - brdf surface file v9.0\n0\nScattering surface\n0\n\n1\t1\n1\n2\t2\n5 40\n450 650\n"
    shares = {
        (side, i, w): 10.0 * (1 + w) + i / 10 + (3 if side else 0) for side in (0, 1) for i in (5, 40) for w in (0, 1)
    }
    tables = "".join(
        f"{share}\n{_table(BELOW if side else THETA, PHI, _lobe(i, BELOW if side else THETA, PHI))}"
        for (side, i, _), share in shares.items()
    )
    data = read(_file(tmp_path, head + tables, "x.brdf"))
    ended = read(_file(tmp_path, f"{head}{tables}End of file\n", "y.brdf"))
    np.testing.assert_array_equal(ended.values, data.values)
    assert data.channels == ("450 nm", "650 nm")
    for (side, i, w), share in shares.items():
        here = (abs(data.theta_i - i) < 1e-6) & (data.wo[:, 2] < -1e-9 if side else data.wo[:, 2] > 1e-9)
        assert _share(data.of_channels([data.channels[w]]), here) == pytest.approx(share / 100, rel=5e-3)
    assert (data.phi_i == 180).all()
    here = (abs(data.theta_i - 40) < 1e-6) & (data.wo[:, 2] > 0)
    peak = np.argmax(np.where(here, data.values[:, 0], 0))
    assert (data.theta_o[peak], data.phi_o[peak]) == (pytest.approx(39), pytest.approx(15))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("v8.0\n0", "v8.0\n1"), "line 2: a binary file, which has no reader here"),
        (("v8.0\n0", "v8.0\n2"), "line 2: must be 0 for text, or 1 for binary"),
        (("Anisotropic BSDF", "Something"), "the title is"),
        (("1\t0\n1\n", "0\t0\n1\n"), "line 8: neither reflection nor transmission"),
        (("1\n10.0", "1\n95.0"), "line 13, column 1: 95.0 is not allowed"),
        (("End of file", "1 2 3"), "'1 2 3' found after the last table"),
        (("90.0\t0.", "90.0\tx0."), "is not a number"),
        (("\n87.0\t", "\n95.0\t"), "angles of this table do not rise"),
        (("31 25", "31 26"), "must be 26"),
        (("31 25", "32 25"), "1 number|3 number|the file ends|numbers?, must be 26"),
    ],
)
def test_bad_files(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    text = _anisotropic([0.0], [10.0], "10\t0\nwhite\n1\n550\t25\n", _table(THETA, PHI, _lobe(10.0, THETA, PHI)))
    assert change[0] in text
    with pytest.raises(ValueError, match=message) as error:
        read(_file(tmp_path, text.replace(*change)))
    assert "x.anisotropicbsdf" in str(error.value)


def test_speos_says_what_it_holds(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="quantity is 'brdf', this speos file says 'brdf_cos'"):
        read(GAUSSIAN, quantity="brdf")


def test_a_long_spectrum_may_stand_for_more_than_there_is_room_for(tmp_path: Path) -> None:
    """A small file: all values of its tables at each of 30,000 wavelengths would be 23 million."""
    spectrum = "10\t0\nwhite\n30000\n" + "".join(f"{400 + 0.01 * k:.2f} {20 + k % 7}\n" for k in range(30_000))
    path = _file(tmp_path, _anisotropic([0.0], [10.0], spectrum, _table(THETA, PHI, _lobe(10.0, THETA, PHI))))
    tracemalloc.start()
    with pytest.raises(
        ValueError, match=r"775 data points of 30000 channels are 23,250,000 numbers, must be 20,000,000 at"
    ):
        read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6
