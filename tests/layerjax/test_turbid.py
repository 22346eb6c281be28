"""Media by thickness and coefficients are media by optical depth and albedo."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fits
import layerjax as lj
from fits.problem.parameters import Free
from fits.problem.problem import Problem

WI, WO = lj.direction(jnp.array([0.2, 0.9, 0.4]), 0.3), lj.direction(jnp.array([0.5, 0.3, 2.3]), 3.0)
PHASE = lj.HenyeyGreenstein(0.6)
SINGLE = lj.SingleScattering()


def pair(d=0.5, mu_s=2.0, mu_a=0.3) -> tuple[lj.Stack, lj.Stack]:
    """The same by both."""
    mu_s, mu_a = np.asarray(mu_s), np.asarray(mu_a)
    turbid = lj.TurbidMedium(d, mu_s, mu_a, PHASE, 0.5)
    return lj.Stack([turbid]), lj.Stack([lj.Medium((mu_s + mu_a) * d, mu_s / (mu_s + mu_a), PHASE, 0.5)])


@pytest.mark.parametrize("transport", [SINGLE, lj.SpongeCake(), lj.AddingDoubling(nodes=4, modes=4)], ids=repr)
def test_it_is_the_medium(transport) -> None:
    turbid, medium = (lj.Stack([*stack.layers], lj.Lambertian(0.3)) for stack in pair(mu_s=[2.0, 1.0, 0.1], mu_a=0.3))
    if isinstance(transport, lj.SpongeCake):
        flakes = lj.SGGX("surface", 0.4)
        turbid, medium = (
            lj.Stack([lj.TurbidMedium(0.5, 2.0, 0.3, flakes)]),
            lj.Stack([lj.Medium(1.15, 2.0 / 2.3, flakes)]),
        )
    values = [lj.evaluate(stack, WI, WO, transport) for stack in (turbid, medium)]
    np.testing.assert_allclose(*values, rtol=1e-10)
    assert turbid.channels == medium.channels


def test_what_passes_and_how_it_is_drawn() -> None:
    turbid, medium = pair()
    np.testing.assert_allclose(lj.unscattered(turbid, WI), lj.unscattered(medium, WI), rtol=1e-12)
    draws = [lj.sample(stack, WI, jax.random.key(1), SINGLE) for stack in (turbid, medium)]
    for one, other in zip(*draws, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10)


def test_maps_of_thickness_and_of_coefficients() -> None:
    thickness, mu_s = np.array([0.2, 0.5, 1.0]), np.array([[1.0, 2.0], [3.0, 4.0], [0.5, 0.1]])
    map_ = lj.Stack([lj.TurbidMedium(thickness, mu_s, 0.1, PHASE)], lj.Lambertian(0.2))
    found = lj.evaluate(map_, WI[0], WO[0], SINGLE)
    for k in range(3):
        one = lj.Stack([lj.TurbidMedium(thickness[k], mu_s[k], 0.1, PHASE)], map_.base)
        np.testing.assert_allclose(found[k], lj.evaluate(one, WI[0], WO[0], SINGLE), rtol=1e-9)


@pytest.mark.parametrize("numbers", [(0.0, 1.0, 0.5), (0.5, 0.0, 0.5), (0.5, 1.0, 0.0), (0.5, 0.0, 0.0)])
def test_derivatives_at_the_ends(numbers) -> None:
    def value(d, mu_s, mu_a):
        stack = lj.Stack([lj.TurbidMedium(d, mu_s, mu_a, PHASE)], lj.Lambertian(0.3))
        return lj.evaluate(stack, WI[0], WO[0], SINGLE)[0]

    for slopes in (jax.grad(value, (0, 1, 2))(*numbers), jax.jacfwd(value, (0, 1, 2))(*numbers)):
        for place, slope in enumerate(slopes):
            ends = []
            for step in (0.0, 1e-5, 2e-5):
                moved = list(numbers)
                moved[place] += step
                ends.append(float(value(*moved)))
            expected = (4.0 * ends[1] - 3.0 * ends[0] - ends[2]) / 2e-5
            assert slope == pytest.approx(expected, rel=1e-4, abs=1e-8)


@pytest.mark.slow
def test_it_is_fitted_in_its_units(tmp_path) -> None:
    geometry = fits.slices([10.0, 50.0], np.arange(-75.0, 76.0, 7.5))
    data = fits.simulate(
        lj.Stack([lj.TurbidMedium(0.5, 1.5, 0.4, PHASE)], lj.Lambertian(0.3)), geometry, SINGLE, 0.01, 1e-5
    )
    free = lj.TurbidMedium(0.5, Free(1.0, 0.0, 10.0), Free(0.1, 0.0, 5.0), PHASE)
    stack = lj.Stack([free], lj.Lambertian(0.3))
    fits.write_problem(tmp_path / "turbid.toml", stack, transport=SINGLE)
    given = fits.read_problem(tmp_path / "turbid.toml")
    assert isinstance(given.stack.layers[0], lj.TurbidMedium)
    found = fits.fit(given.stack, data, transport=given.transport, starts=2)
    assert found.units == {"layers[0].mu_s": "1/mm", "layers[0].mu_a": "1/mm"}
    for name, truth in (("layers[0].mu_s", 1.5), ("layers[0].mu_a", 0.4)):
        assert abs(found.values[name] - truth) < 4.0 * found.standard_errors[name]
    thick = Problem(lj.Stack([lj.TurbidMedium(Free(0.5, 0.0, 2.0), 1.0, 0.1)]), data, SINGLE)
    assert thick.units == {"layers[0].thickness_mm": "mm"}


def test_coefficients_out_of_range_are_refused(tmp_path) -> None:
    with pytest.raises(ValueError, match=r"TurbidMedium.mu_s: -1 is outside \[0, 10000\]"):
        lj.TurbidMedium(1.0, -1.0)
    with pytest.raises(ValueError, match=r"Medium.thickness: 1e\+06 is outside \[0, 10000\]"):
        lj.evaluate(lj.Stack([lj.TurbidMedium(1e3, 1e3)]), WI, WO, SINGLE)
    path = tmp_path / "bad.toml"
    path.write_text('[[layers]]\nkind = "TurbidMedium"\nthickness_mm = 1.0\n')
    with pytest.raises(ValueError, match=r"layers\[0\] has no mu_s, which TurbidMedium needs"):
        fits.read_problem(path)
    path.write_text('[[layers]]\nkind = "Medium"\nthickness_mm = 1.0\n')
    with pytest.raises(ValueError, match=r"layers\[0\] has an unknown key 'thickness_mm'"):
        fits.read_problem(path)
