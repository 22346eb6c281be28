"""Whatever a stack file holds, in whatever place: it can be computed with, or one line names the file and the place."""

from pathlib import Path

import jax
import numpy as np
import pytest

from fits.cli.parser import main
from fits.problem.parameters import Box, is_free
from fits.problem.stack_file import ProblemFile, read_problem, write_problem

BASE = 'base = { kind = "Lambertian", albedo = 0.5 }\n'
MEDIUM = 'layers = [{ kind = "Medium", thickness = 1.0, %s }]\n'
FREE = 'layers = [{ kind = "Medium", thickness = { start = 1.0, low = 0.5, high = 2.0%s } }]\n'
SCALE = BASE + "scale = { start = 1.0, low = 0.5, high = 2.0%s }\n"

# where @ stands, any value may be written; the keys are what an error must name
PLACES = {
    "layers": "layers = @\n",
    "layers[0]": "layers = [@]\n",
    "layers[0].kind": "layers = [{ kind = @ }]\n",
    "layers[0].thickness": 'layers = [{ kind = "Medium", thickness = @ }]\n',
    "layers[0].albedo": MEDIUM % "albedo = @",
    "layers[0].f0": MEDIUM % "f0 = @",
    "layers[0].phase": MEDIUM % "phase = @",
    "layers[0].phase.g": MEDIUM % 'phase = { kind = "HenyeyGreenstein", g = @ }',
    "layers[0].phase.shape": MEDIUM % 'phase = { kind = "SGGX", shape = @, alpha = 0.5 }',
    "layers[0].phase.alpha": MEDIUM % 'phase = { kind = "SGGX", shape = "fiber", alpha = @ }',
    "axis": MEDIUM % 'phase = { kind = "SGGX", shape = "fiber", alpha = 0.5, axis = @ }',
    "layers[0].phase.axis": MEDIUM % 'phase = { kind = "SGGX", shape = "fiber", alpha = 0.5, axis = [0, 0, @] }',
    "layers[0].ior": 'layers = [{ kind = "Interface", ior = @, alpha = 0.1 }]\n',
    "layers[0].distribution": 'layers = [{ kind = "Interface", ior = 1.5, alpha = 0.1, distribution = @ }]\n',
    "layers[0].thickness.start": (FREE % "").replace("start = 1.0", "start = @"),
    "layers[0].thickness.low": (FREE % "").replace("low = 0.5", "low = @"),
    "layers[0].thickness.high": (FREE % "").replace("high = 2.0", "high = @"),
    "layers[0].thickness.prior": FREE % ", prior = @",
    "layers[0].thickness.prior.mean": FREE % ', prior = { kind = "Normal", mean = @, sd = 0.1 }',
    "layers[0].thickness.prior.sd": FREE % ', prior = { kind = "Normal", mean = 1.0, sd = @ }',
    "layers[0].thickness.prior.median": FREE % ', prior = { kind = "LogNormal", median = @, sd = 0.1 }',
    "layers[0].thickness.prior.kind": FREE % ", prior = { kind = @ }",
    "base": "base = @\n",
    "base.albedo": 'base = { kind = "Lambertian", albedo = @ }\n',
    "base.roughness": 'base = { kind = "OrenNayar", albedo = 0.5, roughness = @ }\n',
    "base.k": 'base = { kind = "Conductor", ior = 1.0, k = @, alpha = 0.1 }\n',
    "gallery": "gallery = @\n",
    "objective": BASE + "objective = @\n",
    "transport": BASE + "transport = @\n",
    "transport.nodes": BASE + 'transport = { kind = "AddingDoubling", nodes = @ }\n',
    "transport.ordinates": BASE + 'transport = { kind = "AddingDoubling", ordinates = @ }\n',
    "transport.ordinates[1]": BASE + 'transport = { kind = "AddingDoubling", ordinates = [8, @] }\n',
    "transport.tolerance": BASE + 'transport = { kind = "AddingDoubling", tolerance = @ }\n',
    "transport.orders": BASE + 'transport = { kind = "AddingDoubling", orders = @ }\n',
    "transport.bounces": BASE + 'transport = { kind = "ENDF", bounces = @ }\n',
    "transport.paths": BASE + 'transport = { kind = "RandomWalk", paths = @ }\n',
    "transport.lanes": BASE + 'transport = { kind = "RandomWalk", lanes = @ }\n',
    "transport.symmetric": BASE + 'transport = { kind = "Statistical", symmetric = @ }\n',
    "noise": BASE + "noise = @\n",
    "noise.relative": BASE + "noise = { relative = @ }\n",
    "relative": BASE + "noise = { relative = { start = 0.1, low = 0.0, high = @ } }\n",
    "noise.floor": BASE + "noise = { floor = @ }\n",
    "floor": BASE + "noise = { floor = { start = 0.1, low = @, high = 0.2 } }\n",
    "noise.use_sigma": BASE + "noise = { use_sigma = @ }\n",
    "noise.tails": BASE + "noise = { tails = @ }\n",
    "degrees_of_freedom": BASE + "noise = { degrees_of_freedom = @ }\n",
    "scale": BASE + "scale = @\n",
    "scale.low": (SCALE % "").replace("low = 0.5", "low = @"),
    "scale.high": (SCALE % "").replace("high = 2.0", "high = @"),
    "scale.prior.median": SCALE % ', prior = { kind = "LogNormal", median = @, sd = 0.1 }',
    "scale.prior.sd": SCALE % ', prior = { kind = "LogNormal", median = 1.0, sd = @ }',
    "about": BASE + "about = @\n",
    "about.source": BASE + "about = { source = @ }\n",
    "mystery": BASE + "mystery = @\n",
}

VALUES = {
    "309 digits": "9" * 309,
    "minus 309 digits": "-" + "9" * 309,
    "400 digits": "1" + "0" * 399,
    "5000 digits": "9" * 5000,
    "5000 digits in groups": "_".join(["1234567890"] * 500),
    "5000 hexadecimal digits": "0x" + "f" * 5000,
    "32 bits": str(2**31 - 1),
    "64 bits": str(2**63),
    "infinity": "inf",
    "minus infinity": "-inf",
    "not a number": "nan",
    "1e400": "1e400",
    "1e308": "1e308",
    "-1e308": "-1e308",
    "1e-310": "1e-310",
    "1e-300": "1e-300",
    "0": "0",
    "-0.0": "-0.0",
    "true": "true",
    "date": "2020-02-29",
    "moment": "2020-02-29T12:00:00.123456Z",
    "time": "12:00:00",
    "empty text": "''",
    "long text": '"' + "long " * 20_000 + '"',
    "lines": r'"first\nsecond\u0000third"',
    "empty list": "[]",
    "empty table": "{}",
    "list of lists": "[[0.5]]",
    "long list": "[" + "0.5, " * 2000 + "]",
    "long list of texts": "[" + "'half', " * 2000 + "]",
    "long list of digits": "[" + ("9" * 309 + ", ") * 100 + "]",
    "arrays 300 deep": "[" * 300 + "]" * 300,
    "arrays 20000 deep": "[" * 20_000 + "]" * 20_000,
    "arrays 20000 deep without end": "[" * 20_000,
    "tables 300 deep": "{ a = " * 300 + "1" + " }" * 300,
    "tables 20000 deep": "{ a = " * 20_000 + "1" + " }" * 20_000,
    "dotted keys 1000 deep": "{ " + "a." * 1000 + "b = 1 }",
    "long key": "{ " + "a" * 20_000 + " = 1 }",
    "key of two lines": r'{ "a\nb" = 1 }',
}


def refused(path: Path) -> str | None:
    """The error of reading a file, less the file's name, which it must begin with; None if the file can be used."""
    try:
        problem = read_problem(path)
    except ValueError as error:
        message = str(error)
        assert message.startswith(f"{path}: "), message[:200]
        assert message.isprintable(), message
        assert len(message) < len(str(path)) + 700, message
        return message.removeprefix(f"{path}: ")
    assert_usable(problem, path.with_name("again.toml"))
    return None


def assert_usable(problem: ProblemFile, again: Path) -> None:
    """Its bounds and priors are numbers, and it can be written and read."""
    parts = (problem.stack, problem.scale, problem.noise.relative, problem.noise.floor)
    free = [leaf for leaf in jax.tree.leaves(parts, is_leaf=is_free) if is_free(leaf)]
    box = Box.of(free)
    unit = np.linspace(0.0, 1.0, 5)[:, None] * np.ones(len(box.low))
    for s in unit:
        assert np.isfinite(box.from_unit(s)).all()
        assert np.isfinite(box.prior_residuals(box.from_unit(s)) ** 2).all()
        assert np.isfinite(box.log_prior(np.clip(box.from_unit(s), box.low, box.high)))
    given = {"transport": problem.transport, "noise": problem.noise, "scale": problem.scale}
    write_problem(again, problem.stack, objective=problem.objective, force=True, **given)
    assert read_problem(again).noise == problem.noise


@pytest.mark.parametrize("name", VALUES)
def test_any_value_in_any_place(tmp_path: Path, name: str) -> None:
    path = tmp_path / "stack.toml"
    for place, text in PLACES.items():
        path.write_text(text.replace("@", VALUES[name]))
        message = refused(path)
        unread = message is not None and message.startswith(("arrays or tables are nested", "not valid TOML"))
        assert unread == ("20000 deep" in name), message
        if message is not None and not unread:
            assert place.partition(".")[0].partition("[")[0] in message, (place, message)
            assert place.rpartition(".")[2].partition("[")[0] in message or "channels" in message, (place, message)


FILES = {
    "empty": (b"", "there is neither a layer nor a base"),
    "only a byte order mark": (b"\xef\xbb\xbf", "there is neither a layer nor a base"),
    "UTF-16": (BASE.encode("utf-16"), "not a text file (byte 0 is not UTF-8)"),
    "invalid UTF-8": (b"# \xff\n" + BASE.encode(), "not a text file (byte 2 is not UTF-8)"),
    "zero byte": (BASE.encode() + b"\0", "not valid TOML: "),
    "key twice": ((BASE + BASE).encode(), "not valid TOML: "),
    "table twice": (b"[noise]\n[noise]\n", "not valid TOML: "),
    "long key twice": (b"[noise.%(key)s]\n[noise.%(key)s]\n" % {b"key": b"a" * 20_000}, "not valid TOML: "),
    "long dotted key": (b"base." + b"a." * 2000 + b"b = 1\n", "base has no kind"),
    "deep table": (BASE.encode() + b"[noise." + b"a." * 2000 + b"b]\n", "noise has an unknown key 'a'"),
    "two long numbers": (
        (BASE + "about = { year = 1" + "_000" * 2000 + ", page = " + "9" * 5000 + " }").encode(),
        "about['year'] is 1000",
    ),
    "month 13": (b"about = { day = 2020-13-01 }\n", "not valid TOML: "),
}


@pytest.mark.parametrize(("content", "words"), FILES.values(), ids=FILES)
def test_any_file(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "stack.toml"
    path.write_bytes(content)
    message = refused(path)
    assert message is not None
    assert words in message


def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path: Path) -> None:
    (tmp_path / "stack.toml").write_bytes(b"\xef\xbb\xbf" + BASE.replace("\n", "\r\n").encode())
    assert read_problem(tmp_path / "stack.toml").text.startswith("base")


def test_a_directory_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is a directory, must be a file"):
        read_problem(tmp_path)


def test_long_texts_with_digits_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "stack.toml"
    path.write_text(BASE + f'about = {{ source = "{"1" * 5000}" }}\n')
    assert read_problem(path).about == {"source": "1" * 5000}


WIDE = 'base = { kind = "Lambertian", albedo = { start = 0.5, low = 0.1, high = 0.9, prior = { %s } } }\n'


@pytest.mark.parametrize(
    ("prior", "words"),
    [
        (
            'kind = "Normal", mean = 1e300, sd = 1e-300',
            "its centre must lie within 37 standard deviations of [0.1, 0.9]",
        ),
        ('kind = "Normal", mean = -1e300, sd = 1e-10', "its centre must lie within 37 standard deviations"),
        ('kind = "Normal", mean = 5.0, sd = 0.1', "its centre must lie within 37 standard deviations"),
        ('kind = "Normal", mean = 0.5, sd = 1e-300', "its sd must be above 1e-15 of the distance"),
        ('kind = "Normal", mean = 0.5, sd = 1e-310', "its sd must be above 1e-15 of the distance"),
        ('kind = "Normal", mean = 0.5, sd = 1.7e308', "its sd must be at most 4.5e+307 times the width"),
        ('kind = "LogNormal", median = 1e300, sd = 1.0', "its centre must lie within 37 standard deviations"),
        ('kind = "LogNormal", median = 0.5, sd = 1e-300', "its sd must be above 1e-15 of the distance"),
        ('kind = "Normal", mean = 1e400, sd = 1.0', "prior.mean is inf, must be a finite number"),
    ],
)
def test_priors_that_cannot_be_computed_with_are_refused(tmp_path: Path, prior: str, words: str) -> None:
    path = tmp_path / "stack.toml"
    path.write_text(WIDE % prior)
    message = refused(path)
    assert message is not None
    assert message.startswith("base.albedo")
    assert "prior" in message
    assert words in message


COMMANDS = {
    "309 digits": ("layers[0].thickness", "[0, 10000]"),
    "5000 digits": ("layers[0].thickness", "[0, 10000]"),
    "arrays 20000 deep": ("layers[0].thickness", "nested too deeply to be read, must be at most"),
    "400 digits": ("transport.nodes", "a whole number up to"),
    "1e308": ("layers[0].thickness.prior.mean", "37 standard deviations"),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_the_command_line_says_so_on_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    place, words = COMMANDS[name]
    path = tmp_path / "stack.toml"
    path.write_text(PLACES[place].replace("@", VALUES[name]))
    assert main(["simulate", "--stack", str(path), "--out", str(tmp_path / "new.csv")]) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.startswith(f"layerjax: error: {path}: ")
    assert output.err.count("\n") == 1
    assert len(output.err) < 300 + len(str(path))
    assert words in output.err
    assert not (tmp_path / "new.csv").exists()
