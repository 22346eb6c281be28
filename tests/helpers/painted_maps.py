"""Stores of fitted maps with made-up numbers: no model is fitted."""

from pathlib import Path

import numpy as np

from fits.maps.store import FLAGS, FittedMap, blocks_of, create, open_map

NAMES = ("layers[0].thickness", "layers[0].phase.alpha", "base.albedo")
UNITS = dict(zip(NAMES, ("optical depth", "1", "1"), strict=True))
FREEDOM = 61  # degrees of freedom: 64 measurements less the parameters
GOOD = FLAGS["fitted"] | FLAGS["converged"]
ATTRIBUTES = {
    "version": "0.2.0",
    "stack": '[[layers]]\nkind = "Medium"\n',
    "transport": "SingleScattering()",
    "noise": "Noise(relative=0.02)",
    "samples": 64,
    "channels": ["value"],
    "common": {"layers[0].f0": {"value": 0.04321, "error": 0.00012, "unit": "1", "converged": True}},
    "pilot": {"poor_above": 1.6},
    "options": {"starts": 8, "seed": 0},
    "numerical": {},
}


def numbers(shape: tuple[int, ...], seed: int = 0) -> dict[str, np.ndarray]:
    """Every array of a store in which all texels are fitted, converged and as good as noise allows."""
    rng = np.random.default_rng(seed)
    where = np.meshgrid(*(np.linspace(0.0, 1.0, size) for size in shape), indexing="ij")
    slope = sum(where) / len(shape)
    return {
        f"values/{NAMES[0]}": 0.3 + slope**2,
        f"values/{NAMES[1]}": 0.2 + 0.1 * np.sin(6.0 * slope),
        f"values/{NAMES[2]}": 0.5 + 0.2 * where[0] + 0.01 * rng.standard_normal(shape),
        f"errors/{NAMES[0]}": 0.01 * (1.0 + slope),
        f"errors/{NAMES[1]}": np.full(shape, 0.02),
        f"errors/{NAMES[2]}": 0.005 + 0.001 * rng.random(shape),
        "reduced_chi_square": rng.chisquare(FREEDOM, shape) / FREEDOM,
        "at_bound": np.zeros(shape, np.uint32),
        "measurements": np.full(shape, 64, np.uint32),
        "flags": np.full(shape, GOOD, np.uint16),
    }


def without(found: dict[str, np.ndarray], where: np.ndarray, flag: str) -> None:
    """Make of some texels such as are not fitted, for the reason of this flag."""
    for values in found.values():
        if values.dtype.kind == "f":
            values[where] = np.nan
    found["measurements"][where], found["flags"][where] = 0, FLAGS[flag]


def bounded(found: dict[str, np.ndarray], where: np.ndarray, place: int) -> None:
    """Put a parameter of some texels at a bound."""
    found["at_bound"][where] |= 1 << place
    found["flags"][where] |= FLAGS["at_bound"]
    found[f"errors/{NAMES[place]}"][where] = np.nan


def stored(
    path: Path, found: dict[str, np.ndarray], chunk: tuple[int, ...], *, chunks: int | None = None, **more: object
) -> FittedMap:
    """A store of these arrays, of which the first `chunks` chunks are written; more: attributes."""
    shape = found["flags"].shape
    chunk = tuple(map(min, chunk, shape))
    store = create(path, ATTRIBUTES | {"names": NAMES, "units": UNITS, "shape": shape, "chunk": chunk} | more, {})
    for block in list(blocks_of(shape, store.chunk))[:chunks]:
        store.write(block, {name: values[block] for name, values in found.items()})
    return open_map(path)
