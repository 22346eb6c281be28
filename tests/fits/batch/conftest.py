"""A folder of measurements, and reports that cost nothing."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from fits.batch import fit_file, fit_files
from tests.helpers.coats import make_folder


@pytest.fixture(scope="module", autouse=True)
def no_pictures() -> Iterator[None]:
    """Other tests look at reports of single fits; in this process they are not drawn here."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (fit_file, fit_files):
            patch.setattr(
                module, "write_report", lambda folder, *_: (folder / "report.html").write_text("drawn") and None
            )
        yield


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory, with scans/, coat.toml and bare.toml."""
    make_folder(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path
