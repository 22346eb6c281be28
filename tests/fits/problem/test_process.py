"""Errors of the model that readings share, beside dense matrices that are built here from the definition alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.interpolate import CubicSpline

from fits.data.geometry import slices
from fits.data.measurements import Measurements, channel_names
from fits.inference.descent import here
from fits.problem.correlated import Correlated
from fits.problem.likelihood import Noise
from fits.problem.model import Model
from fits.problem.parameters import Free, LogNormal
from fits.problem.problem import Problem
from fits.problem.process import Correlation, Process, places_of

FREE = Free(0.4, 0.0, 1.0)
LAYOUTS = {
    "one scan": slices([30.0], np.arange(-80.0, 81.0, 8.0)),
    "two incidences": slices([10.0, 50.0], np.arange(-80.0, 81.0, 8.0)),
    "two planes": slices([20.0, 60.0], np.arange(-75.0, 76.0, 15.0), [0.0, 60.0]),
    "both sides": slices([10.0, 40.0], np.arange(-180.0, 180.0, 20.0)),
    "a narrow scan": slices([45.0], 45.0 + np.linspace(-1.0, 1.0, 9)),
}


def transport(stack, wi, wo):
    """A lobe, whose channels differ."""
    half = wi + wo
    return (0.1 + stack["a"] * jnp.exp(-jnp.sum(half[:, :2] ** 2, axis=-1)))[:, None] * jnp.asarray(stack["colour"])


def problem(layout: str, channels: int = 1, **correlated) -> Problem:
    """A stack of one free number, fitted to noise about it."""
    geometry = LAYOUTS[layout]
    generator = np.random.default_rng(len(geometry))
    colour = np.linspace(1.0, 0.5, channels)
    stack = {"a": FREE, "colour": colour}
    values = np.asarray(transport({"a": 0.5, "colour": colour}, geometry.wi, geometry.wo))
    sigma = 0.02 * values
    values = values * (1.0 + 0.1 * generator.standard_normal(values.shape))
    everywhere = np.ones(len(values), bool)
    data = Measurements(geometry.wi, geometry.wo, values, sigma, everywhere, channel_names(channels))
    return Problem(stack, data, transport, Noise(relative=0.01, correlated=Correlated(**correlated)))


def matern(distance: np.ndarray, length: float) -> np.ndarray:
    """Rasmussen & Williams 2006, Eq. 4.17."""
    x = np.sqrt(3.0) * distance / length
    return (1.0 + x) * np.exp(-x)


def kernel(
    one: Measurements, other: Measurements, at: Correlation, angles: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Of relative errors between scans and along them."""
    first, second = places_of(one), places_of(other)
    apart = np.degrees(np.linalg.norm(first.wi[:, None] - second.wi[None], axis=-1))
    turned = np.degrees(np.abs(np.sin(np.radians(first.plane[:, None] - second.plane[None]))))
    scan = matern(apart, float(at.incidence)) * matern(turned, float(at.azimuth))
    along = np.degrees(2.0 * np.abs(np.sin(np.radians(angles[0][:, None] - angles[1][None]) / 2.0)))
    return float(at.amplitude) ** 2 * scan * matern(along, float(at.angle))


def dense(of: Problem, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of all readings, (N C,) and (N C, N C): the process on nodes, and cubic between them."""
    model, data = of.model, of.data
    at = model.build(jnp.asarray(vector)).correlation
    process = model.process
    assert isinstance(process, Process)
    predicted, sigma = (np.asarray(part(jnp.asarray(vector))) for part in (model.predict, model.sigma))
    nodes = np.asarray(process.nodes)
    cubic = CubicSpline(nodes, np.eye(len(nodes)), bc_type="not-a-knot")(places_of(data).angle)
    count, channels = predicted.shape
    between = kernel(data, data, at, (np.zeros(count), np.zeros(count)))
    gaps = np.degrees(2.0 * np.abs(np.sin(np.radians(nodes[:, None] - nodes) / 2.0)))
    shared = between * (cubic @ matern(gaps, float(at.angle)) @ cubic.T)
    colours = float(at.channels) + (1.0 - float(at.channels)) * np.eye(channels) if channels > 1 else np.ones((1, 1))
    full = np.einsum("nm,cd->ncmd", shared, colours).reshape(count * channels, -1)
    flat = predicted.ravel()
    return flat, flat[:, None] * full * flat + np.diag(sigma.ravel() ** 2)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_likelihood_is_that_of_the_dense_matrix(layout: str, channels: int) -> None:
    of = problem(layout, channels)
    for vector in (of.start, 0.3 * of.start + 0.7 * of.low, 0.5 * (of.low + of.high)):
        mean, covariance = dense(of, vector)
        expected = stats.multivariate_normal(mean, covariance).logpdf(of.data.values.ravel())
        # the kernels' jitter is 1e-8 of variances up to 1e3 times those of the noise
        assert float(of.log_likelihood(vector)) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("layout", ["two planes", "both sides"])
def test_each_reading_given_all_others(layout: str) -> None:
    of = problem(layout, 2)
    mean, covariance = dense(of, of.start)
    precision = np.linalg.inv(covariance)
    own = precision @ (of.data.values.ravel() - mean)
    width = 1.0 / np.sqrt(np.diagonal(precision))
    expected = stats.norm.logpdf(own * width) - np.log(width)
    np.testing.assert_allclose(np.ravel(of.log_likelihood_per_datum(of.start)), expected, atol=1e-4)


def test_errors_elsewhere_are_those_of_regression() -> None:
    # readings on the nodes: nothing is interpolated
    of = problem("two incidences", amplitude=0.2, angle=30.0, incidence=25.0)
    at = of.model.build(jnp.asarray(of.start)).correlation
    geometry = slices([30.0, 70.0], np.arange(-60.0, 81.0, 7.0), [0.0, 20.0])
    values = np.ones((len(geometry), 1))
    new = Measurements(geometry.wi, geometry.wo, values, None, np.ones(len(values), bool), ("value",))
    mean, covariance = dense(of, of.start)
    angles = places_of(new).angle, places_of(of.data).angle
    across = kernel(new, of.data, at, angles) * mean
    solved = np.linalg.solve(covariance, across.T).T
    expected = solved @ (of.data.values.ravel() - mean)
    variance = 0.2**2 - np.sum(solved * across, axis=-1)
    found, sd = of.call(Model.lack_at, of.start, places_of(new))
    np.testing.assert_allclose(np.ravel(found), expected, atol=1e-6)
    np.testing.assert_allclose(np.ravel(sd), np.sqrt(variance), atol=1e-5)


def test_half_squares_are_minus_the_log_posterior() -> None:
    of = problem("two planes", 2)
    vectors = np.random.default_rng(1).uniform(of.low, of.high, (5, len(of.start)))
    halves = [0.5 * float(np.sum(np.square(of.residuals(vector)))) for vector in vectors]
    box = of.model.box
    heights = [
        float(of.log_likelihood(vector)) - 0.5 * float(np.sum(box.prior_residuals(jnp.asarray(vector)) ** 2))
        for vector in vectors
    ]
    np.testing.assert_allclose(np.add(halves, heights), halves[0] + heights[0], rtol=1e-10)


def test_no_amplitude_is_plain_noise() -> None:
    of = problem("two incidences", 2, amplitude=1e-6)
    plain = Problem(of.stack, of.data, transport, Noise(relative=0.01))
    sizes = np.abs(np.asarray(of.call(Model.standardised_at, of.start, of.predict(of.start)))) / 0.02
    # z'AA'z / 2, where all readings share one error
    bound = 0.5 * (1e-6 * np.sum(sizes)) ** 2
    assert float(of.log_likelihood(of.start)) == pytest.approx(float(plain.log_likelihood(plain.start)), abs=bound)


@pytest.mark.parametrize("end", ["low", "high", "start"])
def test_derivatives_at_the_ends(end: str) -> None:
    of = problem("two planes", 2)
    vector = getattr(of, end)
    inward = np.where(vector < of.high, 1.0, -1.0) * 1e-6 * (of.high - of.low)
    for derivative in (jax.grad, jax.jacfwd):
        slope = np.asarray(of.call(lambda model, v, d=derivative: d(model.log_likelihood)(v), vector))
        for index, step in enumerate(inward):
            ends = [vector.copy(), vector.copy(), vector.copy()]
            ends[1][index] += step
            ends[2][index] += 2.0 * step
            low, middle, high = (float(of.log_likelihood(entry)) for entry in ends)
            assert slope[index] == pytest.approx((4.0 * middle - 3.0 * low - high) / (2.0 * step), rel=1e-4, abs=1e-3)


def test_gradient_of_the_fit_is_that_of_its_cost() -> None:
    of = problem("two incidences", 2)
    unit = np.asarray(of.model.box.to_unit(jnp.asarray(of.start)))
    found = here(of, unit)

    def cost(model: Model, s: jax.Array) -> jax.Array:
        return 0.5 * sum(jnp.sum(part**2) for part in model.residuals(model.box.from_unit(s)))

    np.testing.assert_allclose(found.gradient, of.call(lambda m, s: jax.grad(lambda t: cost(m, t))(s), unit), rtol=1e-8)


def test_what_the_data_cannot_tell_is_no_parameter() -> None:
    assert problem("one scan").names == ("['a']", "noise.correlated.amplitude", "noise.correlated.angle")
    assert problem("two planes", 3).names[1:] == tuple(
        f"noise.correlated.{name}" for name in ("amplitude", "angle", "incidence", "azimuth", "channels")
    )
    fixed = problem("two planes", amplitude=0.1, angle=20.0, incidence=30.0, azimuth=Free(20.0, 10.0, 50.0))
    assert fixed.names == ("['a']", "noise.correlated.azimuth")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"amplitude": -0.1}, r"Noise.correlated.amplitude is -0.1; it must be a number in \[1e-06, 1\]"),
        ({"angle": Free(20.0, 0.0, 50.0)}, r"Noise.correlated.angle.low is 0.0; it must be a number in \[0.1, 360\]"),
        ({"channels": 1.5}, r"Noise.correlated.channels is 1.5; it must be a number in \[0, 1\]"),
        ({"incidence": Free((20.0, 20.0), 1.0, 50.0)}, "Noise.correlated.incidence has 2 channels"),
        ({"angle": "wide"}, "Noise.correlated.angle is 'wide'"),
    ],
)
def test_bad_numbers_are_refused(given: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Correlated(**given)


def test_bad_noise_is_refused() -> None:
    with pytest.raises(ValueError, match=r"Noise.tails is 'student'; with correlated noise it must be gaussian"):
        Noise(tails="student", correlated=True)
    with pytest.raises(ValueError, match=r"Noise.correlated is 0.3; it must be true, false or Correlated"):
        Noise(correlated=0.3)
    data = problem("one scan").data
    with pytest.raises(ValueError, match=r"noise.correlated stands beside objective 'cube_root'"):
        Problem({"a": FREE, "colour": 1.0}, data, transport, Noise(correlated=True), objective="cube_root")
    generator = np.random.default_rng(0)
    wi, wo = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in generator.standard_normal((2, 60, 3)))
    scattered = Measurements(np.abs(wi), np.abs(wo), np.ones((60, 1)), None, np.ones(60, bool), ("value",))
    with pytest.raises(ValueError, match=r"60 readings lie on 60 scans, at most 48 may be"):
        Problem({"a": FREE, "colour": np.ones(1)}, scattered, transport, Noise(correlated=True))


def test_priors_of_one_s_own() -> None:
    own = Free(0.05, 0.01, 0.2, LogNormal(0.05, 0.3))
    of = problem("one scan", amplitude=own)
    assert (of.low[1], of.high[1]) == (0.01, 0.2)
