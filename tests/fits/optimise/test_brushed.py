"""Both widths of a brushed metal and its tangent, from a measured table and from one plane alone."""

import numpy as np
import pytest

import fits
import layerjax as lj

NOISE = 0.02
SINGLE = lj.SingleScattering()
TRUTH = {"base.alpha": 0.15, "base.alpha_y": 0.4, "base.tangent": 0.3}


def brushed(alpha, alpha_y, tangent):
    return lj.Stack([], lj.Conductor(0.2, 3.0, alpha, alpha_y=alpha_y, tangent=tangent))


# a quarter turn of the tangent: beyond it the widths change places
FAMILY = brushed(fits.Free(0.3, 0.03, 1.0), fits.Free(0.3, 0.03, 1.0), fits.Free(0.0, -0.5, 1.0))


def fitted(wi, wo, values, sigma, family=FAMILY, **options):
    data = fits.Measurements(wi, wo, values, sigma, np.ones(len(wi), bool), ("grey",))
    return fits.fit(family, data, transport=SINGLE, noise=fits.Noise(discrepancy=False), starts=4, **options)


@pytest.mark.parametrize(("turns", "identified"), [([0.0], False), ([0.0, 45.0, 90.0], True)])
def test_one_plane_does_not_distinguish_the_width_across(turns, identified):
    """Of values along the tangent, known up to a factor: the width across is another. Then the sample is turned."""
    theta_i, theta_o = (angle.ravel() for angle in np.meshgrid([10.0, 30.0, 50.0, 70.0], np.linspace(-80, 80, 33)))
    wi = np.concatenate([lj.direction(theta_i, turn, degrees=True) for turn in turns])
    azimuths = [np.where(theta_o < 0, turn, turn + 180.0) for turn in turns]
    wo = np.concatenate([lj.direction(np.abs(theta_o), azimuth, degrees=True) for azimuth in azimuths])
    values = np.asarray(lj.evaluate(brushed(0.15, 0.4, 0.0), wi, wo, SINGLE))
    width = fits.Free(0.3, 0.03, 1.0)
    fit = fitted(wi, wo, values, NOISE * values + 1e-4, brushed(width, width, 0.0), scale=fits.Free(1.0, 0.2, 5.0))
    assert any("base.alpha_y" in direction.weights for direction in fit.unidentified) is not identified
    assert np.isfinite(fit.standard_errors["base.alpha_y"]) == identified
    assert fit.standard_errors["base.alpha"] < 0.001


@pytest.mark.slow
def test_pulls_of_a_table_are_of_unit_width(tmp_path):
    """A table in the format of RGL, noise of 2 %, 100 repeats: means are known to 0.1, standard deviations to 0.07."""
    fits.export(brushed(*TRUTH.values()), tmp_path / "brushed.bsdf", "rgl", transport=SINGLE)
    table = fits.read(tmp_path / "brushed.bsdf")
    random = np.random.default_rng(5)
    pulls = []
    for _ in range(100):
        rows = random.choice(len(table.wi), 500, replace=False)
        wi, wo = table.wi[rows], table.wo[rows]
        exact = table.values[rows, :1]
        sigma = NOISE * exact + 1e-4
        fit = fitted(wi, wo, exact + sigma * random.standard_normal(exact.shape), sigma)
        pulls.append([(fit.values[name] - value) / fit.standard_errors[name] for name, value in TRUTH.items()])
    mean, spread = np.mean(pulls, axis=0), np.std(pulls, axis=0)
    assert np.all(np.abs(mean) < 0.4)
    assert np.all(np.abs(spread - 1.0) < 0.28)
