"""Whether a search finds the stack behind simulated data: where among all structures the true one is ranked."""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import equinox as eqx
import numpy as np

import fits
import layerjax as lj
from benchmarks.measuring import environment
from benchmarks.measuring.writing import DIRECTORY, environment_lines, rounded, table, write
from benchmarks.suite import coated_haze
from fits.data.measurements import Measurements
from fits.engines import Failure, run
from fits.problem.compilation import cores
from fits.structure_search import Library, Structure, default_library, named

NAME = "structures"
REPEATS, QUICK = 40, 4
TRANSPORT = lj.Statistical()
NOISE = 0.02
STARTS = 4
FIRST, WANTED = 3, 36
"""The true structure is required to be among so many first in so many of all."""

WHOLE = default_library()
FORWARD = lj.HenyeyGreenstein(fits.Free(0.3, 0.0, 0.9))
"""The transport does not follow what is scattered backwards: no g below 0 means anything to it."""
LIBRARY = Library(
    {
        "interface": WHOLE.layers["interface"],
        "haze": eqx.tree_at(lambda haze: haze.phase, WHOLE.layers["haze"], FORWARD),
    },
    {name: WHOLE.bases[name] for name in ("diffuse", "metal")},
)

MATERIALS = {
    "ior": (1.3, 1.8),
    "alpha": (0.1, 0.5),
    "thickness": (0.2, 1.5),
    "g": (0.0, 0.6),
    "albedo": (0.2, 0.8),
    "metal": (0.3, 2.0),
    "k": (1.0, 6.0),
}
"""The numbers of layers and bases are drawn from these ranges, uniformly."""

TRUTHS: tuple[Structure, ...] = tuple(
    (*layers, base)
    for layers in (
        ("interface",),
        ("haze",),
        ("interface", "haze"),
        ("haze", "interface"),
        ("interface", "haze", "interface"),
        ("haze", "interface", "haze"),
    )
    for base in LIBRARY.bases
)

TEXT = """\
# Structures that a search finds

{environment}
{repeats} materials of one to three layers with numbers drawn at random, measured at 10, 30, 50 and 70 degrees of
incidence with noise of {noise:.0%}. `fits.search` looks for the stack among those that an interface and haze
over a diffuse base and a metal make, up to three layers. Data and fits are by `{transport}`, all orders of
scattering by their moments: this judges the search, not how well a transport describes a material.

{rows}
*first*, *first three*: how often the true structure is ranked there. *wrong preferred*: how often another structure has
a higher elpd by more than chance (see `ModelScore.clear_diff`); *too complex*: how often that one has more layers.
*fitted*: structures fitted in a search, *time*: that of a search on one core, both in the median.

The true structure is among the first three in {found} of {repeats} (required: {wanted} of {required}); a more complex
one is preferred by more than chance in {complex}.
"""


@dataclass(frozen=True)
class Repeat:
    """One material: its structure, the place of that in the result (0: the first; None: not fitted), the best one,
    the elpd difference of the true one from it, the same beyond chance, and how many structures were fitted."""

    repeat: int
    truth: str
    place: int | None
    best: str
    elpd_diff: float | None
    clear_diff: float | None
    fitted: int
    seconds: float

    @property
    def layers(self) -> int:
        """Layers of the true stack."""
        return self.truth.count("/")

    @property
    def is_wrong_preferred(self) -> bool:
        """Whether another structure is preferred by more than chance."""
        return self.clear_diff is None or self.clear_diff > 0.0


def study(
    quick: bool = False,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    resume: bool = False,
    repeats: int | None = None,
    processes: int | None = None,
) -> tuple[str, tuple[Path, ...]]:
    """Run it, and write ``structures.json`` and ``.md``; returns the markdown and the paths.

    Args:
        quick: 4 materials: a look, no result to quote.
        resume: keep the materials that the directory holds, and run those that it lacks.
        repeats: how many there are to be in all; 40 if None.
        processes: materials at a time, a process each; one for each core if None. 1: by threads, one a core.
    """
    wanted = repeats or (QUICK if quick else REPEATS)
    path = directory / f"{NAME}.json"
    done = [Repeat(**one) for one in json.loads(path.read_text())["repeats"]] if resume and path.exists() else []
    left = sorted(set(range(wanted)) - {one.repeat for one in done})
    for _, found in run(_work, None, left, processes=processes or cores()):
        if isinstance(found, Failure):
            raise ValueError(found.error)
        done = sorted([*done, found], key=lambda one: one.repeat)
        _save(done, directory)
        report(f"material {len(done)}/{wanted}: {found}")
    return _save(done, directory)


def _work(_: None, index: int) -> Repeat:
    return run_repeat(index)


def material(index: int) -> tuple[Structure, Measurements]:
    """A structure, and measurements of a stack with numbers that are drawn at random."""
    structure = TRUTHS[index % len(TRUTHS)]
    generator = np.random.default_rng([2026, index])

    def number(name: str) -> float:
        return float(generator.uniform(*MATERIALS[name]))

    layers: list[lj.Interface | lj.Medium] = [
        lj.Interface(number("ior"), number("alpha"))
        if name == "interface"
        else lj.Medium(number("thickness"), 1.0, lj.HenyeyGreenstein(number("g")))
        for name in structure[:-1]
    ]
    diffuse = structure[-1] == "diffuse"
    base = lj.Lambertian(number("albedo")) if diffuse else lj.Conductor(number("metal"), number("k"), number("alpha"))
    data = fits.simulate(lj.Stack(layers, base), coated_haze.goniometer_slices(), TRANSPORT, NOISE, 1e-6, seed=index)
    return structure, Measurements(data.wi, data.wo, data.values, None, data.mask, data.channels, data.source)


def run_repeat(index: int) -> Repeat:
    """A search for the stack behind one material."""
    began = time.perf_counter()
    structure, data = material(index)
    noise = fits.Noise(relative=NOISE, floor=1e-6)
    options = fits.SearchOptions(layers=3, starts=STARTS)
    found = fits.search(data, LIBRARY, transport=TRANSPORT, noise=noise, seed=index, options=options)
    places = [place for place, one in enumerate(found.candidates) if one.structure == structure and one.model_score]
    score = found.candidates[places[0]].model_score if places else None
    return Repeat(
        repeat=index,
        truth=named(structure),
        place=places[0] if places else None,
        best=found.best.name,
        elpd_diff=None if score is None else score.elpd_diff,
        clear_diff=None if score is None else score.clear_diff,
        fitted=len(found.candidates),
        seconds=time.perf_counter() - began,
    )


def _save(done: list[Repeat], directory: Path) -> tuple[str, tuple[Path, Path]]:
    surroundings = environment.describe()
    by_layers = {
        f"{count} layer{'s' * (count > 1)}": [one for one in done if one.layers == count] for count in (1, 2, 3)
    }
    rows = [_row(kind, found) for kind, found in (by_layers | {"all": done}).items() if found]
    heads = ("true stack", "materials", "first", "first three", "wrong preferred", "too complex", "fitted", "time")
    text = TEXT.format(
        environment=environment_lines(surroundings),
        repeats=len(done),
        noise=NOISE,
        transport=TRANSPORT,
        rows=table(heads, rows),
        found=sum(_among_first(one) for one in done),
        wanted=WANTED,
        required=REPEATS,
        complex=sum(map(_too_complex, done)),
    )
    content = {"environment": surroundings, "repeats": [rounded(asdict(one)) for one in done]}
    return text, write(NAME, content, text, directory)


def _among_first(one: Repeat) -> bool:
    return one.place is not None and one.place < FIRST


def _too_complex(one: Repeat) -> bool:
    return one.is_wrong_preferred and one.best.count("/") > one.layers


def _row(kind: str, repeats: list[Repeat]) -> tuple[str, ...]:
    counts = (
        sum(one.place == 0 for one in repeats),
        sum(map(_among_first, repeats)),
        sum(one.is_wrong_preferred for one in repeats),
        sum(map(_too_complex, repeats)),
    )
    fitted, seconds = (float(np.median([getattr(one, name) for one in repeats])) for name in ("fitted", "seconds"))
    return kind, str(len(repeats)), *map(str, counts), f"{fitted:.0f}", f"{seconds:.0f} s"
