"""Measurements of a map by blocks: every source gives the same numbers, and what is wrong is named."""

import os
import pickle
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray
import zarr

from fits.data.geometry import Geometry, direction
from fits.maps.inputs import map_data
from tests.helpers.map_files import ANGLES, BLOCK, MASK, SHAPE, SIGMA, VALUES, VIEW, C, N, hdf5_file, zarr_group
from tests.helpers.refusals import refuses

DIMS = ("y", "x", "sample", "channel")


def sources(folder):
    """`VALUES` as each kind of source."""
    np.save(folder / "v.npy", VALUES)
    hdf5_file(folder / "v.h5", {"values": VALUES, "other": MASK}, chunks=True, compression="gzip")
    hdf5_file(folder / "one.hdf5", {"anything": VALUES, "labels": np.array([b"gloss", b"matt"])})
    group = zarr_group(folder / "v.zarr", {"values": VALUES, "other": MASK})
    zarr.create_array(folder / "one.zarr", data=VALUES)
    turned = xarray.DataArray(VALUES, dims=DIMS).transpose("channel", "y", "sample", "x")
    turned.to_dataset(name="values").to_zarr(folder / "named.zarr", consolidated=False)
    files = ["v.npy", "v.h5", "v.h5:/values", "one.hdf5", "v.zarr", "v.zarr:/values", "v.zarr/values", "one.zarr"]
    return {
        **{name: f"{folder}/{name}" for name in [*files, "named.zarr"]},
        "path": folder / "v.npy",
        "numpy": VALUES,
        "mapped": np.load(folder / "v.npy", mmap_mode="r"),
        "masked": np.ma.masked_invalid(VALUES),
        "hdf5, object": h5py.File(folder / "v.h5")["values"],
        "zarr, object": group["values"],
        "xarray": turned,
        "xarray, dataset": xarray.Dataset({"values": turned}),
    }


def test_each_source_gives_the_same_blocks(tmp_path):
    expected = map_data(VALUES, VIEW).fingerprint()
    for kind, source in sources(tmp_path).items():
        data = map_data(source, VIEW)
        assert (data.shape, data.samples, data.channels) == (SHAPE, N, C)
        for block in (BLOCK, (slice(0, 1), slice(3, None)), (slice(2, 3),), ()):
            np.testing.assert_array_equal(data.read(block).values, VALUES[block], err_msg=kind)
        assert data.fingerprint() == expected
        if isinstance(source, str | Path):  # another process opens it again
            small = pickle.dumps(data)
            assert len(small) < 2000
            again = pickle.loads(small)
            np.testing.assert_array_equal(again.read(BLOCK).values, VALUES[BLOCK])
            assert again.fingerprint() == expected
    map_data(VALUES, VIEW).read(BLOCK).values[...] = 0.0  # a copy
    np.testing.assert_array_equal(map_data(VALUES, VIEW).read(BLOCK).values, VALUES[BLOCK])


def test_channels_are_distinguished_from_measurements_by_their_number_or_the_names_of_axes():
    for leading, channels in (((3, 4), (2,)), ((7,), ()), ((N,), ()), ((2,), (N,)), ((2, 3, 4), (1,))):
        values = np.random.default_rng(0).uniform(size=(*leading, N, *channels))
        data = map_data(values, VIEW)
        assert (data.shape, data.channels) == (leading, *(channels or (1,)))
        np.testing.assert_array_equal(data.read().values, values.reshape(*leading, N, -1))
    square = np.random.default_rng(0).uniform(size=(N, N, N))
    for dims, expected in (
        (("sample", "a", "b"), np.moveaxis(square, 0, -1)[..., None]),
        (("channel", "sample", "b"), square.transpose(2, 1, 0)),
    ):
        np.testing.assert_array_equal(map_data(xarray.DataArray(square, dims=dims), VIEW).read().values, expected)


@pytest.mark.parametrize("sigma", [SIGMA, SIGMA[..., 0], SIGMA[0, 0, :, 0]], ids=["full", "same for channels", "N"])
def test_deviations_and_masks_are_of_the_block(tmp_path, sigma):
    np.save(tmp_path / "sigma.npy", sigma)
    hdf5_file(tmp_path / "m.h5", {"mask": 255 * MASK.astype(np.uint8), "more": MASK})
    full = np.broadcast_to(sigma[..., None] if sigma.ndim in (1, 3) else sigma, VALUES.shape)
    for source, mask in ((sigma, MASK), (tmp_path / "sigma.npy", tmp_path / "m.h5"), (sigma, xarray.DataArray(MASK))):
        data = map_data(VALUES, VIEW, sigma=source, mask=mask).read(BLOCK)
        np.testing.assert_array_equal(data.sigma, full[BLOCK])
        np.testing.assert_array_equal(data.mask, MASK[BLOCK])
    data = map_data(VALUES, VIEW).read(BLOCK)
    assert (data.sigma, data.mask.all()) == (None, True)
    zero, mask = SIGMA.copy(), np.ones(SHAPE, bool)
    zero[2, 3, 1, 0], mask[2, 3] = 0.0, False
    with pytest.raises(ValueError, match=r"sigma: sigma is 0 in block \[1:4, 2:4\], must be above 0"):
        map_data(VALUES, VIEW, sigma=zero).read(BLOCK)
    assert map_data(VALUES, VIEW, sigma=zero, mask=mask).read(BLOCK).sigma is not None


def test_bad_input_is_named():
    for arguments, message in (
        ({"values": np.ones((N, 3))}, r"values has shape \(6, 3\), the geometry 6 .*: values must be \(..., 6, C\)"),
        ({"values": np.ones((0, N))}, r"values has shape \(0, 6\), must hold something"),
        ({"values": np.ones((2, N), complex)}, "values holds complex128, must hold real numbers"),
        ({"values": "."}, "a map is one array, in one of .npy, .*for layerjax fit and layerjax fit-many"),
        ({"sigma": SIGMA[1:]}, r"sigma has shape \(4, 4, 6, 2\), must be \(5, 4, 6, 2\) or \(5, 4, 6\) or \(6,\)"),
        ({"mask": MASK.T}, r"mask has shape \(4, 5\), must be \(5, 4\)"),
        ({"mask": MASK.astype(float)}, "mask holds float64, a mask must hold truth values"),
        ({"geometry": None}, r"geometry \(--geometry\) is not given, and there are no directions beside the values"),
        ({"geometry": (VIEW.wi, 2.0 * VIEW.wo)}, "geometry: wo is .* must be finite and of length 1"),
        ({"geometry": (VIEW.wi, VIEW.wo[:3])}, r"geometry/wo has shape \(3, 3\), must be \(6, 3\) or \(5, 4, 6, 3\)"),
        ({"geometry": (VIEW.wi,)}, "geometry has 1 entries, must be two"),
        ({"geometry": {"wi": VIEW.wi}}, "geometry holds no directions: wi and wo, or theta_i"),
        ({"geometry": ANGLES | {"theta_o": VIEW.theta_o + 200.0}}, r"theta_o is .*, must be in \[0, 180\] degrees"),
        ({"geometry": "view.npy"}, "no such file: 'view.npy'"),
    ):
        given = {"values": VALUES, "geometry": VIEW} | arguments
        refuses(message, map_data, **given, error=(ValueError, FileNotFoundError))


def test_damaged_files_and_arrays_that_are_not_there_are_named(tmp_path):
    zarr_group(tmp_path / "v.zarr", {"values": VALUES})
    os.truncate(tmp_path / "v.zarr/values/c/1/1/0/0", 20)
    data = map_data(tmp_path / "v.zarr", VIEW)
    np.testing.assert_array_equal(data.read((slice(0, 2),)).values, VALUES[:2])  # the rest is as good as it was
    refuses(r"v.zarr:/values: block \[1:4, 2:4\] cannot be read: \S", data.read, BLOCK)
    refuses("cannot be read", data.fingerprint)
    np.save(tmp_path / "v.npy", VALUES)
    os.truncate(tmp_path / "v.npy", 1000)
    (tmp_path / "w.h5").write_bytes(b"junk")
    zarr_group(tmp_path / "two.zarr", {"first": VALUES, "second": VALUES})
    hdf5_file(tmp_path / "v.h5", {"labels": np.array([b"gloss", b"matt"])})
    for path, message in (
        *((name, rf"{name}: cannot be read: \S") for name in ("v.npy", "w.h5")),
        ("two.zarr", r"two.zarr: no array 'values' of numbers, there are first, second; PATH:/NAME chooses"),
        ("two.zarr:/third", r"two.zarr: holds no 'third'"),
        ("v.h5", r"v.h5: no array 'values' of numbers, there is none"),
    ):
        refuses(message, map_data, f"{tmp_path}/{path}", VIEW)


def test_numbers_that_stand_for_nothing_are_nan_and_packed_ones_unpacked(tmp_path):
    filled = xarray.Dataset({"values": (DIMS, VALUES)})
    encoding = {"values": {"dtype": "i2", "scale_factor": 0.001, "_FillValue": -1}}
    filled.to_zarr(tmp_path / "v2.zarr", zarr_format=2, encoding=encoding)
    filled.to_netcdf(tmp_path / "v.h5", engine="h5netcdf", encoding=encoding)
    filled.to_zarr(tmp_path / "v3.zarr", zarr_format=3, consolidated=False, encoding=encoding)
    for name in ("v2.zarr", "v.h5", "v3.zarr"):
        np.testing.assert_allclose(map_data(tmp_path / name, VIEW).read().values, VALUES, atol=5e-4)


def test_fingerprints_are_of_the_content(monkeypatch):
    def fingerprint(**changes):
        return map_data(**{"values": VALUES, "geometry": VIEW, "sigma": SIGMA, "mask": MASK} | changes).fingerprint()

    def changed(array, *place):
        copy = array.copy()
        copy[place] = not copy[place] if copy.dtype == bool else copy[place] + 1.0
        return copy

    changes = [{"sigma": None, "mask": None}, {"geometry": Geometry(VIEW.wo, VIEW.wi)}, {"mask": changed(MASK, 2, 2)}]
    changes += [{"values": changed(VALUES, 4, 3, 5, 1)}, {"sigma": changed(SIGMA, 2, 1, 0, 0)}]
    assert len({fingerprint(), *(fingerprint(**one) for one in changes)}) == 6
    assert fingerprint(values=VALUES.copy()) == fingerprint()
    monkeypatch.setattr("fits.maps.inputs.WHOLE", 0)  # now some texels enter, the first and the last among them
    long = np.random.default_rng(3).uniform(size=(40, 1000, N))
    given = long, changed(long, 0, 0, 0), changed(long, -1, -1, -1), long.copy()
    first, *others, same = (map_data(one, VIEW).fingerprint() for one in given)
    assert first == same not in others


def test_only_blocks_are_read(tmp_path):
    """A map far beyond memory is opened, and a block of it read: the file is a hole of 400 GB."""
    shape, path = (2**17, 2**17, N), tmp_path / "v.npy"
    with path.open("wb") as file:
        np.lib.format.write_array_header_2_0(file, {"shape": shape, "fortran_order": False, "descr": "<f4"})
        try:
            file.truncate(file.tell() + 4 * int(np.prod(shape)))
        except OSError:
            pytest.skip("no such long files here")
    data = map_data(path, VIEW)
    assert data.shape == shape[:2]
    np.testing.assert_array_equal(data.read((slice(7, 9), slice(5, 8))).values, np.zeros((2, 3, N, 1)))
    assert data.fingerprint()


@pytest.mark.parametrize(("kind", "each"), [("zarr", True), ("hdf5", False), ("hdf5", True), ("xarray", True)])
def test_directions_may_stand_beside_the_values(tmp_path, kind, each):
    turn = np.linspace(0.0, 30.0, SHAPE[0] * SHAPE[1]).reshape(*SHAPE, 1) if each else 0.0
    wi, wo = direction(VIEW.theta_i, VIEW.phi_i), direction(VIEW.theta_o, VIEW.phi_o + turn)
    angles = ANGLES | {"phi_o": VIEW.phi_o + turn}
    if kind == "zarr":
        zarr_group(tmp_path / "v.zarr", {"values": VALUES, "wi": wi, "wo": wo})
        data = map_data(tmp_path / "v.zarr")
    elif kind == "hdf5":
        arrays = {"scan/values": VALUES} | {f"scan/{name}": array for name, array in angles.items()}
        data = map_data(f"{hdf5_file(tmp_path / 'v.h5', arrays)}:/scan/values")
    else:
        named = {name: (DIMS[3 - np.ndim(array) : 3], array) for name, array in angles.items()}
        data = map_data(xarray.Dataset({"values": (DIMS, VALUES)}, coords=named))
    assert (data.geometry is None) == each
    if not each:
        np.testing.assert_allclose((data.geometry.wi, data.geometry.wo), (wi, wo), atol=1e-12)
        return
    block = (slice(1, 3), slice(0, 2))
    measured = data.read(block)
    np.testing.assert_allclose(measured.wi, np.broadcast_to(wi, measured.wi.shape), atol=1e-12)
    np.testing.assert_allclose(measured.wo, wo[block], atol=1e-12)
    if kind != "xarray":
        np.testing.assert_array_equal(pickle.loads(pickle.dumps(data)).read(block).wo, measured.wo)


def test_directions_come_from_elsewhere_and_those_of_masked_texels_are_not_looked_at(tmp_path):
    table = np.column_stack(list(ANGLES.values()))
    np.savetxt(tmp_path / "view.csv", table, delimiter=",", header=",".join(ANGLES), comments="")
    hdf5_file(tmp_path / "view.h5", pair := {"wi": VIEW.wi, "wo": VIEW.wo})
    for source in (tmp_path / "view.csv", tmp_path / "view.h5", (VIEW.wi, VIEW.wo), pair):
        view = map_data(VALUES, source).geometry
        np.testing.assert_allclose((view.wi, view.wo), (VIEW.wi, VIEW.wo), atol=1e-9)
    own, theta = np.broadcast_to(VIEW.wo, (*SHAPE, N, 3)).copy(), np.broadcast_to(VIEW.theta_o, (*SHAPE, N)).copy()
    own[~MASK], theta[~MASK] = np.nan, -999.0  # whatever stands for nothing there
    for source, words in (
        ((VIEW.wi, own), r"geometry: wo is \[nan, nan, nan\] in block .*must be finite and of length 1"),
        (ANGLES | {"theta_o": theta}, r"theta_o is -999, must be in \[0, 180\] degrees"),
    ):
        measured = map_data(VALUES, source, mask=MASK).read()
        np.testing.assert_allclose(measured.wo[MASK], np.broadcast_to(VIEW.wo, (MASK.sum(), N, 3)), atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(measured.wo, axis=-1), 1.0, atol=1e-12)
        refuses(words, map_data, VALUES, source)
