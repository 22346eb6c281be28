"""What is no direction is refused by every function that takes one; an empty batch of them is no fault."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj

SINGLE = lj.SingleScattering()

STACK = lj.Stack([lj.Medium(0.5)], lj.Lambertian(0.5))
UP = np.array([0.0, 0.0, 1.0])
KEY = jax.random.key(0)
WALK = lj.RandomWalk(paths=64)

FUNCTIONS = {
    "evaluate, wi": lambda w: lj.evaluate(STACK, w, UP, SINGLE),
    "evaluate, wo": lambda w: lj.evaluate(STACK, UP, w, SINGLE),
    "evaluate_with_error": lambda w: lj.evaluate_with_error(STACK, w, UP, WALK, key=KEY),
    "sample": lambda w: lj.sample(STACK, w, KEY, SINGLE),
    "pdf, wi": lambda w: lj.pdf(STACK, w, UP, SINGLE),
    "pdf, wo": lambda w: lj.pdf(STACK, UP, w, SINGLE),
    "albedo": lambda w: lj.albedo(STACK, w, SINGLE),
    "albedo of walks": lambda w: lj.albedo(STACK, w, WALK, key=KEY),
    "unscattered": lambda w: lj.unscattered(STACK, w),
    "goniophotometer": lambda w: lj.goniophotometer(STACK, w, key=KEY, paths=64, polar=1, azimuth=1),
}

BAD = {
    "complex": (np.array([0.6, 0.0, 0.8 + 0.5j]), "is not a number or an array of real numbers"),
    "true and false": (np.array([False, False, True]), "is not a number or an array of real numbers"),
    "text": ("up", "'up' is not a number"),
    "too long": (2.0 * UP, "has length 2, must be 1"),
    "too short": (0.99 * UP, "has length 0.99, must be 1"),
    "nothing": (0.0 * UP, "has length 0, must be 1"),
    "NaN": (np.array([np.nan, 0.0, 1.0]), "has length nan, must be 1"),
    "infinite": (np.array([np.inf, 0.0, 0.0]), "has length inf, must be 1"),
    "one of many": (np.array([UP, UP, 3.0 * UP, UP]), r"has length 3 \(w[io]\.reshape\(-1, 3\)\[2\]\), must be 1"),
}


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize(("directions", "message"), BAD.values(), ids=BAD)
def test_it_is_refused(name, directions, message):
    with pytest.raises(ValueError, match=f"^w[io]: .*{message}"):
        FUNCTIONS[name](directions)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_rounding_is_not(name):
    """As they come from files: 4 digits, and single precision."""
    FUNCTIONS[name](np.round(lj.direction(0.7, 0.3), 4))
    FUNCTIONS[name](np.asarray(lj.direction(0.7, 0.3), np.float32))


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("shape", [(0, 3), (2, 0, 3)])
def test_an_empty_batch_has_empty_results(name, shape):
    found = FUNCTIONS[name](np.zeros(shape))
    bins = (found.cosines, found.azimuths) if name == "goniophotometer" else ()
    for array in jax.tree.leaves(found):
        assert 0 in array.shape or any(array is edges for edges in bins)


def test_constants_of_a_program_are_refused_as_well():
    with pytest.raises(ValueError, match="wo: a direction has length 2"):
        jax.jit(lambda wi: lj.evaluate(STACK, wi, 2.0 * UP, SINGLE))(jnp.asarray(UP))


def test_angles_are_real():
    for theta, phi, name in ((0.5j, 0.0, "theta"), (0.0, "east", "phi")):
        with pytest.raises(ValueError, match=f"{name}: .* is not a number"):
            lj.direction(theta, phi)


AXES = [[1e300, 0.0, 1e300], [1e-170, 0.0, 1e-170], [5e-324, 0.0, 5e-324], [3, 0, 3], np.float32([1e-30, 0.0, 1e-30])]


@pytest.mark.parametrize("axis", AXES, ids=str)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_an_axis_may_have_any_length(axis, dtype):
    def value(axis):
        medium = lj.Medium(0.5, phase=lj.SGGX("fiber", 0.3, axis))
        wi, wo = (lj.direction(*angles).astype(dtype) for angles in ((0.5, 0.1), (0.9, 2.0)))
        return lj.evaluate(lj.Stack([medium], lj.Lambertian(0.5)), wi, wo, SINGLE)

    np.testing.assert_allclose(value(axis), value([1.0, 0.0, 1.0]), rtol=10 * np.finfo(dtype).eps)


@pytest.mark.parametrize("axis", [[0.0, 0.0, 0.0], [np.inf, 0.0, 0.0], [np.nan, 0.0, 1.0], [1j, 0, 0], "z", [1.0, 0.0]])
def test_what_is_no_axis_is_refused(axis):
    with pytest.raises(ValueError, match=r"SGGX\.axis"):
        lj.SGGX("fiber", 0.3, axis)
