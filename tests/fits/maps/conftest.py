"""One small map that is fitted once for all tests of maps."""

import shutil

import pytest

from tests.helpers import quick_maps


@pytest.fixture(scope="session")
def measured():
    return quick_maps.values((8, 8))


@pytest.fixture(scope="session")
def whole(tmp_path_factory, measured):
    return quick_maps.fitted(tmp_path_factory.mktemp("map") / "coat.zarr", measured)


@pytest.fixture
def out(tmp_path, whole):
    return shutil.copytree(whole.path, tmp_path / "coat.zarr")
