"""Which transport a stack gets, and that the closed form it may get is the exact answer."""

import jax
import numpy as np
import pytest

import layerjax as lj
from layerjax.transport.automatic import automatic

ABSORBS, SCATTERS = lj.Medium(0.4, 0.0), lj.Medium(0.4, 0.5)
FACE, BASE = lj.Interface(1.5, 0.3), lj.Lambertian(0.8)


@pytest.mark.parametrize(
    ("stack", "expected"),
    [
        (lj.Stack([SCATTERS], BASE), lj.SingleScattering),
        (lj.Stack([], BASE), lj.SingleScattering),
        (lj.Stack([FACE], BASE), lj.Statistical),
        (lj.Stack([FACE, ABSORBS], BASE), lj.Statistical),
        (lj.Stack([FACE, SCATTERS], BASE), lj.AddingDoubling),
        (lj.Stack([FACE, lj.Medium(0.4, 0.0, lj.SGGX("surface", 0.3))], BASE), lj.AddingDoubling),
        (lj.Stack([FACE, lj.Interface(1.3, 0.1)], BASE), lj.AddingDoubling),
        (lj.Stack([FACE], lj.OrenNayar(0.8, 0.3)), lj.AddingDoubling),
        (lj.Stack([FACE]), lj.AddingDoubling),
    ],
)
def test_rule(stack, expected):
    assert type(automatic(stack)) is expected


def test_an_albedo_that_is_not_known_may_scatter():
    def chosen(albedo):
        assert isinstance(automatic(lj.Stack([FACE, lj.Medium(0.4, albedo)], BASE)), lj.AddingDoubling)

    jax.eval_shape(chosen, 0.0)


@pytest.mark.slow
def test_closed_form_is_exact():
    """Within the error that `prepare` states, 5e-3: mostly that of the solver at 24 nodes."""
    cosine = np.array([0.1, 0.5, 0.9])
    wi, wo = lj.direction(np.arccos(cosine)[:, None], 0.0), lj.direction(np.arccos(cosine), 2.0)
    stack = lj.Stack([FACE, ABSORBS], BASE)
    solved = lj.evaluate(stack, wi, wo, lj.AddingDoubling(nodes=24, modes=16))
    np.testing.assert_allclose(lj.evaluate(stack, wi, wo), solved, rtol=5e-3)
