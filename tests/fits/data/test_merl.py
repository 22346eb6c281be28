"""MERL tables: a file written from a formula in half and difference angles is looked up again, by angles or bins."""

from dataclasses import replace

import numpy as np
import pytest

import layerjax as lj
from fits.cli.parser import main
from fits.data.formats.merl import half_difference
from fits.data.geometry import Geometry, direction, slices
from fits.data.measurements import Measurements
from fits.data.reading import read
from fits.data.scans import in_plane, incidences, relative_azimuth
from fits.optimise.fit import fit
from fits.problem.parameters import Free
from tests.helpers.commands import refused
from tests.helpers.merl import SCALE, SHAPE, centre_angles, centre_pairs, smooth_bsdf, write_merl

MERL_BYTES = 12 + 8 * 3 * 90 * 90 * 180


@pytest.fixture(scope="module")
def table():
    return smooth_bsdf(*centre_angles())


@pytest.fixture(scope="module")
def path(tmp_path_factory, table):
    return write_merl(tmp_path_factory.mktemp("merl") / "synthetic.binary", table)


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


def _bins(data: Measurements) -> np.ndarray:
    """Table indices (N, 3), not rounded, by way of this file's own half and difference angles."""
    theta_h, theta_d, phi_d = _angles(data)
    return np.stack([np.sqrt(theta_h * 2 / np.pi) * 90, np.degrees(theta_d), np.degrees(phi_d)], axis=-1)


def test_centre_lookup_reads_bins_as_they_are_at_theircentre_angles(path, geometry, table):
    for data in (read(path), read(path, geometry=geometry)):
        found = half_difference(data.wi, data.wo)
        index = np.floor(_bins(data)).astype(int)
        centres = ((index + 0.5) / SHAPE) ** [2, 1, 1] * [np.pi / 2, np.pi / 2, np.pi]
        np.testing.assert_allclose(np.stack(found, axis=-1), centres, rtol=0, atol=1e-9)
        np.testing.assert_allclose(data.values, table[:, *index.T].T, rtol=1e-14)
        assert len(np.unique(index, axis=0)) == len(data)
        assert data.mask.all()
        assert f"measurements at the centres of {len(data)} bins" in data.source.notes[1]


def test_centres_are_near_what_was_asked_for(path, geometry):
    spread = Geometry(geometry.wi[:50], geometry.wo[:50])
    data = read(path, geometry=spread)
    assert len(data) == 50
    asked = Measurements(spread.wi, spread.wo, data.values, None, data.mask, data.channels)
    off = abs(data.theta_i - asked.theta_i)
    assert off.max() < 0.75
    assert np.mean(off < 0.21) > 0.9  # near retro-reflection there are bins for few incidences
    np.testing.assert_allclose(data.phi_i, asked.phi_i, atol=1e-8)
    # directions that were exchanged or mirrored would be tens of degrees away
    assert np.degrees(np.linalg.norm(data.wo - asked.wo, axis=-1)).max() < 6


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
    np.testing.assert_allclose(data.phi_i, 180, atol=1e-8)
    for group in groups:
        assert np.count_nonzero(in_plane(data)[group.rows]) >= 25
        theta_i, theta_o = data.theta_i[group.rows], data.theta_o[group.rows]
        peak = in_plane(data)[group.rows] & (abs(relative_azimuth(data)[group.rows]) < 1)
        assert abs(theta_o - theta_i)[peak].min() < 0.01  # the mirror direction


def test_light_along_the_normal_and_pairs_at_the_horizon(path):
    upright = read(path, geometry=slices(incidence=0.0, outgoing=(-40.0, 0.0, 40.0)))
    assert upright.theta_i.max() < 0.75
    np.testing.assert_allclose(upright.phi_i, 180, atol=1e-8)
    np.testing.assert_allclose(upright.theta_o, [40, 0, 40], atol=5)
    # half a degree of phi_d puts one of the two below the horizon in every bin near this pair
    low = direction([89.996, 30], 180), direction([89.996, 30], [4.78, 0])
    assert len(read(path, geometry=Geometry(*low))) == 1
    with pytest.raises(ValueError, match="geometry holds only pairs too near the horizon"):
        read(path, geometry=Geometry(low[0][:1], low[1][:1]))


def _flakes(thickness, albedo):
    medium = lj.Medium(thickness=thickness, albedo=0.9, phase=lj.SGGX("surface", 0.02))
    return lj.Stack([medium], base=lj.Lambertian(albedo=albedo))


@pytest.fixture(scope="module")
def flakes_path(tmp_path_factory):
    """An exact table of flakes of thickness 0.8 over Lambertian(0.5), with values near the default slices only."""
    wi, wo = centre_pairs(np.stack(np.unravel_index(np.arange(np.prod(SHAPE)), SHAPE), axis=-1))
    near = np.zeros(len(wi), bool)
    for theta in (10.5, 30.5, 50.5, 70.5):
        near |= (abs(np.degrees(np.arccos([wi[:, 2], wo[:, 2]])) - theta) < 0.3).any(axis=0)
    near &= (wi[:, 2] > 0) & (wo[:, 2] > 0)
    values = np.full(len(wi), -1.0)
    values[near] = lj.evaluate(_flakes(0.8, 0.5), wi[near], wo[near], lj.SingleScattering())[:, 0]
    return write_merl(
        tmp_path_factory.mktemp("merl") / "flakes.binary", np.broadcast_to(values.reshape(SHAPE), (3, *SHAPE))
    )


@pytest.mark.slow
def test_an_exact_table_gives_back_its_stack(flakes_path):
    data = read(flakes_path)
    assert data.mask.all()
    data = replace(data, sigma=0.01 * data.values)
    start = _flakes(Free(1.5, 0.05, 5.0), Free(0.3, 0.0, 1.0))
    found = fit(start, data, transport=lj.SingleScattering(), starts=2)
    assert found.converged
    assert found.values["layers[0].thickness"] == pytest.approx(0.8, abs=1e-7)
    assert found.values["base.albedo"] == pytest.approx(0.5, abs=1e-7)


def test_linear_lookup_recovers_the_formula(path, geometry, table):
    data = read(path, geometry=geometry, lookup="linear")
    np.testing.assert_array_equal([data.wi, data.wo], [geometry.wi, geometry.wo])
    expected = smooth_bsdf(*_angles(geometry)).T
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
    data = read(path, geometry=Geometry(wi, wo), lookup="linear")
    assert data.mask.all()
    expected = smooth_bsdf(*np.array([_half_difference(*pair) for pair in zip(wi, wo, strict=True)]).T).T
    np.testing.assert_allclose(data.values[:, :2], expected[:, :2], rtol=0.02)


def test_default_slices(path):
    data = read(path, lookup="linear")
    assert len(data) == 4 * (35 + 34 + 34)
    assert sorted(set(data.theta_i)) == [10, 30, 50, 70]
    assert len({(*np.round(wi, 6), *np.round(wo, 6)) for wi, wo in zip(data.wi, data.wo, strict=True)}) == len(data)


@pytest.mark.parametrize("lookup", ["centre", "linear", "nearest"])
def test_bins_without_measurement_are_masked(tmp_path, table, lookup):
    holed = table.copy()
    holed[1, :, 40:] = -SCALE[1]  # what the database writes where it has nothing, in one channel
    data = read(
        write_merl(tmp_path / "holed.binary", holed), geometry=slices(incidence=[60], outgoing=[-55, 60]), lookup=lookup
    )
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
    with pytest.raises(ValueError, match="all bins that are requested hold nan"):
        read(other)
    broken[12:] = np.full((MERL_BYTES - 12) // 8, np.inf).tobytes()
    other.write_bytes(broken)
    with pytest.raises(ValueError, match="the table holds inf, must be finite"):
        read(other)


def test_bins_that_hold_nan_are_left_out_and_counted(tmp_path, path):
    whole = read(path)
    table = np.frombuffer(path.read_bytes(), "<f8", offset=12).reshape(3, *SHAPE).copy()
    table[1, *_bins(whole)[:2].astype(int).T] = np.nan  # one channel is enough
    other = tmp_path / "holes.binary"
    other.write_bytes(np.array(SHAPE, "<i4").tobytes() + table.tobytes())
    data = read(other)
    np.testing.assert_array_equal(np.flatnonzero(whole.mask & ~data.mask), [0, 1])
    np.testing.assert_array_equal(data.values[2:], whole.values[2:])
    assert "skipped: 2 data points that need a bin that holds nan" in data.source.notes
    every = read(other, bins="all")
    assert len(every) == len(read(path, bins="all")) - 2
    assert "skipped: 2 bins of the table that hold nan" in every.source.notes


def test_bad_arguments(path):
    with pytest.raises(ValueError, match="lookup is 'cubic', must be one of centre, linear, nearest"):
        read(path, lookup="cubic")
    with pytest.raises(ValueError, match="at or below the horizon"):
        read(path, geometry=slices(outgoing=[100]))
    with pytest.raises(ValueError, match="a MERL file always holds 'brdf'"):
        read(path, quantity="brdf_cos")


# ---- many bins at once ----

COUNT = 3000


def _table_indices(data: Measurements) -> np.ndarray:
    theta_h, theta_d, phi_d = half_difference(data.wi, data.wo)
    shares = np.stack([np.sqrt(theta_h / (np.pi / 2)), theta_d / (np.pi / 2), phi_d / np.pi], axis=-1)
    return np.floor(shares * SHAPE).astype(int)


@pytest.fixture(scope="module")
def holed():
    """A smooth one, without a measurement in one channel of a block of bins."""
    values = smooth_bsdf(*centre_angles())
    values[1, 40:60, :30, :90] = -SCALE[1]
    return values


@pytest.fixture(scope="module")
def holed_path(tmp_path_factory, holed):
    return write_merl(tmp_path_factory.mktemp("merl") / "holed.binary", holed)


@pytest.fixture(scope="module")
def readable(holed):
    wi, wo = centre_pairs(np.stack(np.unravel_index(np.arange(np.prod(SHAPE)), SHAPE), axis=-1))
    return ((wi[:, 2] > 0) & (wo[:, 2] > 0)).reshape(SHAPE) & (holed > 0).all(axis=0)


def test_every_bin_is_read_once(holed_path, holed, readable):
    data = read(holed_path, bins="all")
    bins = _table_indices(data)
    np.testing.assert_array_equal(bins, np.argwhere(readable))
    np.testing.assert_allclose(data.values, holed[:, *bins.T].T, rtol=1e-12)
    assert data.mask.all()
    np.testing.assert_allclose(data.phi_i, 180.0, atol=1e-8)


@pytest.mark.parametrize("strata", ["bins", "flux"])
def test_a_choice_has_bins_as_they_are_and_none_twice(holed_path, holed, readable, strata):
    data = read(holed_path, bins=COUNT, strata=strata)
    bins = _table_indices(data)
    assert len(np.unique(bins, axis=0)) == len(data) == COUNT
    assert readable[tuple(bins.T)].all()
    np.testing.assert_allclose(data.values, holed[:, *bins.T].T, rtol=1e-12)
    again, other = (read(holed_path, bins=COUNT, strata=strata, seed=seed) for seed in (0, 1))
    np.testing.assert_array_equal(again.wi, data.wi)
    assert not np.array_equal(other.wi, data.wi)


def test_every_part_of_the_table_has_its_share(holed_path, readable):
    """By blocks of a fifth of each index: chance alone would be off by 1 / sqrt(N)."""
    bins = _table_indices(read(holed_path, bins=COUNT))
    for axis, size in enumerate(SHAPE):
        edges = np.linspace(0, size, 6)
        found, _ = np.histogram(bins[:, axis], edges)
        expected, _ = np.histogram(np.nonzero(readable)[axis], edges)
        np.testing.assert_allclose(found / COUNT, expected / readable.sum(), atol=0.2 / np.sqrt(COUNT))


def test_a_choice_by_flux_has_means_of_the_hemisphere(tmp_path):
    """Over both hemispheres, weighed by their cosines: means of cos, cos cos and cos^2 are 2/3, 4/9 and 1/2."""
    whole = write_merl(tmp_path / "whole.binary", smooth_bsdf(*centre_angles()))
    data = read(whole, bins=COUNT, strata="flux")
    i, o = data.wi[:, 2], data.wo[:, 2]
    for found, expected in ((i, 2 / 3), (o, 2 / 3), (i * o, 4 / 9), (i * i, 1 / 2)):
        assert found.mean() == pytest.approx(expected, abs=0.5 * found.std() / np.sqrt(COUNT))


def test_bad_choices(holed_path, readable, tmp_path):
    for bad in (0, -3, 2.5, True, "most"):
        with pytest.raises(ValueError, match=r"bins is .*, must be a whole number of at least 1, or 'all'"):
            read(holed_path, bins=bad)
    with pytest.raises(ValueError, match="bins is 200000, must be at most 100000 of the"):
        read(holed_path, bins=200_000)
    with pytest.raises(ValueError, match="strata is 'area', must be one of bins, flux"):
        read(holed_path, bins=10, strata="area")
    with pytest.raises(ValueError, match="seed is -1, must be a whole number"):
        read(holed_path, bins=10, seed=-1)
    with pytest.raises(ValueError, match="bins stands beside geometry or lookup"):
        read(holed_path, bins=10, lookup="linear")
    empty = write_merl(tmp_path / "empty.binary", np.full((3, *SHAPE), -1.0))
    with pytest.raises(ValueError, match="no bin holds a measurement"):
        read(empty, bins="all")
    other = tmp_path / "slices.csv"
    other.write_text("theta_i,phi_i,theta_o,phi_o,brdf\n10,180,20,0,0.1\n")
    with pytest.raises(ValueError, match="geometry and bins apply to MERL and RGL files only"):
        read(other, bins=10)


def test_on_the_command_line(holed_path, tmp_path, capsys):
    out = tmp_path / "some.csv"
    assert main(["convert", str(holed_path), str(out), "--read", "bins=50", "strata=flux"]) == 0
    assert len(read(out)) == 50
    capsys.readouterr()
    message = refused(
        ["convert", str(holed_path), str(tmp_path / "none.csv"), "--read", "strata=flux"], capsys, tmp_path
    )
    assert "strata is given without a number of bins" in message
