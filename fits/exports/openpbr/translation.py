"""From a stack to the OpenPBR surface that resembles it most: a start from its layers, then a fit to its values."""

from collections.abc import Iterator
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.stats import qmc

from fits.data.geometry import Floats, direction
from fits.data.measurements import Measurements, Source, channel_names
from fits.exports.contents import LEAST_COSINE, pairs, views
from fits.exports.material import Material
from fits.exports.openpbr.start import freed, starts
from fits.exports.openpbr.surface import Surface, albedo, evaluate
from fits.optimise.fit import fit
from fits.problem.noise import Noise
from fits.progress import named

PAIRS_TO_FIT, VIEWS_TO_JUDGE = 512, 2048
"""Pairs anywhere, and as many near the mirror direction; and directions of view at each incidence, half and half."""

INCIDENCE = (10.0, 30.0, 50.0, 70.0)
"""Polar angles of the reported errors, in degrees."""

DARK = 1e-3
"""Of the reflected share over pi: values below that count for less."""

STARTS = 4


@dataclass(frozen=True)
class Error:
    """At an incidence, in degrees: relative errors of values, in the median and of 95 of 100, and the reflected shares.

    stack, surface: (C,), of light from there; of the surface by reciprocity, which it obeys nearly: what is seen from
    there of light from everywhere.
    """

    incidence: float
    median: float
    most: float
    stack: Floats
    surface: Floats


@dataclass(frozen=True)
class Translation:
    """surface: by numbers, of which all that it has is fitted. errors: one for each of `INCIDENCE`."""

    surface: Surface
    errors: tuple[Error, ...]


def translated(material: Material) -> Translation:
    """The surface whose values are off by least: by the mean square of relative errors over pairs of directions.

    Half of the pairs are anywhere, as often as light by their cosines, half near the mirror direction.
    """
    wi, wo = pairs(PAIRS_TO_FIT, seed=11)
    values = material.values(wi, wo)
    sigma = np.abs(values) + DARK * material.albedos(direction(np.array(INCIDENCE), 0.0))[0].mean() / np.pi
    names = channel_names(material.channels)
    data = Measurements(wi, wo, values, sigma, np.ones(len(wi), bool), names, Source("", "simulated"))
    noise = Noise(relative=0.0, floor=0.0, discrepancy=False)
    found = [
        fit(
            freed(surface, material.channels),
            data,
            transport=evaluate,
            noise=noise,
            starts=STARTS,
            seed=0,
            progress=named(" and ".join(surface.lobes), material.progress),
        )
        for surface in starts(material.parts)
    ]
    best = min(found, key=lambda one: one.cost)
    return Translation(best.stack, tuple(_errors(material, best.stack)))


def _errors(material: Material, surface: Surface) -> Iterator[Error]:
    u = qmc.Sobol(2, rng=np.random.default_rng(3)).random(VIEWS_TO_JUDGE)
    for incidence in INCIDENCE:
        towards = direction(np.array([incidence]), 0.0)
        wi = np.repeat(towards, len(u), axis=0)
        wo = views(wi, u[:, 0], u[:, 1])
        kept = wo[:, 2] >= LEAST_COSINE
        true = material.values(wi[kept], wo[kept])
        own = np.asarray(_EVALUATE(surface, jnp.asarray(wi[kept]), jnp.asarray(wo[kept])))
        # of what a pair sends in all its channels: one that is nearly black says nothing
        scale = true.max(axis=1, keepdims=True)
        off = (np.abs(own - true)[scale[:, 0] > 0] / scale[scale[:, 0] > 0]).max(axis=1)
        median, most = (float(part) for part in np.quantile(off, [0.5, 0.95]))
        shares = np.broadcast_to(np.asarray(_ALBEDO(surface, jnp.asarray(towards)))[0], (material.channels,))
        yield Error(incidence, median, most, material.albedos(towards)[0][0], shares)


_EVALUATE, _ALBEDO = eqx.filter_jit(evaluate), eqx.filter_jit(albedo)
