"""Free parameters: what is refused, priors against scipy, transforms against calculus, channels that are tied."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, special, stats

import fits
import layerjax as lj
from fits.problem.parameters import Box, Free, LogNormal, LogUniform, Normal, PowerLaw, Uniform, names_of, split
from fits.problem.problem import Joint, Problem
from tests.helpers.models import along
from tests.helpers.refusals import refuses

PRIORS = {  # within the bounds; the logarithm of a log-normal is normal
    "uniform": (Free(0.5, 0.2, 0.9, Uniform()), stats.uniform(0.2, 0.7).logpdf),
    "loguniform": (Free(0.5, 0.01, 10.0, LogUniform()), stats.loguniform(0.01, 10.0).logpdf),
    "normal": (Free(0.5, 0.0, 1.0, Normal(0.8, 0.3)), stats.truncnorm(-8 / 3, 2 / 3, 0.8, 0.3).logpdf),
    "normal far off": (Free(0.5, 0.0, 1.0, Normal(-3.0, 0.3)), stats.truncnorm(10, 40 / 3, -3.0, 0.3).logpdf),
    "lognormal": (Free(1.0, 1.1 / np.e, 1.1 * np.e, LogNormal(1.1, 0.5)), lambda x: LOGARITHM(np.log(x)) - np.log(x)),
}
LOGARITHM = stats.truncnorm(-2.0, 2.0, np.log(1.1), 0.5).logpdf
WAVELENGTHS = (450.0, 550.0, 650.0, 750.0)
GEOMETRY = fits.slices(incidence=(10.0, 50.0), outgoing=np.arange(-70.0, 71.0, 10.0))
NOISE = fits.Noise(relative=0.02, floor=1e-6, discrepancy=False)
SINGLE = lj.SingleScattering()


def law(**changed):
    given = {"amplitude": Free(4.0, 0.1, 50.0), "exponent": Free(0.0, -4.0, 4.0), "wavelengths": WAVELENGTHS}
    return PowerLaw(**given | changed)


def test_refused():
    for call, message in (
        (lambda: Free(0.5, 1.0, 0.0), "low must be below high"),
        (lambda: Free(2.0, 0.0, 1.0), r"Free.start is 2.0; it must lie in \[0.0, 1.0\]"),
        (lambda: Free("half", 0.0, 1.0), "Free.start is 'half'; it must be a finite number"),
        (lambda: Free([0.1, 0.2], [0.0, 0.0, 0.0], 1.0), "different numbers of channels"),
        (lambda: Free(0.5, 0.0, 1.0, LogNormal(1.0, 0.1)), "Free.low is 0.0; it must be above 0 for the prior"),
        (lambda: Free(0.5, 0.0, 1.0, "flat"), "Free.prior: 'flat' is not a Uniform or"),
        (lambda: Free(10**400, 0.0, 1.0), "Free.start is 1000.*; it must be a finite number"),
        (lambda: Free(1.0, -1e308, 1e308), r"float64 cannot hold its density between the bounds \[-1e\+308, 1e\+308\]"),
        (lambda: Free(1e-310, 1e-310, 1.0, LogUniform()), "it must be above 0 for the prior .*, at least 2.2e-308"),
        (lambda: Free(0.5, 0.0, 1.0, Normal(1e300, 1e-300)), r"Free.prior is Normal\(.*float64 cannot hold"),
        (lambda: Free(1.0, 0.0, 2.0, random_walk_sd=0.1), "Free.random_walk_sd is 0.1; .* each of the 0 steps"),
        (lambda: Free((1.0, 1.0), 0.0, 2.0, random_walk_sd=(0.1, 0.2)), r"random_walk_sd is \(0.1, 0.2\).* of the 1"),
        (lambda: Normal(0.0, 0.0), r"Normal.sd is 0.0; it must be a number in \(0, inf\)"),
        (lambda: LogNormal(-1.0, 1.0), r"LogNormal.median is -1.0; it must be a number in \(0, inf\)"),
        (lambda: law(wavelengths=(500.0,)), "PowerLaw.wavelengths has shape"),
        (lambda: law(reference=0.0), "PowerLaw.reference is .*must be finite and above 0"),
        (lambda: law(amplitude=1.0, exponent=1.0), "PowerLaw: nothing is free"),
        (lambda: law(amplitude=Free(1.0, -1.0, 3.0)), r"PowerLaw.amplitude.low is -1.0; .* in \[0, inf\]"),
        (lambda: problem(lj.Stack([], lj.Lambertian(law()))), "base: within the bounds of its power law Lambertian"),
        (lambda: problem(paint(law(), Free((0.5,) * 3, 0.1, 5.0))), r"mu_s has 4, layers\[0\].mu_a has 3"),
        (lambda: problem(paint(law(wavelengths=WAVELENGTHS[:3]))), "stack: it has 3 channels, the data 4"),
        (lambda: joint(walk(0.1), walk(0.2)), "has other bounds or another prior in 'two' than in 'one'"),
    ):
        refuses(message, call)


@pytest.mark.parametrize(("free", "reference"), PRIORS.values(), ids=PRIORS)
def test_prior_density_is_scipys(free, reference):
    """Within the bounds, -inf outside; over the unconstrained vector it integrates to 1 if the determinant is right."""
    box = Box.of([free])
    values = np.linspace(free.low, free.high, 11)[1:-1]
    ours = [float(box.log_prior(jnp.array([value]))) for value in values]
    np.testing.assert_allclose(ours, reference(values), rtol=1e-9, atol=1e-9)
    for value in (free.low - 1.0, free.high + 1e-6, -1e300):
        assert float(box.log_prior(jnp.array([value]))) == -np.inf
    density = jax.jit(lambda u: jnp.exp(box.log_prior(box.constrain(u)) + box.log_determinant(u)))
    total, error = integrate.quad(lambda u: float(density(jnp.array([u]))), -40, 40, points=[-5, 0, 5], epsabs=1e-9)
    assert total == pytest.approx(1.0, abs=max(1e-8, 10 * error))


@pytest.mark.parametrize("mean", [-0.36, 0.7])
@pytest.mark.parametrize("sd", [0.01, 0.9e6, 1.1e6, 1e300])
def test_priors_near_the_limits_are_computed(mean, sd):
    box = Box.of([Free(0.5, 0.0, 1.0, Normal(mean, sd))])
    density = jax.jit(lambda x: jnp.exp(box.log_prior(x[None])))
    total, _ = integrate.quad(lambda x: float(density(jnp.asarray(x))), 0, 1, points=[0.01, 0.69, 0.71, 0.99])
    assert total == pytest.approx(1.0, abs=1e-9)


def test_maps_are_inverses_reach_the_bounds_and_are_finite_far_out():
    box = Box.of([Free(0.5, 0.2, 0.9), Free([1.0, 2.0], 0.01, 10.0, LogUniform())])
    for u in np.random.default_rng(1).normal(0, 4, (10, 3)):
        vector = box.constrain(u)
        np.testing.assert_allclose(special.logit(box.to_unit(vector)), u, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(box.from_unit(box.to_unit(vector)), vector, rtol=1e-13)
    np.testing.assert_allclose(box.from_unit(jnp.array([0.0, 0.5, 1.0])), [0.2, np.sqrt(0.1), 10.0], rtol=1e-14)
    slopes = jnp.diagonal(jax.jacfwd(box.constrain)(jnp.asarray(u)))
    assert float(box.log_determinant(u)) == pytest.approx(float(jnp.sum(jnp.log(slopes))))
    value_and_slope = jax.value_and_grad(lambda x: box.log_determinant(x) + jnp.sum(box.constrain(x)))
    for u in (-800.0, -40.0, 40.0, 800.0):
        vector = box.constrain(jnp.full(3, u))
        assert bool(jnp.all((vector >= box.low * (1 - 1e-15)) & (vector <= box.high * (1 + 1e-15))))
        assert all(np.isfinite(part).all() for part in value_and_slope(jnp.full(3, u)))


def test_a_stack_is_split_and_filled_by_name():
    albedo = Free([0.1, 0.2, 0.3], 0.0, 1.0)
    medium = lj.Medium(Free(0.5, 0.0, 2.0), 0.7, lj.HenyeyGreenstein(Free(0.1, -0.9, 0.9)))
    template, free = split(lj.Stack([medium], base=lj.Lambertian(albedo=albedo)))
    assert names_of(free) == ("layers[0].thickness", "layers[0].phase.g", *(f"base.albedo[{c}]" for c in range(3)))
    assert [entry.shape for entry in free.values()] == [(), (), (3,)]
    expected = lj.Stack([lj.Medium(0.4, 0.7, lj.HenyeyGreenstein(0.2))], lj.Lambertian([0.5, 0.6, 0.7]))
    assert eqx.tree_equal(template.fill(jnp.array([0.4, 0.2, 0.5, 0.6, 0.7])), expected)


def paint(mu_s, mu_a=0.5):
    return lj.Stack([lj.TurbidMedium(0.2, mu_s, mu_a, lj.HenyeyGreenstein(0.3))], lj.Lambertian(0.2))


def problem(stack):
    return Problem(stack, along(GEOMETRY, channels=[f"{nm:g}" for nm in WAVELENGTHS]), SINGLE, NOISE)


def walk(steps):
    return paint(Free((4.0,) * 4, 0.1, 50.0, LogUniform(), random_walk_sd=steps))


def joint(*stacks, shared=("layers",)):
    return Joint(dict(zip(("one", "two"), map(problem, stacks), strict=True)), shared=shared)


def test_a_power_law_is_a_number_a_channel_about_the_geometric_mean():
    mu_s = 6.0 * (np.array(WAVELENGTHS) / 600.0) ** -1.5
    posed = problem(paint(law(reference=600.0)))
    assert posed.units == {"layers[0].mu_s.amplitude": "1/mm", "layers[0].mu_s.exponent": "1"}
    np.testing.assert_allclose(posed.build([6.0, 1.5]).stack.layers[0].mu_s, mu_s, rtol=1e-12)
    exact = lj.evaluate(paint(mu_s), GEOMETRY.wi, GEOMETRY.wo, SINGLE)
    np.testing.assert_allclose(posed.predict([6.0, 1.5]), exact, rtol=1e-9)
    assert law().reference == pytest.approx(stats.gmean(WAVELENGTHS))
    low, high = law(exponent=1.0, amplitude=Free(4.0, 1.0, 9.0), reference=450.0).extremes()
    np.testing.assert_allclose([low, high], np.outer([1.0, 9.0], 450.0 / np.array(WAVELENGTHS)))


def test_a_random_walk_has_the_density_of_neighbours_differences():
    """Flat priors count once, a Gaussian one makes one Gaussian with it."""
    box = Box.of([Free((1.0, 2.0, 3.0), 0.0, 10.0, random_walk_sd=(0.5, 0.2))])
    expected = -np.log(10.0) + stats.norm.logpdf(0.3, scale=0.5) + stats.norm.logpdf(-0.1, scale=0.2)
    assert float(box.log_prior(np.array([4.0, 4.3, 4.2]))) == pytest.approx(expected)
    step = np.diff(np.eye(3), axis=0) / 0.1
    covariance = np.linalg.inv(np.eye(3) / 0.3**2 + step.T @ step)
    x = np.array([2.1, 2.2, 1.9])
    for prior, mean, natural, jacobian in (
        (Normal(2.0, 0.3), 2.0, x, 0.0),
        (LogNormal(2.0, 0.3), np.log(2.0), np.log(x), np.log(x).sum()),
    ):
        box = Box.of([Free((2.0, 2.0, 2.0), 1e-6, 1e3, prior, random_walk_sd=0.1)])
        expected = stats.multivariate_normal([mean] * 3, covariance).logpdf(natural) - jacobian
        assert float(box.log_prior(x)) == pytest.approx(expected)
    one = walk(0.1)  # shared channels are smooth once
    np.testing.assert_allclose(joint(one, one).model.box.differences, problem(one).model.box.differences)
    assert joint(one, one, shared=[]).model.box.differences.shape == (6, 8)
