"""Parameters of media and surfaces, and pairs of directions, over the whole documented box, edges included."""

import numpy as np

POINTS = 20_000  # a structure and precision; six structures


def mixed(random, low, high, *exact, log=False):
    """Uniform (or log-uniform) draws, a quarter of them replaced by exact values: the ends and what else is given."""
    values = (
        np.exp(random.uniform(np.log(max(low, 1e-8)), np.log(high), POINTS))
        if log
        else random.uniform(low, high, POINTS)
    )
    edges = random.choice([low, high, *exact], POINTS)
    return np.where(random.random(POINTS) < 0.25, edges, values)


def draw(seed):
    """Parameters and pairs of directions over the box, a tenth of them on each kind of edge."""
    random = np.random.default_rng(seed)
    parameters = {
        "alpha": mixed(random, 1e-4, 1.0, log=True),
        "thickness": mixed(random, 0.0, 1e4, 1e-6, 1.0, log=True),
        "albedo": mixed(random, 0.0, 1.0),
        "f0": mixed(random, 0.0, 1.0),
        "g": mixed(random, -0.999, 0.999, 0.0, 1e-9),
        "ior": mixed(random, 0.05, 4.0, 1.0, log=True),
        "k": mixed(random, 0.0, 10.0, 1e-8),
        "roughness": mixed(random, 0.0, 1.0),
        "axis": random.normal(size=(POINTS, 3)),
    }
    parameters["axis"][::7] = [0.0, 0.0, 1.0]

    def anywhere():
        cosine = mixed(random, -1.0, 1.0, 1e-6, -1e-6, 0.0, 1e-3)
        sine, phi = np.sqrt(1.0 - cosine**2), random.uniform(-np.pi, np.pi, POINTS)
        return np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=-1)

    wi, wo = anywhere(), anywhere()
    wi[::2, 2] = np.abs(wi[::2, 2])
    wo[::4, 2] = np.abs(wo[::4, 2])
    edges = {0: wi, 1: wi * [-1, -1, 1], 2: wi * [1, 1, -1], 3: -wi}  # retro, mirror, equal attenuations, straight on
    for kind, partner in edges.items():
        wo[kind::10] = partner[kind::10]
    wo[4::40], wi[14::40] = [0, 0, 1], [0, 0, 1]
    return parameters, wi, wo
