"""Imports point downward, and importing the library loads nothing heavy."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# lowest first; a module may import only from lines above its own
LAYERS = [
    "layerjax._numerics",
    "layerjax._parameters",
    "layerjax.channels",
    "layerjax.directions",
    "layerjax.quadrature",
    "layerjax.fresnel",
    "layerjax.distributions",
    "layerjax.vmf",
    "layerjax.vmf_flakes",
    "layerjax.facets",
    "layerjax.phase",
    "layerjax.surfaces._surface",
    "layerjax.surfaces.lambertian",
    "layerjax.surfaces.oren_nayar",
    "layerjax.surfaces.vmf_coefficients",
    "layerjax.precomputed",
    "layerjax.surfaces.vmf_transport",
    "layerjax.surfaces.vmf_diffuse",
    "layerjax.surfaces.microfacet",
    "layerjax.surfaces",
    "layerjax.stack",
    "layerjax.transport._transport",
    "layerjax.transport.single_scattering",
    "layerjax.transport._walk_rng",
    "layerjax.transport._walk_scene",
    "layerjax.transport._walk_surface",
    "layerjax.transport._microsurface",
    "layerjax.transport._walk_state",
    "layerjax.transport._walk_flight",
    "layerjax.transport._walk",
    "layerjax.transport._lanes",
    "layerjax.transport.random_walk",
    "layerjax.transport.first_order",
    "layerjax.transport.proposals",
    "layerjax.transport.discrete",
    "layerjax.transport.discrete.grid",
    "layerjax.transport.discrete.inverse",
    "layerjax.transport.discrete.operators",
    "layerjax.transport.discrete.sampling",
    "layerjax.transport.discrete.media",
    "layerjax.transport.statistics",
    "layerjax.transport.statistics.variance",
    "layerjax.transport.statistics.visible",
    "layerjax.transport.statistics.returns",
    "layerjax.transport.statistics.energies",
    "layerjax.transport.discrete.interfaces",
    "layerjax.transport.discrete.solve",
    "layerjax.transport.discrete.tables",
    "layerjax.transport.adding_doubling",
    "layerjax.transport.spongecake_mapping",
    "layerjax.transport.spongecake_layers",
    "layerjax.transport.spongecake_bend",
    "layerjax.transport.spongecake_lobes",
    "layerjax.transport.spongecake",
    "layerjax.transport.endf_warping",
    "layerjax.transport.endf_chains",
    "layerjax.transport.endf_slab",
    "layerjax.transport.endf_drawing",
    "layerjax.transport.endf",
    "layerjax.transport.weidlich_wilkie",
    "layerjax.transport.statistics.adding",
    "layerjax.transport.statistics.lobes",
    "layerjax.transport.statistics.tables",
    "layerjax.transport.statistics.diffuse",
    "layerjax.precomputed.vmf_diffuse_solver",
    "layerjax.precomputed.vmf_diffuse",
    "layerjax.precomputed.shares",
    "layerjax.precomputed.diffuse_interface",
    "layerjax.transport.statistics.diffuse_base",
    "layerjax.transport.statistics.diffuse_lobe",
    "layerjax.transport.statistics.drawing",
    "layerjax.transport.statistical",
    "layerjax.transport",
    "layerjax.transport.automatic",
    "layerjax.evaluate",
    "layerjax.goniophotometer",
    "layerjax",
    "layerjax.gallery",
    "layerjax.precomputed.microsurface",
    "layerjax.precomputed.learning",
    "layerjax.precomputed.spongecake_data",
    "layerjax.precomputed.spongecake_training",
    "layerjax.precomputed.spongecake_energy",
    "layerjax.precomputed.spongecake_bending",
    "layerjax.precomputed.spongecake",
    "layerjax.precomputed.__main__",
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
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (name if name in LAYERS else node.module for name in names)


def sources(package):
    return sorted((ROOT / package).rglob("*.py"))


@pytest.mark.parametrize("path", sources("layerjax"), ids=module_name)
def test_layerjax_imports_point_downward(path):
    name = module_name(path)
    assert name in LAYERS, f"{name} has no place in LAYERS"
    for other in imported(path):
        root = other.split(".")[0]
        trains = {"optax"} if name == "layerjax.precomputed.learning" else set()  # inside a function there
        assert root in {*sys.stdlib_module_names, "jax", "equinox", "numpy", "layerjax", *trains}
        if root == "layerjax":
            assert LAYERS.index(other) < LAYERS.index(name), f"{name} imports {other}"


@pytest.mark.parametrize("path", sources("fits"), ids=module_name)
def test_fits_does_not_import_benchmarks_or_tests(path):
    assert not {other.split(".")[0] for other in imported(path)} & {"benchmarks", "tests"}


def loaded_by(statement):
    code = f"import sys; {statement}; print(*sorted(name.split('.')[0] for name in sys.modules))"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    return set(output.split())


def test_importing_layerjax_loads_only_jax_equinox_numpy():
    assert loaded_by("import layerjax") - loaded_by("import jax, equinox, numpy") == {"layerjax"}


def test_importing_fits_pays_for_nothing_unused():
    assert not loaded_by("import fits") & {"arviz", "matplotlib", "jaxopt", "h5py", "rich", "emcee", "optimistix"}


def test_public_names_stay_functions_whatever_is_imported_first():
    code = "import fits.compare, fits.report, fits.simulate; print(*(callable(getattr(fits, n)) for n in fits.__all__))"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    assert set(output.split()) == {"True"}
