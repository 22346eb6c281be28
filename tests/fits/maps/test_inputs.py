"""Measurements of a map by blocks: every source gives the same numbers, and what is wrong is named."""

import pickle
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


def _source(kind: str, folder: Path) -> Any:
    """`VALUES` as each kind of source."""
    np.save(folder / "v.npy", VALUES)
    if kind == "numpy":
        return VALUES
    if kind == "mapped":
        return np.load(folder / "v.npy", mmap_mode="r")
    if kind == "npy":
        return str(folder / "v.npy")
    if kind.startswith("hdf5"):
        hdf5_file(folder / "v.h5", {"values": VALUES, "other": MASK}, chunks=True, compression="gzip")
        hdf5_file(folder / "one.hdf5", {"anything": VALUES})
        return {
            "hdf5": folder / "v.h5",
            "hdf5, name": f"{folder}/v.h5:/values",
            "hdf5, one": folder / "one.hdf5",
            "hdf5, object": h5py.File(folder / "v.h5")["values"],
        }[kind]
    if kind.startswith("zarr"):
        group = zarr_group(folder / "v.zarr", {"values": VALUES, "other": MASK})
        zarr.create_array(folder / "one.zarr", data=VALUES)
        return {
            "zarr": folder / "v.zarr",
            "zarr, name": f"{folder}/v.zarr:/values",
            "zarr, folder": folder / "v.zarr" / "values",
            "zarr, one": folder / "one.zarr",
            "zarr, object": group["values"],
            "zarr, group": group,
            "zarr, memory": zarr.array(VALUES),
        }[kind]
    turned = xarray.DataArray(VALUES, dims=("y", "x", "sample", "channel")).transpose("channel", "y", "sample", "x")
    return {"xarray": turned, "xarray, dataset": xarray.Dataset({"values": turned})}[kind]


BY_NAME = ["npy", "hdf5", "hdf5, name", "hdf5, one", "zarr", "zarr, name", "zarr, folder", "zarr, one"]
OBJECTS = [
    "numpy",
    "mapped",
    "hdf5, object",
    "zarr, object",
    "zarr, group",
    "zarr, memory",
    "xarray",
    "xarray, dataset",
]


@pytest.mark.parametrize("kind", BY_NAME + OBJECTS)
def test_each_source_gives_the_same_block(tmp_path: Path, kind: str) -> None:
    found = map_data(_source(kind, tmp_path), VIEW)
    assert (found.shape, found.samples, found.channels) == (SHAPE, N, C)
    for block in (BLOCK, (slice(0, 1), slice(3, None)), (slice(2, 3),), ()):
        np.testing.assert_array_equal(found.read(block), VALUES[block])
    assert found.read(BLOCK).dtype == np.float64
    assert found.fingerprint() == map_data(VALUES, VIEW).fingerprint()
    assert (found.portable is not None) == (kind in BY_NAME)
    if found.portable is not None:
        small = pickle.dumps(found.portable)
        assert len(small) < 2000
        again = map_data(*pickle.loads(small))
        np.testing.assert_array_equal(again.read(BLOCK), VALUES[BLOCK])
        assert again.fingerprint() == found.fingerprint()


def test_what_is_small_goes_to_other_processes_from_memory(tmp_path: Path) -> None:
    np.save(tmp_path / "v.npy", VALUES)
    sigma, mask = SIGMA[0, 0, :, 0], xarray.DataArray(MASK)
    found = map_data(tmp_path / "v.npy", VIEW, sigma=sigma, mask=mask)
    again = map_data(*pickle.loads(pickle.dumps(found.portable)))
    assert again.fingerprint() == found.fingerprint()
    np.testing.assert_array_equal(again.read_mask(BLOCK), MASK[BLOCK])
    np.testing.assert_array_equal(again.read_sigma(BLOCK), found.read_sigma(BLOCK))
    assert map_data(tmp_path / "v.npy", VIEW, sigma=SIGMA).portable is None


def test_blocks_are_copies_and_are_asked_for_by_slices() -> None:
    found = map_data(VALUES, VIEW)
    found.read(BLOCK)[...] = 0.0
    np.testing.assert_array_equal(found.read(BLOCK), VALUES[BLOCK])
    with pytest.raises(ValueError, match="must be slices without a step along 2 axes"):
        found.read((slice(0, 4, 2),))


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
    np.testing.assert_array_equal(found.read(()), values.reshape(*leading, N, channels))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            np.ones((N, 3)),
            r"values has shape \(6, 3\), the geometry 6 pairs of directions: values must be \(..., 6, C\)",
        ),
        (np.ones((4, 5, 7, 3)), r"values has shape \(4, 5, 7, 3\), the geometry 6 pairs"),
        (np.ones(N), r"values has shape \(6,\)"),
        (np.ones((0, N)), r"values has shape \(0, 6\), must hold something"),
        (np.ones((2, N), complex), "values holds complex128, must hold real numbers"),
        ([["a"] * N], "values holds <U1, must hold real numbers"),
        ("nowhere.npy", "no such file: 'nowhere.npy'"),
        (".", "is a folder, .* layerjax fit-many"),
        (__file__, r"test_inputs.py: ends in '.py', a map is read from .npy, .h5, .hdf5 or .zarr"),
    ],
)
def test_values_that_are_none_are_named(values: Any, message: str) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        map_data(values, VIEW)


def test_a_named_axis_decides() -> None:
    square = np.random.default_rng(0).uniform(size=(N, N, N))
    first = map_data(xarray.DataArray(square, dims=("sample", "a", "b")), VIEW)
    assert (first.shape, first.channels) == ((N, N), 1)
    np.testing.assert_array_equal(first.read(())[..., 0], np.moveaxis(square, 0, -1))
    other = map_data(xarray.DataArray(square, dims=("channel", "sample", "b")), VIEW)
    assert (other.shape, other.channels) == ((N,), N)
    np.testing.assert_array_equal(other.read(()), square.transpose(2, 1, 0))


@pytest.mark.parametrize(
    "sigma", [SIGMA, SIGMA[..., 0], SIGMA[:1, :1], SIGMA[0, 0, :, 0]], ids=["full", "channels alike", "axes of 1", "N"]
)
def test_deviations_broadcast(tmp_path: Path, sigma: np.ndarray) -> None:
    path = tmp_path / "sigma.npy"
    np.save(path, sigma)
    full = np.broadcast_to(sigma[..., None] if sigma.ndim in (1, 3) else sigma, VALUES.shape)
    for given in (sigma, path):
        found = map_data(VALUES, VIEW, sigma=given).read_sigma(BLOCK)
        np.testing.assert_array_equal(found, full[BLOCK])
    assert map_data(VALUES, VIEW).read_sigma(BLOCK) is None


def test_a_mask_is_of_truth_values_or_whole_numbers(tmp_path: Path) -> None:
    hdf5_file(tmp_path / "m.h5", {"mask": 255 * MASK.astype(np.uint8), "more": MASK})
    for given in (MASK, tmp_path / "m.h5", xarray.DataArray(MASK)):
        found = map_data(VALUES, VIEW, mask=given).read_mask(BLOCK)
        np.testing.assert_array_equal(found, MASK[BLOCK])
        assert found.dtype == bool
    assert map_data(VALUES, VIEW).read_mask(BLOCK).all()


def test_named_axes_of_mask_and_sigma_follow_those_of_the_values() -> None:
    values = xarray.DataArray(VALUES, dims=("y", "x", "sample", "channel"))
    mask, sigma = xarray.DataArray(MASK, dims=("y", "x")).transpose(), xarray.DataArray(SIGMA, dims=values.dims)
    found = map_data(values, VIEW, sigma=sigma.transpose("channel", "x", "sample", "y"), mask=mask)
    np.testing.assert_array_equal(found.read_mask(()), MASK)
    np.testing.assert_array_equal(found.read_sigma(()), SIGMA)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sigma": SIGMA[1:]}, r"sigma has shape \(4, 4, 6, 2\), sigma must be \(5, 4, 6, 2\), \(5, 4, 6\)"),
        ({"mask": MASK.T}, r"mask has shape \(4, 5\), a mask must have that of the map, \(5, 4\)"),
        ({"mask": MASK.astype(float)}, "mask holds float64, a mask must hold truth values"),
    ],
)
def test_what_does_not_fit_the_values_is_named(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        map_data(VALUES, VIEW, **options)


def test_a_deviation_of_zero_is_named_where_it_counts() -> None:
    sigma = SIGMA.copy()
    sigma[2, 3, 1, 0] = 0.0
    with pytest.raises(ValueError, match=r"sigma: sigma is 0 in block \[1:4, 2:4\], must be above 0"):
        map_data(VALUES, VIEW, sigma=sigma).read_sigma(BLOCK)
    mask = np.ones(SHAPE, bool)
    mask[2, 3] = False
    assert map_data(VALUES, VIEW, sigma=sigma, mask=mask).read_sigma(BLOCK) is not None


def test_damaged_files_are_named(tmp_path: Path) -> None:
    zarr_group(tmp_path / "v.zarr", {"values": VALUES})
    damaged = tmp_path / "v.zarr" / "values" / "c" / "1" / "1" / "0" / "0"
    damaged.write_bytes(damaged.read_bytes()[:20])
    found = map_data(tmp_path / "v.zarr", VIEW)
    np.testing.assert_array_equal(found.read((slice(0, 2),)), VALUES[:2])  # the rest is as good as it was
    with pytest.raises(ValueError, match=r"v.zarr:/values: block \[1:4, 2:4\] cannot be read: \S"):
        found.read(BLOCK)

    path = hdf5_file(tmp_path / "v.h5", {"values": VALUES}, chunks=(5, 4, N, C), compression="gzip")
    content = bytearray(path.read_bytes())
    content[-200:] = bytes(200)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"v\.h5"):
        map_data(path, VIEW).read(BLOCK)

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
    with pytest.raises(ValueError, match=r"v.zarr: no array 'values', there are first, second; PATH:/NAME chooses"):
        map_data(tmp_path / "v.zarr", VIEW)
    with pytest.raises(ValueError, match=r"v.zarr: holds no 'third'"):
        map_data(f"{tmp_path}/v.zarr:/third", VIEW)
    labels = np.array([b"gloss", b"matt"])
    hdf5_file(tmp_path / "v.h5", {"anything": VALUES, "labels": labels})  # words count for nothing
    np.testing.assert_array_equal(map_data(tmp_path / "v.h5", VIEW).read(()), VALUES)
    with pytest.raises(ValueError, match=r"v.h5:/labels holds \|S5, must hold real numbers"):
        map_data(f"{tmp_path}/v.h5:/labels", VIEW)


def test_numbers_that_stand_for_nothing_are_nan(tmp_path: Path) -> None:
    filled = xarray.Dataset({"values": (("y", "x", "sample", "channel"), VALUES)})
    encoding = {"values": {"_FillValue": -999.0}}
    filled.to_zarr(tmp_path / "v2.zarr", zarr_format=2, encoding=encoding)
    filled.to_netcdf(tmp_path / "v.h5", engine="h5netcdf", encoding=encoding)
    filled.to_zarr(tmp_path / "v3.zarr", zarr_format=3, consolidated=False, encoding=encoding)
    for name in ("v2.zarr", "v.h5", "v3.zarr"):
        np.testing.assert_array_equal(map_data(tmp_path / name, VIEW).read(()), VALUES)
    packed = {"values": {"dtype": "i2", "scale_factor": 0.001, "_FillValue": -1}}
    filled.to_netcdf(tmp_path / "packed.h5", engine="h5netcdf", encoding=packed)
    np.testing.assert_allclose(map_data(tmp_path / "packed.h5", VIEW).read(()), VALUES, atol=5e-4)
    hidden = np.ma.masked_invalid(VALUES)
    np.testing.assert_array_equal(map_data(hidden, VIEW).read(()), VALUES)


def test_the_digest_is_of_the_content(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = map_data(VALUES, VIEW, sigma=SIGMA, mask=MASK)
    seen = {plain.fingerprint()}
    for place in ((0, 0, 0, 0), (4, 3, 5, 1), (2, 1, 0, 0)):
        other = VALUES.copy()
        other[place] += 1e-9
        seen |= {map_data(other, VIEW, sigma=SIGMA, mask=MASK).fingerprint()}
        more = SIGMA.copy()
        more[place] *= 1.5
        seen |= {map_data(VALUES, VIEW, sigma=more, mask=MASK).fingerprint()}
    flipped = MASK.copy()
    flipped[2, 2] ^= True
    turned = Geometry(VIEW.wo, VIEW.wi)
    seen |= {map_data(VALUES, VIEW, sigma=SIGMA, mask=flipped).fingerprint(), map_data(VALUES, turned).fingerprint()}
    seen |= {map_data(VALUES, VIEW).fingerprint(), map_data(VALUES.astype(np.float32), VIEW).fingerprint()}
    assert len(seen) == 1 + 6 + 4
    assert map_data(VALUES.copy(), VIEW, sigma=SIGMA, mask=MASK).fingerprint() == plain.fingerprint()

    monkeypatch.setattr("fits.maps.inputs.WHOLE", 0)  # now some texels alone enter, the first and the last among them
    long = np.random.default_rng(3).uniform(size=(40, 1000, N))
    first = map_data(long, VIEW).fingerprint()
    assert map_data(long.copy(), VIEW).fingerprint() == first
    for place in ((0, 0, 0), (39, 999, 5)):
        other = long.copy()
        other[place] += 1.0
        assert map_data(other, VIEW).fingerprint() != first


def test_only_blocks_are_read(tmp_path: Path) -> None:
    """A map far beyond memory is opened, and a block of it read: the file is a hole of 400 GB."""
    shape = (2**17, 2**17, N)
    path = tmp_path / "v.npy"
    with path.open("wb") as file:
        header = {"shape": shape, "fortran_order": False, "descr": "<f4"}
        np.lib.format.write_array_header_2_0(file, header)
        try:
            file.truncate(file.tell() + 4 * int(np.prod(shape)))
        except OSError:
            pytest.skip("no such long files here")
    found = map_data(path, VIEW)
    assert found.shape == shape[:2]
    np.testing.assert_array_equal(found.read((slice(7, 9), slice(5, 8))), np.zeros((2, 3, N, 1)))
    assert found.fingerprint().count(",") > 60  # of blocks from all over it


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
        hdf5_file(
            tmp_path / "v.h5", {"scan/values": VALUES} | {f"scan/{name}": given for name, given in angles.items()}
        )
        found = map_data(f"{tmp_path}/v.h5:/scan/values")
    else:
        dims = ("y", "x", "sample")
        named = {name: (dims[-np.ndim(given) :], given) for name, given in angles.items()}
        if kind == "xarray":
            vectors = {"wi": (("sample", "xyz"), wi), "wo": ((*dims[-wo.ndim + 1 :], "xyz"), wo)}
            found = map_data(xarray.Dataset(vectors | {"values": ((*dims, "channel"), VALUES)}).transpose())
        else:
            found = map_data(xarray.DataArray(VALUES, dims=(*dims, "channel"), coords=named).transpose("x", ...))
        wo = np.swapaxes(wo, 0, 1) if own else wo
    assert (found.geometry is None) == own
    block = (slice(1, 3), slice(0, 2))
    seen = found.read_directions(block)
    for one, expected in zip(seen, (wi, wo), strict=True):
        expected = expected[block] if expected.ndim == 4 else expected
        np.testing.assert_allclose(one, np.broadcast_to(expected, one.shape), atol=1e-12)
    if found.portable is not None:
        np.testing.assert_array_equal(map_data(*found.portable).read_directions(block)[1], seen[1])


def test_directions_come_from_elsewhere(tmp_path: Path) -> None:
    table = np.column_stack(list(ANGLES.values()))
    np.savetxt(tmp_path / "view.csv", table, delimiter=",", header=",".join(ANGLES), comments="")
    hdf5_file(tmp_path / "view.h5", {"wi": VIEW.wi, "wo": VIEW.wo})
    for given in (tmp_path / "view.csv", tmp_path / "view.h5", (VIEW.wi, VIEW.wo), {"wi": VIEW.wi, "wo": VIEW.wo}):
        found = map_data(VALUES, given).read_directions(BLOCK)
        np.testing.assert_allclose(found, (VIEW.wi, VIEW.wo), atol=1e-9)


def test_directions_of_masked_texels_are_not_looked_at() -> None:
    own = np.broadcast_to(VIEW.wo, (*SHAPE, N, 3)).copy()
    own[~MASK] = np.nan
    found = map_data(VALUES, Geometry(VIEW.wi, own), mask=MASK)
    wi, wo = found.read_directions(())
    assert wi.shape == wo.shape == (*SHAPE, N, 3)
    np.testing.assert_array_equal(wo[MASK], own[MASK])
    np.testing.assert_array_equal(wo[~MASK], np.broadcast_to([0.0, 0.0, 1.0], (int((~MASK).sum()), N, 3)))
    with pytest.raises(
        ValueError, match=r"geometry: wo is \[nan, nan, nan\] in block .*must be finite and of length 1"
    ):
        map_data(VALUES, (VIEW.wi, own))


def test_angles_of_masked_texels_are_not_looked_at() -> None:
    """Whatever stands for nothing there, beside angles that all texels share."""
    own = np.broadcast_to(VIEW.theta_o, (*SHAPE, N)).copy()
    own[~MASK] = -999.0
    wi, wo = map_data(VALUES, ANGLES | {"theta_o": own}, mask=MASK).read_directions(())
    np.testing.assert_allclose(wo[MASK], np.broadcast_to(VIEW.wo, (int(MASK.sum()), N, 3)), atol=1e-12)
    np.testing.assert_array_equal(wo[~MASK], np.broadcast_to([0.0, 0.0, 1.0], (int((~MASK).sum()), N, 3)))
    np.testing.assert_allclose(wi, np.broadcast_to(VIEW.wi, wi.shape), atol=1e-12)
    with pytest.raises(ValueError, match=r"theta_o is -999, must be in \[0, 180\] degrees"):
        map_data(VALUES, ANGLES | {"theta_o": own})


@pytest.mark.parametrize(
    ("geometry", "message"),
    [
        (None, "geometry is not given, and there is nothing beside the values"),
        ((VIEW.wi, 2.0 * VIEW.wo), "geometry: wo is .* must be finite and of length 1"),
        ((VIEW.wi, VIEW.wo[:3]), r"shapes wi \(6, 3\), wo \(3, 3\) do not fit together"),
        ((VIEW.wi, VIEW.wo[:, :2]), r"\(wo\) has shape \(6, 2\), must be \(N, 3\) or \(..., N, 3\)"),
        ((VIEW.wi,), "geometry has 1 entries, must be two"),
        ({"wi": VIEW.wi}, "geometry has no directions, must hold wi and wo, or theta_i"),
        (ANGLES | {"theta_o": VIEW.theta_o + 200.0}, r"theta_o is .*, must be in \[0, 180\] degrees"),
        ((VIEW.wi, np.broadcast_to(VIEW.wo, (4, 5, N, 3))), r"for a map of \(4, 5\), the measurements are of \(5, 4\)"),
        ("view.npy", "no such file: 'view.npy'"),
    ],
)
def test_directions_that_are_none_are_named(geometry: Any, message: str) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        map_data(VALUES, geometry)
