"""Files that were damaged on the disk: whatever is read from them is what was written, or an error that names them."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fits.optimise.result import Fit
from fits.reports.results import load_fit, save_fit
from fits.sampling.sample import load, sample


def damaged(content: bytes, step: int) -> Iterator[tuple[int, bytes]]:
    """Copies with 64 bytes zeroed, then inverted, every `step` bytes; with the place of the first that differs."""
    for place in range(0, len(content), step):
        run = content[place : place + 64]
        for other in (bytes(len(run)), bytes(255 - byte for byte in run)):
            if other != run:
                first = next(index for index, byte in enumerate(run) if byte != other[index])
                yield place + first, content[:place] + other + content[place + 64 :]


def test_damage_to_a_chain_is_seen(result: Fit, tmp_path: Path) -> None:
    """Wherever it matters: some bytes of a page of SQLite are of no use."""
    path, refused = tmp_path / "chain.db", 0
    sample(result, walkers=16, seed=1, max_steps=100, path=path)
    whole, posterior = path.read_bytes(), load(result, path)
    copies = [*(bad for _, bad in damaged(whole, 4096)), whole[:100], whole[:-1]]
    for bad in copies:
        path.write_bytes(bad)
        try:
            np.testing.assert_array_equal(load(result, path).chain, posterior.chain)
        except ValueError as error:
            refused += "chain.db: damaged" in str(error)
    assert refused > 0.8 * len(copies)


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
