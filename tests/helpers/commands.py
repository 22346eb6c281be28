"""Commands of `layerjax` that must fail."""

from pathlib import Path

import pytest

from fits.cli.parser import main
from tests.helpers.files import contents


def refused(words: list[str], capsys: pytest.CaptureFixture[str], folder: Path) -> str:
    """The one line on stderr of a command that must fail and leave the folder as it was."""
    before = contents(folder)
    assert main(words) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert contents(folder) == before
    assert output.err.startswith("layerjax: error: ")
    assert output.err.count("\n") == 1
    return output.err
