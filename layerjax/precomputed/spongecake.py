"""Makes the networks of `layerjax.transport.spongecake`: data from `AddingDoubling`, then training.

The shards of data and the state of a training lie in a folder that the work goes on from when it is interrupted.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from layerjax.precomputed.spongecake_data import Split, load
from layerjax.precomputed.spongecake_data import make as make_samples
from layerjax.precomputed.spongecake_training import Batch, Schedule, batch_of, errors, train
from layerjax.transport.spongecake_mapping import pack

SEED = 2022


@dataclass(frozen=True)
class Plan:
    """How much is learned from, and for how long. Materials by the number of their media: one, two."""

    train: tuple[int, int]
    test: tuple[int, int]
    schedule: Schedule


PLANS = {
    False: Plan((4096, 4608), (640, 512), Schedule()),
    True: Plan((64, 64), (32, 32), Schedule(epochs=20, batch=16)),
}
"""By whether the networks are coarse."""

PERCENTILES = (50, 95)


def make(
    coarse: bool = False, work: Path = Path("spongecake-data"), report: Callable[[str], Any] = print
) -> dict[str, NDArray]:
    """The networks' numbers, and a record of how they were made and of how exact they are.

    Returns:
        M-N-weight, M-N-bias: layers N of the network for M media. seed. M-materials: learned from, tested with.
        M-schedule: epochs, batch, rate. M-curve: mean loss of each epoch. M-error: median and 95th percentile of the
        relative L2 error of materials never seen, of the whole BSDF and of multiple scattering alone (2, 2).
    """
    plan = PLANS[coarse]
    table: dict[str, NDArray] = {"seed": np.asarray(SEED)}
    for media, counts in enumerate(zip(plan.train, plan.test, strict=True), start=1):
        splits: tuple[Split, ...] = ("train", "test")
        for split, count in zip(splits, counts, strict=True):
            for there in make_samples(work, count, media, split, SEED):
                report(f"media {media}: {split} {there}/{count}")
        schedule = plan.schedule
        state = work / f"state-{media}-{SEED}-{counts[0]}-{schedule.epochs}-{schedule.batch}.eqx"
        with jax.enable_x64(False):
            net, curve = train(media, load(work, counts[0], media, "train", SEED), SEED, schedule, state, report)
            full, multiple = relative_errors(batch_of(load(work, counts[1], media, "test", SEED)), net)
        table |= pack(net, media)
        table[f"{media}-materials"] = np.asarray(counts)
        table[f"{media}-schedule"] = np.asarray([schedule.epochs, schedule.batch, schedule.rate])
        table[f"{media}-curve"] = curve
        table[f"{media}-error"] = np.percentile([full, multiple], PERCENTILES, axis=1).T
        report(
            f"media {media}: relative L2 error, median and 95th percentile: {table[f'{media}-error'].round(4).tolist()}"
        )
    return table


def relative_errors(batch: Batch, net: Any) -> tuple[NDArray, NDArray]:
    """Relative L2 error of each material over all sides: of the whole BSDF, and of multiple scattering alone."""
    apart = np.sqrt(np.sum(errors(net, batch)[0] ** 2, axis=1))
    return tuple(apart / np.sqrt(np.sum(size**2, axis=1)) for size in (batch.size, batch.size_multiple))
