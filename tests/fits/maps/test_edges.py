"""What smoothness says of differences between neighbours, without a model: against loops over all pairs of texels."""

import numpy as np
import pytest

import fits
from fits.maps.smoothing import Edges

HUBER = 0.1
"""Of a scale: below, a total variation is quadratic."""


@pytest.mark.parametrize("kind", ["gaussian", "total_variation"])
def test_edges_are_those_of_a_loop_over_all_pairs(kind):
    rng = np.random.default_rng(0)
    shape, scales = (3, 4, 2), np.array([0.2, np.inf, 0.05])
    units, there = rng.random((*shape, 3)), rng.random(shape) < 0.8
    units[~there] = np.nan
    edges, block = Edges(kind, scales), (slice(1, 3), slice(0, 3), slice(0, 2))
    centre, precision = edges.pull(units, there, block)
    total = 0.0
    for place in np.ndindex(shape):
        pulls = []
        for other in np.ndindex(shape):
            if np.abs(np.subtract(place, other)).sum() != 1 or not (there[place] and there[other]):
                continue
            for k in (0, 2):
                distance = abs(units[place][k] - units[other][k])
                width = max(distance, HUBER * scales[k])
                pulls.append((k, other, 1.0 / scales[k] ** 2 if kind == "gaussian" else 1.0 / (scales[k] * width)))
                flat = distance**2 / (2.0 * HUBER * scales[k] ** 2) + 0.5 * HUBER
                size = distance / scales[k] if distance > HUBER * scales[k] else flat
                total += 0.5 * (0.5 * (distance / scales[k]) ** 2 if kind == "gaussian" else size)
        inside = tuple(np.subtract(place, (1, 0, 0)))
        if min(inside) < 0 or inside[1] == 3 or not there[place]:
            continue
        for k in range(3):
            mine = [(units[other][k], weight) for at, other, weight in pulls if at == k]
            weights = np.array([weight for _, weight in mine])
            assert precision[inside][k] == pytest.approx(weights.sum())
            if mine:
                assert centre[inside][k] == pytest.approx(np.average([unit for unit, _ in mine], weights=weights))
    assert edges.cost(units, there) == pytest.approx(total)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"kind": "laplace"}, "Smoothness.kind is 'laplace'; it must be one of gaussian, total_variation"),
        ({"scale": 0.0}, "Smoothness.scale is 0.0; it must be a number from 1e-06 to 1e"),
        ({"scale": np.nan}, "Smoothness.scale is nan"),
        ({"scale": "wide"}, "Smoothness.scale is 'wide'"),
        ({"scale": {"base.albedo": -1.0}}, r"Smoothness.scale\['base.albedo'\] is -1.0"),
        ({"scale": {}}, "Smoothness.scale is empty"),
        ({"rounds": 0}, "Smoothness.rounds is 0; it must be a whole number of at least 1"),
        ({"rounds": 1.5}, "Smoothness.rounds is 1.5"),
    ],
)
def test_smoothness_that_cannot_be_is_refused(options, words):
    with pytest.raises(ValueError, match=words):
        fits.Smoothness(**({"kind": "gaussian", "scale": 0.1} | options))


def test_channels_have_a_scale_together_or_their_own():
    names = ["base.albedo[0]", "base.albedo[1]", "layers[0].thickness"]
    both = fits.Smoothness("gaussian", {"base.albedo[1]": 0.3, "base.albedo": 0.1})
    assert both.scales(names) == {"base.albedo[0]": 0.1, "base.albedo[1]": 0.3}
    assert fits.Smoothness("gaussian", 0.2).scales(names) == dict.fromkeys(names, 0.2)
