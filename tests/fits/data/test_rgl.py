"""RGL's tensor files: what is read back of a table that a formula made, and of files that are broken."""

from pathlib import Path

import numpy as np
import pytest

from fits.data.formats import rgl
from fits.data.formats._tensor_file import fields_as_bytes, read_fields
from fits.data.formats.rgl_table import Table, read_table, table_as_bytes
from fits.data.geometry import Floats, Geometry, slices
from fits.data.reading import read


def lambertian(albedo: Floats, azimuths: Floats | None = None, wavelengths: Floats | None = None) -> Table:
    """A diffuse surface over half vectors drawn in proportion to u, by hand: value = f cos(theta_o) 4 sigma / D."""
    side = np.linspace(0.0, 1.0, 33)
    theta_i = np.radians([0.0, 30.0, 60.0, 80.0])
    phi_i = np.zeros(1) if azimuths is None else azimuths
    u = np.linspace(0.0, 1.0, 101)
    warp = np.broadcast_to(u, (len(phi_i), 4, 2, 101))
    theta_m = side * np.pi / 2  # a density in proportion to u: u^2 is uniform, and so is theta
    phi_m = (2 * side - 1) * np.pi
    values = np.empty((len(phi_i), 4, len(albedo), 33, 33))
    for p, phi in enumerate(phi_i):
        for t, theta in enumerate(theta_i):
            turn = phi_m[:, None] - (0.0 if azimuths is None else phi)
            facing = np.sin(theta) * np.sin(theta_m) * np.cos(turn) + np.cos(theta) * np.cos(theta_m)
            cosine = 2 * facing * np.cos(theta_m) - np.cos(theta)
            values[p, t] = np.array(albedo)[:, None, None] / np.pi * cosine * (4 * 0.7) / 1.3
    ndf, sigma = np.full((2, 8), 1.3), np.full((2, 8), 0.7)
    luminance = np.ones(values.shape[:2] + values.shape[3:])
    return Table(theta_i, phi_i, ndf, sigma, warp, luminance, values, wavelengths, "a diffuse surface")


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rgl") / "diffuse.bsdf"
    path.write_bytes(table_as_bytes(lambertian(np.array([0.2, 0.5, 0.8]))))
    return path


def test_nodes_are_readings(path: Path) -> None:
    data = read(path)
    assert data.channels == ("red", "green", "blue")
    assert data.source.format == "rgl"
    assert data.source.quantity == "brdf_cos"
    assert set(data.theta_i.round(3)) == {0.0, 30.0, 60.0, 80.0}
    assert set(data.phi_i[data.theta_i > 0]) == {180.0}
    assert len(data) > 1000
    np.testing.assert_allclose(data.values, np.tile([0.2, 0.5, 0.8], (len(data), 1)) / np.pi, rtol=1e-4)
    # none twice
    assert len(np.unique(np.c_[data.theta_i, data.wo.round(9)], axis=0)) == len(data)


def test_between_nodes_as_renderers_do(path: Path) -> None:
    data = read(path, geometry=slices(incidence=(15, 60), outgoing=np.arange(-75.0, 76.0, 15.0), azimuth=(0, 50)))
    # linear between polar angles of the light, 30 degrees apart: a cosine is off by 3.4 %, and as below
    np.testing.assert_allclose(data.values, np.tile([0.2, 0.5, 0.8], (len(data), 1)) / np.pi, rtol=0.034 + 0.015)
    # and between the grid's azimuths, 11 degrees apart, by 0.5 % of what may be three times as much as the sum
    exact = data.select(incidence=60)
    np.testing.assert_allclose(exact.values, np.tile([0.2, 0.5, 0.8], (len(exact), 1)) / np.pi, rtol=0.015)


def test_some_nodes_from_all_over(path: Path) -> None:
    data = read(path, bins=200, seed=4)
    assert len(data) == 200
    assert len(read(path, bins="all")) == len(read(path))


@pytest.mark.parametrize(("share", "count"), [(0.5, 0.5), (0.51, 1.0), (0.9, 1.0)])
def test_all_nodes_are_read_unless_they_are_twice_as_many(
    path: Path, monkeypatch: pytest.MonkeyPatch, share: float, count: float
) -> None:
    nodes = len(read(path, bins="all"))
    monkeypatch.setattr(rgl, "MOST", int(share * nodes))
    assert len(read(path)) == int(count * nodes)


def test_spectra_are_channels_by_their_wavelengths(tmp_path: Path) -> None:
    path = tmp_path / "spectral.bsdf"
    path.write_bytes(table_as_bytes(lambertian(np.array([0.3, 0.6]), wavelengths=np.array([450.0, 632.8]))))
    data = read(path)
    assert data.channels == ("450 nm", "632.8 nm")
    np.testing.assert_allclose(data.values, np.tile([0.3, 0.6], (len(data), 1)) / np.pi, rtol=1e-4)


@pytest.mark.parametrize(("last", "turns"), [(np.pi, 1), (0.0, 2), (-np.pi / 2, 4)])
def test_azimuths_of_a_part_of_the_turn_stand_for_all(tmp_path: Path, last: float, turns: int) -> None:
    table = lambertian(np.array([0.2, 0.5, 0.8]), np.linspace(-np.pi, last, 32 // turns + 1))
    assert table.turns == turns
    path = tmp_path / "part.bsdf"
    path.write_bytes(table_as_bytes(table))
    seen = slices((60,), (-40.0, 20.0, 50.0), azimuth=(0.0, 70.0, 160.0))
    for turn in np.radians([0.0, 40.0, 130.0, 250.0, 340.0]):
        cosine, sine = np.cos(turn), np.sin(turn)
        rotation = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
        data = read(path, geometry=Geometry(seen.wi @ rotation, seen.wo @ rotation))
        # linear between azimuths 11 degrees apart, twice: 1 % of what may be three times as much as the sum
        np.testing.assert_allclose(data.values, np.tile([0.2, 0.5, 0.8], (len(data), 1)) / np.pi, rtol=0.03)


def test_what_is_written_is_read(path: Path, tmp_path: Path) -> None:
    table = read_table(path)
    again = tmp_path / "again.bsdf"
    again.write_bytes(table_as_bytes(table))
    assert again.read_bytes() == path.read_bytes()
    fields = {"one": np.arange(6, dtype=np.int64).reshape(2, 3), "text": "words", "empty": np.empty((0, 2), np.float32)}
    (tmp_path / "fields").write_bytes(fields_as_bytes(fields))
    read_again = read_fields(tmp_path / "fields")
    assert np.array_equal(read_again["one"], fields["one"])
    assert bytes(read_again["text"]) == b"words"
    assert read_again["empty"].shape == (0, 2)


def broken(path: Path, change: str) -> bytes:
    fields = dict(read_fields(path))
    if change == "missing":
        del fields["sigma"]
    elif change == "no values":
        del fields["rgb"]
    elif change == "no wavelengths":
        fields["spectra"] = fields.pop("rgb")
    elif change == "nan":
        fields["rgb"] = fields["rgb"].copy()
        fields["rgb"][0, 0, 0, 0, 0] = np.nan
    elif change == "shape":
        fields["vndf"] = fields["vndf"][:, :2]
    elif change == "dimensions":
        fields["ndf"] = fields["ndf"][0]
    elif change == "angle":
        fields["theta_i"] = fields["theta_i"] * 2
    elif change == "order":
        fields["theta_i"] = fields["theta_i"][::-1]
    elif change == "negative":
        fields["ndf"] = -fields["ndf"]
    elif change == "sigma":
        fields["sigma"] = 0 * fields["sigma"]
    elif change == "dark":
        fields["vndf"] = 0 * fields["vndf"]
    return fields_as_bytes(fields)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("missing", "no field 'sigma'"),
        ("no values", "no field 'spectra' or 'rgb'"),
        ("no wavelengths", "no field 'wavelengths'"),
        ("nan", "field 'rgb' holds nan, must be finite"),
        ("shape", "field 'vndf' has shape"),
        ("dimensions", "field 'ndf' has shape"),
        ("angle", "field 'theta_i' holds 2.09"),
        ("order", "field 'theta_i' must ascend"),
        ("negative", "field 'ndf' holds -1.3, must be >= 0"),
        ("sigma", "field 'sigma' holds 0"),
        ("dark", "field 'vndf' is 0 everywhere"),
    ],
)
def test_what_is_wrong_is_named(path: Path, tmp_path: Path, change: str, message: str) -> None:
    bad = tmp_path / "bad.bsdf"
    bad.write_bytes(broken(path, change))
    with pytest.raises(ValueError, match=message):
        read(bad)


@pytest.mark.parametrize(
    ("start", "message"),
    [
        (b"tensor_file\0\2\0", "version 2.0, must be 1.0"),
        (b"tensor_file\0\1\0", "ends within its header"),
        (b"tensor_file\0\1\0\xff\xff\xff\xff", "fields announced"),
        (b"tensor_file\0\1\0\1\0\0\0\2\0ab\1\0\x63" + bytes(16), "is of type 99"),
    ],
)
def test_a_broken_header_is_named(tmp_path: Path, start: bytes, message: str) -> None:
    bad = tmp_path / "bad.bsdf"
    bad.write_bytes(start)
    with pytest.raises(ValueError, match=message):
        read(bad)


def test_bad_arguments(path: Path) -> None:
    with pytest.raises(ValueError, match="always holds 'brdf_cos'"):
        read(path, quantity="brdf")
    with pytest.raises(ValueError, match="at or below the horizon"):
        read(path, geometry=slices(outgoing=(120.0,)))
    with pytest.raises(ValueError, match="lookup and strata apply to MERL files only"):
        read(path, strata="flux")
    with pytest.raises(ValueError, match="bins stands beside geometry"):
        read(path, geometry=slices(), bins=10)
