"""Problems as they are put together: the likelihood against scipy.stats, its least-squares form, what is refused."""

from dataclasses import dataclass, replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

import layerjax as lj
from fits import Free, LogNormal, LogUniform, Noise, Normal, Problem, simulate, slices
from fits.problem.model import Model
from fits.problem.noise import information_weights, log_density, named_residual, tail_residual
from tests.helpers.models import design, line, measured

COUNT = 40
VALUES = np.random.default_rng(0).normal(0.5, 0.2, (COUNT, 1))
SIGMA = np.linspace(0.05, 0.2, COUNT)[:, None]
STACK = {"a": Free(0.3, 0.01, 2.0, LogUniform()), "b": Free(0.4, -1.0, 1.0, Normal(0.3, 0.5))}
NU = jnp.asarray(4.0)
TAILS = {"gaussian": stats.norm, "student": stats.t(4.0)}
PAINT = lj.Stack([], lj.Lambertian(Free(0.4, 0.0, 1.0)))
DATA = simulate(lj.Stack([], lj.Lambertian(0.6)), slices(incidence=[20], outgoing=[-40, 10, 70]), noise=0.1)


@pytest.mark.parametrize("z", [0.0, 1e-12, -1e-5, 0.019, 0.0201, -0.3, 2.0, 40.0, 1e6])
def test_densities_are_scipys_and_half_squares_of_residuals(z: float) -> None:
    for tails, reference in TAILS.items():
        expected = reference.logpdf(z) - np.log(0.3)
        assert float(log_density(jnp.asarray(z), jnp.asarray(0.3), tails, NU)) == pytest.approx(expected, rel=1e-12)
    residual = float(tail_residual(jnp.asarray(z), "student", NU))
    assert np.sign(residual) == np.sign(z)
    assert 0.5 * residual**2 == pytest.approx(2.5 * np.log1p(z**2 / 4), rel=1e-12)
    assert float(tail_residual(jnp.asarray(z), "gaussian", NU)) == z


@pytest.mark.parametrize("tails", TAILS)
def test_information_is_the_mean_square_score(tails: str) -> None:
    reference, step = TAILS[tails], 1e-5

    def mean(z: float) -> float:
        return (reference.logpdf(z - step) - reference.logpdf(z + step)) / (2 * step)

    def level(z: float) -> float:
        ends = [reference.logpdf(z * np.exp(-t)) - t for t in (step, -step)]
        return (ends[0] - ends[1]) / (2 * step)

    expected = [
        2
        * integrate.quad(lambda z, score=score: reference.pdf(z) * score(z) ** 2, 0, 400, points=[1, 10], limit=200)[0]
        for score in (mean, level)
    ]
    np.testing.assert_allclose(information_weights(tails, NU), expected, rtol=1e-4)


NOISES = {
    "sigma": Noise(),
    "sigma and relative": Noise(relative=0.1, floor=0.02),
    "relative": Noise(relative=0.1, floor=0.02, use_sigma=False),
    "free": Noise(relative=Free(0.1, 0.0, 1.0), floor=Free(0.02, 1e-3, 1.0), use_sigma=False),
    "free student": Noise(relative=0.05, floor=Free(0.02, 1e-3, 1.0), tails="student", degrees_of_freedom=3.0),
}


@pytest.mark.parametrize("name", NOISES)
def test_problem_against_a_likelihood_written_out(name: str) -> None:
    """Log-likelihood and log-prior by scipy; the residuals give their sum up to one constant."""
    noise = NOISES[name]
    problem = Problem(STACK, measured(VALUES, SIGMA), line, noise, Free(1.0, 0.5, 2.0, LogNormal(1.0, 0.1)))
    assert problem.names[:3] == ("['a']", "['b']", "scale")
    offsets = []
    for vector in np.random.default_rng(1).uniform(problem.low, problem.high, (4, len(problem.names))):
        named = dict(zip(problem.names, vector, strict=True))
        predicted = named["scale"] * (design(COUNT) @ [named["['a']"], named["['b']"]])[:, None]
        relative = named.get("noise.relative", noise.relative if isinstance(noise.relative, float) else 0.0)
        floor = named.get("noise.floor", noise.floor if isinstance(noise.floor, float) else 0.0)
        sigma = np.sqrt((SIGMA**2 if noise.use_sigma else 0.0) + (relative * predicted) ** 2 + floor**2)
        law = stats.norm if noise.tails == "gaussian" else stats.t(3.0)
        each = law.logpdf((VALUES - predicted) / sigma) - np.log(sigma)
        np.testing.assert_allclose(problem.call(Model.log_likelihood_per_datum_at, vector, predicted), each, rtol=1e-10)
        assert float(problem.log_likelihood(vector)) == pytest.approx(each.sum(), rel=1e-12)
        priors = stats.norm.logpdf(named["['b']"], 0.3, 0.5) + stats.norm.logpdf(np.log(named["scale"]), 0, 0.1)
        half = 0.5 * float(np.sum(np.square(problem.residuals(vector))))
        offsets.append(half + each.sum() + priors)
    assert np.ptp(offsets) < 1e-9 * max(1.0, abs(offsets[0]))


def test_posterior_density_is_likelihood_prior_and_map() -> None:
    problem = Problem(STACK, measured(VALUES, SIGMA), line)
    vector = np.array([0.5, 0.2])
    prior = stats.loguniform(0.01, 2.0).logpdf(0.5) + stats.truncnorm(-2.6, 1.4, 0.3, 0.5).logpdf(0.2)
    share = np.array([np.log(0.5 / 0.01) / np.log(200.0), 1.2 / 2.0])
    slopes = np.array([0.5 * np.log(200.0), 2.0]) * share * (1 - share)
    expected = float(problem.log_likelihood(vector)) + prior + np.sum(np.log(slopes))
    u = np.log(share) - np.log1p(-share)
    assert float(problem.log_posterior_unconstrained(u)) == pytest.approx(expected, rel=1e-12)
    for far in (np.array([np.nan, 0.0]), np.array([np.inf, 0.0])):
        assert float(problem.log_posterior_unconstrained(far)) == -np.inf


def test_masked_samples_never_enter_and_noise_is_five_per_cent_by_default() -> None:
    spoiled, mask = VALUES.copy(), np.ones(COUNT, bool)
    spoiled[::4], mask[::4] = 1e6, False
    clean, masked = (Problem(STACK, measured(values, SIGMA, mask), line) for values in (VALUES, spoiled))
    vector = np.array([0.5, 0.2])
    assert clean.count == COUNT - COUNT // 4
    np.testing.assert_array_equal(clean.residuals(vector), masked.residuals(vector))
    predicted = (design(COUNT) @ vector)[:, None]
    sigma = np.hypot(0.05 * predicted, 1e-4 * np.median(np.abs(VALUES)))
    problem = Problem(STACK, measured(VALUES), line)
    assert float(problem.log_likelihood(vector)) == pytest.approx(stats.norm.logpdf(VALUES, predicted, sigma).sum())


def test_named_residuals() -> None:
    predicted, values, cosine = np.array([[0.3], [0.0]]), np.array([[0.2], [-0.01]]), np.array([[0.5], [0.8]])
    f, d = predicted * cosine, values * cosine
    expected = {"cosine_l2": f - d, "log1p_cos": np.log1p(f) - np.log1p(d), "cube_root": np.cbrt(f) - np.cbrt(d)}
    for name, reference in expected.items():
        ours = named_residual(name, *map(jnp.asarray, (predicted, values, cosine)))
        np.testing.assert_allclose(ours, reference, atol=0.011 if name == "cube_root" else 1e-12)
        slope = jax.jacfwd(lambda f, name=name: named_residual(name, f, jnp.asarray(values), jnp.asarray(cosine)))
        assert np.all(np.isfinite(slope(jnp.asarray(predicted))))


def lambert(stack: lj.Stack, wi: jax.Array, wo: jax.Array, gain: float = 1.0) -> jax.Array:
    return jnp.broadcast_to(gain * stack.base.albedo / jnp.pi, (len(wi), 1))


@dataclass(frozen=True)
class Plain:
    gain: float

    def __call__(self, stack: lj.Stack, wi: jax.Array, wo: jax.Array) -> jax.Array:
        return lambert(stack, wi, wo, self.gain)


class Module(eqx.Module):
    gain: jax.Array

    def __call__(self, stack: lj.Stack, wi: jax.Array, wo: jax.Array) -> jax.Array:
        return lambert(stack, wi, wo, self.gain)


CALLABLES = {
    "lambda": (lambda stack, wi, wo: lambert(stack, wi, wo, 2.0), 2.0),
    "compiled": (jax.jit(lambert), 1.0),
    "partial": (partial(lambert, gain=0.5), 0.5),
    "bound method": (Plain(3.0).__call__, 3.0),
    "object": (Plain(3.0), 3.0),
    "equinox module": (Module(jnp.asarray(0.25)), 0.25),
}


@pytest.mark.parametrize(("transport", "gain"), CALLABLES.values(), ids=CALLABLES)
def test_any_callable_stands_for_a_transport(transport, gain: float) -> None:
    problem = Problem(PAINT, DATA, transport=transport)
    np.testing.assert_allclose(problem.predict([0.3]), np.full((3, 1), gain * 0.3 / np.pi), rtol=1e-12)
    seen = simulate(lj.Stack([], lj.Lambertian(0.3)), slices(incidence=[20], outgoing=[10]), transport=transport)
    np.testing.assert_allclose(seen.values, [[gain * 0.3 / np.pi]], rtol=1e-12)


def test_what_follows_from_a_problem() -> None:
    problem = Problem(PAINT, DATA, scale=Free(1.0, 0.5, 2.0))
    assert problem.names == ("base.albedo", "scale")
    assert (problem.count, problem.units) == (3, {"base.albedo": "1", "scale": "1"})
    np.testing.assert_array_equal([problem.low, problem.start, problem.high], [[0.0, 0.5], [0.4, 1.0], [1.0, 2.0]])
    assert problem.model is problem.model
    colours = lj.Stack([], base=lj.Lambertian(albedo=Free([0.1, 0.2, 0.3], 0.0, 1.0)))
    three = Problem(colours, measured(np.repeat(VALUES, 3, axis=1)))
    np.testing.assert_allclose(three.predict([0.1, 0.2, 0.3])[0], np.array([0.1, 0.2, 0.3]) / np.pi, rtol=1e-12)


WALK = lj.Stack([], lj.Lambertian(Free((0.4, 0.4), 0.0, 1.0, random_walk_sd=0.1)))
TWO = replace(DATA, values=np.repeat(DATA.values, 2, axis=1), sigma=None, channels=("a", "b"))
MANY = np.array([0.1, 0.2, 0.3])
FLAT = {"a": Free(0.3, 0.01, 2.0), "b": 0.1}
LINE_DATA = measured(VALUES)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Noise(floor=Free(0.1, 0.0, 1.0)), r"Noise.floor.low is 0.0; it must be a number in \[1e-100, "),
        (lambda: Noise(relative=Free([0.1, 0.1], 0.0, 1.0)), "Noise.relative has 2 channels"),
        (lambda: Noise(floor=1e-200), r"Noise.floor is 1e-200; it must be a number in \[1e-100, 1e\+100\]"),
        (lambda: Noise(relative=Free(0.5, 0.0, 5.0)), r"Noise.relative.high is 5.0; it must be a number in \[0, 1\]"),
        (lambda: Noise(tails="cauchy"), "Noise.tails: 'cauchy' is not one of 'gaussian', 'student'"),
        (lambda: Problem({"a": 0.1, "b": 0.2}, LINE_DATA, line), "nothing is free"),
        (lambda: Problem(STACK, measured(VALUES, mask=np.zeros(COUNT, bool)), line), "no sample is used"),
        (lambda: Problem(STACK, LINE_DATA, line, Noise(relative=0.0, floor=0.0)), "sigma could become 0"),
        (
            lambda: Problem(STACK, measured(1e-300 * np.ones_like(VALUES)), line),
            r"^values: the median of \|value\| is 1e-300 1/sr; .* must be in \[1e-96, 1e\+30\], or Noise.floor",
        ),
        (lambda: Problem(STACK, LINE_DATA, line, scale=-1.0), "scale is -1.0"),
        (lambda: Problem(STACK, LINE_DATA, line, objective="l1"), "objective: 'l1' is not one of 'likelihood', "),
        (
            lambda: Problem(STACK, LINE_DATA, line, objective="cube_root"),
            r"the prior of \['b'\]: objective 'cube_root'",
        ),
        (lambda: Problem(WALK, TWO, objective="cosine_l2"), "the prior of base.albedo: objective 'cosine_l2' weighs"),
        (
            lambda: Problem(FLAT, LINE_DATA, line, Noise(relative=Free(0.1, 0.0, 1.0)), objective="cosine_l2"),
            r"noise\.relative: objective 'cosine_l2' weighs neither",
        ),
        (
            lambda: Problem(FLAT, LINE_DATA, line, Noise(discrepancy=True), objective="cube_root"),
            r"noise\.discrepancy: objective 'cube_root' weighs neither",
        ),
        (lambda: Problem(WALK, replace(TWO, values=TWO.values[:, :1], channels=("a",))), "it has 2 channels, the data"),
        (lambda: Problem(PAINT, DATA, transport="walk"), r'transport: .* is not a Transport or "auto"'),
        (
            lambda: Problem(lj.Stack([], lj.OrenNayar(0.4, Free(MANY, 0.0, 1.0))), DATA, lj.SingleScattering()),
            r"takes one stack; base.roughness of shape \(3,\) makes it a map",
        ),
        (lambda: simulate(lj.Stack([], lj.OrenNayar(0.4, MANY)), slices()), r"base.roughness of shape \(3,\)"),
    ],
)
def test_refused(call, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()
