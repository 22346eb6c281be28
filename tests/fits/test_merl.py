"""MERL tables: a synthetic file, written from a formula in the half and difference angles, is looked up again."""

from pathlib import Path

import numpy as np
import pytest

from fits.formats import read
from fits.geometry import Geometry, direction, slices

SHAPE = (90, 90, 180)
SCALE = np.array([1.0, 1.15, 1.66]) / 1500
MERL_BYTES = 12 + 8 * 3 * 90 * 90 * 180


def _bsdf(theta_h, theta_d, phi_d):
    """A smooth BRDF in three channels, with reciprocity: a period of pi in phi_d."""
    lobe = 0.1 + 2 * np.cos(theta_h) ** 6
    colour = [1 + 0.5 * theta_d, np.cos(theta_d) ** 2 + 0.3, 1 + 0.2 * np.sin(theta_d) ** 2 * np.cos(2 * phi_d + 0.4)]
    return np.stack([lobe * factor * np.ones_like(phi_d) for factor in colour])


def _centres():
    i, j, k = (np.arange(size) + 0.5 for size in SHAPE)
    return np.meshgrid((i / 90) ** 2 * np.pi / 2, j / 90 * np.pi / 2, k / 180 * np.pi, indexing="ij")


def _write(path: Path, table: np.ndarray) -> Path:
    path.write_bytes(np.array(SHAPE, "<i4").tobytes() + (table / SCALE[:, None, None, None]).astype("<f8").tobytes())
    return path


@pytest.fixture(scope="module")
def table():
    return _bsdf(*_centres())


@pytest.fixture(scope="module")
def path(tmp_path_factory, table):
    return _write(tmp_path_factory.mktemp("merl") / "synthetic.binary", table)


def _rotate(v, axis, angle):
    """Rodrigues' formula, as the database's own code turns its vectors."""
    c, s = np.cos(angle), np.sin(angle)
    return c * v + s * np.cross(axis, v) + (1 - c) * (axis @ v) * axis


def _half_difference(wi, wo):
    """Half and difference angles by turning wi back: by -phi_h about the normal, then by -theta_h about y."""
    half = (wi + wo) / np.linalg.norm(wi + wo)
    theta_h, phi_h = np.arccos(min(half[2], 1.0)), np.arctan2(half[1], half[0])
    turned = _rotate(_rotate(wi, np.array([0.0, 0, 1]), -phi_h), np.array([0.0, 1, 0]), -theta_h)
    return theta_h, np.arccos(np.clip(turned[2], -1, 1)), np.arctan2(turned[1], turned[0]) % np.pi


@pytest.fixture(scope="module")
def geometry():
    random = np.random.default_rng(5)
    theta, phi = random.uniform(2, 65, (2, 300)), random.uniform(0, 360, (2, 300))
    return Geometry(direction(theta[0], phi[0]), direction(theta[1], phi[1]))


def _angles(geometry):
    return np.array([_half_difference(wi, wo) for wi, wo in zip(geometry.wi, geometry.wo, strict=True)]).T


def test_linear_lookup_recovers_the_formula(path, geometry, table):
    data = read(path, geometry=geometry)
    expected = _bsdf(*_angles(geometry)).T
    # linear interpolation is off by at most an eighth of the second difference along each axis
    bound = sum(abs(np.diff(table, 2, axis=axis)).max(axis=(1, 2, 3)) for axis in (1, 2, 3)) / 8
    assert (abs(data.values - expected) <= 1.05 * bound).all()
    assert (bound < 0.01 * np.median(expected, axis=0)).all()  # half a bin of another convention would be seen
    assert data.mask.all()
    assert data.channels == ("red", "green", "blue")
    assert "centre at i + 1/2" in data.source.notes[0]


def test_nearest_lookup_takes_the_bin_of_the_database_code(path, geometry, table):
    theta_h, theta_d, phi_d = _angles(geometry)
    degrees = np.degrees(theta_h)
    index = [
        np.sqrt(degrees / 90 * 90 * 90).astype(int),
        np.degrees(theta_d).astype(int),
        np.degrees(phi_d).astype(int),
    ]
    data = read(path, geometry=geometry, lookup="nearest")
    np.testing.assert_allclose(data.values, table[:, *index].T, rtol=1e-14)


def test_mirror_normal_and_retro_directions_are_finite(path):
    wi = direction([30, 0, 30, 80, 0], 180)
    wo = direction([30, 0, -30, 80, 85], 0)
    data = read(path, geometry=Geometry(wi, wo))
    assert data.mask.all()
    expected = _bsdf(*np.array([_half_difference(*pair) for pair in zip(wi, wo, strict=True)]).T).T
    np.testing.assert_allclose(data.values[:, :2], expected[:, :2], rtol=0.02)


def test_default_slices(path):
    data = read(path)
    assert len(data) == 4 * (35 + 34 + 34)
    assert sorted(set(data.theta_i)) == [10, 30, 50, 70]
    assert len({(*np.round(wi, 6), *np.round(wo, 6)) for wi, wo in zip(data.wi, data.wo, strict=True)}) == len(data)


def test_bins_without_measurement_are_masked(tmp_path, table):
    holed = table.copy()
    holed[1, :, 40:] = -SCALE[1]  # what the database writes where it has nothing, in one channel
    data = read(_write(tmp_path / "holed.binary", holed), geometry=slices(incidence=[60], outgoing=[-55, 60]))
    np.testing.assert_array_equal(data.mask, [True, False])  # theta_d of 2.5 and of 60 degrees
    np.testing.assert_array_equal(data.values[1], 0)
    assert "masked: 1 sample that need a bin without a measurement" in data.source.notes


def test_bad_files(tmp_path, path):
    whole = path.read_bytes()
    for size in (0, 5, 12, 1000, MERL_BYTES - 1):
        short = tmp_path / f"short{size}.binary"
        short.write_bytes(whole[:size])
        message = (
            "the file is empty" if size == 0 else f"truncated MERL file, {size} bytes found, {MERL_BYTES} expected"
        )
        with pytest.raises(ValueError, match=message):
            read(short)
    other = tmp_path / "other.binary"
    other.write_bytes(np.array([90, 90, 360], "<i4").tobytes() + bytes(100))
    with pytest.raises(ValueError, match=r"MERL header says \(90, 90, 360\), must be \(90, 90, 180\)"):
        read(other)
    other.write_bytes(whole + b"\0")
    with pytest.raises(ValueError, match=f"MERL file too long, {MERL_BYTES + 1} bytes found"):
        read(other)
    broken = bytearray(whole)
    broken[12:] = np.full((MERL_BYTES - 12) // 8, np.nan).tobytes()
    other.write_bytes(broken)
    with pytest.raises(ValueError, match="the table holds nan, must be finite"):
        read(other)


def test_bad_arguments(path):
    with pytest.raises(ValueError, match="lookup is 'cubic', must be one of linear, nearest"):
        read(path, lookup="cubic")
    with pytest.raises(ValueError, match="at or below the horizon"):
        read(path, geometry=slices(outgoing=[100]))
    with pytest.raises(ValueError, match="a MERL file always holds 'brdf'"):
        read(path, quantity="brdf_cos")
