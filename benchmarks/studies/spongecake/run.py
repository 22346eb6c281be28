"""SpongeCake's multiple scattering beside the truth: errors of held-out materials, energy, the paper's figures, fits.

The held-out materials are those that `layerjax.precompute.spongecake.data` draws for testing; their multiple
scattering is solved once and kept in the folder given as `work`.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import fits
import layerjax as lj
from benchmarks.measuring import environment
from benchmarks.measuring.writing import DIRECTORY, write
from benchmarks.studies.spongecake.cost import ROUNDS, costs
from benchmarks.studies.spongecake.tables import Errors, Figure, Findings, Fitted, Furnace, Gain, Settings, markdown
from layerjax.normals.sggx import Kind
from layerjax.precompute.learning import Schedule
from layerjax.precompute.spongecake import data as materials
from layerjax.precompute.spongecake import training
from layerjax.precompute.spongecake.maker import PLANS, SEED
from layerjax.precompute.spongecake.training import ENERGY_WEIGHT, LobeFeatures

KINDS: tuple[Kind, ...] = ("surface", "fiber")
CAKE, FIRST = lj.SpongeCake(), lj.SingleScattering()
COUNTS, QUICK_COUNTS = PLANS[False].test, (64, 64)

GAINS, QUICK_GAINS = (1024, 150), (64, 5)
"""Materials learned from, and epochs, where the gain of each step is measured."""

ANGLES = (0.0, 30.0, 50.0, 70.0, 80.0)
"""Degrees of incidence in the furnace."""

NODES = 32
"""Quadrature of albedos."""

NARROW = 0.3
"""Roughness of fibers below which the paper names its failure case."""

WALKS, QUICK_WALKS = 1 << 18, 1 << 14
POINTS = 1 << 13
"""Paths of the walk: for energies, and for each point value."""


def study(
    quick: bool = False,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    work: Path = Path("spongecake-data"),
) -> tuple[str, tuple[Path, ...]]:
    """Measure, and write ``spongecake.json`` and ``.md`` into the directory; returns the markdown and the paths."""
    settings = Settings(
        QUICK_COUNTS if quick else COUNTS,
        ANGLES,
        QUICK_WALKS if quick else WALKS,
        ROUNDS,
        *(QUICK_GAINS if quick else GAINS),
    )
    found = Findings()
    for media, count in enumerate(settings.counts, start=1):
        samples = _solved(work, count, media, report)
        found.errors.extend(held_out(samples, media))
        report(f"media {media}: errors")
        found.furnace.extend(furnace(samples, media))
        report(f"media {media}: furnace")
    found.gains.extend(gains(work, settings.gain_materials, settings.gain_epochs, report))
    for name, stack, which in list(figures())[:: 6 if quick else 1]:
        found.figures.append(drawn_figure(name, stack, which, settings.paths))
        report(f"figures: {name}")
    for name, phase, truth in thick()[:: 5 if quick else 1]:
        found.fits.append(fit(name, phase, truth))
        report(f"fits: {name}: bias {found.fits[-1].cake_bias:.3f}, single scattering {found.fits[-1].first_bias:.3f}")
    found.costs.extend(costs(quick))
    report(f"costs: at most {max(row.ratio for row in found.costs):.2f} times single scattering")
    surroundings = environment.describe()
    text = markdown(surroundings, settings, found)
    content = {"environment": surroundings, "quick": quick, **asdict(found)}
    return text, write("spongecake", content, text, directory)


def _solved(work: Path, count: int, media: int, report: Callable[[str], None]) -> materials.Samples:
    """The held-out materials with their truth, kept in the folder `work`."""
    for there in materials.make(work, count, media, "test", SEED):
        report(f"media {media}: truth of {there} of {count}")
    return materials.load(work, count, media, "test", SEED)


def lobes_alone(stack: lj.Stack) -> lj.Prepared:
    """The stack made ready for SpongeCake without the factor that puts energies right."""
    return eqx.tree_at(lambda ready: ready.state.second.energy_correction, lj.prepare(stack, CAKE), None)


Ready = Callable[[lj.Stack], lj.Prepared]
WAYS: tuple[Ready, ...] = (lobes_alone, partial(lj.prepare, transport=CAKE))


def gains(work: Path, count: int, epochs: int, report: Callable[[str], None]) -> list[Gain]:
    """The gain of each step beyond the paper: the same short training with more and more of them, one medium."""
    for _ in materials.make(work, count, 1, "train", SEED):
        pass
    learned, test = materials.load(work, count, 1, "train", SEED), materials.load(work, count // 2, 1, "test", SEED)
    lossless = np.minimum(test.layers.albedo, test.layers.f0).min(axis=1) == 1.0
    none = LobeFeatures(False, False, False, False)
    steps = {
        "as in the paper: one weight for both sides": (none, ENERGY_WEIGHT),
        "reflection and transmission apart": (none._replace(by_side=True), ENERGY_WEIGHT),
        "and blurred": (LobeFeatures(rim=False, slopes=False), ENERGY_WEIGHT),
        "and with a Schlick term": (LobeFeatures(slopes=False), ENERGY_WEIGHT),
        "and with slopes: as it ships": (LobeFeatures(), ENERGY_WEIGHT),
        "the same without the penalty on energy": (LobeFeatures(), 0.0),
    }
    rows = []
    with jax.enable_x64(False):
        batch = training.batch_of(test)
        for name, (parts, energy) in steps.items():
            schedule = Schedule(epochs=epochs)
            net, _ = training.train(1, learned, SEED, schedule, None, lambda line: None, energy, parts)
            norms, albedos = training.errors(net, batch, parts)
            size = np.sqrt(np.sum(norms**2, axis=1))
            full, multiple = (100 * size / np.sqrt(np.sum(s**2, axis=1)) for s in (batch.size, batch.size_multiple))
            lost = 100 * np.mean(np.abs(albedos.sum(axis=1)), axis=1)[lossless]
            rows.append(Gain(name, *(_middle_and_high(values) for values in (full, multiple, lost))))
            report(f"gains: {name}: {rows[-1].full[0]:.2f} %")
    return rows


def _middle_and_high(values: NDArray) -> tuple[float, float]:
    middle, high = np.percentile(values[np.isfinite(values)], (50, 95))
    return float(middle), float(high)


def groups(samples: materials.Samples, media: int) -> dict[str, NDArray[np.bool_]]:
    """Rows of each kind of material."""
    kind, alpha = samples.layers.kind, samples.layers.alpha
    every = np.ones(len(kind), bool)
    found = {"all": every}
    for each in itertools.product(range(len(materials.KINDS)), repeat=media):
        name = " over ".join("haze" if materials.KINDS[k] == "hg" else materials.KINDS[k] for k in each)
        found[name] = np.all(kind == each, axis=1)
    fiber = (kind == materials.KINDS.index("fiber")) & (alpha < NARROW)
    found[f"with fibers of alpha < {NARROW:g}"] = fiber.any(axis=1)
    return {name: rows for name, rows in found.items() if rows.any()}


def held_out(samples: materials.Samples, media: int) -> list[Errors]:
    """Errors of the held-out materials, by kind."""
    lobes, cake = (_values(samples, ready) for ready in WAYS)
    first = _values(samples, partial(lj.prepare, transport=FIRST))
    truth = first + samples.values
    weight = np.abs(samples.wi[..., 2])[:, (0, 1, 0), :, None]

    def norm(x: NDArray, sides: Sequence[int]) -> NDArray:
        return np.sqrt(np.sum((weight * x * x)[:, list(sides)], axis=(1, 2, 3)))

    lit = (0, 2) if media == 1 else (0, 1, 2)

    def relative(values: NDArray, sides: Sequence[int], size: NDArray = truth) -> NDArray:
        return 100 * norm(values - truth, sides) / np.maximum(norm(size, sides), 1e-12)

    # what next to nothing passes through has no relative error
    passes = norm(truth, (2,)) > 1e-4 * norm(truth, (0,))
    rows = []
    for name, chosen in groups(samples, media).items():

        def both(values: NDArray, chosen: NDArray = chosen) -> tuple[float, float]:
            return _middle_and_high(values[chosen])

        through = [np.where(passes, relative(cake, (2,), size), np.nan) for size in (truth, samples.values)]
        rows.append(
            Errors(
                name,
                media,
                int(chosen.sum()),
                both(relative(cake, lit)),
                both(relative(cake, lit, samples.values)),
                both(relative(cake, (0,))),
                both(through[0]),
                both(relative(cake, (0,), samples.values)),
                both(through[1]),
                both(relative(first, lit)),
                both(relative(lobes, lit)),
            )
        )
    return rows


def furnace(samples: materials.Samples, media: int) -> list[Furnace]:
    """Energy of the held-out materials with their absorption taken away, by kind."""
    wi = jnp.asarray(lj.direction(jnp.deg2rad(jnp.asarray(ANGLES)), 0.4), jnp.float32)
    found = np.zeros((len(WAYS), len(samples.values), len(ANGLES)))
    for rows, make, numbers in _structures(samples):

        def total(numbers: dict, make: Callable = make) -> jax.Array:
            white = {**numbers, "albedo": jnp.ones_like(numbers["albedo"]), "f0": jnp.ones_like(numbers["f0"])}
            stack = make(white)
            scattered = [sum(lj.albedo(ready(stack), wi, nodes=NODES)) for ready in WAYS]
            return (jnp.stack(scattered) + lj.unscattered(stack, wi))[..., 0]

        found[:, rows] = jnp.swapaxes(jax.lax.map(jax.jit(total), numbers), 0, 1)
    apart = 100 * np.abs(found - 1.0)
    return [
        Furnace(name, media, int(rows.sum()), *(_middle_and_high(each[rows]) for each in apart))
        for name, rows in groups(samples, media).items()
    ]


def _structures(samples: materials.Samples) -> Any:
    """Materials of one structure: their rows, what makes a stack of numbers, and these."""
    layers = samples.layers
    level = np.all(layers.axis[..., 2] == 1.0, axis=1)
    for key in sorted({(*kind, flat) for kind, flat in zip(layers.kind.tolist(), level.tolist(), strict=True)}):
        *kind, flat = key
        rows = np.flatnonzero(np.all(layers.kind == kind, axis=1) & (level == flat))
        names = tuple(materials.KINDS[k] for k in kind)
        numbers = {
            name: jnp.asarray(array[rows], jnp.float32) for name, array in vars(layers).items() if name != "kind"
        }
        yield rows, lambda numbers, names=names, flat=flat: materials.stack_of(names, not flat, numbers), numbers


def _values(samples: materials.Samples, ready: Ready) -> NDArray[np.float64]:
    """BSDF at the pairs of the samples, (n, 3, i, o)."""
    found = np.zeros(samples.values.shape)
    lit = samples.wi[:, (0, 1, 0)]
    for rows, make, numbers in _structures(samples):

        @eqx.filter_jit
        def one(arguments: tuple, make: Callable = make) -> jax.Array:
            numbers, wi, wo = arguments
            return lj.evaluate(ready(make(numbers)), wi[..., None, :], wo)[..., 0]

        found[rows] = jax.lax.map(one, (numbers, jnp.asarray(lit[rows]), jnp.asarray(samples.wo[rows])))
    return found


def figures() -> Any:
    """Materials of Figs. 8 to 13: a name, the stack, and which figures show such."""
    along = (1.0, 0.0, 0.0)
    for kind, alpha, depth in itertools.product(KINDS, (0.2, 0.5, 0.9), (0.5, 2.0, 10.0)):
        phase = lj.SGGX(kind, alpha, along if kind == "fiber" else None)
        yield f"{kind} {alpha:g}, T {depth:g}", lj.Stack([lj.Medium(depth, 1.0, phase)]), "8-10"
    top = lj.Medium(1.0, 0.9, lj.SGGX("fiber", 0.3, along))
    for kind, alpha, depth in itertools.product(KINDS, (0.3, 0.8), (1.0, 5.0)):
        phase = lj.SGGX(kind, alpha, (0.0, 1.0, 0.0) if kind == "fiber" else None)
        stack = lj.Stack([top, lj.Medium(depth, 0.9, phase)])
        yield f"fiber 0.3, T 1 over {kind} {alpha:g}, T {depth:g}", stack, "11-13"


def drawn_figure(name: str, stack: lj.Stack, which: str, paths: int) -> Figure:
    """One material of the figures beside the walk."""
    wi = lj.direction(np.deg2rad(30.0), 0.0)
    seen = lj.goniophotometer(stack, wi, key=jax.random.key(1), paths=paths, polar=1, azimuth=1)
    polar = np.deg2rad([*range(5, 90, 17), *range(95, 180, 17)])
    wo = lj.direction(np.tile(polar, 4), np.repeat(np.deg2rad([0.0, 90.0, 180.0, 270.0]), len(polar)) + 0.02)
    truth, noise = lj.evaluate_with_error(stack, wi, wo, lj.RandomWalk(paths=POINTS), key=jax.random.key(2))
    single, both = (lj.evaluate(stack, wi, wo, how) for how in (FIRST, CAKE))
    weight = np.abs(np.asarray(wo)[:, 2:])

    def norm(x: Any) -> float:
        return float(np.sqrt(np.sum(weight * np.asarray(x) ** 2)))

    def energies(how: lj.Transport) -> tuple[float, float]:
        near, far = lj.albedo(stack, wi, how, nodes=NODES)
        return float(near[0]), float(far[0])

    albedo, error = np.asarray(seen.albedo)[:, 0], np.asarray(seen.albedo_error)[:, 0]
    return Figure(
        which,
        name,
        (float(albedo[0]), float(albedo[1])),
        (float(error[0]), float(error[1])),
        energies(FIRST),
        energies(CAKE),
        *(100 * norm(x) / norm(truth) for x in (single - truth, both - truth, noise)),
    )


def thick() -> list[tuple[str, Callable[[Any], Any], tuple[float, float, float]]]:
    """Ten thick materials: a name, their phase function of alpha, and alpha (g), thickness and albedo."""
    tilted = (0.3, 0.0, 0.95)
    kinds: dict[str, Callable[[Any], Any]] = {
        "surface": lambda alpha: lj.SGGX("surface", alpha),
        "surface, tilted": lambda alpha: lj.SGGX("surface", alpha, tilted),
        "fiber": lambda alpha: lj.SGGX("fiber", alpha),
        "fiber, in the plane": lambda alpha: lj.SGGX("fiber", alpha, (1.0, 0.0, 0.0)),
        "haze": lj.HenyeyGreenstein,
    }
    numbers = {False: (0.5, 4.0, 0.95), True: (0.3, 8.0, 0.85)}
    return [
        (f"{name}, {'darker' if dark else 'bright'}", phase, numbers[dark])
        for name, phase in kinds.items()
        for dark in numbers
    ]


def fit(name: str, phase: Callable[[Any], Any], truth: tuple[float, float, float]) -> Fitted:
    """Alpha (or g), thickness and albedo from slices with 1 % noise, by both models."""

    def stack(alpha: Any, thickness: Any, albedo: Any) -> lj.Stack:
        return lj.Stack([lj.Medium(thickness, albedo, phase(alpha))])

    view = fits.slices(incidence=[10, 30, 50, 70])
    data = fits.simulate(stack(*truth), view, lj.AddingDoubling(), noise=0.01, seed=1)
    free = stack(fits.Free(0.4, 0.05, 0.95), fits.Free(3.0, 0.3, 30.0), fits.Free(0.9, 0.3, 1.0))
    found = []
    for how in (CAKE, FIRST):
        best = fits.fit(free, data, transport=how, starts=2, seed=0).stack.layers[0]
        alpha = best.phase.g if isinstance(best.phase, lj.HenyeyGreenstein) else best.phase.alpha
        found.append((float(alpha), float(best.thickness), float(best.albedo)))

    def bias(values: tuple[float, ...]) -> float:
        apart = (np.log(values[0] / truth[0]), np.log(values[1] / truth[1]), values[2] - truth[2])
        return float(np.sqrt(np.mean(np.square(apart))))

    return Fitted(name, truth, found[0], found[1], bias(found[0]), bias(found[1]))
