"""Measurements of a map by blocks: every source gives the same numbers, and what is wrong is named."""

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray
import zarr

from fits.data.geometry import Geometry, direction
from fits.maps.inputs import map_data
from tests.helpers.map_files import ANGLES, BLOCK, MASK, SHAPE, SIGMA, VALUES, VIEW, C, N, hdf5_file, zarr_group

DIMS = ("y", "x", "sample", "channel")


def _sources(folder: Path) -> dict[str, Any]:
    """`VALUES` as each kind of source."""
    np.save(folder / "v.npy", VALUES)
    hdf5_file(folder / "v.h5", {"values": VALUES, "other": MASK}, chunks=True, compression="gzip")
    hdf5_file(folder / "one.hdf5", {"anything": VALUES, "labels": np.array([b"gloss", b"matt"])})
    group = zarr_group(folder / "v.zarr", {"values": VALUES, "other": MASK})
    zarr.create_array(folder / "one.zarr", data=VALUES)
    turned = xarray.DataArray(VALUES, dims=DIMS).transpose("channel", "y", "sample", "x")
    return {
        "npy": str(folder / "v.npy"),
        "hdf5": folder / "v.h5",
        "hdf5, name": f"{folder}/v.h5:/values",
        "hdf5, one": folder / "one.hdf5",
        "zarr": folder / "v.zarr",
        "zarr, name": f"{folder}/v.zarr:/values",
        "zarr, folder": folder / "v.zarr" / "values",
        "zarr, one": folder / "one.zarr",
        "numpy": VALUES,
        "mapped": np.load(folder / "v.npy", mmap_mode="r"),
        "masked": np.ma.masked_invalid(VALUES),
        "hdf5, object": h5py.File(folder / "v.h5")["values"],
        "zarr, object": group["values"],
        "zarr, group": group,
        "zarr, memory": zarr.array(VALUES),
        "xarray": turned,
        "xarray, dataset": xarray.Dataset({"values": turned}),
    }


def test_each_source_gives_the_same_blocks(tmp_path: Path) -> None:
    expected = map_data(VALUES, VIEW).fingerprints()
    for kind, source in _sources(tmp_path).items():
        found = map_data(source, VIEW)
        assert (found.shape, found.samples, found.channels) == (SHAPE, N, C)
        for block in (BLOCK, (slice(0, 1), slice(3, None)), (slice(2, 3),), ()):
            np.testing.assert_array_equal(found.read(block).values, VALUES[block], err_msg=kind)
        assert found.fingerprints() == expected
        assert (found.portable is not None) == isinstance(source, str | Path)
        if found.portable is not None:
            assert replace(map_data(source, VIEW, sigma=SIGMA), sigma=None).portable[2] is None
            small = pickle.dumps(found.portable)
            assert len(small) < 2000
            again = map_data(*pickle.loads(small))
            np.testing.assert_array_equal(again.read(BLOCK).values, VALUES[BLOCK])
            assert again.fingerprints() == expected
    found = map_data(VALUES, VIEW)
    found.read(BLOCK).values[...] = 0.0  # a copy
    np.testing.assert_array_equal(found.read(BLOCK).values, VALUES[BLOCK])


@pytest.mark.parametrize(
    ("shape", "leading", "channels"),
    [
        ((3, 4, N, 2), (3, 4), 2),
        ((3, 4, N), (3, 4), 1),
        ((7, N), (7,), 1),
        ((N, N), (N,), 1),
        ((2, N, N), (2,), N),  # both fit
        ((2, 3, 4, N, 1), (2, 3, 4), 1),
    ],
)
def test_channels_are_told_from_measurements(shape: tuple, leading: tuple, channels: int) -> None:
    values = np.arange(float(np.prod(shape))).reshape(shape)
    found = map_data(values, VIEW)
    assert (found.shape, found.channels) == (leading, channels)
    np.testing.assert_array_equal(found.read().values, values.reshape(*leading, N, channels))


def test_a_named_axis_decides() -> None:
    square = np.random.default_rng(0).uniform(size=(N, N, N))
    first = map_data(xarray.DataArray(square, dims=("sample", "a", "b")), VIEW)
    assert (first.shape, first.channels) == ((N, N), 1)
    np.testing.assert_array_equal(first.read().values[..., 0], np.moveaxis(square, 0, -1))
    other = map_data(xarray.DataArray(square, dims=("channel", "sample", "b")), VIEW)
    assert (other.shape, other.channels) == ((N,), N)
    np.testing.assert_array_equal(other.read().values, square.transpose(2, 1, 0))
    # and those of mask and sigma follow those of the values
    mask, sigma = xarray.DataArray(MASK, dims=DIMS[:2]).transpose(), xarray.DataArray(SIGMA, dims=DIMS)
    turned = sigma.transpose("channel", "x", "sample", "y")
    found = map_data(xarray.DataArray(VALUES, dims=DIMS), VIEW, sigma=turned, mask=mask).read()
    np.testing.assert_array_equal(found.mask, MASK)
    np.testing.assert_array_equal(found.sigma, SIGMA)


@pytest.mark.parametrize(
    "sigma", [SIGMA, SIGMA[..., 0], SIGMA[:1, :1], SIGMA[0, 0, :, 0]], ids=["full", "channels alike", "axes of 1", "N"]
)
def test_deviations_and_masks_are_of_the_block(tmp_path: Path, sigma: np.ndarray) -> None:
    np.save(tmp_path / "sigma.npy", sigma)
    hdf5_file(tmp_path / "m.h5", {"mask": 255 * MASK.astype(np.uint8), "more": MASK})
    full = np.broadcast_to(sigma[..., None] if sigma.ndim in (1, 3) else sigma, VALUES.shape)
    for given, mask in ((sigma, MASK), (tmp_path / "sigma.npy", tmp_path / "m.h5"), (sigma, xarray.DataArray(MASK))):
        found = map_data(VALUES, VIEW, sigma=given, mask=mask).read(BLOCK)
        np.testing.assert_array_equal(found.sigma, full[BLOCK])
        np.testing.assert_array_equal(found.mask, MASK[BLOCK])
    found = map_data(VALUES, VIEW).read(BLOCK)
    assert found.sigma is None
    assert found.mask.all()


def test_a_deviation_of_zero_is_named_where_it_counts() -> None:
    sigma, mask = SIGMA.copy(), np.ones(SHAPE, bool)
    sigma[2, 3, 1, 0], mask[2, 3] = 0.0, False
    with pytest.raises(ValueError, match=r"sigma: sigma is 0 in block \[1:4, 2:4\], must be above 0"):
        map_data(VALUES, VIEW, sigma=sigma).read(BLOCK)
    assert map_data(VALUES, VIEW, sigma=sigma, mask=mask).read(BLOCK).sigma is not None


REFUSED = [
    (np.ones((N, 3)), r"values has shape \(6, 3\), the geometry 6 pairs of directions: values must be \(..., 6, C\)"),
    (np.ones((4, 5, 7, 3)), r"values has shape \(4, 5, 7, 3\), the geometry 6 pairs"),
    (np.ones((0, N)), r"values has shape \(0, 6\), must hold something"),
    (np.ones((2, N), complex), "values holds complex128, must hold real numbers"),
    ([["a"] * N], "values holds <U1, must hold real numbers"),
    ("nowhere.npy", "no such file: 'nowhere.npy'"),
    (".", "a map is one array, in .npy, .*for layerjax fit and layerjax fit-many"),
    (__file__, r"test_inputs.py: a map is one array, in .npy"),
]
PARTS = [
    ({"sigma": SIGMA[1:]}, r"sigma has shape \(4, 4, 6, 2\), sigma must be \(5, 4, 6, 2\), \(5, 4, 6\)"),
    ({"mask": MASK.T}, r"mask has shape \(4, 5\), a mask must have that of the map, \(5, 4\)"),
    ({"mask": MASK.astype(float)}, "mask holds float64, a mask must hold truth values"),
]
DIRECTIONS = [
    (None, "geometry is not given, and there is nothing beside the values"),
    ((VIEW.wi, 2.0 * VIEW.wo), "geometry: wo is .* must be finite and of length 1"),
    ((VIEW.wi, VIEW.wo[:3]), r"shapes wi \(6, 3\), wo \(3, 3\) do not fit together"),
    ((VIEW.wi, VIEW.wo[:, :2]), r"\(wo\) has shape \(6, 2\), must be \(N, 3\) or \(..., N, 3\)"),
    ((VIEW.wi,), "geometry has 1 entries, must be two"),
    ({"wi": VIEW.wi}, "geometry has no directions, must hold wi and wo, or theta_i"),
    (ANGLES | {"theta_o": VIEW.theta_o + 200.0}, r"theta_o is .*, must be in \[0, 180\] degrees"),
    ((VIEW.wi, np.broadcast_to(VIEW.wo, (4, 5, N, 3))), r"for a map of \(4, 5\), the measurements are of \(5, 4\)"),
    ("view.npy", "no such file: 'view.npy'"),
]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        *(({"values": values}, message) for values, message in REFUSED),
        *PARTS,
        *(({"geometry": geometry}, message) for geometry, message in DIRECTIONS),
    ],
)
def test_what_cannot_be_is_named(given: dict, message: str) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        map_data(**{"values": VALUES, "geometry": VIEW} | given)


def test_damaged_files_are_named(tmp_path: Path) -> None:
    zarr_group(tmp_path / "v.zarr", {"values": VALUES})
    damaged = tmp_path / "v.zarr" / "values" / "c" / "1" / "1" / "0" / "0"
    damaged.write_bytes(damaged.read_bytes()[:20])
    found = map_data(tmp_path / "v.zarr", VIEW)
    np.testing.assert_array_equal(found.read((slice(0, 2),)).values, VALUES[:2])  # the rest is as good as it was
    with pytest.raises(ValueError, match=r"v.zarr:/values: block \[1:4, 2:4\] cannot be read: \S"):
        found.read(BLOCK)
    assert "?" in found.fingerprints()

    np.save(tmp_path / "v.npy", VALUES)
    later = map_data(tmp_path / "v.npy", VIEW)
    (tmp_path / "v.npy").write_bytes((tmp_path / "v.npy").read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"v.npy: block \[1:4, 2:4\] cannot be read: .*truncated"):
        later.read(BLOCK)  # to touch the pages that are gone would kill the process
    for name, junk in (("v.npy", None), ("w.npy", b"junk"), ("w.h5", b"junk")):
        if junk is not None:
            (tmp_path / name).write_bytes(junk)
        with pytest.raises(ValueError, match=rf"{name}: cannot be read: \S"):
            map_data(tmp_path / name, VIEW)


def test_a_group_with_several_arrays_says_which(tmp_path: Path) -> None:
    zarr_group(tmp_path / "v.zarr", {"first": VALUES, "second": VALUES})
    hdf5_file(tmp_path / "v.h5", {"labels": np.array([b"gloss", b"matt"])})
    for path, message in (
        ("v.zarr", r"v.zarr: no array 'values', there are first, second; PATH:/NAME chooses"),
        ("v.zarr:/third", r"v.zarr: holds no 'third'"),
        ("v.h5:/labels", r"v.h5:/labels holds \|S5, must hold real numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            map_data(f"{tmp_path}/{path}", VIEW)


def test_numbers_that_stand_for_nothing_are_nan_and_packed_ones_unpacked(tmp_path: Path) -> None:
    filled = xarray.Dataset({"values": (DIMS, VALUES)})
    encoding = {"values": {"_FillValue": -999.0}}
    filled.to_zarr(tmp_path / "v2.zarr", zarr_format=2, encoding=encoding)
    filled.to_netcdf(tmp_path / "v.h5", engine="h5netcdf", encoding=encoding)
    filled.to_zarr(tmp_path / "v3.zarr", zarr_format=3, consolidated=False, encoding=encoding)
    for name in ("v2.zarr", "v.h5", "v3.zarr"):
        np.testing.assert_array_equal(map_data(tmp_path / name, VIEW).read().values, VALUES)
    packed = {"values": {"dtype": "i2", "scale_factor": 0.001, "_FillValue": -1}}
    filled.to_netcdf(tmp_path / "packed.h5", engine="h5netcdf", encoding=packed)
    np.testing.assert_allclose(map_data(tmp_path / "packed.h5", VIEW).read().values, VALUES, atol=5e-4)


def test_fingerprints_are_of_the_content(monkeypatch: pytest.MonkeyPatch) -> None:
    def of(*given: Any, **more: Any) -> tuple[str, ...]:
        return tuple(map_data(*given, **more).fingerprints())

    plain, flipped = of(VALUES, VIEW, sigma=SIGMA, mask=MASK), MASK.copy()
    flipped[2, 2] ^= True
    seen = {
        plain,
        of(VALUES, VIEW, sigma=SIGMA, mask=flipped),
        of(VALUES, Geometry(VIEW.wo, VIEW.wi)),
        of(VALUES, VIEW),
    }
    for place in ((0, 0, 0, 0), (4, 3, 5, 1), (2, 1, 0, 0)):
        other, more = VALUES.copy(), SIGMA.copy()
        other[place] += 1e-9
        more[place] *= 1.5
        seen |= {of(other, VIEW, sigma=SIGMA, mask=MASK), of(VALUES, VIEW, sigma=more, mask=MASK)}
    assert len(seen) == 4 + 6
    assert of(VALUES.copy(), VIEW, sigma=SIGMA, mask=MASK) == plain

    monkeypatch.setattr("fits.maps.inputs.WHOLE", 0)  # now some texels alone enter, the first and the last among them
    long = np.random.default_rng(3).uniform(size=(40, 1000, N))
    first = of(long, VIEW)
    assert of(long.copy(), VIEW) == first
    for place in ((0, 0, 0), (39, 999, 5)):
        other = long.copy()
        other[place] += 1.0
        assert of(other, VIEW) != first


def test_only_blocks_are_read(tmp_path: Path) -> None:
    """A map far beyond memory is opened, and a block of it read: the file is a hole of 400 GB."""
    shape, path = (2**17, 2**17, N), tmp_path / "v.npy"
    with path.open("wb") as file:
        np.lib.format.write_array_header_2_0(file, {"shape": shape, "fortran_order": False, "descr": "<f4"})
        try:
            file.truncate(file.tell() + 4 * int(np.prod(shape)))
        except OSError:
            pytest.skip("no such long files here")
    found = map_data(path, VIEW)
    assert found.shape == shape[:2]
    np.testing.assert_array_equal(found.read((slice(7, 9), slice(5, 8))).values, np.zeros((2, 3, N, 1)))
    assert len(found.fingerprints()) > 60  # of blocks from all over it


# ---- directions ----


@pytest.mark.parametrize("kind", ["zarr", "hdf5", "xarray", "xarray, by angles"])
@pytest.mark.parametrize("own", [False, True], ids=["common", "own"])
def test_directions_may_stand_beside_the_values(tmp_path: Path, kind: str, own: bool) -> None:
    turn = np.linspace(0.0, 30.0, SHAPE[0] * SHAPE[1]).reshape(*SHAPE, 1) if own else 0.0
    wi, wo = direction(VIEW.theta_i, VIEW.phi_i), direction(VIEW.theta_o, VIEW.phi_o + turn)
    angles = ANGLES | {"phi_o": VIEW.phi_o + turn}
    if kind == "zarr":
        zarr_group(tmp_path / "v.zarr", {"values": VALUES, "wi": wi, "wo": wo})
        found = map_data(tmp_path / "v.zarr")
    elif kind == "hdf5":
        arrays = {"scan/values": VALUES} | {f"scan/{name}": given for name, given in angles.items()}
        found = map_data(f"{hdf5_file(tmp_path / 'v.h5', arrays)}:/scan/values")
    else:
        dims = DIMS[:3]
        named = {name: (dims[-np.ndim(given) :], given) for name, given in angles.items()}
        if kind == "xarray":
            vectors = {"wi": (("sample", "xyz"), wi), "wo": ((*dims[-wo.ndim + 1 :], "xyz"), wo)}
            found = map_data(xarray.Dataset(vectors | {"values": (DIMS, VALUES)}).transpose())
        else:
            found = map_data(xarray.DataArray(VALUES, dims=DIMS, coords=named).transpose("x", ...))
        wo = np.swapaxes(wo, 0, 1) if own else wo
    assert (found.geometry is None) == own
    if found.geometry is not None:
        np.testing.assert_allclose((found.geometry.wi, found.geometry.wo), (wi, wo), atol=1e-12)
        return
    block = (slice(1, 3), slice(0, 2))
    seen = found.read(block)
    np.testing.assert_allclose(seen.wi, np.broadcast_to(wi, seen.wi.shape), atol=1e-12)
    np.testing.assert_allclose(seen.wo, wo[block], atol=1e-12)
    if found.portable is not None:
        np.testing.assert_array_equal(map_data(*found.portable).read(block).wo, seen.wo)


def test_directions_come_from_elsewhere(tmp_path: Path) -> None:
    table = np.column_stack(list(ANGLES.values()))
    np.savetxt(tmp_path / "view.csv", table, delimiter=",", header=",".join(ANGLES), comments="")
    hdf5_file(tmp_path / "view.h5", {"wi": VIEW.wi, "wo": VIEW.wo})
    for given in (tmp_path / "view.csv", tmp_path / "view.h5", (VIEW.wi, VIEW.wo), {"wi": VIEW.wi, "wo": VIEW.wo}):
        found = map_data(VALUES, given).geometry
        np.testing.assert_allclose((found.wi, found.wo), (VIEW.wi, VIEW.wo), atol=1e-9)


def test_directions_of_masked_texels_are_not_looked_at() -> None:
    own = np.broadcast_to(VIEW.wo, (*SHAPE, N, 3)).copy()
    own[~MASK] = np.nan
    theta = np.broadcast_to(VIEW.theta_o, (*SHAPE, N)).copy()
    theta[~MASK] = -999.0  # whatever stands for nothing there, beside angles that all texels share
    for given, words in (
        ((VIEW.wi, own), r"geometry: wo is \[nan, nan, nan\] in block .*must be finite and of length 1"),
        (ANGLES | {"theta_o": theta}, r"theta_o is -999, must be in \[0, 180\] degrees"),
    ):
        found = map_data(VALUES, given, mask=MASK).read()
        assert found.wi.shape == found.wo.shape == (*SHAPE, N, 3)
        np.testing.assert_allclose(found.wo[MASK], np.broadcast_to(VIEW.wo, (int(MASK.sum()), N, 3)), atol=1e-12)
        assert (found.wo[~MASK] == [0.0, 0.0, 1.0]).all()
        with pytest.raises(ValueError, match=words):
            map_data(VALUES, given)
