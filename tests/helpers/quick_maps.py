"""A small map of a coat over a diffuse base that is fitted in no time."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fits
import layerjax as lj
from fits import FittedMap, Geometry, MapOptions
from tests.helpers.files import contents

TRANSPORT, NOISE = lj.SingleScattering(), fits.Noise(relative=0.02)
NAMES = ("layers[0].thickness", "base.albedo")


def coat(thickness, albedo):
    return lj.Stack([lj.Medium(thickness, 0.8, lj.HenyeyGreenstein(0.3))], lj.Lambertian(albedo))


FREE = coat(fits.Free(0.5, 0.05, 3.0), fits.Free(0.4, 0.0, 1.0))


def geometry() -> Geometry:
    """16 pairs of directions."""
    every = fits.slices(incidence=[10.0, 60.0])
    places = np.linspace(0, len(every.wi) - 1, 16).astype(int)
    return Geometry(every.wi[places], every.wo[places])


def truth(shape: tuple[int, ...]) -> np.ndarray:
    """Thickness and albedo of every texel, (..., 2): one grows and the other falls along the map."""
    along = np.linspace(0.0, 1.0, int(np.prod(shape))).reshape(shape)
    return np.stack([0.2 + 0.8 * along, 0.8 - 0.6 * along], axis=-1)


def seen(numbers: np.ndarray, view: Geometry, seed: int = 0) -> np.ndarray:
    """Values of texels with these numbers (..., 2), with noise: (..., N, 1)."""

    def one(pair):
        return lj.evaluate(coat(*pair), jnp.asarray(view.wi), jnp.asarray(view.wo), transport=TRANSPORT)

    values = np.asarray(jax.jit(jax.vmap(one))(numbers.reshape(-1, 2))).reshape(*numbers.shape[:-1], -1, 1)
    return values * (1.0 + NOISE.relative * np.random.default_rng(seed).standard_normal(values.shape))


def values(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    """Values of the whole map with noise, (..., 16, 1)."""
    return seen(truth(shape), geometry(), seed)


def fitted(out: Path, given: np.ndarray, stack=FREE, view=None, **options) -> FittedMap:
    """The map of values, from a pilot of eight in chunks of 16; options: of `fits.fit_map` or of its `MapOptions`."""
    names = {one.name for one in fields(MapOptions)}
    arguments = {"noise": NOISE, "transport": TRANSPORT} | {k: v for k, v in options.items() if k not in names}
    chosen = {"chunk_size": 16, "pilot_texels": 8, "starts": 2} | {k: v for k, v in options.items() if k in names}
    view = geometry() if view is None else view
    return fits.fit_map(stack, view, given, out, options=MapOptions(**chosen), **arguments)


def assert_same(found: FittedMap, expected: FittedMap) -> None:
    """To the bit: every file of the stores."""
    one, other = (
        {path.removeprefix(str(map.path)): content for path, content in contents(map.path).items()}
        for map in (found, expected)
    )
    assert {name for name in {*one, *other} if one.get(name) != other.get(name)} == set()


@contextmanager
def full_disk(monkeypatch: pytest.MonkeyPatch, after: int | None) -> Iterator[None]:
    """A disk that is full after so many files that zarr writes; None: it never is."""
    replace, written = Path.replace, []

    def full(source: Path, target: Path) -> Path:
        written.append(target)
        if after is not None and len(written) > after:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(source))
        return replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", full)
        yield
