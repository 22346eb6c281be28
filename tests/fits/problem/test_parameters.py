"""Free parameters: what is refused, priors against scipy, transforms against calculus done otherwise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, special, stats

import layerjax as lj
from fits.problem.parameters import Box, Free, LogNormal, LogUniform, Normal, Uniform, split

PRIORS = {
    "uniform": (Free(0.5, 0.2, 0.9, Uniform()), stats.uniform(0.2, 0.7)),
    "loguniform": (Free(0.5, 0.01, 10.0, LogUniform()), stats.loguniform(0.01, 10.0)),
    "normal": (Free(0.5, 0.0, 1.0, Normal(0.8, 0.3)), stats.truncnorm(-8 / 3, 2 / 3, 0.8, 0.3)),
    "normal far off": (Free(0.5, 0.0, 1.0, Normal(-3.0, 0.3)), stats.truncnorm(10, 40 / 3, -3.0, 0.3)),
}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.5, 1.0, 0.0), "low must be below high"),
        ((0.5, 0.5, 0.5), "low must be below high"),
        ((2.0, 0.0, 1.0), r"Free.start is 2.0; it must lie in \[0.0, 1.0\]"),
        (([0.1, 2.0], 0.0, 1.0), "Free.start"),
        ((float("nan"), 0.0, 1.0), "Free.start is nan; it must be finite"),
        ((0.5, 0.0, float("inf")), "Free.high is inf; it must be finite"),
        (("half", 0.0, 1.0), "Free.start is 'half'; it must be a number"),
        (([0.1, 0.2], [0.0, 0.0, 0.0], 1.0), "different numbers of channels"),
        ((0.5, 0.0, 1.0, LogNormal(1.0, 0.1)), "Free.low is 0.0; it must be above 0 for the prior"),
        ((0.5, 0.0, 1.0, "flat"), "Free.prior is 'flat'"),
        ((10**400, 0.0, 1.0), "Free.start is 1000.*; it must be a number"),
        ((1.0, -1e308, 1e308), "float64 must hold their difference"),
        (
            (1e-310, 1e-310, 1.0, LogUniform()),
            "Free.low is 1e-310; it must be above 0 for the prior .*, at least 2.2e-308",
        ),
        ((1e300, 1e300, np.nextafter(1e300, 2e300), LogUniform()), "float64 must hold their difference"),
        ((0.5, [0.0, 0.4], 1.0, Normal(-0.3, 0.01)), r"must lie within 37 standard deviations of \[\[0.0, 0.4\], "),
        ((0.5, 0.0, 1.0, Normal(1.38, 0.01)), "must lie within 37 standard deviations"),
        ((1.0, 0.5, 2.0, LogNormal(0.5 * np.exp(-0.38), 0.01)), "must lie within 37 standard deviations"),
        ((0.5, 0.0, 1.0, Normal(0.5, 1e-16)), "its sd must be above 1e-15"),
    ],
)
def test_free_refuses(arguments: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Free(*arguments)


@pytest.mark.parametrize(
    ("kind", "numbers", "message"),
    [
        (Normal, (0.0, 0.0), "Normal.sd is 0.0; it must be one number, finite and above 0"),
        (Normal, (float("nan"), 1.0), "Normal.mean is nan; it must be one number, finite$"),
        (Normal, ((0.1, 0.2, 0.3), 0.05), r"Normal.mean is \(0.1, 0.2, 0.3\); it must be one number"),
        (Normal, (0.5, (0.1, 0.2)), r"Normal.sd is \(0.1, 0.2\); it must be one number"),
        (Normal, ("half", 0.1), "Normal.mean is 'half'; it must be one number"),
        (LogNormal, (-1.0, 1.0), "LogNormal.median is -1.0; it must be one number, finite and above 0"),
        (LogNormal, (1.0, -1.0), "LogNormal.sd is -1.0"),
        (LogNormal, ((1.0, 2.0), 1.0), r"LogNormal.median is \(1.0, 2.0\); it must be one number"),
    ],
)
def test_priors_refuse(kind, numbers: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        kind(*numbers)


@pytest.mark.parametrize("name", PRIORS)
def test_prior_density_is_scipys(name: str) -> None:
    free, reference = PRIORS[name]
    box = Box.of([free])
    values = np.linspace(free.low, free.high, 11)[1:-1]
    ours = [float(box.log_prior(jnp.array([value]))) for value in values]
    np.testing.assert_allclose(ours, reference.logpdf(values), rtol=1e-9, atol=1e-9)


def test_lognormal_density_is_scipys_renormalised_within_the_bounds() -> None:
    free, reference = Free(1.0, 0.8, 1.3, LogNormal(1.1, 0.2)), stats.lognorm(0.2, scale=1.1)
    values = np.linspace(0.8, 1.3, 7)
    expected = reference.logpdf(values) - np.log(reference.cdf(1.3) - reference.cdf(0.8))
    ours = [float(Box.of([free]).log_prior(jnp.array([value]))) for value in values]
    np.testing.assert_allclose(ours, expected, rtol=1e-10)


@pytest.mark.parametrize("mean", [-0.36, 0.0, 0.7, 1.36])
@pytest.mark.parametrize("sd", [0.01, 1.0, 0.9e6, 1.1e6, 1e20, 1e300])
def test_priors_near_the_limits_are_computed(mean: float, sd: float) -> None:
    box = Box.of([Free(0.5, 0.0, 1.0, Normal(mean, sd))])
    total, _ = integrate.quad(
        lambda x: float(np.exp(box.log_prior(jnp.array([x])))), 0, 1, points=[0.01, 0.69, 0.71, 0.99]
    )
    assert total == pytest.approx(1.0, abs=1e-9)
    if sd > 1e7:
        assert float(box.log_prior(jnp.array([0.3]))) == pytest.approx(0.0, abs=1e-6)  # flat


@pytest.mark.parametrize("name", PRIORS)
def test_prior_outside_the_bounds_is_minus_infinity(name: str) -> None:
    free, _ = PRIORS[name]
    for value in (free.low - 1.0, free.high + 1e-6, -1e300):
        assert float(Box.of([free]).log_prior(jnp.array([value]))) == -np.inf


@pytest.mark.parametrize("name", PRIORS)
def test_density_over_unconstrained_space_integrates_to_one(name: str) -> None:
    """Change of variables: right only if the log-determinant is."""
    box = Box.of([PRIORS[name][0]])
    density = jax.jit(lambda u: jnp.exp(box.log_prior(box.constrain(u)) + box.log_determinant(u)))
    total, error = integrate.quad(lambda u: float(density(jnp.array([u]))), -40, 40, points=[-5, 0, 5], epsabs=1e-9)
    assert total == pytest.approx(1.0, abs=max(1e-8, 10 * error))


def test_log_determinant_is_that_of_the_map_by_differences() -> None:
    box = Box.of([Free(0.5, 0.2, 0.9), Free([1.0, 2.0], 0.01, 10.0, LogUniform())])
    for u in np.random.default_rng(0).normal(0, 3, (5, 3)):
        step = 1e-6
        slopes = (np.asarray(box.constrain(u + step)) - np.asarray(box.constrain(u - step))) / (2 * step)
        assert float(box.log_determinant(u)) == pytest.approx(np.sum(np.log(slopes)), abs=1e-6)


def test_maps_are_inverses_and_reach_the_bounds() -> None:
    box = Box.of([Free(0.5, 0.2, 0.9), Free([1.0, 2.0], 0.01, 10.0, LogUniform())])
    for u in np.random.default_rng(1).normal(0, 4, (10, 3)):
        vector = box.constrain(u)
        np.testing.assert_allclose(special.logit(box.to_unit(vector)), u, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(box.from_unit(box.to_unit(vector)), vector, rtol=1e-13)
    np.testing.assert_allclose(box.from_unit(jnp.array([0.0, 0.5, 1.0])), [0.2, np.sqrt(0.1), 10.0], rtol=1e-14)


def test_far_out_nothing_is_nan() -> None:
    box = Box.of([Free(0.5, 0.0, 0.9), Free(1.0, 0.01, 10.0, LogNormal(1.0, 0.1))])
    for u in (-800.0, -40.0, 40.0, 800.0):
        at = jnp.array([u, u])
        vector = box.constrain(at)
        assert bool(jnp.all((vector >= box.low * (1 - 1e-15)) & (vector <= box.high * (1 + 1e-15))))
        value, slope = jax.value_and_grad(lambda x: box.log_determinant(x) + jnp.sum(box.constrain(x)))(at)
        assert np.isfinite(value)
        assert np.all(np.isfinite(slope))


def test_a_stack_is_split_and_filled_by_name() -> None:
    albedo = Free([0.1, 0.2, 0.3], 0.0, 1.0)
    medium = lj.Medium(thickness=Free(0.5, 0.0, 2.0), albedo=0.7, phase=lj.HenyeyGreenstein(g=Free(0.1, -0.9, 0.9)))
    template, names, free = split(lj.Stack([medium], base=lj.Lambertian(albedo=albedo)))
    assert names == (
        "layers[0].thickness",
        "layers[0].phase.g",
        "base.albedo[0]",
        "base.albedo[1]",
        "base.albedo[2]",
    )
    assert [entry.shape for entry in free] == [(), (), (3,)]
    stack = template.fill(jnp.array([0.4, 0.2, 0.5, 0.6, 0.7]))
    assert float(stack.layers[0].thickness) == 0.4
    assert float(stack.layers[0].albedo) == 0.7
    assert float(stack.layers[0].phase.g) == 0.2
    np.testing.assert_array_equal(stack.base.albedo, [0.5, 0.6, 0.7])
