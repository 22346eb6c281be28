"""Fits with all orders of scattering as the model, from simulated slices to gradients."""

import jax
import numpy as np
import pytest

import layerjax as lj
from fits.optimise.fit import fit
from fits.optimise.result import Fit
from fits.problem.model import Model
from fits.problem.parameters import Free
from fits.problem.problem import Problem
from fits.problem.simulate import simulate, slices

TRANSPORT = lj.AddingDoubling(nodes=4, modes=4)
TRUTH = {"layers[0].thickness": 2.0, "base.albedo": 0.2}
NOISE = 0.02


def coat(thickness, base):
    medium = lj.Medium(thickness=thickness, albedo=0.95, phase=lj.HenyeyGreenstein(g=0.5))
    return lj.Stack([medium], base=lj.Lambertian(albedo=base))


@pytest.fixture(scope="module")
def coat_fit() -> Fit:
    geometry = slices(incidence=(10, 60), outgoing=np.arange(-70, 71, 10))
    data = simulate(coat(*TRUTH.values()), geometry, transport=TRANSPORT, noise=NOISE, seed=0)
    free = coat(Free(0.5, 0.05, 20.0), Free(0.5, 0.0, 1.0))
    return fit(free, data, transport=TRANSPORT, starts=2, seed=0)


def test_a_fit_recovers_the_coat_that_made_the_data(coat_fit):
    assert coat_fit.converged
    assert coat_fit.at_bound == ()
    for name, truth in TRUTH.items():
        assert abs(coat_fit.values[name] - truth) < 3.0 * coat_fit.standard_errors[name]  # a fixed seed: for good
    # chi-square has standard deviation sqrt(2 n)
    assert abs(coat_fit.chi_square - coat_fit.degrees_of_freedom) < 3.0 * np.sqrt(2.0 * coat_fit.degrees_of_freedom)


def test_the_gradient_of_the_posterior_agrees_with_differences(coat_fit):
    problem = coat_fit.problem
    u = np.array([-1.5, 0.3])  # unconstrained: thickness 3.7, base albedo 0.57
    _, gradient = problem.call(_value_and_gradient, u)
    # the error of central differences is about h^2 = 1e-8 relative, their rounding 1e-16 / h of the log-posterior
    h = 1e-4
    for index, step in enumerate(np.eye(2) * h):
        up, down = (float(problem.call(_value_and_gradient, u + sign * step)[0]) for sign in (1.0, -1.0))
        np.testing.assert_allclose(gradient[index], (up - down) / (2.0 * h), rtol=1e-6)


@pytest.mark.parametrize(
    ("transport", "message"),
    [
        (lj.RandomWalk(), "RandomWalk is random; use a deterministic one"),
        (lj.AddingDoubling(tolerance=0.01), "AddingDoubling.tolerance: 0.01 needs concrete parameters"),
    ],
)
def test_a_transport_that_cannot_be_fitted_says_so(coat_fit, transport, message):
    with pytest.raises(ValueError, match=message):
        Problem(coat_fit.problem.stack, coat_fit.problem.data, transport)


def test_simulating_with_a_random_transport_is_refused():
    with pytest.raises(ValueError, match="RandomWalk is random"):
        simulate(coat(1.0, 0.2), slices(), transport=lj.RandomWalk())


def _value_and_gradient(model: Model, u: jax.Array) -> tuple[jax.Array, jax.Array]:
    return jax.value_and_grad(model.log_posterior_unconstrained)(u)
