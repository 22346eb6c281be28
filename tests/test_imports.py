"""Imports point downward, and importing the library loads nothing heavy."""

import ast
import graphlib
import subprocess
import sys
from pathlib import Path

import pytest

import fits
import fits.inference
import fits.problem
import fits.reporting

ROOT = Path(__file__).parents[1]

# lowest first; what lies in a package may import what lies in those above its own line, and beside it
PACKAGES = [
    "layerjax._checks",
    "layerjax._known",
    "layerjax._numerics",
    "layerjax._parameters",
    "layerjax._shapes",
    "layerjax._shown",
    "layerjax._drawn",
    "layerjax.channels",
    "layerjax.directions",
    "layerjax._devices",
    "layerjax._batching",
    "layerjax.quadrature",
    "layerjax.fresnel",
    "layerjax.tables",
    "layerjax.normals",
    "layerjax.phase",
    "layerjax.microsurface",
    "layerjax.surfaces",
    "layerjax.stack",
    "layerjax.gallery",
    "layerjax.mixture",
    "layerjax.transport.known_directions",
    "layerjax.transport.contract",
    "layerjax.transport.single_scattering",
    "layerjax.transport.first_order",
    "layerjax.transport.weidlich_wilkie",
    "layerjax.transport.spongecake",
    "layerjax.transport.endf",
    "layerjax.transport.adding_doubling",
    "layerjax.transport.statistical",
    "layerjax.transport.random_walk",
    "layerjax.transport",
    "layerjax.maps",
    "layerjax.preparation",
    "layerjax.numerical_error",
    "layerjax.evaluate",
    "layerjax.mitsuba",
    "layerjax",
    "layerjax.precompute",
    "fits._files",
    "fits._lazy",
    "fits.names",
    "fits.progress",
    "fits.data",
    "fits.problem",
    "fits.engines",
    "fits.inference",
    "fits.maps",
    "fits.reporting",
    "fits.structures",
    "fits.many",
    "fits.exporting",
    "fits.cli",
    "fits",
    "benchmarks.suite",
    "benchmarks.measuring",
    "benchmarks.peers",
    "benchmarks.studies",
    "benchmarks",
]


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


def package_of(module):
    """The longest line of PACKAGES that the module is or lies in."""
    return max((name for name in PACKAGES if f"{module}.".startswith(f"{name}.")), key=len)


@pytest.mark.parametrize("path", MODULES.values(), ids=module_name)
def test_imports_point_downward(path):
    name = module_name(path)
    own = PACKAGES.index(package_of(name))
    for other in imported(path):
        root = other.split(".")[0]
        if root in ("layerjax", "fits", "benchmarks"):
            # what is imported as a whole is asked for a public name when it runs
            whole = other in ("layerjax", "fits") and root != name.split(".")[0]
            assert whole or PACKAGES.index(package_of(other)) <= own, f"{name} imports {other}"
        assert root != "tests"


@pytest.mark.parametrize("path", sources("layerjax"), ids=module_name)
def test_layerjax_needs_jax_equinox_and_numpy_alone(path):
    more = {"layerjax.precompute.learning": {"optax"}, "layerjax.mitsuba": {"mitsuba", "drjit"}}  # by extras
    known = {*sys.stdlib_module_names, "jax", "equinox", "numpy", "layerjax", *more.get(module_name(path), ())}
    assert {name.split(".")[0] for name in imported(path)} <= known


@pytest.mark.parametrize("package", ["layerjax", "fits", "benchmarks"])
def test_no_two_modules_need_each_other(package):
    own = {name: path for name, path in MODULES.items() if name.split(".")[0] == package}
    graphlib.TopologicalSorter({name: set(imported(path)) & own.keys() for name, path in own.items()}).prepare()


@pytest.mark.parametrize("path", sources("tests"), ids=module_name)
def test_what_tests_share_lies_in_helpers(path):
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


@pytest.mark.parametrize("room", [fits, fits.problem, fits.inference, fits.reporting], ids=lambda room: room.__name__)
def test_public_names_are_there_and_no_modules(room):
    """Importing a module binds its name in its package: none may hide a function."""
    assert not {f"{room.__name__}.{name}" for name in room.__all__} & MODULES.keys()
    for name in room.__all__:
        assert getattr(room, name) is getattr(fits, name)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = room.nothing
