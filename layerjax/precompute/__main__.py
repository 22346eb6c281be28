"""python -m layerjax.precompute NAME [--out DIR] [--coarse] [--work DIR]: make a table again."""

import argparse
import importlib
from pathlib import Path
from typing import Any

import jax
import numpy as np

from layerjax import tables
from layerjax.precompute import NAMES

TABLE_FOLDER = Path(tables.__file__).parent


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m layerjax.precompute", description="Make a table again.")
    parser.add_argument("name", choices=NAMES)
    parser.add_argument("--out", type=Path, help="folder for NAME.npz (default: that of the tables that ship)")
    parser.add_argument("--coarse", action="store_true", help="a quick, less exact table, which needs --out")
    parser.add_argument(
        "--work", type=Path, help="folder that long work (spongecake alone) is resumed from (default: spongecake-data)"
    )
    options = parser.parse_args()
    if options.coarse and options.out is None:
        parser.error("--coarse needs --out: a coarse table would replace the one that ships")
    if options.work is not None and options.name != "spongecake":
        parser.error(f"--work is of spongecake alone, not of {options.name}")
    jax.config.update("jax_enable_x64", True)
    module = importlib.import_module(f"layerjax.precompute.{options.name}")
    kept = {} if options.work is None else {"work": options.work}
    path = write(options.out or TABLE_FOLDER, options.name, module.make(coarse=options.coarse, **kept))
    print(f"{path}: {path.stat().st_size / 1024:.0f} kB")


def write(folder: Path, name: str, table: dict[str, Any]) -> Path:
    """NAME.npz in the folder, which is made: whole, or what was there stays."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.npz"
    temporary = path.with_suffix(".part")
    try:
        with temporary.open("wb") as file:
            np.savez_compressed(file, **table)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


if __name__ == "__main__":
    main()
