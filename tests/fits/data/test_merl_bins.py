"""Many bins of a MERL table at once: every one, or a choice that stands for all."""

import numpy as np
import pytest

from fits.cli.parser import main
from fits.data.formats.merl import half_difference
from fits.data.reading import read
from tests.helpers.commands import refused
from tests.helpers.merl import SCALE, SHAPE, centre_angles, centre_pairs, smooth_bsdf, write_merl

COUNT = 3000


@pytest.fixture(scope="module")
def table():
    """A smooth one, without a measurement in one channel of a block of bins."""
    values = smooth_bsdf(*centre_angles())
    values[1, 40:60, :30, :90] = -SCALE[1]
    return values


@pytest.fixture(scope="module")
def path(tmp_path_factory, table):
    return write_merl(tmp_path_factory.mktemp("merl") / "holed.binary", table)


@pytest.fixture(scope="module")
def readable(table):
    wi, wo = centre_pairs(np.stack(np.unravel_index(np.arange(np.prod(SHAPE)), SHAPE), axis=-1))
    return ((wi[:, 2] > 0) & (wo[:, 2] > 0)).reshape(SHAPE) & (table > 0).all(axis=0)


def _bins(data):
    theta_h, theta_d, phi_d = half_difference(data.wi, data.wo)
    shares = np.stack([np.sqrt(theta_h / (np.pi / 2)), theta_d / (np.pi / 2), phi_d / np.pi], axis=-1)
    return np.floor(shares * SHAPE).astype(int)


def test_every_bin_is_read_once(path, table, readable):
    data = read(path, bins="all")
    bins = _bins(data)
    np.testing.assert_array_equal(bins, np.argwhere(readable))
    np.testing.assert_allclose(data.values, table[:, *bins.T].T, rtol=1e-12)
    assert data.mask.all()
    np.testing.assert_allclose(data.phi_i, 180.0, atol=1e-8)


@pytest.mark.parametrize("strata", ["bins", "flux"])
def test_a_choice_has_bins_as_they_are_and_none_twice(path, table, readable, strata):
    data = read(path, bins=COUNT, strata=strata)
    bins = _bins(data)
    assert len(np.unique(bins, axis=0)) == len(data) == COUNT
    assert readable[tuple(bins.T)].all()
    np.testing.assert_allclose(data.values, table[:, *bins.T].T, rtol=1e-12)
    again, other = (read(path, bins=COUNT, strata=strata, seed=seed) for seed in (0, 1))
    np.testing.assert_array_equal(again.wi, data.wi)
    assert not np.array_equal(other.wi, data.wi)


def test_every_part_of_the_table_has_its_share(path, readable):
    """By blocks of a fifth of each index: chance alone would be off by 1 / sqrt(N)."""
    bins = _bins(read(path, bins=COUNT))
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


def test_bad_choices(path, readable, tmp_path):
    for bad in (0, -3, 2.5, True, "most"):
        with pytest.raises(ValueError, match=r"bins is .*, must be a whole number of at least 1, or 'all'"):
            read(path, bins=bad)
    with pytest.raises(ValueError, match="bins is 200000, must be at most 100000 of the"):
        read(path, bins=200_000)
    with pytest.raises(ValueError, match="strata is 'area', must be one of bins, flux"):
        read(path, bins=10, strata="area")
    with pytest.raises(ValueError, match="seed is -1, must be a whole number"):
        read(path, bins=10, seed=-1)
    with pytest.raises(ValueError, match="bins stands beside geometry or lookup"):
        read(path, bins=10, lookup="linear")
    empty = write_merl(tmp_path / "empty.binary", np.full((3, *SHAPE), -1.0))
    with pytest.raises(ValueError, match="no bin holds a measurement"):
        read(empty, bins="all")
    other = tmp_path / "slices.csv"
    other.write_text("theta_i,phi_i,theta_o,phi_o,brdf\n10,180,20,0,0.1\n")
    with pytest.raises(ValueError, match="geometry and bins apply to MERL and RGL files only"):
        read(other, bins=10)


def test_on_the_command_line(path, tmp_path, capsys):
    out = tmp_path / "some.csv"
    assert main(["convert", str(path), str(out), "--read", "bins=50", "strata=flux"]) == 0
    assert len(read(out)) == 50
    capsys.readouterr()
    message = refused(["convert", str(path), str(tmp_path / "none.csv"), "--read", "strata=flux"], capsys, tmp_path)
    assert "strata is given without a number of bins" in message
