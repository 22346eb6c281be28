"""MERL tables: a file written from a formula in half and difference angles is looked up again, by angles or bins."""

import numpy as np
import pytest

from fits import Geometry, ReadOptions, read, slices
from fits.data.geometry import direction
from fits.data.scans import in_plane, incidences, relative_azimuth
from tests.helpers.data_files import written
from tests.helpers.merl import SCALE, SHAPE, centre_angles, centre_pairs, half_angles, smooth_bsdf, write_merl
from tests.helpers.refusals import refuses

HEADER = np.array(SHAPE, "<i4").tobytes()
SIZE = len(HEADER) + 8 * 3 * np.prod(SHAPE)
COUNT = 3000
RANDOM = np.random.default_rng(5)
THETA, PHI = RANDOM.uniform(2, 65, (2, 300)), RANDOM.uniform(0, 360, (2, 300))
GEOMETRY = Geometry(direction(THETA[0], PHI[0]), direction(THETA[1], PHI[1]))


@pytest.fixture(scope="module")
def table():
    return smooth_bsdf(*centre_angles())


@pytest.fixture(scope="module")
def path(tmp_path_factory, table):
    return write_merl(tmp_path_factory.mktemp("merl") / "synthetic.binary", table)


def angles_of(pairs):
    """Half and difference angles that the table is made of, (3, N)."""
    theta_h, _, theta_d, phi_d = half_angles(pairs.wi, pairs.wo)
    return np.array([theta_h, theta_d, phi_d % np.pi])


def bins_of(pairs):
    theta_h, theta_d, phi_d = angles_of(pairs) * 2 / np.pi
    return np.floor(np.stack([np.sqrt(theta_h), theta_d, phi_d / 2], axis=-1) * SHAPE).astype(int)


def test_centre_lookup_reads_bins_as_they_are_at_their_centre_angles_near_those_requested(path, table):
    some = Geometry(GEOMETRY.wi[:50], GEOMETRY.wo[:50])
    for data in (read(path), read(path, geometry=GEOMETRY), read(path, geometry=some)):
        index = bins_of(data)
        centres = ((index + 0.5) / SHAPE) ** [2, 1, 1] * [np.pi / 2, np.pi / 2, np.pi]
        np.testing.assert_allclose(angles_of(data).T, centres, rtol=0, atol=1e-9)
        np.testing.assert_allclose(data.values, table[:, *index.T].T, rtol=1e-14)
        assert len(np.unique(index, axis=0)) == len(data)
        assert data.mask.all()
        assert f"measurements at the centres of {len(data)} bins" in data.source.notes[1]
    off = abs(data.theta_i - some.theta_i)
    assert off.max() < 0.75
    assert np.mean(off < 0.21) > 0.9  # near retro-reflection there are bins for few incidences
    np.testing.assert_allclose(data.phi_i, some.phi_i, atol=1e-8)
    # directions that were exchanged or mirrored would be tens of degrees away
    assert np.degrees(np.linalg.norm(data.wo - some.wo, axis=-1)).max() < 6


def test_a_pair_at_a_centre_stays_and_its_reciprocal_is_the_same_reading(path, table):
    index = np.array([[3, 40, 20], [20, 30, 100], [45, 10, 179], [0, 60, 0]])
    wi, wo = centre_pairs(index)
    for light, viewer in ((wi, wo), (wo, wi)):
        data = read(path, geometry=Geometry(light, viewer))
        np.testing.assert_allclose([data.wi, data.wo], [light, viewer], atol=1e-12)
        np.testing.assert_allclose(data.values, table[:, *index.T].T, rtol=1e-14)
    both = read(path, geometry=Geometry(np.concatenate([wi, wo]), np.concatenate([wo, wi])))
    np.testing.assert_allclose([both.wi, both.wo], [wi, wo], atol=1e-12)
    assert any("skipped: 4 of the 8 pairs requested" in note for note in both.source.notes)


def test_centres_along_the_default_slices_remain_slices(path):
    data = read(path)
    assert 380 < len(data) < 420
    groups = incidences(data)
    np.testing.assert_allclose([group.theta for group in groups], [10.5, 30.5, 50.5, 70.5], atol=0.1)
    for group in groups:
        plane, away = in_plane(data)[group.rows], abs(relative_azimuth(data)[group.rows])
        assert np.count_nonzero(plane) >= 25
        assert abs(data.theta_o - data.theta_i)[group.rows][plane & (away < 1)].min() < 0.01  # the mirror direction


def test_light_along_the_normal_and_pairs_at_the_horizon(path):
    upright = read(path, geometry=slices(incidence=0.0, outgoing=(-40.0, 0.0, 40.0)))
    assert upright.theta_i.max() < 0.75
    np.testing.assert_allclose(upright.phi_i, 180, atol=1e-8)
    np.testing.assert_allclose(upright.theta_o, [40, 0, 40], atol=5)
    # half a degree of phi_d puts one of the two below the horizon in every bin near this pair
    low = direction([89.996, 30], 180), direction([89.996, 30], [4.78, 0])
    assert len(read(path, geometry=Geometry(*low))) == 1
    refuses("geometry holds only pairs too near the horizon", read, path, geometry=Geometry(low[0][:1], low[1][:1]))


def test_linear_lookup_recovers_the_formula_and_the_nearest_is_that_of_the_database_code(path, table):
    data = read(path, geometry=GEOMETRY, lookup="linear")
    np.testing.assert_array_equal([data.wi, data.wo], [GEOMETRY.wi, GEOMETRY.wo])
    expected = smooth_bsdf(*angles_of(GEOMETRY)).T
    # linear interpolation is off by at most an eighth of the second difference along each axis
    bound = sum(abs(np.diff(table, 2, axis=axis)).max(axis=(1, 2, 3)) for axis in (1, 2, 3)) / 8
    assert (abs(data.values - expected) <= 1.05 * bound).all()
    assert (bound < 0.01 * np.median(expected, axis=0)).all()  # half a bin of another convention would be seen
    assert data.channels == ("red", "green", "blue")
    assert "centre at i + 1/2" in data.source.notes[0]
    # mirror, normal and retro directions
    edges = Geometry(direction([30, 0, 30, 80, 0], 180), direction([30, 0, -30, 80, 85], 0))
    data, expected = read(path, geometry=edges, lookup="linear"), smooth_bsdf(*angles_of(edges)).T
    assert data.mask.all()
    np.testing.assert_allclose(data.values[:, :2], expected[:, :2], rtol=0.02)
    data = read(path, geometry=GEOMETRY, lookup="nearest")
    np.testing.assert_allclose(data.values, table[:, *bins_of(GEOMETRY).T].T, rtol=1e-14)


def test_bins_that_hold_nan_are_left_out_and_counted(tmp_path, path, table):
    whole, holed = read(path), table / SCALE[:, None, None, None]
    holed[1, *bins_of(whole)[:2].T] = np.nan  # one channel is enough
    other = written(tmp_path, HEADER + holed.tobytes(), "holes.binary")
    data, every = read(other), read(other, bins="all")
    np.testing.assert_array_equal(np.flatnonzero(whole.mask & ~data.mask), [0, 1])
    np.testing.assert_allclose(data.values[2:], whole.values[2:], rtol=1e-14)
    assert "skipped: 2 data points that need a bin that holds nan" in data.source.notes
    assert "skipped: 2 bins of the table that hold nan" in every.source.notes


@pytest.fixture(scope="module")
def holed(tmp_path_factory, table):
    """A file, without a measurement in one channel of a block of bins; its table, and which bins can be read."""
    values = table.copy()
    values[1, 40:60, :30, :90] = -SCALE[1]
    wi, wo = centre_pairs(np.stack(np.unravel_index(np.arange(np.prod(SHAPE)), SHAPE), axis=-1))
    readable = ((wi[:, 2] > 0) & (wo[:, 2] > 0)).reshape(SHAPE) & (values > 0).all(axis=0)
    return write_merl(tmp_path_factory.mktemp("merl") / "holed.binary", values), values, readable


def test_bins_without_measurement_are_masked_and_every_other_is_read_once(holed):
    path, values, readable = holed
    wi, wo = centre_pairs(np.array([[10, 20, 20], [50, 10, 20]]))
    for lookup in ("centre", "linear", "nearest"):
        data = read(path, geometry=Geometry(wi, wo), lookup=lookup)
        np.testing.assert_array_equal(data.mask, [True, False])
        np.testing.assert_array_equal(data.values[1], 0)
        assert "masked: 1 sample that need a bin without a measurement" in data.source.notes
    data = read(path, bins="all")
    bins = bins_of(data)
    np.testing.assert_array_equal(bins, np.argwhere(readable))
    np.testing.assert_allclose(data.values, values[:, *bins.T].T, rtol=1e-12)
    assert data.mask.all()
    np.testing.assert_allclose(data.phi_i, 180.0, atol=1e-8)


@pytest.mark.parametrize("strata", ["bins", "flux"])
def test_a_choice_has_bins_as_they_are_and_none_twice(holed, strata):
    path, values, readable = holed
    data = read(path, bins=COUNT, strata=strata)
    bins = bins_of(data)
    assert len(np.unique(bins, axis=0)) == len(data) == COUNT
    assert readable[tuple(bins.T)].all()
    np.testing.assert_allclose(data.values, values[:, *bins.T].T, rtol=1e-12)
    again, other = (read(path, bins=COUNT, strata=strata, seed=seed) for seed in (0, 1))
    np.testing.assert_array_equal(again.wi, data.wi)
    assert not np.array_equal(other.wi, data.wi)
    if strata == "bins":  # blocks of a fifth of each index have their share: chance alone would be off by 1 / sqrt(N)
        for axis, size in enumerate(SHAPE):
            edges = np.linspace(0, size, 6)
            found, _ = np.histogram(bins[:, axis], edges)
            expected, _ = np.histogram(np.nonzero(readable)[axis], edges)
            np.testing.assert_allclose(found / COUNT, expected / readable.sum(), atol=0.2 / np.sqrt(COUNT))


def test_a_choice_by_flux_has_means_of_the_hemisphere(path):
    """Over both hemispheres, weighed by their cosines: means of cos, cos cos and cos^2 are 2/3, 4/9 and 1/2."""
    data = ReadOptions.parse(["strata=flux", f"bins={COUNT}"]).read(path)
    i, o = data.wi[:, 2], data.wo[:, 2]
    for found, expected in ((i, 2 / 3), (o, 2 / 3), (i * o, 4 / 9), (i * i, 1 / 2)):
        assert found.mean() == pytest.approx(expected, abs=0.5 * found.std() / np.sqrt(COUNT))


def test_bad_arguments(path):
    bins = "must be a whole number of at least 1, or 'all'"
    for given, message in (
        ({"lookup": "cubic"}, "lookup is 'cubic', must be one of centre, linear, nearest"),
        ({"geometry": slices(outgoing=[100])}, "at or below the horizon"),
        ({"quantity": "brdf_cos"}, "a MERL file always holds 'brdf'"),
        *(({"bins": bad}, f"bins is {bad!r}, {bins}") for bad in (0, -3, 2.5, True, "most")),
        ({"bins": 200_000}, "bins is 200000, must be at most 100000 of the"),
        ({"strata": "flux"}, "strata is given without a number of bins"),
        ({"bins": 10, "strata": "area"}, "strata is 'area', must be one of bins, flux"),
        ({"bins": 10, "seed": -1}, "seed is -1, must be a whole number"),
        ({"bins": 10, "lookup": "linear"}, "bins stands beside geometry or lookup"),
    ):
        refuses(message, read, path, **given)


def test_bad_files(tmp_path):
    def filled(number):
        return HEADER + np.full(3 * np.prod(SHAPE), number).tobytes()

    short = {size: f"truncated MERL file, {size} bytes found, {SIZE} expected" for size in (5, SIZE - 1)}
    for content, message in (
        *((filled(0.1)[:size], words) for size, words in short.items()),
        (np.array([90, 90, 360], "<i4").tobytes() + bytes(100), r"MERL header says \(90, 90, 360\), must be \(90, 90,"),
        (filled(0.1) + b"\0", f"MERL file too long, {SIZE + 1} bytes found"),
        (filled(np.nan), "all bins that are requested hold nan"),
        (filled(np.inf), "the table holds inf, must be finite"),
    ):
        path = written(tmp_path, content, "bad.binary")
        refuses(message, read, path)
    refuses("no bin holds a measurement", read, written(tmp_path, filled(-1.0), "bad.binary"), bins="all")
