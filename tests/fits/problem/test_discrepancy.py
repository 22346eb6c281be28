"""Model discrepancy, beside dense matrices that are built here from the definition alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from fits import Discrepancy, Free, LogNormal, Measurements, Noise, Problem, slices
from fits.data.measurements import channel_names
from fits.problem.discrepancy import Correlation, make_process, places
from fits.problem.model import Model
from tests.helpers.merl import half_angles
from tests.helpers.models import along

LAYOUTS = {
    "one scan": slices([30.0], np.arange(-80.0, 81.0, 8.0)),
    "two incidences": slices([10.0, 50.0], np.arange(-80.0, 81.0, 8.0)),
    "two planes": slices([20.0, 60.0], np.arange(-75.0, 76.0, 15.0), [0.0, 60.0]),
    "both sides": slices([10.0, 40.0], np.arange(-180.0, 180.0, 20.0)),
    "a narrow scan": slices([45.0], 45.0 + np.linspace(-1.0, 1.0, 9)),
}
MANY = slices([5.0, 20.0, 35.0, 50.0, 60.0, 70.0], np.linspace(-85.0, 85.0, 100))
FREE = Free(20.0, 10.0, 50.0)


def transport(stack, wi, wo):
    half = wi + wo
    return (0.1 + stack["a"] * jnp.exp(-jnp.sum(half[:, :2] ** 2, axis=-1)))[:, None] * jnp.asarray(stack["colour"])


def problem(layout: str, channels: int = 1, relative: float | Free = 0.01, **correlated) -> Problem:
    geometry, stack = LAYOUTS[layout], {"a": Free(0.4, 0.0, 1.0), "colour": np.linspace(1.0, 0.5, channels)}
    exact = np.asarray(transport(stack | {"a": 0.5}, geometry.wi, geometry.wo))
    scatter = np.random.default_rng(len(geometry)).standard_normal(exact.shape)
    data = along(geometry, exact * (1.0 + 0.1 * scatter), 0.02 * exact, channel_names(channels))
    return Problem(stack, data, transport, Noise(relative=relative, discrepancy=Discrepancy(**correlated)))


def matern(distance: np.ndarray, length: float) -> np.ndarray:
    """Rasmussen & Williams 2006, Eq. 4.17."""
    x = np.sqrt(5.0) * distance / length
    return (1.0 + x + x**2 / 3.0) * np.exp(-x)


def folded(data: Measurements) -> np.ndarray:
    """Half angle, and difference angle as a vector of |cos| and |sin| of its azimuth, (N, 3), and the side, (N,)."""
    upper = (np.column_stack([w[:, :2], np.abs(w[:, 2])]) for w in (data.wi, data.wo))
    tilt, _, theta, azimuth = half_angles(*upper)
    azimuth[tilt < 1e-7] = 0.0  # about the normal there is none
    side = np.where(data.wi[:, 2] * data.wo[:, 2] <= 0, 2, data.wi[:, 2] < 0)
    theta = np.degrees(theta)
    return np.stack([np.degrees(tilt), theta * np.abs(np.cos(azimuth)), theta * np.abs(np.sin(azimuth)), side], axis=-1)


def kernel(one: np.ndarray, other: np.ndarray, at: Correlation) -> np.ndarray:
    tilt = matern(np.abs(one[:, None, 0] - other[:, 0]), float(at.length_half))
    apart = np.linalg.norm(one[:, None, 1:3] - other[:, 1:3], axis=-1)
    alike = tilt * matern(apart, float(at.length_difference)) * (one[:, None, 3] == other[:, 3])
    return float(at.amplitude) ** 2 * alike * np.outer(larger(one, at), larger(other, at))


def larger(where: np.ndarray, at: Correlation) -> np.ndarray:
    """Than along the normal, by the angles of half vector and difference, neither above 85 degrees."""
    angles = np.minimum([np.abs(where[:, 0]), np.linalg.norm(where[:, 1:3], axis=-1)], 85.0)
    return np.prod(np.cos(np.radians(angles)), axis=0) ** -float(at.grazing_exponent)


def soft(of: Problem) -> np.ndarray:
    """Four standard deviations of the additive noise, (N, C)."""
    floor = 1e-4 * np.median(np.abs(of.data.values))
    return 4.0 * np.hypot(of.data.sigma, floor)


def dense(of: Problem, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean (N C,) and covariance of all logarithms asinh(x / s), without inducing points."""
    at, predicted, own = of.build(vector).correlation, np.asarray(of.predict(vector)), folded(of.data)
    together = float(at.channel_correlation)
    colours = together + (1.0 - together) * np.eye(predicted.shape[1])
    full = np.einsum("nm,cd->ncmd", kernel(own, own, at), colours).reshape(predicted.size, -1)
    values, s = of.data.values, soft(of)
    noise = np.sqrt((s / 4.0) ** 2 + (0.01 * values) ** 2) / np.hypot(values, s)
    return np.arcsinh(predicted / s).ravel(), full + np.diag(noise.ravel() ** 2)


def logarithms(of: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Of the readings, and of their derivatives, (N C,)."""
    values, s = of.data.values.ravel(), soft(of).ravel()
    return np.arcsinh(values / s), -np.log(np.hypot(values, s))


@pytest.mark.parametrize("channels", [1, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_likelihoods_of_all_and_leave_one_out_are_those_of_the_dense_matrix(layout: str, channels: int) -> None:
    """So few measurements are all inducing points."""
    of = problem(layout, channels)
    where, slopes = logarithms(of)
    for vector in (0.5 * (of.low + of.high), of.start):
        mean, covariance = dense(of, vector)
        expected = stats.multivariate_normal(mean, covariance).logpdf(where) + np.sum(slopes)
        # the kernels' jitter is 1e-8 of variances up to 1e3 times those of the noise
        assert float(of.log_likelihood(vector)) == pytest.approx(expected, abs=1e-3)
    precision = np.linalg.inv(covariance)
    width = 1.0 / np.sqrt(np.diagonal(precision))
    expected = stats.norm.logpdf(precision @ (where - mean) * width) - np.log(width) + slopes
    found = of.call(Model.log_likelihood_per_datum_at, of.start, of.predict(of.start))
    np.testing.assert_allclose(np.ravel(found), expected, atol=1e-4)


def test_light_and_viewer_may_change_places() -> None:
    generator = np.random.default_rng(3)
    wi, wo = (w / np.linalg.norm(w, axis=-1, keepdims=True) for w in generator.standard_normal((2, 200, 3)))
    np.testing.assert_allclose(places(wi, wo), places(wo, wi), atol=1e-6)
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(places(wi @ turn.T, wo @ turn.T), places(wi, wo), atol=1e-6)


def test_many_measurements_are_regressed_on_inducing_points() -> None:
    """Kullback-Leibler divergence, the mean of what the log-likelihood misses: 0.5 is a shift by one standard error."""
    process = make_process(MANY.wi, MANY.wo)
    where, nodes = places(MANY.wi, MANY.wo), np.asarray(process.where)
    assert len(nodes) < len(where) / 3

    def both(at: Correlation) -> tuple[np.ndarray, np.ndarray]:
        return kernel(where, where, at), np.asarray(process.weights @ kernel(nodes, nodes, at) @ process.weights.T)

    # what regression leaves is a covariance: nowhere larger than the largest variance, 2 % at a reach half as far
    exact, found = both(Correlation(1.0, *(2.0 * np.asarray(process.shortest)), 0.0, 0.0))
    assert np.max(np.abs(exact - found)) < 0.02
    for at in (Correlation(0.05, 18.0, 18.0, 0.5, 0.0), Correlation(0.1, 25.0, 25.0, 0.5, 0.0)):
        exact, found = (matrix + 0.02**2 * np.eye(len(where)) for matrix in both(at))
        ratio = np.linalg.solve(found, exact)
        assert abs(0.5 * (np.trace(ratio) - len(exact) - np.linalg.slogdet(ratio)[1])) < 0.5


def test_errors_elsewhere_are_those_of_regression() -> None:
    of = problem("two incidences", amplitude=0.2, length_half=20.0, length_difference=18.0)
    at, new = of.build(of.start).correlation, along(slices([30.0, 70.0], np.arange(-60.0, 81.0, 7.0), [0.0, 20.0]))
    mean, covariance = dense(of, of.start)
    across = kernel(folded(new), folded(of.data), at)
    solved = np.linalg.solve(covariance, across.T).T
    expected = solved @ (logarithms(of)[0] - mean)
    variance = (0.2 * larger(folded(new), at)) ** 2 - np.sum(solved * across, axis=-1)
    found, sd = of.call(Model.discrepancy_at, of.start, of.predict(of.start), places(new.wi, new.wo))
    np.testing.assert_allclose(np.ravel(found), expected, atol=1e-5)
    np.testing.assert_allclose(np.ravel(sd), np.sqrt(variance), atol=1e-4)


def test_half_squares_are_minus_the_log_posterior() -> None:
    of = problem("two planes", 2)
    vectors = np.random.default_rng(1).uniform(of.low, of.high, (5, len(of.start)))
    sums = []
    for vector in vectors:
        prior = np.sum(of.model.box.prior_residuals(jnp.asarray(vector)) ** 2)
        sums.append(0.5 * (np.sum(np.square(of.residuals(vector))) - prior) + of.log_likelihood(vector))
    np.testing.assert_allclose(sums, sums[0], rtol=1e-10)


def test_information_is_that_of_the_covariance() -> None:
    """tr(S^-1 dS S^-1 dS) / 2 by finite differences of the dense covariance."""
    of = problem("two planes", 2)
    first = next(index for index, name in enumerate(of.names) if name.startswith("noise"))
    _, covariance = dense(of, of.start)
    moved = []
    for step in 1e-4 * np.diag(of.start)[first:]:
        change = dense(of, of.start + step)[1] - dense(of, of.start - step)[1]
        moved.append(np.linalg.solve(covariance, change / (2.0 * step.sum())))
    expected = 0.5 * np.einsum("aij,bji->ab", moved, moved)
    rows = np.asarray(of.call(lambda model, v: jax.jacfwd(lambda w: model.linear_parts(w)[1][1])(v), of.start))
    found = (rows.T @ rows)[first:, first:]
    scale = np.sqrt(np.diagonal(expected))
    np.testing.assert_allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-4)


@pytest.mark.parametrize("relative", [0.01, Free(0.02, 1e-4, 0.1)])
@pytest.mark.parametrize("end", ["low", "high"])
def test_derivatives_at_the_ends(end: str, relative: float | Free) -> None:
    of = problem("two planes", 2, relative)
    vector = getattr(of, end)
    inward = np.diag(np.where(vector < of.high, 1.0, -1.0) * 1e-6 * (of.high - of.low))
    for derivative in (jax.grad, jax.jacfwd):
        slope = np.asarray(of.call(lambda model, v, d=derivative: d(model.log_likelihood)(v), vector))
        for found, step in zip(slope, inward, strict=True):
            low, middle, high = (float(of.log_likelihood(vector + count * step)) for count in range(3))
            assert found == pytest.approx((4.0 * middle - 3.0 * low - high) / (2.0 * step.sum()), rel=1e-4, abs=1e-3)


def test_what_is_given_is_no_parameter() -> None:
    every = tuple(f"noise.discrepancy.{name}" for name in Correlation._fields)
    assert (problem("one scan").names, problem("two planes", 3).names[1:]) == (("['a']", *every[:4]), every)
    fixed = problem("two planes", amplitude=0.1, length_half=20.0, length_difference=FREE, grazing_exponent=0.0)
    assert fixed.units == {"['a']": "1", "noise.discrepancy.length_difference": "deg"}
    own = problem("one scan", amplitude=Free(0.05, 0.01, 0.2, LogNormal(0.05, 0.3)))
    assert (own.low[1], own.high[1]) == (0.01, 0.2)


def test_a_smooth_process_has_a_root_in_single_precision() -> None:
    """Without room for its rounding on the diagonal the root was NaN, and with it every prediction."""
    process, drawn = make_process(MANY.wi, MANY.wo), []
    parts = process, np.random.default_rng(0).standard_normal((1, len(process.where))), Correlation(0.1, 40, 40, 1, 0)
    for kind in (jnp.float64, jnp.float32):
        one, white, at = jax.tree.map(lambda x, kind=kind: jnp.asarray(x, kind), parts)
        drawn.append(one.sample(white, at))
    found, rough = drawn
    np.testing.assert_allclose(rough, found, atol=1e-2 * float(jnp.max(jnp.abs(found))))


@pytest.mark.slow
@pytest.mark.parametrize("double", [False, True])
def test_channels_that_share_all_errors_have_finite_densities(double: bool) -> None:
    """At a correlation of 1, with noise far below the discrepancy, the covariance was not positive definite."""
    misfit, relative = np.full((len(MANY.wi), 3), 0.1), np.full((len(MANY.wi), 3), 1e6)
    with jax.enable_x64(double):
        process = make_process(MANY.wi, MANY.wo, 3)
        for length in (15.0, 40.0, 360.0):
            at = Correlation(1.0, length, length, 2.0, 1.0)
            whitened = process.whitened(jnp.asarray(misfit), jnp.asarray(relative), at)
            precision = process.leave_one_out(jnp.asarray(misfit), jnp.asarray(relative), at)[1]
            assert all(bool(jnp.all(jnp.isfinite(part))) for part in whitened)
            assert bool(jnp.all(precision > 0.0))
