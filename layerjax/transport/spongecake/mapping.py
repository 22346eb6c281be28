"""Maps the parameters of one medium or two to those of a second lobe (Wang et al. 2022, Sec. 5).

The multiple scattering of a slab looks like its single scattering with other parameters, and a constant. A multilayer
perceptron of three hidden layers of 128 finds these: for every medium alpha' (g' of a Henyey-Greenstein medium), tau'
and a blur; for every pair of sides a weight of each medium's lobe, plain and with a Schlick term, and a level. What is
known is built in and need not be learned:

- a turn about the normal changes nothing: tilts and the angle between axes go in as even invariants of the axes;
- a slab turned upside down is lit from below: one network serves both sides, called for either order of the media;
- without collisions, or after one, nothing is left: weights are in proportion to the square of what scatters;
- reciprocity: the lobes are reciprocal, the levels a constant, both times one factor of either direction, and
  transmission has one set of weights both ways.

Beyond the paper: weights of reflection and transmission are apart, since one for both cannot fit both (isotropic, tau
5: 0.585 and 0.250 of the light); the blur, see `layerjax.transport.spongecake.lobes`; the Schlick term; the
factors, which bend both towards grazing; and Henyey-Greenstein media.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import clamp_min, safe_sqrt

WIDTH, DEPTH = 128, 3
"""Hidden layers: how wide, how many (Sec. 5)."""

LEAST_ALPHA = 0.03
"""Narrower lobes are mapped as these: none is learned from."""

LEAST_SLOPE = -0.9
"""From the normal to the horizon: what is multiplied stays positive."""

LN2 = float(np.log(2.0))

LEVEL = 0.3 / jnp.pi
"""Scale of the constant term."""

GEOMETRY_FEATURES, PAIR_FEATURES = 12, 2
MEDIUM_FEATURES = GEOMETRY_FEATURES + 8


class Numbers(NamedTuple):
    """Parameters of k media, one channel: arrays (k,), but for kind (k, 3) and axis (k, 3).

    kind: 1 at the place of "surface", "fiber" or Henyey-Greenstein. alpha: roughness, 1 if Henyey-Greenstein. g: its
    mean cosine, 0 if flakes. axis: a unit vector, z if there is none.
    """

    kind: Array
    alpha: Array
    g: Array
    thickness: Array
    albedo: Array
    f0: Array
    axis: Array


class LobeShape(NamedTuple):
    """Parameters of the second lobe of k media, (k,) each; alpha is g of a Henyey-Greenstein medium."""

    alpha: Array
    thickness: Array
    blur: Array


class Weights(NamedTuple):
    """Strength of the second lobe for each pair of sides. lobes: (3, k, 2), plain and times a Schlick term.

    levels: (3,), the Lambertian term, 1/sr. slopes, rims: (2, 2), reflection and transmission by directions above and
    below: of either direction the Lambertian term is multiplied by 1 + slope (1 - cos), the lobes by
    1 + rim (1 - cos)^4.
    """

    lobes: Array
    levels: Array
    slopes: Array
    rims: Array


def network(media: int, key: Array) -> eqx.nn.MLP:
    """A network for so many media that has learned nothing yet: the second lobe is the first, spread a little."""
    return perceptron(media * MEDIUM_FEATURES + pair_features(media), 3 * media + 2 * (2 * media + 3), key)


def perceptron(inputs: int, outputs: int, key: Array) -> eqx.nn.MLP:
    """A network whose output is next to 0 for every input."""
    fresh = eqx.nn.MLP(inputs, outputs, WIDTH, DEPTH, activation=jax.nn.silu, key=key)
    last = fresh.layers[-1]
    small = (0.1 * last.weight, jnp.zeros(outputs))
    return eqx.tree_at(lambda net: (net.layers[-1].weight, net.layers[-1].bias), fresh, small)


def pack(net: eqx.nn.MLP) -> dict[str, np.ndarray]:
    """The network's numbers by name, for a file."""
    return {
        f"{n}-{name}": np.asarray(getattr(layer, name), np.float32)
        for n, layer in enumerate(net.layers)
        for name in ("weight", "bias")
    }


def unpack(table: Mapping[str, np.ndarray], prefix: str, fresh: Callable[[Array], eqx.nn.MLP]) -> eqx.nn.MLP:
    """The network whose numbers `pack` has named, as numpy arrays.

    prefix: what stands before the names and a dash. fresh: makes a network like it, from a key.
    """
    empty = eqx.filter_eval_shape(fresh, jax.random.key(0))
    places = [(n, name) for n in range(len(empty.layers)) for name in ("weight", "bias")]
    numbers = [table[f"{prefix}-{n}-{name}"] for n, name in places]
    return eqx.tree_at(lambda net: [getattr(net.layers[n], name) for n, name in places], empty, numbers)


def shape_of(net: eqx.nn.MLP, media: Numbers) -> LobeShape:
    """The second lobe's parameters, from `media` with the mean albedo and f0 of all channels."""
    count = len(media.thickness)
    found = []
    for order in orders(count):
        turned = reorder(media, order)
        raw = _network_output(net, turned, turned.albedo, turned.f0)[: 3 * count].reshape(count, 3)
        found.append(raw[jnp.asarray(order)])  # an order of two is its own inverse
    raw = sum(found[1:], found[0]) / len(found)
    is_hg = media.kind[:, 2] > 0
    width = clamp_min(media.alpha, LEAST_ALPHA)
    alpha = 0.02 + 0.98 * jax.nn.sigmoid(jax.scipy.special.logit(0.98 * width) + raw[:, 0])
    g = 0.98 * jnp.tanh(jnp.arctanh(0.99 * media.g) + raw[:, 0])
    thickness = media.thickness / (1.0 + 0.1 * media.thickness) * jnp.exp(raw[:, 1])
    return LobeShape(jnp.where(is_hg, g, alpha), thickness, jnp.exp(2.0 * raw[:, 2] - 2.0))


def weights_of(net: eqx.nn.MLP, media: Numbers, mean_albedo: Array, mean_f0: Array) -> Weights:
    """The second lobe's strength in one channel. mean_albedo, mean_f0: over all channels, (k,) each."""
    count = len(media.thickness)
    lobes, levels, slopes, rims = [], [], [], []
    for order in orders(count):
        index = jnp.asarray(order)
        raw = _network_output(net, reorder(media, order), mean_albedo[index], mean_f0[index])[3 * count :]
        strength = jax.nn.softplus(raw.reshape(2, 2 * count + 3))
        lobes.append(strength[:, : 2 * count].reshape(2, count, 2)[:, index])
        levels.append(strength[:, 2 * count])
        slopes.append(LEAST_SLOPE * (1.0 - strength[:, 2 * count + 1] / LN2))  # 0 before anything is learned
        rims.append(LEAST_SLOPE * (1.0 - strength[:, 2 * count + 2] / LN2))
    above, below = 0, len(lobes) - 1
    through = (sum(lobe[1] for lobe in lobes) / len(lobes), sum(level[1] for level in levels) / len(levels))
    share = jnp.sum(scattered_share(media.albedo, media.f0) * media.thickness / (1.0 + media.thickness)) ** 2
    return Weights(
        share * jnp.stack([lobes[above][0], lobes[below][0], through[0]]),
        LEVEL * share * jnp.stack([levels[above][0], levels[below][0], through[1]]),
        jnp.stack([slopes[above], slopes[below]], -1),
        jnp.stack([rims[above], rims[below]], -1),
    )


def _network_output(net: eqx.nn.MLP, media: Numbers, mean_albedo: Array, mean_f0: Array) -> Array:
    count = len(media.thickness)
    features = []
    for k in range(count):
        medium = medium_of(media, k)
        features += [geometry(medium), _optics(medium, mean_albedo[k], mean_f0[k])]
    return net(jnp.concatenate([*features, *features_of_pairs(media)]))


def geometry(medium: Numbers) -> Array:
    """Inputs of networks that describe a medium but for its absorption, (GEOMETRY_FEATURES,)."""
    alpha = clamp_min(medium.alpha, LEAST_ALPHA)
    is_hg = medium.kind[2]
    tilt = (1.0 - is_hg) * medium.axis[2] * medium.axis[2]
    radial, axial = (1.0 + medium.kind[k] * (alpha - 1.0) for k in (0, 1))
    area = safe_sqrt(radial * radial * (1.0 - tilt) + axial * axial * tilt)  # as seen along the normal
    tau = medium.thickness
    numbers = [alpha, 0.5 * jnp.log(alpha), medium.g, medium.g * medium.g, tilt, area]
    numbers += [jnp.log(tau + 1e-2) / 3.0, tau / (1.0 + tau), jnp.exp(-tau * area)]
    return jnp.concatenate([medium.kind, jnp.stack(numbers)])


def features_of_pairs(media: Numbers) -> list[Array]:
    """Inputs of networks that describe the angle of two axes, one array or none."""
    if len(media.thickness) == 1:
        return []
    flakes = (1.0 - media.kind[0, 2]) * (1.0 - media.kind[1, 2])
    cosine = jnp.sum(media.axis[0] * media.axis[1])
    return [flakes * jnp.stack([cosine * cosine, cosine * media.axis[0, 2] * media.axis[1, 2]])]


def pair_features(media: int) -> int:
    """How many numbers `features_of_pairs` makes."""
    return PAIR_FEATURES if media > 1 else 0


def _optics(medium: Numbers, mean_albedo: Array, mean_f0: Array) -> Array:
    numbers: list[Array] = []
    for albedo, f0 in ((medium.albedo, medium.f0), (mean_albedo, mean_f0)):
        numbers += [2.0 * albedo - 1.0, jnp.sqrt(1.0 - albedo + 1e-3), 2.0 * f0 - 1.0, albedo * f0]
    return jnp.stack(numbers)


def scattered_share(albedo: Array, f0: Array) -> Array:
    """About the share of light that survives a collision, between 0 and 1."""
    return albedo * (0.1 + 0.9 * f0)


def orders(count: int) -> tuple[tuple[int, ...], ...]:
    """The media as they lie, and upside down."""
    return ((0,),) if count == 1 else ((0, 1), (1, 0))


def reorder(media: Numbers, order: tuple[int, ...]) -> Numbers:
    return Numbers(*(part[jnp.asarray(order)] for part in media))


def medium_of(media: Numbers, k: int) -> Numbers:
    """The numbers of one of the media."""
    return Numbers(*(part[k] for part in media))
