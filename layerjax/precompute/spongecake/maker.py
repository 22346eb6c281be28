"""Makes the networks of `layerjax.transport.spongecake.transport`: data from `AddingDoubling`, then training.

Networks of the second lobe come first, then those that put its energy right, which are learned beside the former. The
shards of data and the state of a training lie in a folder from which interrupted work resumes.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from numpy.typing import NDArray

from layerjax.precompute.learning import Schedule
from layerjax.precompute.spongecake import data, energy_correction, training
from layerjax.precompute.spongecake.data import Split
from layerjax.transport.spongecake.mapping import pack

Report = Callable[[str], Any]

SEED = 2022


@dataclass(frozen=True)
class TrainingPlan:
    """How much is learned from and tested with, and for how long. Materials by the number of their media: one, two."""

    train: tuple[int, int]
    test: tuple[int, int]
    schedule: Schedule


PLANS = {
    False: TrainingPlan((4096, 4608), (640, 512), Schedule()),
    True: TrainingPlan((64, 64), (32, 32), Schedule(epochs=20, batch=16)),
}
"""By whether the networks are coarse: of second lobes."""

CORRECTION_PLANS = {
    False: TrainingPlan((30720, 30720), (2048, 2048), Schedule(epochs=150, batch=128)),
    True: TrainingPlan((256, 256), (256, 256), Schedule(epochs=10, batch=32)),
}
"""And of what puts their energy right."""

PERCENTILES = (50, 95)


def make(coarse: bool = False, work: Path = Path("spongecake-data"), report: Report = print) -> dict[str, NDArray]:
    """The networks' numbers, and a record of how they were made and of how exact they are.

    Returns:
        M-N-weight, M-N-bias: layers N of the network for M media. seed. M-materials: learned from, tested with.
        M-schedule: epochs, batch, rate. M-curve: mean loss of each epoch. M-error: median and 95th percentile of the
        relative L2 error of materials never seen, of the whole BSDF and of multiple scattering alone (2, 2). The same
        as M-bend-... of what puts energies right; M-bend-error: of what is missing of the energy of light from one
        direction (2,).

    Made again on the same machine, the table is the same to the bit. Elsewhere rounding grows while networks learn, and
    their numbers differ.
    """
    table: dict[str, NDArray] = {"seed": np.asarray(SEED)}
    for media in (1, 2):
        net, numbers = _second_lobe(media, PLANS[coarse], work, report)
        corrections = _energy_correction(media, net, CORRECTION_PLANS[coarse], work, report)
        table |= {f"{media}-{name}": value for name, value in numbers.items()}
        table |= {f"{media}-bend-{name}": value for name, value in corrections.items()}
    return table


def _second_lobe(media: int, plan: TrainingPlan, work: Path, report: Report) -> tuple[eqx.nn.MLP, dict[str, NDArray]]:
    """The network, and its numbers and record by name."""
    count, tested, schedule = plan.train[media - 1], plan.test[media - 1], plan.schedule
    splits: tuple[tuple[Split, int], ...] = (("train", count), ("test", tested))
    for split, wanted in splits:
        for there in data.make(work, wanted, media, split, SEED):
            report(f"media {media}: {split} {there}/{wanted}")

    def say(line: str) -> None:
        report(f"media {media}: {line}")

    with jax.enable_x64(False):
        learned = data.load(work, count, media, "train", SEED)
        net, curve = training.train(media, learned, SEED, schedule, work / _state(media, plan), say)
        batch = training.batch_of(data.load(work, tested, media, "test", SEED))
        apart = np.sqrt(np.sum(training.errors(net, batch)[0] ** 2, axis=1))
    relative = [apart / np.sqrt(np.sum(size**2, axis=1)) for size in (batch.size, batch.size_multiple)]
    error = np.percentile(relative, PERCENTILES, axis=1).T
    report(f"media {media}: relative L2 error, median and 95th percentile: {error.round(4).tolist()}")
    return net, pack(net) | _record(media, plan, curve, error)


def _energy_correction(
    media: int, net: eqx.nn.MLP, plan: TrainingPlan, work: Path, report: Report
) -> dict[str, NDArray]:
    """Numbers and record by name of the network that puts the energy of another right."""
    count, tested = plan.train[media - 1], plan.test[media - 1]
    own = work / f"{hashlib.sha256(b''.join(part.tobytes() for part in pack(net).values())).hexdigest()[:12]}"
    for there in energy_correction.make(own, count + tested, media, {media: net}, SEED):
        report(f"media {media}: energy: {there}/{count + tested}")
    corrections = energy_correction.load(own, count + tested, media, SEED)
    learned, held_out = (
        energy_correction.select(corrections, slice(count)),
        energy_correction.select(corrections, slice(count, None)),
    )

    def say(line: str) -> None:
        report(f"media {media}: energy: {line}")

    with jax.enable_x64(False):
        network, curve = energy_correction.train(media, learned, SEED, plan.schedule, own / _state(media, plan), say)
        error = np.percentile(np.abs(energy_correction.errors(network, held_out)), PERCENTILES)
    report(f"media {media}: energy: missing energy, median and 95th percentile: {error.round(4).tolist()}")
    return pack(network) | _record(media, plan, curve, error)


def _record(media: int, plan: TrainingPlan, curve: NDArray, error: NDArray) -> dict[str, NDArray]:
    schedule = plan.schedule
    return {
        "materials": np.asarray((plan.train[media - 1], plan.test[media - 1])),
        "schedule": np.asarray([schedule.epochs, schedule.batch, schedule.rate]),
        "curve": curve,
        "error": error,
    }


def _state(media: int, plan: TrainingPlan) -> str:
    """Name of the file that a training resumes from."""
    return f"state-{media}-{SEED}-{plan.train[media - 1]}-{plan.schedule.epochs}-{plan.schedule.batch}.eqx"
