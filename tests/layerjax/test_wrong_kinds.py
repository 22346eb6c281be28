"""Arguments of a wrong kind are refused in one line that names them, by every public function and class."""

import inspect

import jax
import numpy as np
import pytest

import layerjax as lj

STACK = lj.Stack([lj.Medium(0.5)], lj.Lambertian(0.5))
UP = np.array([0.0, 0.0, 1.0])
KEY = jax.random.key(0)
LIT = {"stack": STACK, "wi": UP}
PAIR = {**LIT, "wo": UP}
SINGLE = {"transport": lj.SingleScattering()}

FUNCTIONS = {
    "angles": {"w": UP},
    "direction": {"theta": 0.5, "phi": 0.0, "degrees": False},
    "evaluate": {**PAIR, **SINGLE, "side": "all", "key": KEY},
    "evaluate_with_error": {**PAIR, "transport": lj.RandomWalk(paths=64), "side": "all", "key": KEY},
    "sample": {**LIT, "key": KEY, **SINGLE},
    "pdf": {**PAIR, **SINGLE},
    "albedo": {**LIT, **SINGLE, "nodes": 8, "key": KEY},
    "specular": LIT,
    "unscattered": LIT,
    "metal": {"name": "gold", "wavelengths_nm": 550.0},
    "cauchy": {"wavelengths_nm": 550.0, "a": 1.5, "b": 0.004, "c": 0.0},
    "sellmeier": {"wavelengths_nm": 550.0, "b": 1.0, "c": 0.01},
    "prepare": {"stack": STACK, **SINGLE},
    "choose_transport": {**PAIR, **SINGLE},
    "goniophotometer": {
        **LIT,
        "key": KEY,
        "paths": 64,
        "polar": 1,
        "azimuth": 1,
        "orders": 2,
        "batch_size": 64,
        "facet_multiple_scattering": False,
    },
}

CLASSES = {
    "Interface": {"ior": 1.5, "alpha": 0.1, "distribution": "ggx"},
    "Medium": {"thickness": 1.0, "albedo": 0.5, "phase": lj.Rayleigh(), "f0": 0.5},
    "TurbidMedium": {"thickness_mm": 1.0, "mu_s": 1.0, "mu_a": 1.0, "phase": lj.Rayleigh(), "f0": 0.5},
    "Stack": {"layers": [lj.Medium(0.5)], "base": lj.Lambertian(0.5)},
    "Mixture": {"parts": {"a": STACK, "b": STACK}, "weights": [0.5, None]},
    "HenyeyGreenstein": {"g": 0.5},
    "SGGX": {"kind": "fiber", "alpha": 0.5, "axis": (1.0, 0.0, 0.0)},
    "Lambertian": {"albedo": 0.5},
    "OrenNayar": {"albedo": 0.5, "roughness": 0.3},
    "VMFDiffuse": {"albedo": 0.5, "roughness": 0.3},
    "Conductor": {"ior": 0.2, "k": 3.0, "alpha": 0.1, "distribution": "ggx", "film": lj.ThinFilm(1.5, 100.0, 550.0)},
    "ThinFilm": {"ior": 1.5, "thickness_nm": 100.0, "wavelengths_nm": 550.0},
    "AddingDoubling": {"nodes": 8, "modes": 4, "facet_multiple_scattering": False, "tolerance": 1e-3},
    "ENDF": {"bounces": 1},
    "RandomWalk": {"paths": 64, "orders": "all", "facet_multiple_scattering": False, "batch_size": 64},
    "Statistical": {"symmetric": True},
    "SingleScattering": {},
    "SpongeCake": {},
    "WeidlichWilkie": {},
}

WRONG = {
    "class": lj.Interface,
    "transport's class": lj.Statistical,
    "string": "Statistical",
    "surface": lj.Lambertian(0.5),
    "layer": lj.Interface(1.5, 0.3),
    "None": None,
    "dictionary": {},
}

NONE_IS_FINE = {
    ("Medium", "f0"), ("TurbidMedium", "f0"), ("Stack", "base"), ("evaluate", "key"), ("albedo", "key"),
    ("AddingDoubling", "nodes"), ("AddingDoubling", "modes"), ("AddingDoubling", "tolerance"), ("SGGX", "axis"),
    ("Conductor", "film"), ("Conductor", "alpha"), ("Interface", "alpha"), ("Interface", "film"),
}  # fmt: skip
"""Arguments that may be left out."""


def _fine(name, argument, kind):
    return (kind == "None" and (name, argument) in NONE_IS_FINE) or (name, argument, kind) == (
        "Stack",
        "base",
        "surface",
    )


CASES = [
    (name, argument, kind)
    for name, arguments in (FUNCTIONS | CLASSES).items()
    for argument in arguments
    for kind in WRONG
    if not _fine(name, argument, kind)
]


@pytest.mark.filterwarnings("ignore:A JAX array is being set as static")  # equinox's, before a class can look
@pytest.mark.parametrize(("name", "argument", "kind"), CASES)
def test_it_is_refused_by_name(name, argument, kind):
    given = (FUNCTIONS | CLASSES)[name] | {argument: WRONG[kind]}
    with pytest.raises((TypeError, ValueError)) as caught:
        getattr(lj, name)(**given)
    message = str(caught.value)
    assert argument in message
    assert "\n" not in message
    assert len(message) < 300


@pytest.mark.parametrize("name", FUNCTIONS | CLASSES)
def test_unknown_arguments_are_named(name):
    with pytest.raises(TypeError, match="rubbish") as caught:
        getattr(lj, name)(**(FUNCTIONS | CLASSES)[name], rubbish=1)
    assert "\n" not in str(caught.value)


def test_all_public_names_are_asked():
    """What is left: data, results, and contracts that are derived from."""
    public = {name for name, value in vars(lj).items() if callable(value) and not name.startswith("_")}
    assert public - {*FUNCTIONS, *CLASSES} == {
        "PhaseFunction",
        "Transport",
        "Prepared",
        "Goniogram",
        "Rayleigh",
        "ResolutionWarning",
        "compiler_options",  # takes no arguments
        "keep_programs",
    }
    for name, arguments in FUNCTIONS.items():
        assert not [one for one in inspect.signature(getattr(lj, name)).parameters if one not in arguments], name


FIXES = {
    "a surface for a stack": (lambda: lj.evaluate(lj.Lambertian(0.5), UP, UP), "a surface alone is Stack([], base="),
    "a layer for a stack": (lambda: lj.albedo(lj.Medium(0.5), UP), "a layer alone is Stack([layer])"),
    "a layer for layers": (lambda: lj.Stack(lj.Medium(0.5)), "is not a list of"),
    "a word for a transport": (lambda: lj.pdf(STACK, UP, UP, "Statistical"), "Statistical() is one"),
    "a class for a transport": (lambda: lj.prepare(STACK, lj.Statistical), "Statistical() is one"),
    "a seed for a key": (lambda: lj.sample(STACK, UP, 3, SINGLE["transport"]), "such as jax.random.key(3)"),
    "a seed for a key that is not needed": (
        lambda: lj.evaluate(STACK, UP, UP, **SINGLE, key=3),
        "such as jax.random.key(3)",
    ),
    "a key a part": (
        lambda: lj.sample(lj.Mixture({"a": STACK, "b": STACK}, [0.5, None]), UP, jax.random.split(KEY)),
        "is not a JAX random key",
    ),
    "roughness for alpha": (lambda: lj.Interface(1.5, roughness=0.3), "'roughness' (alpha?)"),
    "two widths": (lambda: lj.Interface(1.5, (0.1, 0.3)), "Interface.alpha: (0.1, 0.3) given, must be one number"),
    "an index a channel": (lambda: lj.Interface([1.5, 1.6, 1.7], 0.1), "Interface.ior: [1.5, 1.6, 1.7] given"),
    "a square": (lambda: lj.Stack([lj.Medium(np.ones((32, 32)))]), "layers[0].thickness: shape (32, 32) given"),
    "degrees": (lambda: lj.direction(30.0, 0), "direction(..., degrees=True)"),
    "degrees among others": (lambda: lj.direction(np.array([0.0, 10.0]), 0.0), "direction(..., degrees=True)"),
    "degrees in a list": (lambda: lj.direction([0, 60], 0.0), "direction(..., degrees=True)"),
    "azimuth in degrees": (lambda: lj.direction(0.5, 45), "phi: 45 is outside [-3 pi, 3 pi]; of angles in degrees say"),
    "azimuths in degrees": (lambda: lj.direction(0.5, np.arange(-90.0, 10.0)), "direction(..., degrees=True)"),
    "more than half a turn": (lambda: lj.direction(190.0, 0.0, degrees=True), "190 degrees is outside [-180, 180]"),
}


@pytest.mark.parametrize(("call", "fix"), FIXES.values(), ids=FIXES)
def test_the_fix_is_named(call, fix):
    with pytest.raises((TypeError, ValueError)) as caught:
        call()
    assert fix in str(caught.value)
    assert "\n" not in str(caught.value)


def test_squares_that_other_numbers_explain_are_maps():
    """Of texels and channels, or of rows and columns."""
    square = lj.Medium(np.full((3, 3), 0.5))
    for other in (lj.Lambertian([[0.2, 0.4, 0.6]]), lj.Conductor(0.2, 3.0, np.array([0.1, 0.2, 0.3]))):
        stack = lj.Stack([square], other)
        assert lj.evaluate(stack, UP, UP, **SINGLE).shape == (3, 3)
    rows = lj.Stack([lj.Medium(np.full((3, 3, 1), 0.5))], lj.Lambertian([0.2, 0.4, 0.6]))
    assert lj.evaluate(rows, UP, UP, **SINGLE).shape == (3, 3, 3)


@pytest.mark.parametrize("theta", [-180.0, -30.0, 0.0, 90.0, 180.0])
def test_directions_in_degrees(theta):
    found = lj.direction(theta, [0, 200], degrees=True)
    np.testing.assert_allclose(found, lj.direction(np.deg2rad(theta), np.deg2rad([0, 200])), atol=1e-15)
    single = lj.direction(np.float32(theta), np.float32(20.0), degrees=True)
    assert single.dtype == np.float32


def test_angles_that_are_not_known_are_taken_as_they_are():
    found = jax.jit(lambda theta: lj.direction(theta, 0.0))(7.0)
    np.testing.assert_allclose(found, lj.direction(7.0 - 2 * np.pi, 0.0), atol=1e-14)
    found = jax.jit(lambda phi: lj.direction(0.5, phi))(45.0)
    np.testing.assert_allclose(found, lj.direction(0.5, 45.0 % (2 * np.pi)), atol=1e-14)


def test_an_azimuth_may_be_that_of_a_mirror_direction():
    whole = np.linspace(-2 * np.pi, 2 * np.pi, 9, dtype=np.float32)
    np.testing.assert_allclose(
        lj.direction(0.5, whole + np.float32(np.pi)), lj.direction(0.5, np.pi + whole), atol=1e-6
    )
    lj.direction(30.0, 900.0, degrees=True)
