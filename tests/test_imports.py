"""What imports cost, and what they may name; that they point downward is a contract in `pyproject.toml`."""

import ast
import graphlib
import subprocess
import sys
from pathlib import Path

import pytest

import fits
import fits.optimise

ROOT = Path(__file__).parents[1]


def module_name(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield name if name in MODULES else node.module


def sources(package):
    return sorted((ROOT / package).rglob("*.py"))


MODULES = {module_name(path): path for package in ("layerjax", "fits", "benchmarks") for path in sources(package)}


def test_layerjax_needs_jax_equinox_and_numpy_alone():
    more = {"layerjax.precompute.learning": {"optax"}, "layerjax.mitsuba": {"mitsuba", "drjit"}}  # by extras
    known = {*sys.stdlib_module_names, "jax", "equinox", "numpy", "layerjax"}
    for path in sources("layerjax"):
        others = {name.split(".")[0] for name in imported(path)} - known - more.get(module_name(path), set())
        assert not others, f"{path} imports {others}"


@pytest.mark.parametrize("package", ["layerjax", "fits", "benchmarks"])
def test_no_two_modules_need_each_other(package):
    own = {name: path for name, path in MODULES.items() if name.split(".")[0] == package}
    graphlib.TopologicalSorter({name: set(imported(path)) & own.keys() for name, path in own.items()}).prepare()


def test_what_tests_share_lies_in_helpers():
    for path in sources("tests"):
        for other in imported(path):
            if other.split(".")[0] == "tests":
                assert other.startswith("tests.helpers"), f"{path} imports {other}"


def loaded_by(statement):
    code = f"import sys; {statement}; print(*sorted(name.split('.')[0] for name in sys.modules))"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    return set(output.split())


def test_importing_layerjax_loads_only_jax_equinox_numpy():
    assert loaded_by("import layerjax") - loaded_by("import jax, equinox, numpy") == {"layerjax"}


def test_importing_fits_pays_for_nothing_unused():
    assert not loaded_by("import fits") & {
        "arviz",
        "matplotlib",
        "jaxopt",
        "h5py",
        "zarr",
        "rich",
        "emcee",
        "optimistix",
    }


def test_fitting_and_exporting_load_what_few_need_when_they_need_it():
    unused = {"jaxopt", "arviz", "emcee", "h5py", "MaterialX", "matplotlib"}
    assert not loaded_by("import fits.optimise.fit, fits.exports.export") & unused


def test_public_names_are_there_and_no_modules():
    """Importing a module binds its name in its package: none may hide a function."""
    assert not {f"fits.{name}" for name in fits.__all__} & MODULES.keys()
    for name in fits.__all__:
        assert getattr(fits, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = fits.nothing
