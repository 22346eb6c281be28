"""Directions of the readings of a map: where they may stand, and what is wrong with them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray

from fits.data.geometry import Geometry, direction
from fits.maps.inputs import readings
from tests.helpers.map_files import ANGLES, BLOCK, MASK, SHAPE, VALUES, VIEW, N, hdf5_file, zarr_group


@pytest.mark.parametrize("kind", ["zarr", "hdf5", "xarray", "xarray, by angles"])
@pytest.mark.parametrize("own", [False, True], ids=["common", "own"])
def test_directions_may_stand_beside_the_values(tmp_path: Path, kind: str, own: bool) -> None:
    turn = np.linspace(0.0, 30.0, SHAPE[0] * SHAPE[1]).reshape(*SHAPE, 1) if own else 0.0
    wi, wo = direction(VIEW.theta_i, VIEW.phi_i), direction(VIEW.theta_o, VIEW.phi_o + turn)
    angles = ANGLES | {"phi_o": VIEW.phi_o + turn}
    if kind == "zarr":
        zarr_group(tmp_path / "v.zarr", {"values": VALUES, "wi": wi, "wo": wo})
        found = readings(tmp_path / "v.zarr")
    elif kind == "hdf5":
        hdf5_file(
            tmp_path / "v.h5", {"scan/values": VALUES} | {f"scan/{name}": given for name, given in angles.items()}
        )
        found = readings(f"{tmp_path}/v.h5:/scan/values")
    else:
        dims = ("y", "x", "sample")
        named = {name: (dims[-np.ndim(given) :], given) for name, given in angles.items()}
        if kind == "xarray":
            vectors = {"wi": (("sample", "xyz"), wi), "wo": ((*dims[-wo.ndim + 1 :], "xyz"), wo)}
            found = readings(xarray.Dataset(vectors | {"values": ((*dims, "channel"), VALUES)}).transpose())
        else:
            found = readings(xarray.DataArray(VALUES, dims=(*dims, "channel"), coords=named).transpose("x", ...))
        wo = np.swapaxes(wo, 0, 1) if own else wo
    assert (found.geometry is None) == own
    block = (slice(1, 3), slice(0, 2))
    seen = found.read_directions(block)
    for one, expected in zip(seen, (wi, wo), strict=True):
        expected = expected[block] if expected.ndim == 4 else expected
        np.testing.assert_allclose(one, np.broadcast_to(expected, one.shape), atol=1e-12)
    if found.portable is not None:
        np.testing.assert_array_equal(found.portable.open().read_directions(block)[1], seen[1])


def test_directions_come_from_elsewhere(tmp_path: Path) -> None:
    table = np.column_stack(list(ANGLES.values()))
    np.savetxt(tmp_path / "view.csv", table, delimiter=",", header=",".join(ANGLES), comments="")
    hdf5_file(tmp_path / "view.h5", {"wi": VIEW.wi, "wo": VIEW.wo})
    for given in (tmp_path / "view.csv", tmp_path / "view.h5", (VIEW.wi, VIEW.wo), {"wi": VIEW.wi, "wo": VIEW.wo}):
        found = readings(VALUES, given).read_directions(BLOCK)
        np.testing.assert_allclose(found, (VIEW.wi, VIEW.wo), atol=1e-9)


def test_directions_of_masked_texels_are_not_looked_at() -> None:
    own = np.broadcast_to(VIEW.wo, (*SHAPE, N, 3)).copy()
    own[~MASK] = np.nan
    found = readings(VALUES, Geometry(VIEW.wi, own), mask=MASK)
    wi, wo = found.read_directions(())
    assert wi.shape == wo.shape == (*SHAPE, N, 3)
    np.testing.assert_array_equal(wo[MASK], own[MASK])
    np.testing.assert_array_equal(wo[~MASK], np.broadcast_to([0.0, 0.0, 1.0], (int((~MASK).sum()), N, 3)))
    with pytest.raises(
        ValueError, match=r"geometry: wo is \[nan, nan, nan\] in block .*must be finite and of length 1"
    ):
        readings(VALUES, (VIEW.wi, own))


def test_angles_of_masked_texels_are_not_looked_at() -> None:
    """Whatever stands for nothing there, beside angles that all texels share."""
    own = np.broadcast_to(VIEW.theta_o, (*SHAPE, N)).copy()
    own[~MASK] = -999.0
    wi, wo = readings(VALUES, ANGLES | {"theta_o": own}, mask=MASK).read_directions(())
    np.testing.assert_allclose(wo[MASK], np.broadcast_to(VIEW.wo, (int(MASK.sum()), N, 3)), atol=1e-12)
    np.testing.assert_array_equal(wo[~MASK], np.broadcast_to([0.0, 0.0, 1.0], (int((~MASK).sum()), N, 3)))
    np.testing.assert_allclose(wi, np.broadcast_to(VIEW.wi, wi.shape), atol=1e-12)
    with pytest.raises(ValueError, match=r"theta_o is -999, must be in \[0, 180\] degrees"):
        readings(VALUES, ANGLES | {"theta_o": own})


@pytest.mark.parametrize(
    ("geometry", "message"),
    [
        (None, "geometry is not given, and there is nothing beside the readings"),
        ((VIEW.wi, 2.0 * VIEW.wo), "geometry: wo is .* must be finite and of length 1"),
        ((VIEW.wi, VIEW.wo[:3]), r"shapes wi \(6, 3\), wo \(3, 3\) do not fit together"),
        ((VIEW.wi, VIEW.wo[:, :2]), r"\(wo\) has shape \(6, 2\), must be \(N, 3\) or \(..., N, 3\)"),
        ((VIEW.wi,), "geometry has 1 entries, must be two"),
        ({"wi": VIEW.wi}, "geometry has no directions, must hold wi and wo, or theta_i"),
        (ANGLES | {"theta_o": VIEW.theta_o + 200.0}, r"theta_o is .*, must be in \[0, 180\] degrees"),
        ((VIEW.wi, np.broadcast_to(VIEW.wo, (4, 5, N, 3))), r"for a map of \(4, 5\), the readings are of \(5, 4\)"),
        ("view.npy", "no such file: 'view.npy'"),
    ],
)
def test_directions_that_are_none_are_named(geometry: Any, message: str) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        readings(VALUES, geometry)
