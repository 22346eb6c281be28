"""TOML problem files: both ways, and whatever they hold: it can be computed with, or one line names file and place."""

import equinox as eqx
import jax
import numpy as np
import pytest

import fits
import layerjax as lj
from fits import Discrepancy, Instrument, Noise
from fits.optimise.options import FitOptions, options_from
from fits.problem.parameters import Box, Free, LogNormal, LogUniform, Normal, PowerLaw, is_free
from fits.problem.stack_file import material_to_dict, read_instrument, read_problem, stack_from_dict, write_problem
from fits.reports.html import FitReport
from tests.helpers import places
from tests.helpers.refusals import refuses

EXAMPLES = sorted(places.EXAMPLES.glob("*.toml"))
FULL = """
about = { source = "a paper", remark = "kept as it is" }
transport = { kind = "AddingDoubling", nodes = 16, ordinates = [8, 12], tolerance = 0.01 }
objective = "cube_root"
scale = { start = 1.0, low = 0.8, high = 1.25, prior = { kind = "LogNormal", median = 1.0, sd = 0.05 } }
instrument = { detector_aperture = 2.0, tilt = { start = 0.0, low = -1.0, high = 1.0 } }
options = { autocorrelation = 0.4 }
[[layers]]
kind = "Medium"
thickness = { start = 0.5, low = 0.0, high = 5.0 }
albedo = 0.9
[layers.phase]
kind = "SGGX"
shape = "fiber"
alpha = { start = 0.3, low = 0.02, high = 1.0, prior = { kind = "Normal", mean = 0.3, sd = 0.1 } }
axis = [1, 0, 0]
[[layers]]
kind = "Interface"
ior = 1.5
alpha = 0.1
[base]
kind = "Lambertian"
albedo = { start = [0.1, 0.2, 0.3], low = 0.0, high = [0.5, 0.6, 0.7], random_walk_sd = [0.1, 0.2] }
[noise]
relative = { start = 0.05, low = 0.01, high = 0.5 }
floor = 1e-4
use_sigma = false
discrepancy = { length_half = { start = 12.0, low = 8.0, high = 20.0 } }
"""
MIXED = """\
transport = "SingleScattering"

[mixture.dust]
weight = { start = 0.5, low = 0.0, high = 1.0 }
layers = [{ kind = "Medium", thickness = { start = 1.0, low = 0.1, high = 5.0 }, albedo = 0.6 }]
base = { kind = "Lambertian", albedo = 0.1 }

[mixture.metal.base]
kind = "Conductor"
ior = 0.2
k = 3.0
alpha = { start = 0.4, low = 0.1, high = 1.0 }
"""
MIXTURE = {"dust.layers[0].thickness": 0.6, "metal.base.alpha": 0.25, "weights.dust": 0.3}
WEIGHT, METAL = "weight = { start = 0.5, low = 0.0, high = 1.0 }", "[mixture.metal.base]"
INSTRUMENT = Instrument(detector_aperture=2.0, tilt=Free(0.0, -1.0, 1.0))
BASE = 'base = { kind = "Lambertian", albedo = 0.5 }\n'
LAYER = "[[layers]]\nkind = 'Medium'\n"
THIN = LAYER + "thickness = 1\n"
TINTED = "base = {{ kind = 'Conductor', ior = 1, k = 1, alpha = 1, film = {} }}\n"
LAW = PowerLaw(Free(4.0, 0.1, 50.0), Free(0.0, -4.0, 4.0), (450.0, 550.0), 600.0)


def read(tmp_path, text):
    path = tmp_path / "problem.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_problem(path)


def test_everything_in_a_file_arrives_and_is_written_again(tmp_path):
    problem = read(tmp_path, FULL)
    medium, interface = problem.stack.layers
    assert medium.thickness == Free(0.5, 0.0, 5.0)
    assert medium.phase.alpha == Free(0.3, 0.02, 1.0, Normal(0.3, 0.1))
    assert (float(medium.albedo), medium.phase.kind, medium.phase.axis.tolist()) == (0.9, "fiber", [1, 0, 0])
    assert (float(interface.ior), float(interface.alpha)) == (1.5, 0.1)
    assert problem.stack.base.albedo == Free([0.1, 0.2, 0.3], 0.0, [0.5, 0.6, 0.7], random_walk_sd=(0.1, 0.2))
    shared = Discrepancy(length_half=Free(12.0, 8.0, 20.0))
    assert problem.noise == Noise(Free(0.05, 0.01, 0.5), 1e-4, False, discrepancy=shared)
    assert problem.scale == Free(1.0, 0.8, 1.25, LogNormal(1.0, 0.05))
    assert problem.transport == lj.AddingDoubling(nodes=16, ordinates=(8, 12), tolerance=0.01)
    assert (problem.objective, problem.instrument) == ("cube_root", INSTRUMENT)
    assert (problem.about, problem.text) == ({"source": "a paper", "remark": "kept as it is"}, FULL)
    assert options_from(problem.options) == FitOptions(autocorrelation=0.4)

    path = tmp_path / "again.toml"
    names = ("transport", "noise", "scale", "objective", "instrument")
    settings = {name: getattr(problem, name) for name in names}
    write_problem(path, problem.stack, **settings)
    again = read_problem(path)
    assert eqx.tree_equal(again.stack, problem.stack)
    assert {name: getattr(again, name) for name in names} == settings
    assert read_instrument(path) == INSTRUMENT
    refuses("exists already", write_problem, path, problem.stack)
    write_problem(path, problem.stack, force=True)
    plain = read_problem(path)
    assert (plain.transport, plain.objective, plain.scale, plain.noise) == ("auto", "likelihood", None, Noise())
    refuses(r"again.toml: there is no .instrument.", read_instrument, path)

    for given in (True, False, Discrepancy(0.05)):
        write_problem(path, problem.stack, noise=Noise(0.03, discrepancy=given), force=True)
        assert read_problem(path).noise == Noise(0.03, discrepancy=given)


def test_what_could_not_be_read_back_is_not_written(tmp_path):
    """Classes of one's own: a file could name them, but nothing could read them back."""
    painted, careful = type("Painted", (lj.Lambertian,), {}), type("Careful", (lj.SingleScattering,), {})
    with pytest.raises(ValueError, match=r"base\.kind is 'Painted', must be one of Lambertian, "):
        write_problem(tmp_path / "problem.toml", lj.Stack([], painted(0.5)))
    with pytest.raises(ValueError, match=r"transport is 'Careful', must be one of "):
        write_problem(tmp_path / "problem.toml", lj.Stack([], lj.Lambertian(0.5)), transport=careful())
    assert not list(tmp_path.iterdir())


def test_dictionary_round_trip():
    for stack in (
        lj.Stack([], lj.Conductor([0.2, 0.9], 3.9, 0.1, film=lj.ThinFilm(1.5, Free(9.0, 0.0, 99.0), [610.0, 550.0]))),
        lj.Stack([], base=lj.VMFDiffuse(Free(0.4, 0.0, [0.8, 0.9, 1.0]), Free(0.3, 0.0, 1.0), form="all_orders")),
        lj.Stack([lj.Medium(thickness=1 / 3, phase=lj.HenyeyGreenstein(g=Free(0.1, -0.9, 0.9)), f0=0.04)]),
        lj.Stack([lj.Medium(Free(1.0, 0.1, 10.0, LogUniform()), phase=lj.Rayleigh())], lj.OrenNayar(0.5, 0.3)),
        lj.Stack([lj.Interface(Free(1.5, 1.3, 1.7))], lj.Conductor(0.2, 3.9)),
        lj.Stack([lj.Interface(1.5, film=lj.ThinFilm(1.38, Free(99.0, 0.0, 200.0), [610.0, 550.0]))]),
        lj.Stack([lj.TurbidMedium(0.2, LAW, 0.5, lj.HenyeyGreenstein(0.3))]),
    ):
        assert eqx.tree_equal(stack_from_dict(material_to_dict(stack)), stack)
    stack = jax.tree.map(lambda leaf: leaf.astype("float32"), lj.Stack([], base=lj.Lambertian(albedo=np.float32(0.9))))
    assert material_to_dict(stack) == {"base": {"kind": "Lambertian", "albedo": 0.9}}
    assert material_to_dict(lj.Stack([lj.Interface(1.5)])) == {
        "layers": [{"kind": "Interface", "ior": 1.5, "distribution": "ggx", "smooth": True}]
    }


FACE = "[[layers]]\nkind = 'Interface'\nior = 1.5\n"
FREE = LAYER + "thickness = {{ start = 1, low = 0, high = 2{} }}\n"
WRONG = {
    "": "neither a layer nor a base",
    b"\xef\xbb\xbf": "neither a layer nor a base",
    BASE.encode("utf-16"): r"not a text file \(byte 0 is not UTF-8\)",
    "base." + "a." * 2000 + "b = 1\n": "base has no kind",
    "about = { day = 2020-13-01 }\n": "not valid TOML: ",
    THIN + "albdo = 0.5\n": r"layers\[0\] has an unknown key 'albdo' \(did you mean 'albedo'\?\); allo",
    BASE + "bse = 3\n": "the file has an unknown key 'bse'",
    LAYER + "thickness = -1\n": r"layers\[0\]: Medium.thickness: -1 is outside \[0, 10000\]",
    LAYER + "albedo = 0.5\n": r"layers\[0\] has no thickness, which Medium needs",
    "[[layers]]\nthickness = 1\n": r"layers\[0\] has no kind, must be one of Interface, Medium",
    "[[layers]]\nkind = 'Mediun'\n": r"layers\[0\].kind is 'Mediun' \(did you mean 'Medium'\?\)",
    FREE.replace("low = 0", "low = 5").format(""): r"layers\[0\].thickness: low is 5.0 and high is 2.0",
    FREE.replace("high = 2", "high = 1e6").format(""): r"layers\[0\].thickness.high is 1000000.0, must be a number in",
    FREE.format(", prior = { kind = 'Normal', mean = 1, sd = -1 }"): r"layers\[0\].thickness.prior: Normal.sd is -1",
    THIN + "phase = { kind = 'SGGX', shape = 'ball', alpha = 0.1 }\n": r"layers\[0\].phase: SGGX.shape: ",
    BASE + "noise = { discrepancy = { length_half = -3.0 } }\n": "noise.discrepancy.length_half is -3.0",
    FACE: r"layers\[0\] has no alpha, must have it or smooth = true",
    FACE + "smoth = true\n": r"unknown key 'smoth' \(did you mean 'smooth'\?\)",
    FACE + "smooth = 1\n": r"layers\[0\].smooth: 1 is neither true nor false",
    FACE + "smooth = true\nalpha = 0.1\n": r"layers\[0\].smooth: true, and alpha given as well",
    TINTED.format("{ ior = 1 }"): "base.film has no thickness_nm, which ThinFilm needs",
    FACE + "smooth = true\nfilm = { ior = 1.4 }\n": r"layers\[0\]\.film has no thickness_nm, which ThinFilm needs",
    TINTED.format("3"): r"base: Conductor\.film: 3 is not a ThinFilm or None",
    BASE + "scale = { start = [1, 1], low = 0.5, high = 2 }\n": "scale has 2 channels, must be one number for all",
    BASE + "instrument = { detector_aperture = 31 }\n": r"instrument.detector_aperture is 31; .* in \[0, 30\]",
    BASE + "transport = 'Singlescattering'\n": "transport is 'Singlescattering' .did you mean 'SingleScattering'",
    BASE.replace("0.5", "[0.1, 0.2]") + LAYER + "thickness = [1, 2, 3]\n": "disagree on the number of",
    MIXED.replace("high = 1.0 }\nlayers", "high = 1.2 }\nlayers"): r"weight.high is 1.2, must be a number in \[0, 1\]",
    MIXED.replace("weight = {", "weight = 0.3\nwait = {"): r"unknown key 'wait' \(did you mean 'weight'\?\)",
    MIXED.replace("albedo = 0.1", "albedo = 1.1"): r"mixture.dust.base: Lambertian.albedo: 1.1 is outside \[0, 1\]",
    MIXED.replace(METAL, f"[mixture.metal]\nweight = 0.2\n{METAL}"): "one has to be free of choice",
    MIXED.replace(METAL, "[base]"): "mixture is a whole material, must stand without base",
    MIXED.replace(WEIGHT, ""): "mixture: Mixture.weights: 2 are None",
    MIXED.replace(WEIGHT, "weight = [0.1, 0.2]"): r"dust.weight is \[0.1, 0.2\]; it must be a number in \[0, 1\]",
}


@pytest.mark.parametrize("text", WRONG)
def test_bad_files_are_one_line_that_names_the_place(tmp_path, text):
    words = refuses(WRONG[text], read, tmp_path, text)
    assert words.startswith(str(tmp_path / "problem.toml"))
    assert "\n" not in words
    refuses("is a directory, must be a file", read_problem, tmp_path)


def test_mixtures_are_read_fitted_and_written(tmp_path):
    view, single = fits.slices([10.0, 50.0], np.arange(-75.0, 76.0, 7.5)), lj.SingleScattering()
    thickness, alpha, weight = MIXTURE.values()
    dust = lj.Stack([lj.Medium(thickness, 0.6)], lj.Lambertian(0.1))
    mixed = lj.Mixture({"dust": dust, "metal": lj.Stack([], lj.Conductor(0.2, 3.0, alpha))}, [weight, None])
    data = fits.simulate(mixed, view, single, 0.03, 1e-4)
    (tmp_path / "dusty.toml").write_text(MIXED)
    given = read_problem(tmp_path / "dusty.toml")
    write_problem(tmp_path / "again.toml", given.stack, transport=given.transport)
    again = read_problem(tmp_path / "again.toml")
    one, other = (fits.Problem(each.stack, data, each.transport) for each in (given, again))
    assert one.names == other.names == tuple(MIXTURE)
    np.testing.assert_array_equal([one.start, one.low], [other.start, other.low])
    np.testing.assert_allclose(one.predict(one.start), other.predict(other.start))
    found = fits.fit(given.stack, data, transport=single, starts=1)
    for name, truth in MIXTURE.items():
        assert abs(found.values[name] - truth) < 4.0 * found.standard_errors[name]
    fits.save_fit(found, tmp_path / "result")
    assert tuple(fits.load_fit(tmp_path / "result").values) == tuple(MIXTURE)
    assert "[mixture.dust]" in FitReport(found).page()


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_are_valid(path):
    problem = read_problem(path)
    assert problem.scale == Free(1.0, 0.7, 1.4, LogNormal(1.0, 0.1))
    assert any(map(is_free, jax.tree.leaves(problem.stack, is_leaf=is_free)))


MEDIUM = 'layers = [{ kind = "Medium", thickness = 1.0, %s }]\n'
NUMBER = 'layers = [{ kind = "Medium", thickness = { start = 1.0, low = 0.5, high = 2.0%s } }]\n'
# where @ stands, any value may be written; the keys are what an error must name
PLACES = {
    "layers": "layers = @\n",
    "layers[0].kind": "layers = [{ kind = @ }]\n",
    "layers[0].thickness": 'layers = [{ kind = "Medium", thickness = @ }]\n',
    "layers[0].phase": MEDIUM % "phase = @",
    "layers[0].phase.shape": MEDIUM % 'phase = { kind = "SGGX", shape = @, alpha = 0.5 }',
    "layers[0].thickness.low": NUMBER.replace("0.5", "@") % "",
    "layers[0].thickness.prior": NUMBER % ", prior = @",
    "layers[0].thickness.prior.median": NUMBER % ', prior = { kind = "LogNormal", median = @, sd = 0.1 }',
    "gallery": "gallery = @\n",
    "objective": BASE + "objective = @\n",
    "transport": BASE + "transport = @\n",
    "transport.ordinates[1]": BASE + 'transport = { kind = "AddingDoubling", ordinates = [8, @] }\n',
    "noise": BASE + "noise = @\n",
    "noise.relative": BASE + "noise = { relative = @ }\n",
    "noise.use_sigma": BASE + "noise = { use_sigma = @ }\n",
    "mystery": BASE + "mystery = @\n",
}
TOKENS = ("inf", "nan", "-1e308", "1e-310", "true", "2020-02-29T12:00:00.123456Z", "[]", "[[0.5]]")
VALUES = {token: token for token in TOKENS} | {
    "309 digits": "9" * 309,
    "long text": '"' + "long " * 20_000 + '"',
    "lines": r'"first\nsecond\u0000third"',
    "long list of texts": "[" + "'half', " * 2000 + "]",
    "arrays 20000 deep": "[" * 20_000 + "]" * 20_000,
    "tables 300 deep": "{ a = " * 300 + "1" + " }" * 300,
}


@pytest.mark.parametrize("name", VALUES)
def test_any_value_in_any_place(tmp_path, name):
    path = tmp_path / "stack.toml"
    for place, text in PLACES.items():
        path.write_text(text.replace("@", VALUES[name]))
        try:
            problem = read_problem(path)
        except ValueError as error:
            named, message = str(error)[: len(f"{path}: ")], str(error)[len(f"{path}: ") :]
            assert named == f"{path}: ", message[:200]
            assert message.isprintable(), message
            assert len(message) < 700, message
            unread = message.startswith(("arrays or tables are nested", "not valid TOML"))
            assert unread == ("20000 deep" in name), message
            first, last = place.split(".")[0].split("[")[0], place.split(".")[-1].split("[")[0]
            assert unread or (first in message and (last in message or "channels" in message)), (place, message)
            continue
        parts = (problem.stack, problem.scale, problem.noise.relative, problem.noise.floor)
        box = Box.of([leaf for leaf in jax.tree.leaves(parts, is_leaf=is_free) if is_free(leaf)])
        for share in np.linspace(0.0, 1.0, 5):
            vector = box.from_unit(np.full(len(box.low), share))
            for found in (vector, box.prior_residuals(vector) ** 2, box.log_prior(np.clip(vector, box.low, box.high))):
                assert np.isfinite(found).all()
        given = {name: getattr(problem, name) for name in ("transport", "noise", "scale", "objective")}
        write_problem(again := path.with_name("again.toml"), problem.stack, force=True, **given)
        assert read_problem(again).noise == problem.noise
