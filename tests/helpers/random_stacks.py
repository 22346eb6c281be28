"""Random stacks of many structures, each a function of a vector of numbers."""

import jax.numpy as jnp
import numpy as np

import layerjax as lj
from layerjax._parameters import leaves_with_names
from layerjax.phase import HenyeyGreenstein


def uniform(low, high):
    return lambda random: random.uniform(low, high)


def logarithmic(low, high):
    return lambda random: np.exp(random.uniform(np.log(low), np.log(high)))


INDEX, ROUGH, DEPTH, ALBEDO, G = (
    uniform(1.2, 1.9), logarithmic(0.05, 0.8), logarithmic(0.1, 8.0), uniform(0.3, 1.0), uniform(-0.5, 0.9),
)  # fmt: skip
INNER, METAL, PAINT = logarithmic(0.12, 0.8), (uniform(0.2, 2.0), uniform(1.5, 5.0)), uniform(0.1, 0.95)

STRUCTURES = {
    "coated metal": (
        (INDEX, ROUGH, *METAL, INNER),
        lambda p: lj.Stack([lj.Interface(p[0], p[1])], lj.Conductor(p[2], p[3], p[4])),
    ),
    "varnish": ((INDEX, ROUGH, PAINT), lambda p: lj.Stack([lj.Interface(p[0], p[1])], lj.Lambertian(p[2]))),
    "hazy coat": (
        (INDEX, ROUGH, DEPTH, ALBEDO, G, PAINT),
        lambda p: lj.Stack(
            [lj.Interface(p[0], p[1]), lj.Medium(p[2], p[3], HenyeyGreenstein(p[4]))], lj.Lambertian(p[5])
        ),
    ),
    "flakes in a coat": (
        (INDEX, ROUGH, DEPTH, ALBEDO, INNER, PAINT),
        lambda p: lj.Stack(
            [lj.Interface(p[0], p[1]), lj.Medium(p[2], p[3], lj.SGGX("surface", p[4]))], lj.Lambertian(p[5])
        ),
    ),
    "flakes": (
        (DEPTH, ALBEDO, logarithmic(0.2, 0.8), PAINT),
        lambda p: lj.Stack([lj.Medium(p[0], p[1], lj.SGGX("surface", p[2]))], lj.Lambertian(p[3])),
    ),
    "haze on metal": (
        (DEPTH, ALBEDO, G, *METAL, INNER),
        lambda p: lj.Stack([lj.Medium(p[0], p[1], HenyeyGreenstein(p[2]))], lj.Conductor(p[3], p[4], p[5])),
    ),
    "slab": (
        (INDEX, logarithmic(0.2, 0.8), DEPTH, ALBEDO, G, logarithmic(0.2, 0.8)),
        lambda p: lj.Stack(
            [lj.Interface(p[0], p[1]), lj.Medium(p[2], p[3], HenyeyGreenstein(p[4])), lj.Interface(1.0, p[5])]
        ),
    ),
}
"""Name: how each number is drawn, and the stack of them."""

FILM = (uniform(1.35, 2.3), uniform(20.0, 600.0))

OTHER_INTERFACES = {
    "smooth varnish": ((INDEX, PAINT), lambda p: lj.Stack([lj.Interface(p[0])], lj.Lambertian(p[1]))),
    "smooth coat on metal": (
        (INDEX, *METAL, INNER),
        lambda p: lj.Stack([lj.Interface(p[0])], lj.Conductor(p[1], p[2], p[3])),
    ),
    "hazy pane": (
        (INDEX, DEPTH, ALBEDO, G),
        lambda p: lj.Stack([lj.Interface(p[0]), lj.Medium(p[1], p[2], HenyeyGreenstein(p[3])), lj.Interface(1.0)]),
    ),
    "haze on a mirror": (
        (INDEX, ROUGH, DEPTH, ALBEDO, G, *METAL),
        lambda p: lj.Stack(
            [lj.Interface(p[0], p[1]), lj.Medium(p[2], p[3], HenyeyGreenstein(p[4]))], lj.Conductor(p[5], p[6])
        ),
    ),
    "Beckmann coat": (
        (INDEX, ROUGH, *METAL, INNER),
        lambda p: lj.Stack([lj.Interface(p[0], p[1], "beckmann")], lj.Conductor(p[2], p[3], p[4], "beckmann")),
    ),
    "Student-t coat": (
        (INDEX, ROUGH, uniform(1.8, 10.0), PAINT),
        lambda p: lj.Stack([lj.Interface(p[0], p[1], "gtr", gamma=p[2])], lj.Lambertian(p[3])),
    ),
    "filmed coat": (
        (INDEX, ROUGH, *FILM, PAINT),
        lambda p: lj.Stack([lj.Interface(p[0], p[1], film=lj.ThinFilm(p[2], p[3], 550.0))], lj.Lambertian(p[4])),
    ),
    "filmed metal": (
        (INDEX, ROUGH, *METAL, INNER, *FILM),
        lambda p: lj.Stack(
            [lj.Interface(p[0], p[1])], lj.Conductor(p[2], p[3], p[4], film=lj.ThinFilm(p[5], p[6], 550.0))
        ),
    ),
    "brushed metal": (
        (INDEX, *METAL, logarithmic(0.3, 0.8), logarithmic(0.3, 0.8), uniform(-1.5, 1.5)),
        lambda p: lj.Stack([lj.Interface(p[0])], lj.Conductor(p[1], p[2], p[3], alpha_y=p[4], tangent=p[5])),
    ),
    "brushed coat": (
        (INDEX, logarithmic(0.1, 0.8), logarithmic(0.1, 0.8), uniform(-1.5, 1.5), PAINT),
        lambda p: lj.Stack([lj.Interface(p[0], p[1], alpha_y=p[2], tangent=p[3])], lj.Lambertian(p[4])),
    ),
}
"""The same of smooth and brushed interfaces, of other normals, and with films."""


def drawn(kind, seed):
    random = np.random.default_rng([seed, len(kind)])
    return jnp.asarray([draw(random) for draw in (STRUCTURES | OTHER_INTERFACES)[kind][0]])


def lengths(stack, numbers):
    """What slopes by the numbers of a stack are multiplied by: by widths and thicknesses by their share."""
    named = leaves_with_names(stack)
    shares = {float(leaf) for path, leaf in named if path.endswith(("alpha", "thickness"))}
    return np.array([value if value in shares else 1.0 for value in map(float, numbers)])
