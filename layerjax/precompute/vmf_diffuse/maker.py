"""vmf_diffuse.npz: the rough diffuse surface of `layerjax.surfaces.vmf_diffuse.all_orders`, from its half-space.

At nodes of the roughness and of the albedo the solution is fitted by least squares with the forms that the surface
evaluates; between them the coefficients are polynomials. Directional albedos are part of the fit, so that energy is
kept. There is nothing random in it.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from layerjax.precompute.vmf_diffuse.half_space import HalfSpace, all_orders, half_space, orders
from layerjax.surfaces.vmf_diffuse import all_orders as surface

NODES = {False: 40, True: 20}
"""Cosines of the half-space, by whether the table is coarse."""

ROUGHNESSES = 13
"""Roughnesses, and so coefficients along them."""

NARROWEST = 1e-6
"""Spread that stands for 0, at which the layer at grazing has no width."""

GRAZING = 3e-3
"""Cosine, over that of the layer, below which no more weight is given to directions."""

ENERGY = 3.0
"""Weight of a directional albedo over that of values."""


def make(coarse: bool = False, report: Callable[[str], Any] = print) -> dict[str, np.ndarray]:
    """The table: forms (roughness, form, pair of places), coefficients of Chebyshev polynomials in the spread; pairs
    are those of an upper triangle."""
    spreads = _chebyshev_lobatto(ROUGHNESSES)
    fitted = []
    for n, spread in enumerate(np.maximum(spreads, NARROWEST)):
        report(f"vmf_diffuse: roughness {n + 1} of {ROUGHNESSES}")
        fitted.append(_fit(float(spread), NODES[coarse]))
    values = np.stack(fitted)
    # at roughness 0 all places are 1, and the means over the azimuth are 1 / pi and, past the first order, 0
    row, column = np.triu_indices(surface.PLACES)
    missing = -np.sum(values[0] * np.where(row == column, 1.0, 2.0), axis=-1)
    missing[0] += 1.0 / np.pi
    values[0, :, 0] += np.where(np.asarray(surface.FORM_MODES) == 0, missing, 0.0)
    nodes = np.asarray(surface.chebyshev(jnp.asarray(spreads), ROUGHNESSES)).T
    forms = np.linalg.solve(nodes, values.reshape(ROUGHNESSES, -1)).reshape(values.shape)
    return {"forms": forms.astype(np.float32)}


def flake_width(spread: float) -> float:
    """alpha of a spread in (0, 1], see `layerjax.surfaces.vmf_diffuse.all_orders.flake_spread`."""
    return np.inf if spread >= 1.0 else float(np.sqrt(0.25 * np.pi * spread / (1.0 - spread)))


def _fit(spread: float, nodes: int) -> np.ndarray:
    """Coefficients (form, pair of places) at one roughness."""
    space = half_space(flake_width(spread), nodes, surface.MODES[0])
    scattered = orders(space, 3)
    target: list[np.ndarray] = [scattered[n, m] for n, count in enumerate(surface.MODES) for m in range(count)]
    for mode, count in enumerate(surface.REST):
        places = 0.5 - 0.5 * np.cos(np.pi * (np.arange(count) + 0.5) / count)
        rests = [_rest(space, scattered[:, mode], _albedo(place, spread), mode) for place in places]
        polynomials = np.asarray(surface.chebyshev(jnp.asarray(places), count)).T
        target.extend(np.tensordot(np.linalg.inv(polynomials), np.stack(rests), 1))
    values = np.stack(target)
    modes, found = np.asarray(surface.FORM_MODES), []
    for mode in range(surface.MODES[0]):
        design, weight = _design(space, spread, mode)
        rows, chosen = [design * weight[..., None]], np.flatnonzero(modes == mode)
        sought = [values[chosen] * weight]
        if mode == 0:
            equal = ENERGY * np.sqrt(_spread_out(space, spread))
            rows.append(equal[:, None] * np.moveaxis(space.albedo(np.moveaxis(design, -1, 0)), 0, -1))
            sought.append(equal * space.albedo(values[chosen]))
        matrix = np.concatenate([part.reshape(-1, design.shape[-1]) for part in rows])
        right = np.concatenate([part.reshape(len(chosen), -1) for part in sought], axis=1)
        q, r = np.linalg.qr(matrix)
        found.append((chosen, right @ q @ np.linalg.pinv(r, rcond=1e-7).T))
    coefficients = np.zeros((len(modes), found[0][1].shape[-1]))
    for chosen, solved in found:
        coefficients[chosen] = solved
    return coefficients


def _rest(space: HalfSpace, scattered: np.ndarray, albedo: float, mode: int) -> np.ndarray:
    """Orders past the third over c^4."""
    known = np.tensordot(albedo ** np.arange(1.0, 4.0), scattered, 1)
    return (all_orders(space, albedo, mode) - known) / albedo**4


def _albedo(place: float, spread: float) -> float:
    """Inverse of `layerjax.surfaces.vmf_diffuse.all_orders.albedo_place`."""
    drift = float(surface.albedo_drift(jnp.asarray(spread)))
    root = drift + place * (np.sqrt(1.0 + drift * drift) - drift)
    return 1.0 + drift * drift - root * root


def _design(space: HalfSpace, spread: float, mode: int) -> tuple[np.ndarray, np.ndarray]:
    """What each pair of places adds to a mode of the BRDF (incident, outgoing, pair), and the weights of directions.

    Modes m > 0 enter a sum over cosines twice, which is left to the coefficients.
    """
    u, t = jnp.asarray(space.cosines), jnp.asarray(spread)
    mean, facing = (np.asarray(area) for area in surface.flake_areas(u, t))
    place, narrow = (np.asarray(part) for part in surface.layer_place(u, t))
    polynomials = np.asarray(surface.chebyshev(jnp.asarray(place), surface.PLACES))
    sine = np.sqrt(spread * narrow * (1.0 - space.cosines) * (1.0 + space.cosines)) ** mode
    factor = facing * sine / (2.0 if mode else 1.0)
    ratio = np.outer(factor, facing * sine) / (np.outer(space.cosines, mean) + np.outer(mean, space.cosines))
    row, column = np.triu_indices(surface.PLACES)
    one = polynomials[row][:, :, None] * polynomials[column][:, None]
    pairs = np.where((row == column)[:, None, None], one, one + one.swapaxes(1, 2))
    even = _spread_out(space, spread)
    weight = np.sqrt(np.outer(space.weights * space.cosines, even) + np.outer(even, space.weights * space.cosines))
    return np.moveaxis(ratio * pairs, 0, -1), weight


def _spread_out(space: HalfSpace, spread: float) -> np.ndarray:
    """Weights of cosines that count each decade equally, down to grazing within the layer."""
    width = flake_width(spread)
    layer = 1.0 if np.isinf(width) else width / (1.0 + width)
    return space.weights / (space.cosines + GRAZING * layer)


def _chebyshev_lobatto(count: int) -> np.ndarray:
    """Nodes on [0, 1], both ends among them."""
    return 0.5 - 0.5 * np.cos(np.pi * np.arange(count) / (count - 1))
