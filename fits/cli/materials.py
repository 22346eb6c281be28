"""Commands on a material: simulate measurements of it, draw it, write it for renderers."""

from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fits._files import write_bytes
from fits.cli.input_output import DONE, require_free_place, use_jax
from fits.data.measurements import Measurements
from fits.data.totals import Totals
from fits.progress import show_progress

if TYPE_CHECKING:
    from fits.optimise.result import Fit
    from layerjax import Mixture, Stack


def simulate(arguments: Namespace) -> int:
    """Write simulated measurements of a stack; noise, scale and instrument of its file are not simulated."""
    require_free_place(arguments.out, arguments.force, ".csv", "measurements")
    use_jax()
    from fits.data.geometry import slices
    from fits.problem.simulate import simulate as run_simulation
    from fits.problem.stack_file import read_problem

    given = read_problem(arguments.stack)
    geometry = slices([theta for several in arguments.incidence for theta in several], azimuth=arguments.azimuth)
    data = run_simulation(
        _at_start(given.stack), geometry, transport=given.transport, noise=arguments.noise, seed=arguments.seed
    )
    return write_measurements(data, arguments)


def write_measurements(data: Measurements, arguments: Namespace) -> int:
    """Write them as csv, and print their number."""
    from fits.data.formats.csv import write_csv

    what, quantity = "measurements", "BRDF in 1/sr"
    if isinstance(data, Totals):
        what, quantity = "totals", "shares of the incident flux"
        if data.spheres is not None:
            raise ValueError(f"{data.source.path}: integrating spheres measured these, which a CSV cannot describe")
    write_csv(data, arguments.out, force=arguments.force)
    print(f"{arguments.out}: {len(data)} {what}, {len(data.channels)} channels, {quantity}")
    return DONE


def render(arguments: Namespace) -> int:
    """Draw a material of the gallery, or of a file, or the best of a saved fit."""
    require_free_place(arguments.out, arguments.force, ".png", "pictures")
    use_jax()
    from fits.optimise.result import Fit
    from fits.reports.plots.data import as_png
    from fits.reports.render import render as run_render
    from layerjax import Transport

    name = arguments.material
    material, transport = _material(name)
    if isinstance(material, Fit):
        material.require_one("render")
        used = material.problem.transport
        material, transport = material.stack, used if isinstance(used, Transport) else None
    figure = run_render(material, transport, title=Path(name).resolve().stem.replace("_", " "))
    write_bytes(arguments.out, as_png(figure), force=arguments.force)
    print(f"{arguments.out}: {name}")
    return DONE


def export(arguments: Namespace) -> int:
    """Write a material, or the best of a saved fit, for renderers or for optical design."""
    require_free_place(arguments.out, arguments.force)
    use_jax()
    from fits.exports.export import export as run_export

    name = arguments.material
    material, transport = _material(name)
    with show_progress() as progress:
        written = run_export(
            material,
            arguments.out,
            arguments.to,
            transport=transport,
            wavelengths=arguments.wavelengths,
            name=Path(name).resolve().stem,
            force=arguments.force,
            progress=progress,
        )
    print(f"{written.path}: {Path(name).name}")
    for note in written.notes:
        print(f"{note[0].upper()}{note[1:]}.")
    return DONE


def _material(name: str) -> "tuple[Fit | Stack | Mixture, Any]":
    """A saved fit, or a stack of the gallery or of a file, at its start; and its transport, None if not given."""
    from fits.problem.stack_file import read_problem
    from fits.reports.results import load_fit
    from layerjax import gallery

    if Path(name).is_dir():
        return load_fit(name), None
    if name in gallery.names():
        return gallery.stack(name), None
    if Path(name).suffix == ".toml":
        given = read_problem(name)
        return _at_start(given.stack), None if given.transport == "auto" else given.transport
    raise ValueError(f"{name}: neither a .toml file nor a material of the gallery: {', '.join(gallery.names())}")


def _at_start(stack: "Stack | Mixture") -> "Stack | Mixture":
    """The stack with every free parameter at its start value."""
    import jax

    from fits.problem.parameters import is_free, with_values

    return with_values(jax.tree.map(lambda leaf: leaf.arrays()[0] if is_free(leaf) else leaf, stack, is_leaf=is_free))
