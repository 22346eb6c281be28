"""The likelihood against scipy.stats, and the least-squares form against the likelihood."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

import layerjax as lj
from fits.problem.noise import (
    Noise,
    information_weights,
    log_density,
    named_residual,
    sigma_residual,
    tail_residual,
)
from fits.problem.parameters import Free, LogNormal, LogUniform, Normal
from fits.problem.problem import Problem
from tests.helpers.models import design, line, measured

COUNT = 40
VALUES = np.random.default_rng(0).normal(0.5, 0.2, (COUNT, 1))
SIGMA = np.linspace(0.05, 0.2, COUNT)[:, None]
STACK = {"a": Free(0.3, 0.01, 2.0, LogUniform()), "b": Free(0.4, -1.0, 1.0, Normal(0.3, 0.5))}
NU = jnp.asarray(4.0)


@pytest.mark.parametrize("z", [0.0, 1e-9, 1e-4, 0.3, 2.0, 40.0, 1e6])
def test_densities_are_scipys(z: float) -> None:
    sigma = jnp.asarray(0.3)
    for tails, reference in (("gaussian", stats.norm), ("student", stats.t(4.0))):
        expected = reference.logpdf(z) - np.log(0.3)
        assert float(log_density(jnp.asarray(z), sigma, tails, NU)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("z", [1e-12, -1e-5, 0.019, 0.0201, -0.3, 2.0, 40.0, 1e6])
def test_half_square_of_the_residual_is_minus_the_log_density(z: float) -> None:
    residual = float(tail_residual(jnp.asarray(z), "student", NU))
    assert np.sign(residual) == np.sign(z)
    assert 0.5 * residual**2 == pytest.approx(2.5 * np.log1p(z**2 / 4), rel=1e-12)
    assert float(tail_residual(jnp.asarray(z), "gaussian", NU)) == z


def test_residual_is_smooth_at_zero() -> None:
    slope = jax.grad(lambda z: tail_residual(z, "student", NU))
    at = np.array([-1e-2, -1e-8, 0.0, 1e-8, 1e-2])
    np.testing.assert_allclose([float(slope(z)) for z in at], np.sqrt(5 / 4), rtol=1e-4)


def test_residual_of_a_level_is_its_logarithm() -> None:
    levels = np.array([0.1, 0.2, 5.0])
    halves = 0.5 * np.asarray(sigma_residual(jnp.asarray(levels), jnp.asarray(0.1))) ** 2
    np.testing.assert_allclose(halves - halves[0], np.log(levels / 0.1), rtol=1e-12)
    assert np.isfinite(float(jax.grad(sigma_residual)(0.1, 0.1)))


@pytest.mark.parametrize(("tails", "reference"), [("gaussian", stats.norm), ("student", stats.t(4.0))])
def test_information_is_the_mean_square_score(tails: str, reference) -> None:
    def score_square(parameter: str) -> float:
        def integrand(z: float) -> float:
            step = 1e-5
            if parameter == "mean":
                score = (reference.logpdf(z - step) - reference.logpdf(z + step)) / (2 * step)
            else:
                ends = [reference.logpdf(z * np.exp(-t)) - t for t in (step, -step)]
                score = (ends[0] - ends[1]) / (2 * step)
            return reference.pdf(z) * score**2

        return 2 * integrate.quad(integrand, 0, 400, points=[1, 10], limit=200)[0]

    weights = information_weights(tails, NU)
    np.testing.assert_allclose(weights, [score_square("mean"), score_square("level")], rtol=1e-4)


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
        np.testing.assert_allclose(problem.log_likelihood_per_datum(vector), each, rtol=1e-10)
        assert float(problem.log_likelihood(vector)) == pytest.approx(each.sum(), rel=1e-12)
        gaussian_priors = stats.norm.logpdf(named["['b']"], 0.3, 0.5) + stats.norm.logpdf(
            np.log(named["scale"]), 0, 0.1
        )
        half = 0.5 * float(np.sum(np.square(problem.residuals(vector))))
        offsets.append(half + each.sum() + gaussian_priors)
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


def test_masked_samples_never_enter() -> None:
    spoiled, mask = VALUES.copy(), np.ones(COUNT, bool)
    spoiled[::4], mask[::4] = 1e6, False
    clean = Problem(STACK, measured(VALUES, SIGMA, mask), line)
    masked = Problem(STACK, measured(spoiled, SIGMA, mask), line)
    vector = np.array([0.5, 0.2])
    assert clean.count == COUNT - COUNT // 4
    np.testing.assert_array_equal(clean.residuals(vector), masked.residuals(vector))


def test_default_noise_is_five_per_cent_of_the_model() -> None:
    problem = Problem(STACK, measured(VALUES), line)
    vector = np.array([0.5, 0.2])
    predicted = (design(COUNT) @ vector)[:, None]
    sigma = np.hypot(0.05 * predicted, 1e-4 * np.median(np.abs(VALUES)))
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


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Noise(relative=-0.1), "Noise.relative is -0.1"),
        (lambda: Noise(floor=Free(0.1, 0.0, 1.0)), r"Noise.floor.low is 0.0; it must be a number in \[1e-100, "),
        (lambda: Noise(relative=Free([0.1, 0.1], 0.0, 1.0)), "Noise.relative has 2 channels"),
        (lambda: Noise(tails="cauchy"), "Noise.tails is 'cauchy'; it must be one of gaussian, student"),
        (lambda: Noise(floor=1e-200), r"Noise.floor is 1e-200; it must be a number in \[1e-100, 1e\+100\]"),
        (lambda: Noise(relative=Free(1.0, 0.0, 1e200)), r"Noise.relative.high is 1e\+200"),
        (lambda: Noise(degrees_of_freedom=0.0), "Noise.degrees_of_freedom is 0.0"),
        (lambda: Noise(degrees_of_freedom=1e17), r"Noise.degrees_of_freedom is 1e\+17; it must be a number in"),
        (lambda: Problem({"a": 0.1, "b": 0.2}, measured(VALUES), line), "nothing is free"),
        (lambda: Problem(STACK, measured(VALUES, mask=np.zeros(COUNT, bool)), line), "no sample is used"),
        (lambda: Problem(STACK, measured(VALUES), line, Noise(relative=0.0, floor=0.0)), "sigma could become 0"),
        (lambda: Problem(STACK, measured(VALUES), line, objective="l1"), "objective is 'l1'"),
        (lambda: Problem(STACK, measured(VALUES), line, scale=-1.0), "scale is -1.0"),
        (lambda: Problem(STACK, measured(VALUES), line, objective="cube_root"), "has no weight beside objective"),
    ],
)
def test_refused(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_free_noise_is_refused_beside_a_named_objective() -> None:
    flat = {"a": Free(0.3, 0.01, 2.0), "b": 0.1}
    with pytest.raises(ValueError, match=r"noise\.relative is free"):
        Problem(flat, measured(VALUES), line, Noise(relative=Free(0.1, 0.0, 1.0)), objective="cosine_l2")


def test_channels_must_match() -> None:
    stack = lj.Stack([], base=lj.Lambertian(albedo=Free([0.1, 0.2, 0.3], 0.0, 1.0)))
    with pytest.raises(ValueError, match="it has 3 channels, the data 1"):
        Problem(stack, measured(VALUES))
    three = Problem(stack, measured(np.repeat(VALUES, 3, axis=1)))
    np.testing.assert_allclose(three.predict([0.1, 0.2, 0.3])[0], np.array([0.1, 0.2, 0.3]) / np.pi, rtol=1e-12)
