"""What is measured elsewhere: the stack with its uncertainty, the model discrepancy, and the noise of a measurement."""

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import layerjax as lj
from fits.data.geometry import Geometry, polar
from fits.data.measurements import Measurements, Source
from fits.data.totals import Totals
from fits.optimise.result import Fit
from fits.prediction.importance import UNRELIABLE, weighted
from fits.prediction.prediction import Floats, Prediction, banded, require_level
from fits.problem.discrepancy.inducing_points import places
from fits.problem.discrepancy.logarithm import logarithm, size
from fits.problem.discrepancy.logarithm import softness as soft
from fits.problem.instrument import gain_unknown
from fits.problem.model import Model
from fits.problem.problem import polar_angles
from fits.sampling.posterior import Posterior
from layerjax._checks import in_short, require_kind
from layerjax.mixture import stacks_of

if TYPE_CHECKING:
    from fits.sampling.mixture import Mixture

LEAST_DRAWS = 400
"""Of the approximation that draws of a posterior are chosen from."""

DRAWS = 256
"""Vectors of parameters that a prediction is made with."""

LEVELS = (0.025, 0.25, 0.5, 0.75, 0.975)


class Mixed(Protocol):
    """Several fits that predict as one: see `fits.average`."""

    def predict(
        self, at: Geometry | Measurements, *, levels: tuple[float, ...], draws: int, seed: int
    ) -> Prediction: ...


def predict(
    of: Fit | Posterior | Mixed,
    at: Geometry | Measurements,
    *,
    levels: tuple[float, ...] = LEVELS,
    draws: int = DRAWS,
    seed: int = 0,
) -> Prediction:
    """The BSDF that the fit expects elsewhere, and what a new measurement of it would give.

    Args:
        of: a posterior, or a fit, of whose posterior draws are made by weights (see `fits.prediction.importance`); or
            an average of some.
        at: pairs of directions, above, or below a stack that light passes; of `Measurements` their used samples, with
            their own sigma.
        levels: of the quantiles, in (0, 1).
        draws: vectors of parameters, at least 2.
        seed: of these, and of the noise.

    Readings whose sigma is not known have the median sigma of those that were fitted, relative to the model.

    Raises:
        ValueError: a level or number of draws out of range, a fit of a named objective, readings in other channels,
            directions below an opaque stack, or such that the transport cannot answer.
    """
    for level in levels:
        require_level(level)
    if draws < 2:
        raise ValueError(f"draws is {draws}; it must be at least 2")
    require_kind("at", at, Geometry, Measurements)
    if not isinstance(of, Fit | Posterior):
        if isinstance(of, type) or not hasattr(of, "predict"):
            raise ValueError(f"of: {in_short(of)} is not a Fit, a Posterior or an Average")
        return of.predict(at, levels=levels, draws=draws, seed=seed)
    return foretold(of, at, levels=levels, draws=draws, seed=seed)


def foretold(
    of: Fit | Posterior,
    at: Geometry | Measurements,
    *,
    draws: int,
    seed: int,
    levels: tuple[float, ...] = LEVELS,
    like: "Mixture | None" = None,
) -> Prediction:
    """`predict`, by an approximation of a posterior that the fit's is like, where there is one (see `weighted`)."""
    fit = of.fit if isinstance(of, Posterior) else of
    if not fit.is_posterior:
        raise ValueError(f"predict: a fit of {fit.problem.objective!r} has no noise model, it says nothing of readings")
    generator = np.random.default_rng(seed)
    data = _measurements(fit, at)
    vectors, pareto_k = _vectors(of, draws, generator, like)
    values = np.asarray(fit.problem.predict_at(vectors, data.wi, data.wo), float)
    values = np.broadcast_to(values, (*values.shape[:2], len(fit.problem.data.channels)))
    sigma = _own_sigma(fit, values, data.sigma)
    parts = _readings(fit, vectors, values, data, sigma)
    noise = fit.problem.noise
    freedom = noise.degrees_of_freedom if noise.tails == "student" else math.inf
    found = banded(data.wi, data.wo, fit.problem.data.channels, levels, values, *parts, freedom, seed)
    return replace(found, pareto_k=pareto_k, readings=at.used() if isinstance(at, Measurements) else None)


def _measurements(fit: Fit, at: Geometry | Measurements) -> Measurements:
    if isinstance(fit.problem.data, Totals) or isinstance(at, Totals):
        raise ValueError("predict: totals are not predicted; it takes a fit of values along directions, and such")
    if isinstance(at, Measurements):
        if len(at.channels) != len(fit.problem.data.channels):
            raise ValueError(
                f"predict: the readings have the channels {', '.join(at.channels)}, "
                f"the fit {', '.join(fit.problem.data.channels)}"
            )
        return at.used()
    _require_visible(fit, at)
    count, channels = len(at), fit.problem.data.channels
    nothing = np.zeros((count, len(channels)))
    return Measurements(at.wi, at.wo, nothing, None, np.ones(count, bool), channels, Source("", "memory"))


def _require_visible(fit: Fit, at: Geometry) -> None:
    """Refuse directions in or below the surface of an opaque stack, whose BSDF is 0 there and has no logarithm."""
    material = fit.problem.stack
    if not isinstance(material, lj.Stack | lj.Mixture) or any(one.base is None for one in stacks_of(material)):
        return
    for name, w in (("light", at.wi), ("viewer", at.wo)):
        lowest = float(polar(w).max(initial=0.0))
        if lowest >= 90.0:
            raise ValueError(
                f"predict: a {name} at {lowest:g} degrees sees nothing of an opaque stack; its polar angle must be in "
                "[0, 90) degrees"
            )


def _vectors(
    of: Fit | Posterior, draws: int, generator: np.random.Generator, like: "Mixture | None" = None
) -> tuple[Floats, float]:
    """Draws (D, P) of the posterior, and the shape of their weights."""
    if isinstance(of, Fit) and of.within is not None and of.dataset is not None:
        vectors, shape = _vectors(of.within, draws, generator)  # what others say of its parameters counts too
        return vectors[:, list(of.within.problem.places(of.dataset))], shape
    if isinstance(of, Posterior):
        return generator.choice(of.samples, draws, axis=0, replace=len(of.samples) < draws), math.nan
    random = np.random.RandomState(generator.integers(2**31))
    found = weighted(of, max(LEAST_DRAWS, 2 * draws), random, good=UNRELIABLE, like=like)
    positions = jnp.asarray(found.resampled(random, draws))
    return np.asarray(jax.vmap(of.problem.model.box.constrain)(positions), float), found.shape


def with_discrepancy(fit: Fit, wi: Floats, wo: Floats, values: Floats) -> Floats:
    """The BSDF of the best fit along other directions, (M, 3) each, where the stack alone has these values, (M, C)."""
    if fit.problem.model.process is None:
        return values
    _, floor = (np.asarray(part, float) for part in fit.problem.call(_levels, fit.vector[None]))
    softness = _softness(fit, np.hypot(_own_sigma(fit, values[None], None), floor))
    lack = np.asarray(fit.problem.call(Model.discrepancy_at, fit.vector, fit.predicted, places(wi, wo))[0])
    return softness * np.sinh(np.asarray(logarithm(values, softness)) + lack)


def _softness(fit: Fit, additive: Floats) -> Floats:
    typical = np.full(additive.shape, np.median(np.abs(fit.problem.data.used().values)))
    return soft(typical, additive)


def _own_sigma(fit: Fit, values: Floats, sigma: Floats | None) -> Floats:
    """The measurement's own, (M, C), where it has one; that of what was fitted, relative to the model, elsewhere."""
    used = fit.problem.data.used()
    if used.sigma is None or not fit.problem.noise.use_sigma:
        return np.zeros(values.shape[1:])
    if sigma is not None:
        return sigma
    relative = np.median(used.sigma / np.maximum(np.abs(fit.predicted), np.finfo(float).tiny), axis=0)
    return relative * np.median(np.abs(values), axis=0)


def _readings(
    fit: Fit, vectors: Floats, values: Floats, data: Measurements, sigma: Floats
) -> tuple[Floats, Floats, Floats | None, Floats | None]:
    """Means, scales, softness and what is unknown of the discrepancy (see `Prediction`), with these values of the
    model, (D, M, C)."""
    relative, floor = (np.asarray(part, float)[:, None, None] for part in fit.problem.call(_levels, vectors))
    relative = np.hypot(relative, gain_unknown(fit.problem.instrument, data.wi, polar_angles(fit.problem.data)))
    if fit.problem.model.process is None:
        return values, np.sqrt(sigma**2 + (relative * values) ** 2 + floor**2), None, None
    lack, unknown = (np.asarray(part) for part in fit.problem.call(_lack_at, vectors, places(data.wi, data.wo)))
    softness = _softness(fit, np.hypot(sigma, np.median(floor)))
    means = np.asarray(logarithm(values, softness)) + lack
    corrected = softness * np.sinh(means)
    noise = np.sqrt(sigma**2 + (relative * corrected) ** 2 + floor**2) / np.asarray(size(corrected, softness))
    return means, np.hypot(unknown, noise), softness, unknown


def _levels(model: Model, vectors: Array) -> tuple[Array, Array]:
    def one(vector: Array) -> tuple[Array, Array]:
        parts = model.build(vector)
        return parts.relative, parts.floor

    return jax.vmap(one)(vectors)


def _lack_at(model: Model, vectors: Array, where: Array) -> tuple[Array, Array]:
    return jax.lax.map(lambda vector: model.discrepancy_at(vector, model.predict(vector), where), vectors)
