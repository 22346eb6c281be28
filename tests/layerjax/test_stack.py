"""Validation by name, value and range; pytrees that can be traced, mapped and differentiated."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import layerjax as lj
from layerjax.stack import simplify

SINGLE = lj.SingleScattering()

HG = lj.HenyeyGreenstein(0.5)

REFUSED = {
    "Interface.ior: 0.1 is outside [0.25, 4]": lambda: lj.Interface(0.1, 0.1),
    "Interface.alpha: 2 is outside [0.0001, 1]": lambda: lj.Interface(1.5, 2.0),
    "Medium.thickness: -1 is outside [0, 10000]": lambda: lj.Medium(-1.0),
    "Medium.thickness: nan is outside": lambda: lj.Medium(float("nan")),
    "Medium.albedo: 1.5 is outside [0, 1]": lambda: lj.Medium(1.0, [0.5, 1.5]),
    "Medium.f0: -0.1 is outside [0, 1]": lambda: lj.Medium(1.0, 0.5, HG, -0.1),
    "Medium.phase: 'haze' is not": lambda: lj.Medium(1.0, 0.5, "haze"),
    "HenyeyGreenstein.g: 1 is outside [-0.999, 0.999]": lambda: lj.HenyeyGreenstein(1.0),
    "SGGX.alpha: 0 is outside [0.0001, 1]": lambda: lj.SGGX("surface", 0.0),
    "SGGX.kind: 'flake' is not one of 'surface', 'fiber'": lambda: lj.SGGX("flake", 0.1),
    "SGGX.axis: [0.0, 0.0, 0.0] is not a finite vector": lambda: lj.SGGX("fiber", 0.1, (0.0, 0.0, 0.0)),
    "SGGX.axis: shape (2,) given, (3,) needed": lambda: lj.SGGX("fiber", 0.1, (0.0, 1.0)),
    "SGGX.alpha: shape (0,) given, which holds no number": lambda: lj.SGGX("fiber", []),
    "Lambertian.albedo: 'red' is not a number": lambda: lj.Lambertian("red"),
    "Lambertian.albedo: None is not a number": lambda: lj.Lambertian(None),
    "OrenNayar.roughness: 2 is outside [0, 1]": lambda: lj.OrenNayar(0.5, 2.0),
    "OrenNayar.form: 'modern' is not one of": lambda: lj.OrenNayar(0.5, 0.5, "modern"),
    "Conductor.k: 30 is outside [0, 20]": lambda: lj.Conductor(0.2, 30.0, 0.1),
    "Stack.layers[1]: 3 is not an Interface, a Medium or a TurbidMedium": lambda: lj.Stack([lj.Medium(1.0), 3]),
    "Stack.base: 0.5 is not a surface": lambda: lj.Stack([], 0.5),
    "layers[0].albedo has 3, base.albedo has 2": lambda: lj.Stack([lj.Medium(1.0, [1, 1, 1])], lj.Lambertian([1, 1])),
}


@pytest.mark.parametrize("message", REFUSED)
def test_bad_values_are_refused_by_name_value_and_range(message):
    with pytest.raises(ValueError) as error:  # noqa: PT011  (the message is compared below, brackets and all)
        REFUSED[message]()
    assert message in str(error.value)


def test_every_range_is_enforced_at_both_ends():
    makers = {
        "Interface.ior": lambda v: lj.Interface(v, 0.1),
        "Interface.alpha": lambda v: lj.Interface(1.5, v),
        "Interface.alpha, beckmann": lambda v: lj.Interface(1.5, v, "beckmann"),
        "Interface.alpha_y": lambda v: lj.Interface(1.5, 0.1, alpha_y=v),
        "Interface.tangent": lambda v: lj.Interface(1.5, 0.1, alpha_y=0.2, tangent=v),
        "Interface.alpha, vmf": lambda v: lj.Interface(1.5, v, "vmf"),
        "Interface.alpha, gtr": lambda v: lj.Interface(1.5, v, "gtr", gamma=3.0),
        "Interface.gamma": lambda v: lj.Interface(1.5, 0.1, "gtr", gamma=v),
        "Medium.thickness": lambda v: lj.Medium(v),
        "Medium.albedo": lambda v: lj.Medium(1.0, v),
        "Medium.f0": lambda v: lj.Medium(1.0, f0=v),
        "TurbidMedium.thickness_mm": lambda v: lj.TurbidMedium(v, 1.0),
        "TurbidMedium.mu_s": lambda v: lj.TurbidMedium(1.0, v),
        "TurbidMedium.mu_a": lambda v: lj.TurbidMedium(1.0, 1.0, v),
        "TurbidMedium.f0": lambda v: lj.TurbidMedium(1.0, 1.0, f0=v),
        "Mixture.weights": lambda v: lj.Mixture({"a": lj.Stack([], lj.Lambertian(0.5)), "b": lj.Stack([])}, [v, None]),
        "HenyeyGreenstein.g": lj.HenyeyGreenstein,
        "SGGX.alpha": lambda v: lj.SGGX("fiber", v),
        "Lambertian.albedo": lj.Lambertian,
        "OrenNayar.albedo": lambda v: lj.OrenNayar(v, 0.5),
        "OrenNayar.roughness": lambda v: lj.OrenNayar(0.5, v),
        "VMFDiffuse.albedo": lambda v: lj.VMFDiffuse(v, 0.5),
        "VMFDiffuse.roughness": lambda v: lj.VMFDiffuse(0.5, v),
        "Conductor.ior": lambda v: lj.Conductor(v, 1.0, 0.1),
        "Conductor.k": lambda v: lj.Conductor(1.0, v, 0.1),
        "Conductor.alpha": lambda v: lj.Conductor(1.0, 1.0, v),
        "Conductor.alpha, beckmann": lambda v: lj.Conductor(1.0, 1.0, v, "beckmann"),
        "Conductor.alpha, vmf": lambda v: lj.Conductor(1.0, 1.0, v, "vmf"),
        "Conductor.alpha_y": lambda v: lj.Conductor(1.0, 1.0, 0.1, alpha_y=v),
        "Conductor.tangent": lambda v: lj.Conductor(1.0, 1.0, 0.1, alpha_y=0.2, tangent=v),
        "Conductor.alpha, gtr": lambda v: lj.Conductor(1.0, 1.0, v, "gtr", gamma=3.0),
        "Conductor.gamma": lambda v: lj.Conductor(1.0, 1.0, 0.1, "gtr", gamma=v),
        "ThinFilm.ior": lambda v: lj.ThinFilm(v, 100.0, 550.0),
        "ThinFilm.thickness_nm": lambda v: lj.ThinFilm(1.5, v, 550.0),
        "ThinFilm.wavelengths_nm": lambda v: lj.ThinFilm(1.5, 100.0, v),
    }
    assert set(makers) == {name for name in lj.RANGES if hasattr(lj, name.split(".")[0])}  # those of the package
    for name, make in makers.items():
        low, high = lj.RANGES[name]
        for value in (low, high, np.float32(low), np.float32(high)):
            make(value)
        for value in (low - 0.01 * (1 + abs(low)), high * 1.01):
            with pytest.raises(ValueError, match=name.replace(".", r"\.")):
                make(value)


def test_a_transport_names_the_layer_that_it_cannot_carry():
    stack = lj.Stack([lj.Medium(1.0), lj.Interface(1.5, 0.1)])
    with pytest.raises(ValueError, match=r"layers\[1\]: SingleScattering carries no Interface"):
        lj.evaluate(stack, lj.direction(0.5, 0.0), lj.direction(0.5, 1.0), lj.SingleScattering())
    with pytest.raises(ValueError, match="transport: 'fast' is not a Transport"):
        lj.evaluate(lj.Stack([]), lj.direction(0.5, 0.0), lj.direction(0.5, 1.0), transport="fast")


def test_placeholders_pass_the_constructor_and_are_refused_on_evaluation():
    class Unknown:
        __layerjax_placeholder__ = True

    stack = lj.Stack([lj.Medium(Unknown(), phase=lj.SGGX("fiber", Unknown()))], lj.Lambertian(0.5))
    with pytest.raises(ValueError, match=r"layers\[0\]\.thickness, layers\[0\]\.phase\.alpha not given a value"):
        lj.evaluate(stack, lj.direction(0.5, 0.0), lj.direction(0.5, 1.0), SINGLE)


def make(p):
    layers = [
        lj.Medium(p["thickness"], [0.9, 0.8, p["albedo"]], lj.SGGX("surface", p["alpha"], p["axis"]), p["f0"]),
        lj.Medium(0.5, 0.7, lj.HenyeyGreenstein(p["g"])),
    ]
    return lj.Stack(layers, lj.Conductor([0.2, 0.9, 1.1], p["k"], 0.3))


PARAMETERS = {"thickness": 0.8, "albedo": 0.6, "alpha": 0.3, "f0": 0.1, "g": 0.4, "k": 2.5}
PARAMETERS = {name: jnp.asarray(value) for name, value in PARAMETERS.items()} | {"axis": jnp.array([0.2, 0.1, 0.9])}
W = np.deg2rad(75.0)
WI, WO = lj.direction(0.6, 0.2), lj.direction(0.9, 2.4)


@pytest.mark.slow
def test_gradients_agree_with_central_differences():
    def value(p, wi, wo):
        return jnp.sum(lj.evaluate(make(p), wi, wo, SINGLE) * jnp.array([1.0, 2.0, 3.0]))

    arguments = (PARAMETERS, WI, WO)
    reverse = jax.jit(jax.grad(value, (0, 1, 2)))(*arguments)
    forward = jax.jit(jax.jacfwd(value, (0, 1, 2)))(*arguments)
    flat, unflatten = ravel_pytree(arguments)
    step = 1e-6
    at = jax.jit(jax.vmap(lambda x: value(*unflatten(x))))
    shifts = step * jnp.eye(flat.size)
    numeric = (at(flat + shifts) - at(flat - shifts)) / (2 * step)
    scale = float(jnp.max(jnp.abs(numeric)))
    # central differences at 1e-6 are good to 1e-10 / 1e-6 of the value, and to step^2
    for gradient in (reverse, forward):
        np.testing.assert_allclose(ravel_pytree(gradient)[0], numeric, rtol=1e-6, atol=1e-8 * scale)


@pytest.mark.slow
def test_gradients_where_wi_and_wo_are_equally_attenuated():
    # at the mirror image of wi through the plane; |a - b| and min(a, b) have no derivative there, the value has
    def value(x):
        layers = [lj.Medium(x[0], phase=lj.SGGX("surface", 0.4)), lj.Medium(x[1], 0.7, HG)]
        return lj.evaluate(lj.Stack(layers), lj.direction(x[2], 0.3), lj.direction(jnp.pi - x[3], x[4]), SINGLE)[0]

    random = np.random.default_rng(0)
    theta, thickness = random.uniform(0.05, 1.4, 500), random.uniform(0.1, 3.0, (2, 500))
    x = np.stack([*thickness, theta, theta, random.uniform(0.5, 3.0, 500)], axis=-1)
    step, at = 1e-6, jax.jit(jax.vmap(value))
    numeric = np.stack([(at(x + step * e) - at(x - step * e)) / (2 * step) for e in np.eye(5)], axis=-1)
    scale = np.max(np.abs(numeric), axis=1, keepdims=True)
    for derivative in (jax.grad, jax.jacfwd):
        found = jax.jit(jax.vmap(derivative(value)))(x)
        np.testing.assert_array_less(np.abs(found - numeric) / scale, 1e-7)


def test_a_parameter_map_runs_under_vmap():
    alphas = jnp.linspace(0.1, 0.9, 5)
    stacks = eqx.filter_vmap(lambda alpha: make({**PARAMETERS, "alpha": alpha}))(alphas)
    together = jax.vmap(lambda stack: lj.evaluate(stack, WI, WO, SINGLE))(stacks)
    alone = [lj.evaluate(make({**PARAMETERS, "alpha": alpha}), WI, WO, SINGLE) for alpha in alphas]
    np.testing.assert_allclose(together, jnp.stack(alone), rtol=1e-13)


def test_matched_interfaces_are_dropped():
    top, medium, base = lj.Interface(1.5, 0.3), lj.Medium(0.4, 0.5), lj.Conductor(0.2, 3.9, 0.1)
    matched = [lj.Interface(1.0, 0.2), top, lj.Interface(1.5, 0.6), medium, lj.Interface(jnp.float32(1.5), 0.1)]
    assert simplify(lj.Stack(matched, base)).layers == simplify(lj.Stack([top, medium], base)).layers
    kept = [top, lj.Interface(1.2, 0.3), lj.Interface(1.5, 0.3), lj.Interface(1.0, 0.3)]  # each differs from the last
    assert simplify(lj.Stack(kept)).layers == tuple(kept)
    values = [lj.evaluate(lj.Stack(layers, base), WI, WO, lj.WeidlichWilkie()) for layers in ([top], [top, matched[2]])]
    np.testing.assert_array_equal(*values)
    through = lj.unscattered(lj.Stack([lj.Interface(1.0, 0.5), medium]), WI)
    np.testing.assert_array_equal(through, lj.unscattered(lj.Stack([medium]), WI))


def test_interfaces_of_traced_index_are_kept():
    # the reflectance is 0 at 1, its second derivative is not
    given = lj.Interface(1.0, 0.2)  # under a traced index it cannot be said to be matched

    def value(ior):
        stack = lj.Stack([lj.Interface(ior, 0.5), given], lj.Lambertian(0.0))
        counts.append(len(simplify(stack).layers))
        return lj.evaluate(stack, WI, WO, lj.WeidlichWilkie())[0]

    counts = []
    assert value(1.0) == 0.0
    assert jax.jit(jax.grad(jax.grad(value)))(1.0) > 0.0
    assert counts == [0, 2]


def test_masking_takes_light_where_no_index_changes():
    """Smith's G1 of GGX, for the way in and the way out."""
    stack = lj.Stack([lj.Interface(1.0 + 1e-9, 0.3)], lj.Lambertian(0.5))
    wi, wo = lj.direction(W, 0.0), lj.direction(W, np.pi)
    value = lj.evaluate(stack, wi, wo, lj.AddingDoubling(nodes=8, modes=4))
    kept = (2.0 / (1.0 + np.sqrt(1.0 + (0.3 * np.tan(W)) ** 2))) ** 2
    np.testing.assert_allclose(value * np.pi / 0.5, kept, rtol=2e-3)
    assert round(1.0 - kept, 2) == 0.36
