"""One small map that is fitted once for all tests of maps."""

import shutil

import pytest

from tests.helpers import quick_maps


@pytest.fixture(scope="session")
def geometry():
    return quick_maps.geometry()


@pytest.fixture(scope="session")
def measured():
    """Values of 8 x 8 texels, none of them missing."""
    return quick_maps.values((8, 8))


@pytest.fixture(scope="session")
def whole(tmp_path_factory, measured):
    """Their map, of an undisturbed run."""
    return quick_maps.fitted(tmp_path_factory.mktemp("map") / "coat.zarr", measured)


@pytest.fixture
def out(tmp_path, whole):
    """A copy of its store."""
    return shutil.copytree(whole.path, tmp_path / "coat.zarr")
