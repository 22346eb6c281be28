"""How long a step still takes, as its progress says."""

import io

import pytest

from fits import progress
from fits.progress import show_progress


def test_the_first_step_does_not_count_once_there_are_others(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    stream = io.StringIO()
    with show_progress(stream) as told:
        # taken up again at 10 of 40; the first step compiles for 100 s, others take 20 s each
        for done, at in ((10, 0.0), (11, 100.0), (12, 120.0), (13, 140.0), (40, 680.0)):
            clock[0] = at
            told("map", done, 40, "fine")
    assert stream.getvalue().splitlines() == [
        "layerjax: map 10/40 (fine)",
        "layerjax: map 11/40 (about 48 min left; fine)",
        "layerjax: map 12/40 (about 9 min left; fine)",
        "layerjax: map 13/40 (about 9 min left; fine)",
        "layerjax: map 40/40 (fine)",
    ]
