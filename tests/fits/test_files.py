"""Files as they are written."""

import os
from pathlib import Path

import pytest

from fits._files import write_text


def test_files_are_written_without_touching_the_umask_that_other_threads_share(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "plain").touch()
    monkeypatch.setattr(os, "umask", lambda mode: pytest.fail("the umask is set"))
    write_text(tmp_path / "own", "text")
    assert (tmp_path / "own").stat().st_mode == (tmp_path / "plain").stat().st_mode
