"""RGL's tensor files: what is read back of a table that a formula made, files that are broken, and densities."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fits import Geometry, read, slices
from fits.data.formats import rgl
from fits.data.formats._square import Density, Interpolation
from fits.data.formats._tensor_file import fields_as_bytes, read_fields
from fits.data.formats.rgl_table import Table, read_table, table_as_bytes
from tests.helpers.data_files import written
from tests.helpers.refusals import refuses

RGB = np.array([0.2, 0.5, 0.8])
RANDOM = np.random.default_rng(3)
FIRST, SECOND = RANDOM.uniform(0.1, 2.0, (2, 5, 7))
SECOND[:2] = 0.0
SECOND[3, 2:5] = 0.0
DENSITY = Density(np.stack([FIRST, SECOND]))  # two densities, one of them with rows and cells that are 0


def lambertian(azimuths=(0.0,)):
    """A diffuse surface over half vectors drawn in proportion to u, by hand: value = f cos(theta_o) 4 sigma / D."""
    side = np.linspace(0.0, 1.0, 33)
    theta_i = np.radians([0.0, 30.0, 60.0, 80.0])
    phi_i = np.array(azimuths)
    warp = np.broadcast_to(np.linspace(0.0, 1.0, 101), (len(phi_i), 4, 2, 101))
    # a density in proportion to u: u^2 is uniform, and so is theta
    phi, theta, phi_m, theta_m = np.meshgrid(phi_i, theta_i, (2 * side - 1) * np.pi, side * np.pi / 2, indexing="ij")
    facing = np.sin(theta) * np.sin(theta_m) * np.cos(phi_m - phi) + np.cos(theta) * np.cos(theta_m)
    cosine = 2 * facing * np.cos(theta_m) - np.cos(theta)
    values = RGB[:, None, None] / np.pi * cosine[:, :, None] * (4 * 0.7) / 1.3
    ndf, sigma = np.full((2, 8), 1.3), np.full((2, 8), 0.7)
    return Table(theta_i, phi_i, ndf, sigma, warp, np.ones(cosine.shape), values, None, "a diffuse surface")


def diffuse(data, tolerance):
    np.testing.assert_allclose(data.values, np.tile(RGB / np.pi, (len(data), 1)), rtol=tolerance)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return written(tmp_path_factory.mktemp("rgl"), table_as_bytes(lambertian()), "diffuse.bsdf")


def test_nodes_are_readings(path, monkeypatch):
    assert table_as_bytes(read_table(path)) == path.read_bytes()
    data = read(path)
    assert (data.channels, data.source.quantity) == (("red", "green", "blue"), "brdf_cos")
    assert set(data.theta_i.round(3)) == {0.0, 30.0, 60.0, 80.0}
    assert set(data.phi_i[data.theta_i > 0]) == {180.0}
    diffuse(data, 1e-4)
    assert len(np.unique(np.c_[data.theta_i, data.wo.round(9)], axis=0)) == len(data)  # none twice
    nodes = len(read(path, bins="all"))
    assert (len(data), len(read(path, bins=200, seed=4))) == (nodes, 200)
    for share, count in ((0.5, 0.5), (0.51, 1.0), (0.9, 1.0)):  # all, unless they are twice as many as that
        monkeypatch.setattr(rgl, "MOST", int(share * nodes))
        assert len(read(path)) == int(count * nodes)


def test_between_nodes_as_renderers_do(path):
    data = read(path, geometry=slices(incidence=(15, 60), outgoing=np.arange(-75.0, 76.0, 15.0), azimuth=(0, 50)))
    # linear between polar angles of the light, 30 degrees apart: a cosine is off by 3.4 %, and as below
    diffuse(data, 0.034 + 0.015)
    # and between the grid's azimuths, 11 degrees apart, by 0.5 % of what may be three times as much as the sum
    diffuse(data.select(incidence=60), 0.015)


@pytest.mark.parametrize(("last", "turns"), [(np.pi, 1), (0.0, 2), (-np.pi / 2, 4)])
def test_azimuths_of_a_part_of_the_turn_stand_for_all(reading, last, turns):
    table = lambertian(azimuths=np.linspace(-np.pi, last, 32 // turns + 1))
    assert table.turns == turns
    seen = slices((60,), (-40.0, 20.0, 50.0), azimuth=(0.0, 70.0, 160.0))
    for turn in (0.0, 40.0, 130.0, 250.0, 340.0):
        rotation = Rotation.from_euler("z", turn, degrees=True)
        view = Geometry(rotation.apply(np.array(seen.wi)), rotation.apply(np.array(seen.wo)))
        # linear between azimuths 11 degrees apart, twice: 1 % of what may be three times as much as the sum
        diffuse(reading(table_as_bytes(table), geometry=view), 0.03)


def test_what_is_wrong_is_named(path, reading):
    for name, change, message in (
        ("sigma", None, "no field 'sigma'"),
        ("rgb", None, "no field 'spectra' or 'rgb'"),
        ("rgb", lambda values, fields: fields.update(spectra=values), "no field 'wavelengths'"),
        ("vndf", lambda values, _: values[:, :2], "field 'vndf' has shape"),
        ("ndf", lambda values, _: values[0], "field 'ndf' has shape"),
        ("theta_i", lambda values, _: values * 2, "field 'theta_i' holds 2.09"),
        ("theta_i", lambda values, _: values[::-1], "field 'theta_i' must ascend"),
        ("ndf", lambda values, _: -values, "field 'ndf' holds -1.3, must be >= 0"),
        ("sigma", lambda values, _: 0 * values, "field 'sigma' holds 0"),
        ("vndf", lambda values, _: 0 * values, "field 'vndf' is 0 everywhere"),
    ):
        fields = dict(read_fields(path))
        fields[name] = None if change is None else change(fields[name], fields)
        fields = {key: value for key, value in fields.items() if value is not None}
        refuses(message, reading, fields_as_bytes(fields))


def test_bad_arguments(path):
    refuses("at or below the horizon", read, path, geometry=slices(outgoing=(120.0,)))
    refuses("lookup and strata apply to MERL files only", read, path, strata="flux")
    refuses("bins stands beside geometry", read, path, geometry=slices(), bins=10)


def test_what_is_drawn_goes_back_to_the_numbers_it_was_drawn_by():
    sides = np.linspace(0.0, 1.0, 41)[1:-1]
    for table, (x, y) in enumerate(zip(*DENSITY.drawn(sides, sides), strict=True)):
        only = Interpolation(np.full((x.size, 1), table), np.ones((x.size, 1)))
        sx, sy, _ = DENSITY.undrawn(x.ravel(), y.ravel(), only)
        expected = np.meshgrid(sides, sides)
        np.testing.assert_allclose([sx.reshape(x.shape), sy.reshape(x.shape)], expected, atol=1e-9)
