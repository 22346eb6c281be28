"""Texts as files, and the bytes of one file of every format."""

import functools

import pytest

from fits.data.reading import read
from tests.helpers.data_files import FILES, written


@pytest.fixture
def reading(tmp_path):
    """What a text, or bytes, reads as, as a file of that name."""
    return lambda text, name="data.txt", **options: read(written(tmp_path, text, name), **options)


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """The bytes of a file of a format, made once."""
    folder = tmp_path_factory.mktemp("files")
    return functools.cache(lambda kind: FILES[kind](folder))
