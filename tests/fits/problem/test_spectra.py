"""Channels that a power law or a smooth prior holds together."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import fits
import layerjax as lj
from benchmarks.measuring.repeats import fit_many
from fits import Free, LogNormal, LogUniform, Normal, PowerLaw
from fits.problem.parameters import Box
from fits.problem.stack_file import read_problem, write_problem

WAVELENGTHS = (450.0, 550.0, 650.0, 750.0)
GEOMETRY = fits.slices(incidence=(10.0, 50.0), outgoing=np.arange(-70.0, 71.0, 10.0))
NOISE = fits.Noise(relative=0.02, floor=1e-6, discrepancy=False)


def paint(mu_s, mu_a=0.5) -> lj.Stack:
    return lj.Stack([lj.TurbidMedium(0.2, mu_s, mu_a, lj.HenyeyGreenstein(0.3))], lj.Lambertian(0.2))


def law(**changed) -> PowerLaw:
    given = {"amplitude": Free(4.0, 0.1, 50.0), "exponent": Free(0.0, -4.0, 4.0), "wavelengths": WAVELENGTHS}
    return PowerLaw(**given | changed)


@pytest.fixture(scope="module")
def exact() -> np.ndarray:
    """Coefficients of 6 / mm at 600 nm, with exponent 1.5."""
    mu_s = 6.0 * (np.array(WAVELENGTHS) / 600.0) ** -1.5
    return np.asarray(lj.evaluate(paint(mu_s), GEOMETRY.wi, GEOMETRY.wo, lj.SingleScattering()))


def problem(stack: lj.Stack, values: np.ndarray) -> fits.Problem:
    names = tuple(f"{nm:g}" for nm in WAVELENGTHS)
    data = fits.Measurements(GEOMETRY.wi, GEOMETRY.wo, values, None, np.ones(len(values), bool), names)
    return fits.Problem(stack, data, lj.SingleScattering(), NOISE)


def test_a_power_law_is_recovered(exact: np.ndarray) -> None:
    posed = problem(paint(law(reference=600.0)), exact)
    assert posed.names == ("layers[0].mu_s.amplitude", "layers[0].mu_s.exponent")
    assert posed.units == {"layers[0].mu_s.amplitude": "1/mm", "layers[0].mu_s.exponent": "1"}
    data = replace(posed.data, sigma=0.02 * exact)
    fit = fits.fit(posed.stack, data, transport=posed.transport, noise=fits.Noise(discrepancy=False), starts=2)
    assert list(fit.values.values()) == pytest.approx([6.0, 1.5], rel=1e-6)
    # what is fitted is a stack with a number a channel
    np.testing.assert_allclose(fit.stack.layers[0].mu_s, 6.0 * (np.array(WAVELENGTHS) / 600.0) ** -1.5, rtol=1e-6)


def test_its_errors_are_honest_and_smaller_than_those_of_free_channels(exact: np.ndarray) -> None:
    noisy = exact * (1.0 + 0.02 * np.random.default_rng(3).standard_normal((200, *exact.shape)))
    tied = fit_many(problem(paint(law(reference=600.0)), exact), noisy)
    pulls = (tied.vectors - [6.0, 1.5]) / tied.standard_errors
    assert np.abs(pulls.mean(axis=0)).max() < 3.5 / np.sqrt(200)
    np.testing.assert_allclose(pulls.std(axis=0), 1.0, atol=3.5 / np.sqrt(400))
    free = fit_many(problem(paint(Free((4.0,) * 4, 0.1, 50.0)), exact), noisy[:5])
    relative = [found.standard_errors[:5] / found.vectors[:5] for found in (tied, free)]
    assert relative[0][:, 0].max() < 0.7 * relative[1][:, 1].min()  # at 600 nm, and of the channel at 550 nm


def test_the_reference_is_the_geometric_mean() -> None:
    assert law().reference == pytest.approx(stats.gmean(WAVELENGTHS))
    low, high = law(exponent=1.0, amplitude=Free(4.0, 1.0, 9.0), reference=450.0).extremes()
    np.testing.assert_allclose([low, high], np.outer([1.0, 9.0], 450.0 / np.array(WAVELENGTHS)))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"wavelengths": (500.0,)}, "PowerLaw.wavelengths has shape"),
        ({"wavelengths": (500.0, -1.0), "reference": 500.0}, "PowerLaw.wavelengths is .*must be finite and above 0"),
        ({"reference": 0.0}, "PowerLaw.reference is .*must be finite and above 0"),
        ({"amplitude": 1.0, "exponent": 1.0}, "PowerLaw: nothing is free"),
        ({"amplitude": Free((1.0, 2.0), 0.0, 3.0)}, "PowerLaw.amplitude has 2 channels"),
        ({"amplitude": [1.0, 2.0]}, "PowerLaw.amplitude has 2 channels; it must be one number"),
        ({"exponent": (1.0, 2.0, 3.0)}, "PowerLaw.exponent has 3 channels; it must be one number"),
        ({"amplitude": Free(1.0, -1.0, 3.0)}, "PowerLaw.amplitude reaches down to -1"),
    ],
)
def test_bad_laws(changed: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        law(**changed)


def test_laws_where_they_may_not_stand(exact: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"base: within the bounds of its power law Lambertian.albedo"):
        problem(lj.Stack([], lj.Lambertian(law())), exact)
    with pytest.raises(ValueError, match="PowerLaw stands where no number a channel may"):
        problem(lj.Stack([], lj.Conductor(1.5, 3.0, law(amplitude=Free(0.1, 0.05, 0.2), exponent=0.0))), exact)


def test_channels_that_do_not_go_together_are_named(exact: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"layers\[0\].mu_s has 4, layers\[0\].mu_a has 3"):
        problem(paint(law(), Free((0.5,) * 3, 0.1, 5.0)), exact)
    with pytest.raises(ValueError, match="stack: it has 3 channels, the data 4"):
        problem(paint(law(wavelengths=WAVELENGTHS[:3])), exact)


def test_both_are_written_and_read(tmp_path) -> None:
    stack = paint(law(reference=600.0), Free((0.5,) * 4, 0.1, 5.0, LogUniform(), random_walk_sd=(0.1, 0.2, 0.3)))
    write_problem(tmp_path / "paint.toml", stack)
    read = read_problem(tmp_path / "paint.toml").stack
    assert read.layers[0].mu_s == stack.layers[0].mu_s
    assert read.layers[0].mu_a == stack.layers[0].mu_a
    text = (tmp_path / "paint.toml").read_text().replace("reference = 600.0", "reference = -1.0")
    (tmp_path / "bad.toml").write_text(text)
    with pytest.raises(ValueError, match=r"layers\[0\].mu_s: PowerLaw.reference is"):
        read_problem(tmp_path / "bad.toml")


def test_a_smooth_prior_is_a_random_walk() -> None:
    """Its density is that of neighbours' differences, normalised: flat ones count once."""
    box = Box.of([Free((1.0, 2.0, 3.0), 0.0, 10.0, random_walk_sd=(0.5, 0.2))])
    x = np.array([4.0, 4.3, 4.2])
    expected = -np.log(10.0) + stats.norm.logpdf(0.3, scale=0.5) + stats.norm.logpdf(-0.1, scale=0.2)
    assert float(box.log_prior(x)) == pytest.approx(expected)


@pytest.mark.parametrize("logarithmic", [False, True])
def test_with_a_gaussian_prior_it_is_one_gaussian(logarithmic: bool) -> None:
    prior = LogNormal(2.0, 0.3) if logarithmic else Normal(2.0, 0.3)
    box = Box.of([Free((2.0, 2.0, 2.0), 1e-6, 1e3, prior, random_walk_sd=0.1)])
    step = np.diff(np.eye(3), axis=0) / 0.1
    covariance = np.linalg.inv(np.eye(3) / 0.3**2 + step.T @ step)
    x = np.array([2.1, 2.2, 1.9])
    natural = np.log(x) if logarithmic else x
    expected = stats.multivariate_normal([np.log(2.0) if logarithmic else 2.0] * 3, covariance).logpdf(natural)
    assert float(box.log_prior(x)) == pytest.approx(expected - (np.log(x).sum() if logarithmic else 0.0))


def test_a_smooth_prior_draws_a_channel_to_its_neighbours(exact: np.ndarray) -> None:
    """More so the narrower it is; and what is tied is known better."""
    values = exact.copy()
    values[:, 1] *= 1.3
    alone, tied, rigid = (
        fits.fit(
            paint(Free((4.0,) * 4, 0.1, 50.0, LogUniform(), random_walk_sd=smooth)),
            problem(paint(law()), values).data,
            transport=lj.SingleScattering(),
            noise=fits.Noise(relative=0.5, floor=1e-6, discrepancy=False),
            starts=1,
        )
        for smooth in (None, 0.3, 1e-4)
    )
    fitted = [np.log(list(fit.values.values())) for fit in (alone, tied, rigid)]
    roughness = [np.abs(np.diff(values, 2)).max() for values in fitted]
    assert roughness[2] < 1e-3 < roughness[1] < 0.7 * roughness[0]
    assert max(tied.errors / np.exp(fitted[1])) < max(alone.errors / np.exp(fitted[0]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((1.0, 0.0, 2.0, None, 0.1), "Free.random_walk_sd is given for a single number"),
        (((1.0, 1.0), 0.0, 2.0, None, (0.1, 0.2)), "Free.random_walk_sd has 2 entries; it must have 1 or 1"),
        (((1.0, 1.0), 0.0, 2.0, None, 0.0), "Free.random_walk_sd is 0.0; it must be above 0"),
    ],
)
def test_bad_smoothness(arguments: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Free(*arguments)


def test_shared_channels_are_smooth_once_in_a_joint_fit(exact: np.ndarray) -> None:
    posed = problem(paint(Free((4.0,) * 4, 0.1, 50.0, LogUniform(), random_walk_sd=0.1)), exact)
    joint = fits.Joint({"one": posed, "two": posed}, shared=["layers"])
    np.testing.assert_allclose(joint.model.box.between, posed.model.box.between)
    apart = fits.Joint({"one": posed, "two": posed})
    assert apart.model.box.between.shape == (6, 8)
    other = problem(paint(Free((4.0,) * 4, 0.1, 50.0, LogUniform(), random_walk_sd=0.2)), exact)
    with pytest.raises(ValueError, match="has other bounds or another prior in 'two' than in 'one'"):
        fits.Joint({"one": posed, "two": other}, shared=["layers"])
