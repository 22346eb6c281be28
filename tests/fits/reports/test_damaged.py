"""Files that were damaged on the disk: whatever is read from them is what was written, or an error that names them."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fits.optimise.result import Fit
from fits.reports.results import load_fit, save_fit
from fits.sampling.chain import USER_BLOCK, read_chain
from fits.sampling.sample import load, sample
from tests.helpers.files import largest_file


def damaged(content: bytes, step: int) -> Iterator[tuple[int, bytes]]:
    """Copies with 64 bytes zeroed, then inverted, every `step` bytes; with the place of the first that differs."""
    for place in range(0, len(content), step):
        run = content[place : place + 64]
        for other in (bytes(len(run)), bytes(255 - byte for byte in run)):
            if other != run:
                first = next(index for index, byte in enumerate(run) if byte != other[index])
                yield place + first, content[:place] + other + content[place + 64 :]


def test_damage_to_a_chain_is_seen(result: Fit, tmp_path: Path) -> None:
    """Each read of a damaged file says so, wherever it is; HDF5 itself never returns where its heap of texts is 0."""
    path = tmp_path / "chain.h5"
    sample(result, walkers=16, seed=1, max_steps=100, path=path)
    whole, stored = path.read_bytes(), read_chain(path)
    places = [*damaged(whole, 512), *damaged(whole[: USER_BLOCK + 4096], 32)]
    for _, bad in places:
        path.write_bytes(bad + whole[len(bad) :])
        with pytest.raises(ValueError, match=r"chain\.h5 is (damaged|not a chain of layerjax)"):
            read_chain(path)
    for length in (0, 100, USER_BLOCK, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"chain\.h5 is (damaged|not a chain of layerjax)"):
            read_chain(path)
    path.write_bytes(whole[USER_BLOCK:])  # as layerjax 0.1.0 wrote it
    np.testing.assert_array_equal(read_chain(path)["chain"], stored["chain"])


def test_damage_to_a_journal_costs_the_steps_behind_it_and_reading_nothing(result: Fit, tmp_path: Path) -> None:
    path, journal = tmp_path / "chain.h5", tmp_path / "chain.journal"
    with largest_file(8 * 2940), pytest.raises(OSError, match="too large"):  # after eight steps of 16 walkers
        sample(result, walkers=16, seed=1, path=path)
    whole, chain = journal.read_bytes(), load(result, path).chain
    assert len(chain) == 8
    for place, bad in damaged(whole[2940:], 512):
        journal.write_bytes(whole[:2940] + bad)
        found = load(result, path).chain
        np.testing.assert_array_equal(found, chain[: 1 + place // 2940])
        assert journal.read_bytes() == whole[:2940] + bad


def test_damage_to_a_result_is_seen(coat_fit: Fit, tmp_path: Path) -> None:
    directory = tmp_path / "result"
    save_fit(coat_fit, directory)
    for name in ("fit.json", "data.csv", "problem.toml"):
        path = directory / name
        whole = path.read_bytes()
        for _, bad in damaged(whole, 512):
            path.write_bytes(bad)
            with pytest.raises(ValueError, match=name):
                load_fit(directory)
        path.write_bytes(whole)
    content = json.loads((directory / "fit.json").read_text())
    content["fit"]["cost"] += 1e-9
    (directory / "fit.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"fit\.json: damaged or changed"):
        load_fit(directory)
