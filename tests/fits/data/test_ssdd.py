"""SSDD files: all coordinates, blocks, colours and binary numbers."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fits.data.geometry import direction

BLOCK = """DATA_TYPE {kind}
COLOR_MODEL {colour}
PARAM_TYPE {system}_coordinate_system
PARAM0_LIST {incidences}
PARAM2_LIST 0 20 60
PARAM3_LIST 0 90 200
{more}DATA {mode}
"""
NUMBERS = "\n".join(map(str, range(18))) + "\n"  # PARAM0 runs fastest


def block(kind="brdf", system="spherical", more="", colour="monochrome", mode="ascii", incidences="10 40"):
    said = {"kind": kind, "system": system, "more": more, "colour": colour, "mode": mode}
    return BLOCK.format(**said, incidences=incidences)


def test_spherical(reading):
    data = reading(f"VERSION 0.2\n\n{block()}# a comment\n{NUMBERS}")
    number = {float(value): row for row, value in enumerate(data.values[:, 0])}
    np.testing.assert_allclose(data.wi[number[1]], direction(40, 0), atol=1e-15)
    outgoing = [data.wo[number[value]] for value in (2, 8, 17)]
    np.testing.assert_allclose(outgoing, direction([20, 20, 60], [0, 90, 200]), atol=1e-15)


@pytest.mark.parametrize(
    ("system", "count"),
    [
        ("spherical", 9),  # of each of three directions of the light: the pole, and two azimuths
        ("specular", 10),  # light along the normal: its azimuth and the viewer's add up to 0, 90, 180
    ],
)
def test_directions_that_a_file_repeats_are_read_once(reading, system, count):
    lists = "PARAM0_LIST 0 30\nPARAM1_LIST 0 90 360\nPARAM2_LIST 0 20\nPARAM3_LIST 0 90 360\n"
    head = f"VERSION 0.3\nDATA_TYPE brdf\nCOLOR_MODEL monochrome\nPARAM_TYPE {system}_coordinate_system\n"
    data = reading(f"{head}{lists}DATA ascii\n" + "\n".join(map(str, range(36))))
    pairs = np.round(np.hstack([data.wi, data.wo]), 9) + 0.0
    assert len(np.unique(pairs, axis=0)) == len(data) == count
    assert data.values.max() < 24  # the first of them: none of the azimuth 360
    assert f"skipped: {36 - count} values at directions that the file holds already" in data.source.notes


@pytest.mark.parametrize("kind", ["brdf", "btdf"])
def test_around_the_mirror_direction(reading, kind):
    """Angles from the specular direction, and of a BTDF from where it bends by an offset."""
    bent = kind == "btdf"
    offsets = "PARAM4_LIST 0 -12.5\n" if bent else ""
    data = reading(f"VERSION 0.3\n{block(kind, 'specular', offsets)}{NUMBERS}")
    side, bend = np.array([1, 1, -1 if bent else 1]), 12.5 * bent
    for light, theta in ((10, 10), (40, 40 - bend)):
        here = abs(data.theta_i - light) < 1e-9
        away = np.degrees(np.arccos(np.clip(data.wo[here] @ (direction(theta, 180) * side), -1, 1)))
        place = data.values[here, 0].astype(int) // 2  # which of param 2 and 3
        np.testing.assert_allclose(away, np.tile([0.0, 20.0, 60.0], 3)[place], atol=1e-6)
    # azimuth 0 leads towards the normal, azimuth 90 to +y
    first = data.wo[data.values[:, 0] == 3][0]  # light at 40, 20 degrees away, azimuth 0
    np.testing.assert_allclose(first, direction(20 - bend, 180) * side, atol=1e-12)
    assert data.wo[data.values[:, 0] == 9][0, 1] == pytest.approx(np.sin(np.radians(20)))


def test_half_vectors(reading):
    data = reading(f"VERSION 0.3\n{block(system='half_difference')}{NUMBERS}")
    for wi, wo, value in zip(data.wi, data.wo, data.values[:, 0].astype(int), strict=True):
        half = (wi + wo) / np.linalg.norm(wi + wo)
        theta_h, theta_d, phi_d = (10, 40)[value % 2], (0, 20, 60)[value // 2 % 3], (0, 90, 200)[value // 6]
        np.testing.assert_allclose(half, direction(theta_h, 0), atol=1e-12)
        local = Rotation.from_euler("y", -theta_h, degrees=True).apply(wi.copy())  # towards x is positive
        np.testing.assert_allclose(local, direction(theta_d, phi_d), atol=1e-12)
    assert "skipped" in " ".join(data.source.notes)  # some lie below the horizon


def test_blocks_colours_and_binary(reading):
    numbers = np.random.default_rng(0).random((2, 18, 3)).astype("<f4")
    spectrum = {"colour": "spectrum", "more": "WAVELENGTH_LIST 400 500 600\n", "mode": "binary"}
    heads = [block(kind, **spectrum).encode() for kind in ("brdf", "btdf")]
    blocks = [head + part.tobytes() + b"\n" for head, part in zip(heads, numbers, strict=True)]
    mirror = b"DATA_TYPE specular_reflectance\nCOLOR_MODEL monochrome\nPARAM0_LIST 0 90\nDATA ascii\n0.05\n1\n"
    data = reading(b"VERSION 0.3\n\nAPI libbsdf\n" + blocks[0] + mirror + blocks[1])
    assert data.channels == ("400 nm", "500 nm", "600 nm")
    once = np.r_[0:6, 8:12, 14:18]  # at PARAM2 = 0 all azimuths are one direction
    np.testing.assert_array_equal(data.values, numbers[:, once].reshape(-1, 3).astype(float))
    np.testing.assert_array_equal(np.sign(data.wo[:, 2]), np.repeat([1, -1], 14))
    assert "skipped: specular_reflectance" in data.source.notes
    for wrong, message in (
        (b"abc", r"line 9: 3 bytes of data, must be 216 \(truncated\?\)"),
        ((numbers[0] * np.nan).tobytes(), "line 9: the data hold nan, must be finite"),
    ):
        with pytest.raises(ValueError, match=message):
            reading(b"VERSION 0.3\n" + heads[0] + wrong)
