"""The plugin for Mitsuba: values, draws and derivatives are those of the stack, and its own test accepts the draws."""

import contextlib
import io
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import layerjax as lj

pytestmark = pytest.mark.peers

COAT = lj.Stack(
    [lj.Interface(1.5, 0.1), lj.Medium(0.5, [0.9, 0.8, 0.5], lj.HenyeyGreenstein(0.3))], lj.Lambertian([0.6, 0.3, 0.1])
)
SHEET = lj.Stack([lj.Medium(0.3, 0.0), lj.Medium(0.7, 0.9, lj.SGGX("fiber", 0.4, (1.0, 0.5, 0.6)))])
GLASS = lj.Stack([lj.Interface(1.5, 0.2)])
SOLVER = lj.AddingDoubling(nodes=12, modes=16)
STACKS: dict[str, tuple[lj.Stack | lj.Mixture, Any]] = {
    "coat": (COAT, lj.Statistical()),
    "metal": (lj.Stack([], lj.Conductor([0.2, 0.9, 1.1], [3.9, 2.4, 2.2], 0.3)), "auto"),
    "flakes": (
        lj.Stack([lj.Medium(0.7, 0.9, lj.SGGX("surface", 0.4, (0.3, 0.2, 0.9)), 0.1)], lj.OrenNayar(0.5, 0.4)),
        lj.SpongeCake(),
    ),
    "brushed": (lj.Stack([], lj.Conductor(0.2, 3.9, 0.15, alpha_y=0.4, tangent=0.3)), "auto"),
    "sheet": (SHEET, lj.SingleScattering()),
    "glass": (GLASS, SOLVER),
    "pane": (lj.Stack([lj.Interface(1.5, 0.2), lj.Medium(0.3, 0.8), lj.Interface(1.0, 0.3)]), SOLVER),
    "varnish": (lj.Stack([lj.Interface(1.5)], lj.Lambertian([0.6, 0.3, 0.1])), SOLVER),
    "window": (lj.Stack([lj.Interface(1.5), lj.Medium(0.3, 0.8), lj.Interface(1.3)]), SOLVER),
    "mirror": (lj.Stack([lj.Medium(0.3, 0.8)], lj.Conductor([0.2, 0.9, 1.1], [3.9, 2.4, 2.2])), SOLVER),
    "spots": (
        lj.Mixture(
            {"paint": lj.Stack([], lj.Lambertian(0.4)), "gloss": lj.Stack([lj.Interface(1.5)], lj.Lambertian(0.4))},
            [0.3, None],
        ),
        SOLVER,
    ),
    "mixture": (lj.Mixture({"paint": lj.Stack([], lj.Lambertian(0.4)), "veil": SHEET}, [0.3, None]), "auto"),
}
LIGHTS = ((0.3, 0.2, 0.93), (0.8, 0.0, 0.6), (0.5, 0.1, -0.8))


@pytest.fixture(scope="module")
def mi() -> Any:
    found = pytest.importorskip("mitsuba")
    try:
        found.set_variant("llvm_ad_rgb")
    except Exception as error:
        pytest.skip(f"no LLVM: {error}")
    import layerjax.mitsuba as plugin

    plugin.register()
    return found


def bsdf(stack: lj.Stack | lj.Mixture, transport: Any, **options: Any) -> Any:
    import layerjax.mitsuba as plugin

    return plugin.bsdf(stack, transport, **options)


def rows(count: int, seed: int) -> np.ndarray:
    found = np.random.default_rng(seed).standard_normal((count, 3))
    return (found / np.linalg.norm(found, axis=1, keepdims=True)).astype(np.float32)


def at(mi: Any, wi: np.ndarray) -> Any:
    found = mi.SurfaceInteraction3f()
    found.wi = mi.Vector3f(wi.T)
    return found


@pytest.mark.parametrize("name", STACKS)
def test_values_are_those_of_the_stack(mi: Any, name: str) -> None:
    """Of radiance the viewer is wi; of importance wo. Between media of two indices that is not the same."""
    stack, transport = STACKS[name]
    made, wi, wo = bsdf(stack, transport), rows(300, 0), rows(300, 1)
    for mode, light, viewer in ((mi.TransportMode.Radiance, wo, wi), (mi.TransportMode.Importance, wi, wo)):
        found = np.array(made.eval(mi.BSDFContext(mode), at(mi, wi), mi.Vector3f(wo.T))).T
        true = np.asarray(lj.evaluate(stack, light, viewer, transport)) * abs(wo[:, 2:])
        np.testing.assert_allclose(found, np.broadcast_to(true, found.shape), rtol=2e-5, atol=1e-7)


@pytest.mark.parametrize("name", STACKS)
def test_draws_are_worth_the_albedo(mi: Any, name: str) -> None:
    """What passes straight is drawn too. The density of a draw is that which is asked for, of what is scattered."""
    stack, transport = STACKS[name]
    made, count, random = bsdf(stack, transport), 50_000, np.random.default_rng(2)
    for height in (0.7, -0.7):
        wi = np.array([np.sqrt(1.0 - height**2), 0.0, height], np.float32)
        many = np.broadcast_to(wi, (count, 3))
        drawn, weight = made.sample(
            mi.BSDFContext(mi.TransportMode.Importance),
            at(mi, many),
            mi.Float(random.random(count)),
            mi.Point2f(random.random((2, count))),
        )
        weight = np.array(weight).T
        expected = sum(np.asarray(part) for part in lj.albedo(stack, wi, transport)) + np.asarray(
            sum(lj.specular(stack, wi))
        )
        assert np.all(abs(weight.mean(axis=0) - expected) < 4.0 * weight.std(axis=0) / np.sqrt(count) + 2e-3)
        deltas = int(mi.BSDFFlags.Null | mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission)
        scattered = np.array(drawn.sampled_type) & deltas == 0
        density = np.array(made.pdf(mi.BSDFContext(mi.TransportMode.Importance), at(mi, many), drawn.wo))
        kept = scattered & (np.array(drawn.pdf) > 0.0) & np.any(weight > 0.0, axis=1)
        np.testing.assert_allclose(density[kept], np.array(drawn.pdf)[kept], rtol=1e-4)


@pytest.mark.parametrize("name", STACKS)
def test_mitsuba_accepts_the_draws(mi: Any, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By its chi-square test; light that passes straight has no density, and is left out."""
    import layerjax.mitsuba as plugin

    monkeypatch.chdir(tmp_path)  # a test that fails writes a file
    monkeypatch.setitem(plugin.materials, name, STACKS[name])
    context = mi.BSDFContext()
    context.type_mask = mi.BSDFFlags.Glossy
    for light in LIGHTS:
        wi = (np.array(light) / np.linalg.norm(light)).tolist()
        extra = f'<string name="material" value="{name}"/>'
        sample, density = mi.chi2.BSDFAdapter("layerjax", extra, wi=wi, ctx=context)
        test = mi.chi2.ChiSquareTest(
            domain=mi.chi2.SphericalDomain(),
            sample_func=sample,
            pdf_func=density,
            sample_dim=3,
            res=51,
            ires=8,
            sample_count=200_000,
        )
        with contextlib.redirect_stdout(io.StringIO()):
            passed = test.run(significance_level=0.01 / len(LIGHTS) / len(STACKS))
        assert passed, test.messages


def test_derivatives_of_a_picture_are_differences(mi: Any) -> None:
    """By every number of a coat, of a sphere in the light of a point: nothing in that picture is drawn at random."""
    import drjit as dr

    ball = {"type": "sphere", "bsdf": bsdf(COAT, lj.Statistical())}
    film = {"type": "hdrfilm", "width": 12, "height": 12, "filter": {"type": "box"}}
    camera = {"type": "perspective", "fov": 40, "film": film, "sampler": {"type": "independent"}}
    camera["to_world"] = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    light = {"type": "point", "position": [2, 1, 4], "intensity": {"type": "rgb", "value": 10.0}}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "ball": ball,
            "light": light,
            "camera": camera,
        }
    )
    numbers = mi.traverse(scene)
    names = [name for name in numbers.keys() if name.startswith("ball.bsdf.")]  # noqa: SIM118
    assert len(names) == 6
    for name in names:
        dr.enable_grad(numbers[name])
    numbers.update()
    mean = dr.full(mi.TensorXf, 1.0 / (12 * 12 * 3), shape=(12, 12, 3))
    # what `mi.render` does, except that it draws other rays for the derivatives
    scene.integrator().render_backward(scene, numbers, mean, seed=1, spp=16)
    found = {name: np.sum(np.array(dr.grad(numbers[name]))) for name in names}
    for name in names:
        dr.disable_grad(numbers[name])
    for name in names:
        value = type(numbers[name])(numbers[name])
        # the error is of the fifth order in a step of 5 %, and rounding is below 1 % of a change so large
        step, means = 0.02 * float(np.ravel(value)[0]), []
        for steps in (-2, -1, 1, 2):
            numbers[name] = value + steps * step
            numbers.update()
            means.append(np.array(mi.render(scene, spp=16, seed=1), float).mean())
        numbers[name] = value
        numbers.update()
        difference = (8.0 * (means[2] - means[1]) - (means[3] - means[0])) / (12.0 * step)
        assert found[name] == pytest.approx(difference, rel=0.02), name


def test_numbers_are_seen_and_checked(mi: Any) -> None:
    numbers = mi.traverse(bsdf(SHEET, "auto", id="sheet"))
    assert "layers[1].phase.alpha" in numbers.keys()  # noqa: SIM118
    numbers["layers[1].phase.alpha"] = 1.5
    with pytest.raises((ValueError, RuntimeError), match=r"SGGX.alpha: 1.5 is outside \[0.0001, 1\]"):
        numbers.update()


def test_what_lies_behind_and_what_passes_straight_follow_the_numbers(mi: Any) -> None:
    """An opaque part has nothing behind it; an interface of index 1 is none, until it gets another."""
    veil, varnish = lj.Medium(0.3, 0.0), lj.Stack([lj.Interface(1.7, 0.1)], lj.Conductor(0.2, 3.0, 0.1))
    mixed = lj.Mixture({"veil": lj.Stack([veil]), "varnish": varnish}, [0.5, None])
    assert bsdf(mixed, lj.Statistical()).material.eta == 1.0
    made = bsdf(lj.Stack([lj.Interface(1.0, 0.1), veil]), lj.Statistical(), id="veil")
    assert (made.material.eta, made.material.has_null) == (1.0, True)
    numbers = mi.traverse(made)
    numbers["layers[0].ior"] = 1.5
    numbers.update()
    assert (made.material.eta, made.material.has_null) == (1.5, False)
    assert not mi.has_flag(made.flags(), mi.BSDFFlags.Null)


def test_what_it_cannot_take_is_refused(mi: Any) -> None:
    import drjit as dr

    import layerjax.mitsuba as plugin

    for stack, words in (
        (lj.Stack([], lj.Lambertian(np.full((2, 3, 1), 0.5))), r"the stack is a map of shape \(2, 3\)"),
        (lj.Stack([], lj.Lambertian([0.5, 0.4])), "the stack has 2 channels, llvm_ad_rgb takes 3"),
    ):
        with pytest.raises(ValueError, match=words):
            plugin.bsdf(stack)
    with pytest.raises(RuntimeError, match=r"'stone' is neither in layerjax\.mitsuba"):
        mi.load_dict({"type": "layerjax", "material": "stone"})
    assert mi.load_dict({"type": "layerjax", "material": "sheen"}).material.stack.channels in (1, 3)
    dr.set_flag(dr.JitFlag.SymbolicCalls, True)
    plugin.register()
    assert not dr.flag(dr.JitFlag.SymbolicCalls)


def test_other_variants() -> None:
    """Grey ones do, spectral ones are refused; and layerjax alone imports no Mitsuba."""
    pytest.importorskip("mitsuba")
    program = """
import sys
import layerjax as lj
assert "mitsuba" not in sys.modules
import mitsuba as mi
mi.set_variant("llvm_ad_mono")
import layerjax.mitsuba as plugin
made = plugin.bsdf(lj.Stack([], lj.Lambertian(0.5)))
si = mi.SurfaceInteraction3f()
si.wi = mi.Vector3f(0, 0, 1)
assert abs(made.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0.6, 0.8))[0][0] - 0.5 * 0.8 / 3.14159265) < 1e-6
mi.set_variant("llvm_ad_spectral")
try:
    plugin.register()
except ValueError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("mitsuba: the variant is llvm_ad_spectral; it must be")


def test_the_same_numbers_draw_the_same(mi: Any) -> None:
    made, count = bsdf(COAT, lj.Statistical()), 100
    uniform = np.random.default_rng(0).random((3, count))
    found = [
        np.array(made.sample(mi.BSDFContext(), at(mi, rows(count, 5)), mi.Float(one), mi.Point2f(two))[0].wo)
        for one, two in ((uniform[0], uniform[1:]), (uniform[0], uniform[1:]), (1.0 - uniform[0], uniform[1:]))
    ]
    np.testing.assert_array_equal(found[0], found[1])
    leaves = abs(found[0][2]) > 0.0  # from below the coat reflects nothing, and draws no direction
    assert np.mean(leaves) > 0.3
    assert not np.any(np.all(found[0] == found[2], axis=0)[leaves])
