"""pab's goniophotometer texts: the example of Radiance's manual, its own reader, and errors."""

import subprocess
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from fits.data.geometry import direction, slices
from fits.data.reading import read
from tests.helpers import data_files

MANUAL = """#sample_name "a sample"
#incident_angle 82.5 180
#format: theta phi DSF
84.968 125.790 0.009744
84.889 125.610 0.007737
84.805 125.427 0.008569
"""


_file = partial(data_files.written, name="a.dat")


def test_the_example_of_the_manual(tmp_path: Path) -> None:
    data = read(_file(tmp_path, MANUAL))
    assert (data.source.format, data.source.quantity) == ("pab", "brdf_cos")
    np.testing.assert_allclose(data.wi, np.tile(direction(82.5, 180), (3, 1)))
    np.testing.assert_allclose(data.wo[0], direction(84.968, 125.79))
    np.testing.assert_allclose(data.values[0, 0], 0.009744 / np.cos(np.radians(84.968)))
    again = MANUAL.replace("#incident_angle 82.5 180", "#intheta 82.5\n#inphi 180\n#upphi 90\n#colorimetry: CIE-Y")
    same = read(_file(tmp_path, again))
    np.testing.assert_array_equal(same.values, data.values)
    assert "up is at phi 90" in same.source.notes[-1]


def test_bsdfs_and_colours(tmp_path: Path) -> None:
    text = "#format: theta phi BTDF\n#incident_angle 20 0\n#colorimetry: CIE-XYZ\n150 180 1 2 3\n90 0 1 1 1\n"
    data = read(_file(tmp_path, text))
    assert data.channels == ("X", "Y", "Z")
    np.testing.assert_array_equal(data.values[0], [1, 2, 3])
    assert data.wo[0, 2] < 0
    np.testing.assert_array_equal(data.mask, [True, False])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("DSF", "energy"), "line 3: format is 'theta phi energy'"),
        (("theta phi DSF", "theta phi"), "line 3: format is 'theta phi'"),
        (("#incident_angle 82.5 180\n", ""), "no #incident_angle, nor #intheta and #inphi"),
        (("82.5 180", "82.5"), "line 2: incident_angle must be followed by theta and phi, found 1 word"),
        (("82.5 180", "200 180"), "line 2, column 'theta': 200 is not allowed"),
        (("0.007737", ""), "line 5: 2 numbers, must be 3"),
        (("0.007737", "inf"), "line 5, column 3: inf is not allowed"),
        (("84.889", "284.889"), "line 5, column 'theta': 284.889 is not allowed"),
        (('#sample_name "a sample"', "#colorimetry: RGB"), "line 1: colorimetry is 'RGB'"),
    ],
)
def test_bad_files(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    assert change[0] in MANUAL
    with pytest.raises(ValueError, match=message) as error:
        read(_file(tmp_path, MANUAL.replace(*change)), format="pab")
    assert "a.dat" in str(error.value)


@pytest.mark.peers
def test_radiance_takes_the_azimuths_as_we_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A lobe off the plane of incidence, by `pabopto2bsdf` and `bsdf2ttree`, lies where our reading of the file is."""
    pyradiance = pytest.importorskip("pyradiance")
    root = Path(pyradiance.__file__).parent
    if not (root / "bin" / "pabopto2bsdf").exists():
        pytest.skip("no pabopto2bsdf")
    monkeypatch.setenv("PATH", f"{root / 'bin'}:/usr/bin:/bin")
    monkeypatch.setenv("RAYPATH", str(root / "lib"))
    names = []
    for theta in (0.0, 20.0, 40.0, 60.0):  # the same azimuth: isotropic
        geometry = slices([theta], np.arange(0, 85, 2.5), list(np.arange(0, 360, 10.0)))
        peak = direction(theta, 180 + 30)
        value = 0.05 + 2.0 * np.exp(-20 * (1 - geometry.wo @ peak))
        rows = np.stack([geometry.theta_o, geometry.phi_o, value], axis=-1)
        head = f"#incident_angle {theta} 0\n#format: theta phi BSDF\n#upphi 90\n"
        body = "\n".join(" ".join(f"{number:.6g}" for number in row) for row in rows)
        names.append(str(_file(tmp_path, f"{head}{body}\n", name=f"{theta:g}.dat")))
    found = subprocess.run(["pabopto2bsdf", "-s", "i", *names], check=True, capture_output=True).stdout
    (tmp_path / "a.sir").write_bytes(found)
    made = subprocess.run(["bsdf2ttree", "-g", "5", str(tmp_path / "a.sir")], check=True, capture_output=True)
    theirs = read(_file(tmp_path, made.stdout.decode(), name="a.xml"))
    ours = read(tmp_path / "40.dat")

    def off_plane(data) -> float:
        """Azimuth of the mean direction of the lobe, from where the light travels."""
        near = (abs(data.theta_i % 180 - (40 if data is ours else 140)) < 6) & (data.values[:, 0] > 0.5)
        azimuth = np.radians(data.phi_o[near] - data.phi_i[near] - 180)
        return float(np.degrees(np.angle(np.sum(data.values[near, 0] * np.exp(1j * azimuth)))))

    assert off_plane(ours) == pytest.approx(30, abs=1)
    # its z points to the room, to WINDOW's back: turned over, azimuths run the other way
    assert set(np.sign(theirs.wi[:, 2])) == {-1}
    assert off_plane(theirs) == pytest.approx(-30, abs=2)  # it fits a sum of Gaussians, in boxes of 4 degrees and more
