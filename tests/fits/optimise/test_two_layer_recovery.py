"""A metal under an absorbing coat, from simulated slices: what comes back, and what the data cannot tell apart."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from fits.data.geometry import slices
from fits.optimise.fit import fit
from fits.optimise.result import Fit
from fits.problem.parameters import Free, LogNormal
from fits.problem.simulate import simulate
from fits.reports import verdicts

pytestmark = pytest.mark.slow  # its derivatives compile for more than a minute

TRANSPORT = lj.Statistical(microfacets="single")
NOISE = 0.03
TRUTH = {
    "layers[0].ior": 1.5,
    "layers[0].alpha": 0.1,
    "layers[1].thickness": 0.3,
    "base.ior": 0.95,  # copper at 550 nm
    "base.k": 2.6,
    "base.alpha": 0.3,
}
ORDER = ("layers[0].ior", "layers[1].thickness", "base.ior", "base.k")


def coat(ior, alpha, thickness, base_ior, base_k, base_alpha):
    return lj.Stack(
        [lj.Interface(ior=ior, alpha=alpha), lj.Medium(thickness=thickness, albedo=0.0)],
        base=lj.Conductor(ior=base_ior, k=base_k, alpha=base_alpha),
    )


@pytest.fixture(scope="module")
def coat_fit() -> Fit:
    """All six numbers free; of the metal a handbook's median with a factor of 1.6 either way is known beforehand."""
    geometry = slices(incidence=(10, 35, 60), outgoing=np.arange(-80, 81, 10), azimuth=(0, 90))
    data = simulate(coat(*TRUTH.values()), geometry, transport=TRANSPORT, noise=NOISE, seed=1)
    free = coat(
        Free(1.4, 1.2, 2.2),
        Free(0.2, 0.02, 0.6),
        Free(0.5, 0.01, 3.0),
        Free(1.0, 0.05, 6.0, LogNormal(1.0, 0.5)),
        Free(3.0, 0.5, 10.0, LogNormal(3.0, 0.5)),
        Free(0.2, 0.02, 0.8),
    )
    return fit(free, data, transport=TRANSPORT, starts=2, seed=0)


def returned(ior, thickness, n, k):
    """What a smooth such metal returns at normal incidence through the absorber, by Fresnel's formula."""
    return ((n - ior) ** 2 + k**2) / ((n + ior) ** 2 + k**2) * jnp.exp(-2.0 * thickness)


def test_every_parameter_comes_back_within_its_errors(coat_fit: Fit) -> None:
    assert coat_fit.converged
    assert coat_fit.at_bound == ()
    for name, truth in TRUTH.items():
        assert abs(coat_fit.values[name] - truth) < 3.0 * coat_fit.standard_errors[name], name
    # chi-square has standard deviation sqrt(2 n)
    assert abs(coat_fit.chi_square - coat_fit.degrees_of_freedom) < 3.0 * np.sqrt(2.0 * coat_fit.degrees_of_freedom)
    for name, within in (("layers[0].ior", 0.01), ("layers[0].alpha", 0.02), ("base.alpha", 0.02)):
        assert coat_fit.standard_errors[name] < within * TRUTH[name], name


def test_index_extinction_and_absorption_are_said_to_be_inseparable(coat_fit: Fit) -> None:
    (combination,) = coat_fit.unidentified
    assert set(combination.weights) == {"base.ior", "base.k", "layers[1].thickness"}
    assert combination.unconstrained
    for name, alone in combination.conditional_errors.items():
        assert alone < 0.05 * coat_fit.standard_errors[name], name
    sentence = verdicts.verdict(coat_fit).sentences[2]
    assert "are not identified separately" in sentence
    assert all(name in sentence for name in combination.weights)


def test_along_it_the_light_returned_stays_the_same(coat_fit: Fit) -> None:
    """That light is the combination which the data do hold: 20 times better than index or extinction."""
    values = [coat_fit.values[name] for name in ORDER]
    slopes = np.array(jax.grad(returned, argnums=(0, 1, 2, 3))(*values))
    (combination,) = coat_fit.unidentified
    widths = dict(
        zip(coat_fit.problem.names, coat_fit.problem.model.box.slope(jnp.asarray(coat_fit.vector)), strict=True)
    )
    changes = slopes * [combination.weights.get(name, 0.0) * float(widths[name]) for name in ORDER]
    assert abs(np.sum(changes)) < 0.1 * np.sum(np.abs(changes))

    rows = [coat_fit.problem.names.index(name) for name in ORDER]
    error = float(np.sqrt(slopes @ coat_fit.covariance[np.ix_(rows, rows)] @ slopes))
    value, truth = float(returned(*values)), float(returned(*(TRUTH[name] for name in ORDER)))
    assert abs(value - truth) < 3.0 * error
    for name in ("base.ior", "base.k"):
        assert error / value < 0.05 * coat_fit.standard_errors[name] / coat_fit.values[name], name
