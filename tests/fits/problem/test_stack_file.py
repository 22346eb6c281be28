"""TOML problem files: both ways, and errors that name the place."""

from pathlib import Path

import jax
import numpy as np
import pytest

import layerjax as lj
from fits.problem.instrument import Instrument
from fits.problem.noise import Noise
from fits.problem.parameters import Free, LogNormal, LogUniform, Normal, is_free
from fits.problem.stack_file import read_instrument, read_problem, write_problem
from fits.problem.toml import stack_from_dict, stack_to_dict
from tests.helpers import places

EXAMPLES = sorted(places.EXAMPLES.glob("*.toml"))

FULL = """
about = { source = "a paper", remark = "kept as it is" }
transport = "SingleScattering"
objective = "cube_root"
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
albedo = { start = [0.1, 0.2, 0.3], low = 0.0, high = [0.5, 0.6, 0.7] }
[noise]
relative = { start = 0.05, low = 0.01, high = 0.5 }
floor = 1e-4
use_sigma = false
tails = "student"
degrees_of_freedom = 3
[scale]
start = 1.0
low = 0.8
high = 1.25
prior = { kind = "LogNormal", median = 1.0, sd = 0.05 }
"""


def _read(tmp_path: Path, text: str):
    path = tmp_path / "problem.toml"
    path.write_text(text)
    return read_problem(path)


def _same(first: lj.Stack, second: lj.Stack) -> None:
    leaves, others = (jax.tree.leaves(stack, is_leaf=is_free) for stack in (first, second))
    assert jax.tree.structure(first, is_leaf=is_free) == jax.tree.structure(second, is_leaf=is_free)
    for leaf, other in zip(leaves, others, strict=True):
        if isinstance(leaf, Free):
            assert leaf == other
        else:
            np.testing.assert_array_equal(leaf, other)


def test_everything_in_a_file_arrives(tmp_path):
    problem = _read(tmp_path, FULL)
    medium, interface = problem.stack.layers
    assert medium.thickness == Free(0.5, 0.0, 5.0)
    assert medium.phase.alpha == Free(0.3, 0.02, 1.0, Normal(0.3, 0.1))
    assert (float(medium.albedo), medium.phase.kind, medium.phase.axis.tolist()) == (0.9, "fiber", [1, 0, 0])
    assert (float(interface.ior), float(interface.alpha)) == (1.5, 0.1)
    assert problem.stack.base.albedo == Free([0.1, 0.2, 0.3], 0.0, [0.5, 0.6, 0.7])
    assert problem.noise == Noise(Free(0.05, 0.01, 0.5), 1e-4, False, "student", 3.0)
    assert problem.scale == Free(1.0, 0.8, 1.25, LogNormal(1.0, 0.05))
    assert isinstance(problem.transport, lj.SingleScattering)
    assert problem.objective == "cube_root"
    assert problem.about == {"source": "a paper", "remark": "kept as it is"}
    assert problem.text == FULL


def test_defaults(tmp_path):
    problem = _read(tmp_path, "[base]\nkind = 'OrenNayar'\nalbedo = 0.5\nroughness = 0.2\n")
    assert (problem.transport, problem.objective, problem.scale, problem.noise) == ("auto", "likelihood", None, Noise())
    assert problem.stack.base.form == "energy_preserving"


def test_file_round_trip(tmp_path):
    problem = _read(tmp_path, FULL)
    path = tmp_path / "again.toml"
    settings = {"transport": problem.transport, "noise": problem.noise, "scale": problem.scale}
    write_problem(path, problem.stack, objective=problem.objective, **settings)
    again = read_problem(path)
    _same(again.stack, problem.stack)
    assert (again.noise, again.scale, again.objective) == (problem.noise, problem.scale, problem.objective)
    assert again.transport == problem.transport
    with pytest.raises(ValueError, match="exists already"):
        write_problem(path, problem.stack)
    write_problem(path, problem.stack, force=True)
    assert read_problem(path).transport == "auto"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["again.toml", "problem.toml"]


class Ghost(lj.Rayleigh):
    """A phase function of one's own: a file could name it, but nothing could read it back."""


class Painted(lj.Lambertian):
    """A base of one's own."""


class Careful(lj.SingleScattering):
    """A transport of one's own."""


@pytest.mark.parametrize(
    ("stack", "transport", "message"),
    [
        (
            lj.Stack([lj.Interface(1.5, 0.1), lj.Medium(1.0, phase=Ghost())]),
            "auto",
            r"layers\[1\]\.phase\.kind is 'Ghost', must be one of HenyeyGreenstein, Rayleigh, SGGX",
        ),
        (lj.Stack([], Painted(0.5)), "auto", r"base\.kind is 'Painted', must be one of Lambertian, "),
        (lj.Stack([], lj.Lambertian(0.5)), Careful(), r"transport\.kind is 'Careful', must be one of "),
    ],
    ids=["phase", "base", "transport"],
)
def test_what_could_not_be_read_back_is_not_written(tmp_path, stack, transport, message):
    path = tmp_path / "problem.toml"
    with pytest.raises(ValueError, match=message):
        write_problem(path, stack, transport=transport)
    assert not path.exists()


def test_options_of_a_transport(tmp_path):
    problem = _read(
        tmp_path, "transport = { kind = 'AddingDoubling', nodes = 16, ordinates = [8, 12], tolerance = 0.01 }\n" + BASE
    )
    assert problem.transport == lj.AddingDoubling(nodes=16, ordinates=(8, 12), tolerance=0.01)
    path = tmp_path / "again.toml"
    write_problem(path, problem.stack, transport=problem.transport)
    assert read_problem(path).transport == problem.transport


@pytest.mark.parametrize(
    "stack",
    [
        lj.Stack([], base=lj.Conductor(ior=[0.2, 0.9, 1.1], k=3.9, alpha=0.1)),
        lj.Stack([], base=lj.VMFDiffuse(Free(0.4, 0.0, [0.8, 0.9, 1.0]), Free(0.3, 0.0, 1.0), form="transport")),
        lj.Stack([lj.Medium(thickness=Free(0.2, 0.0, 2.0), phase=lj.Rayleigh())]),
        lj.Stack([lj.Medium(thickness=1 / 3, phase=lj.HenyeyGreenstein(g=Free(0.1, -0.9, 0.9)), f0=0.04)]),
        lj.Stack(
            [lj.Medium(thickness=Free(1.0, 0.1, 10.0, LogUniform()))], base=lj.OrenNayar(0.5, 0.3, form="classic")
        ),
    ],
)
def test_dictionary_round_trip(stack):
    _same(stack_from_dict(stack_to_dict(stack)), stack)


def test_a_file_with_the_former_name_of_a_form_opens():
    written = {"kind": "VMFDiffuse", "albedo": 0.5, "roughness": 0.3, "form": "transport"}
    stack = stack_from_dict({"base": written})
    assert stack_to_dict(stack) == {"base": written | {"form": "all_orders"}}


def test_single_precision_numbers_stay_short():
    stack = lj.Stack([], base=lj.Lambertian(albedo=np.float32(0.9)))
    stack = jax.tree.map(lambda leaf: leaf.astype("float32"), stack)
    assert stack_to_dict(stack) == {"base": {"kind": "Lambertian", "albedo": 0.9}}


BASE = "[base]\nkind = 'Lambertian'\nalbedo = 0.5\n"
LAYER = "[[layers]]\nkind = 'Medium'\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "neither a layer nor a base"),
        ("[base\n", "not valid TOML"),
        (
            LAYER + "thickness = 1\nalbdo = 0.5\n",
            r"layers\[0\] has an unknown key 'albdo' \(did you mean 'albedo'\?\); allowed: kind, th",
        ),
        (
            "about = { year = 2022 }\n[base]\nkind = 'Lambertian'\nalbedo = 1\n",
            r"about\['year'\] is 2022, must be a text",
        ),
        ("bse = 3\n[base]\nkind = 'Lambertian'\nalbedo = 1\n", "the file has an unknown key 'bse'"),
        (LAYER + "thickness = 'thick'\n", r"layers\[0\].thickness is 'thick', must be a number in \[0, 10000\]"),
        (LAYER + "thickness = true\n", r"layers\[0\].thickness is True"),
        (LAYER + "thickness = nan\n", r"layers\[0\].thickness is nan, must be a number in \[0, 10000\]"),
        (LAYER + "thickness = -1\n", r"layers\[0\].thickness is -1, must be a number in \[0, 10000\]"),
        (LAYER + "thickness = []\n", r"layers\[0\].thickness is an empty list"),
        (LAYER + "albedo = 0.5\n", r"layers\[0\] \(Medium\) has no thickness"),
        ("[[layers]]\nthickness = 1\n", r"layers\[0\] has no kind, must be one of Interface, Medium"),
        ("[[layers]]\nkind = 'Mediun'\n", r"layers\[0\].kind is 'Mediun' \(did you mean 'Medium'\?\)"),
        ("[[layers]]\nkind = ['Medium']\n", r"layers\[0\].kind is \['Medium'\]"),
        ("layers = 3\n", "layers is not a list of tables"),
        (
            LAYER + "thickness = { start = 9, low = 0, high = 5 }\n",
            r"layers\[0\].thickness: start is 9.0; it must lie in \[0.0, 5.0\]",
        ),
        (
            LAYER + "thickness = { start = 1, low = 5, high = 0 }\n",
            r"layers\[0\].thickness: low is 5.0 and high is 0.0",
        ),
        (LAYER + "thickness = { start = 1, low = 0 }\n", r"layers\[0\].thickness has no high"),
        (LAYER + "thickness = { start = 1, low = 0, high = 1e6 }\n", r"layers\[0\].thickness.high is 1e\+06, must be"),
        (LAYER + "thickness = { start = 1, low = 0, hihg = 2 }\n", r"layers\[0\].thickness has an unknown key 'hihg'"),
        (
            LAYER + "thickness = { start = 1, low = 0, high = 2, prior = 'Normal' }\n",
            r"layers\[0\].thickness.prior is 'Normal', must be a table",
        ),
        (
            LAYER + "thickness = { start = 1, low = 0, high = 2, prior = { kind = 'Normal', mean = 1 } }\n",
            r"layers\[0\].thickness.prior \(Normal\) has no sd",
        ),
        (
            LAYER + "thickness = { start = 1, low = 0, high = 2, prior = { kind = 'Normal', mean = 1, sd = -1 } }\n",
            r"layers\[0\].thickness.prior: Normal.sd is -1",
        ),
        (
            LAYER + "thickness = { start = 1, low = 0, high = 2, prior = { kind = 'LogUniform' } }\n",
            r"layers\[0\].thickness: low is 0.0; it must be above 0",
        ),
        (LAYER + "thickness = 1\nphase = 'SGGX'\n", r"layers\[0\].phase is 'SGGX', must be a table"),
        (
            LAYER + "thickness = 1\nphase = { kind = 'SGGX', shape = 'ball', alpha = 0.1 }\n",
            r"layers\[0\].phase.shape is 'ball', must be one of surface, fiber",
        ),
        (
            LAYER + "thickness = 1\nphase = { kind = 'SGGX', shape = 'fiber', alpha = 0.1, axis = [1, 0] }\n",
            r"layers\[0\].phase: SGGX.axis: shape \(2,\)",
        ),
        ("[base]\nkind = 'Lambertian'\nalbedo = 0.5\n[noise]\nrelativ = 0.1\n", "noise has an unknown key 'relativ'"),
        (
            "[base]\nkind = 'Lambertian'\nalbedo = 0.5\n[noise]\nuse_sigma = 1\n",
            "noise.use_sigma is 1, must be true or false",
        ),
        ("[base]\nkind = 'Lambertian'\nalbedo = 0.5\n[noise]\nrelative = -1\n", "noise.relative is -1"),
        (
            "[base]\nkind = 'Lambertian'\nalbedo = 0.5\n[noise]\ntails = 'fat'\n",
            "noise.tails is 'fat', must be one of gaussian, student",
        ),
        (
            "[base]\nkind = 'Lambertian'\nalbedo = 0.5\n[noise]\ndegrees_of_freedom = { start = 1 }\n",
            "noise.degrees_of_freedom is",
        ),
        (
            "[base]\nkind = 'Lambertian'\nalbedo = 0.5\n[scale]\nstart = 1\nlow = -1\nhigh = 2\n",
            r"scale.low is -1, must be a number in \[1e-100, 1e\+100\]",
        ),
        (
            "transport = 'Singlescattering'\n[base]\nkind = 'Lambertian'\nalbedo = 0.5\n",
            "transport is 'Singlescattering' .did you mean 'SingleScattering'",
        ),
        (
            "transport = { kind = 'AddingDoubling', ordinates = [8, 12.5] }\n" + BASE,
            r"transport.ordinates is \[8, 12.5\], must be a list of 2 whole numbers",
        ),
        (
            "transport = { kind = 'AddingDoubling', nodes = 1.5 }\n" + BASE,
            "transport.nodes is 1.5, must be a whole number",
        ),
        (
            "objective = 'best'\n[base]\nkind = 'Lambertian'\nalbedo = 0.5\n",
            "objective is 'best', must be one of likelihood",
        ),
        (
            "[base]\nkind = 'Lambertian'\nalbedo = [0.1, 0.2]\n" + LAYER + "thickness = [1, 2, 3]\n",
            "disagree on the number of channels",
        ),
        (
            BASE + "[[layers]]\nkind = 'Interface'\nior = 1.5\nalpha = [0.1, 0.2]\n",
            r"layers\[0\]: Interface.alpha: \(0.1, 0.2\) given, must be one number",
        ),
    ],
)
def test_bad_files_are_one_line_that_names_the_place(tmp_path, text, message):
    with pytest.raises(ValueError, match=message) as caught:
        _read(tmp_path, text)
    assert str(caught.value).startswith(str(tmp_path / "problem.toml"))
    assert "\n" not in str(caught.value)


def test_missing_and_binary_files(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_problem(tmp_path / "nothing.toml")
    (tmp_path / "junk.toml").write_bytes(bytes(range(256)))
    with pytest.raises(ValueError, match="not a text file"):
        read_problem(tmp_path / "junk.toml")


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_are_valid(path):
    problem = read_problem(path)
    assert problem.scale == Free(1.0, 0.7, 1.4, LogNormal(1.0, 0.1))
    assert any(isinstance(leaf, Free) for leaf in jax.tree.leaves(problem.stack, is_leaf=is_free))


def test_there_are_examples():
    assert {"flake_coat_over_diffuse", "hg_coat_over_diffuse", "rough_conductor"} <= {path.stem for path in EXAMPLES}


def test_an_instrument_is_read_by_itself(tmp_path: Path) -> None:
    path = tmp_path / "seen.toml"
    path.write_text("[instrument]\ndetector_aperture = 2.0\ntilt = { start = 0.0, low = -1.0, high = 1.0 }\n")
    assert read_instrument(path) == Instrument(detector_aperture=2.0, tilt=Free(0.0, -1.0, 1.0))
    for text, message in (
        ("[noise]\nfloor = 1e-4\n", "there is no .instrument."),
        ("[instrument]\ndetector_aperture = 40\n", "detector_aperture is 40"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=rf"seen.toml: .*{message}"):
            read_instrument(path)
