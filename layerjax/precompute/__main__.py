"""python -m layerjax.precompute NAME [--out DIR] [--coarse] [--work DIR]: make a table again."""

import argparse
import importlib
from pathlib import Path

import jax
import numpy as np

from layerjax import tables
from layerjax.precompute import NAMES


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m layerjax.precompute", description="Make a table again.")
    parser.add_argument("name", choices=NAMES)
    parser.add_argument("--out", type=Path, default=Path(tables.__file__).parent, help="folder for NAME.npz")
    parser.add_argument("--coarse", action="store_true", help="a quick, less exact table")
    parser.add_argument(
        "--work", type=Path, default=Path("spongecake-data"), help="folder that long work (spongecake) goes on from"
    )
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    module = importlib.import_module(f"layerjax.precompute.{options.name}")
    kept = {"work": options.work} if options.name == "spongecake" else {}
    table = module.make(coarse=options.coarse, **kept)
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / f"{options.name}.npz"
    np.savez_compressed(path, **table)
    print(f"{path}: {path.stat().st_size / 1024:.0f} kB")


if __name__ == "__main__":
    main()
