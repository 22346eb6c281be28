"""Tables that ship with the library: small, made by the code beside them."""

from importlib import import_module
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from layerjax import tables
from layerjax.microsurface.directional_albedo import first_event, first_mirror
from layerjax.microsurface.multiple_bounces import conductor_basis, interface_bases
from layerjax.precompute import NAMES, microsurface
from layerjax.precompute import __main__ as command
from layerjax.tables import load

FOLDER = Path(tables.__file__).parent


def test_tables_are_small_and_have_makers():
    shipped = list(FOLDER.glob("*.npz"))
    assert {path.stem for path in shipped} == set(NAMES)
    assert all(callable(import_module(f"layerjax.precompute.{name}").make) for name in NAMES)
    assert sum(path.stat().st_size for path in shipped) < 4e6
    assert (FOLDER / "microsurface.npz").stat().st_size < 2e5


def test_a_table_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path = command.write(tmp_path / "new", "energies", {"values": np.arange(3.0)})

    def full(file, **table):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="No space"):
        command.write(path.parent, "energies", {"values": np.arange(4.0)})
    assert list(path.parent.iterdir()) == [path]
    assert np.load(path)["values"].tolist() == [0.0, 1.0, 2.0]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["energies", "--coarse"], "--coarse needs --out"),
        (["energies", "--out", "x", "--work", "y"], "--work is of spongecake alone, not of energies"),
    ],
)
def test_options_that_do_not_go_together_are_refused(options, told, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["precompute", *options])
    with pytest.raises(SystemExit) as refused:
        command.main()
    assert refused.value.code == 2
    assert told in capsys.readouterr().err


@pytest.mark.slow
def test_a_coarse_table_of_microsurfaces_equals_the_one_that_ships():
    lines: list[str] = []
    coarse, fine = microsurface.make(coarse=True, report=lines.append), load("microsurface")
    assert coarse.keys() == fine.keys()
    assert len(lines) == 5
    rng = np.random.default_rng(1)
    cosine, alpha, lower = jnp.asarray(rng.uniform([[0.1], [0.1], [0.3]], [[1.0], [1.0], [0.9]], (3, 200)))
    for side, ior in (("below", lower), ("above", 1 / lower)):
        _, kept, stuck = first_event(cosine, alpha, ior)
        bases = interface_bases(cosine, alpha, ior)
        for name, amount in (("reflected", kept), ("refracted", stuck)):
            assert fine[f"{name}_{side}"].dtype == np.float64
            change = amount * (bases[name] @ (coarse[f"{name}_{side}"] - fine[f"{name}_{side}"]))
            # the coarse fit: half as many coefficients as points, whose energies are off by 1e-3 to 1.2e-2 (rms)
            assert np.sqrt(np.mean(change**2)) < 2e-2
    ior, k = jnp.asarray(rng.uniform([[0.2], [1.0]], [[3.0], [8.0]], (2, 200)))
    _, kept = first_mirror(cosine, alpha, ior, k)
    basis, _ = conductor_basis(cosine, alpha, ior, k)
    change = kept * (basis @ (coarse["conductor"] - fine["conductor"]))
    assert np.sqrt(np.mean(change**2)) < 5e-3
