"""Radiance of Henyey-Greenstein slabs against PythonicDISORT, in both hemispheres.

Errors are relative value by value, with a floor of 1e-3 of the largest value that the light of one incidence gives:
what is a thousand times darker than that is measured against the floor.
"""

import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from benchmarks.peers import disort

pytestmark = [pytest.mark.peers, pytest.mark.skipif(disort.why_not() is not None, reason=str(disort.why_not()))]

STREAMS, FINE = 64, lj.AddingDoubling(nodes=32, modes=48)
INCIDENCES = (0.15, 0.55, 0.95)
"""None at a node, where DISORT's beam resonates."""
AZIMUTHS = np.array([0.0, 0.7, 2.0, np.pi])
FLOOR = 1e-3
SLABS = [(tau, g, albedo) for tau in (0.1, 1.0, 10.0) for g in (-0.3, 0.7, 0.85) for albedo in (0.5, 0.99, 0.999)]


def worst(found, reference):
    return np.max(np.abs(found - reference) / np.maximum(reference, FLOOR * reference.max()))


@pytest.mark.parametrize(("thickness", "g", "albedo"), SLABS)
def test_radiance_at_the_nodes_of_disort(thickness, g, albedo):
    prepared = lj.prepare(lj.Stack([lj.Medium(thickness, albedo, lj.HenyeyGreenstein(g))]), FINE)
    wi = lj.direction(jnp.arccos(jnp.array(INCIDENCES))[:, None, None], 0.0)
    wo = lj.direction(np.arccos(disort.nodes(STREAMS))[:, None], AZIMUTHS)
    values = np.asarray(lj.evaluate(prepared, wi, wo))[..., 0]
    for incidence, found in zip(INCIDENCES, values, strict=True):
        assert worst(found, disort.bsdf(thickness, g, albedo, incidence, AZIMUTHS, STREAMS)) < 2e-4


@pytest.mark.parametrize(("thickness", "g", "albedo"), [(0.1, 0.85, 0.999), (1.0, 0.85, 0.5), (10.0, 0.7, 0.99)])
def test_the_error_of_disort_itself(thickness, g, albedo):
    """An odd number of nodes a hemisphere has one at 1/2, where two numbers of streams meet without interpolation."""
    for incidence in INCIDENCES:
        coarse, fine = (
            disort.bsdf(thickness, g, albedo, incidence, AZIMUTHS, streams)[np.isclose(abs(disort.nodes(streams)), 0.5)]
            for streams in (STREAMS + 2, 2 * STREAMS + 2)
        )
        assert coarse.shape == (2, len(AZIMUTHS))
        assert worst(coarse, fine) < 5e-6
