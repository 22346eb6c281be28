"""A training that resumes where it was interrupted: Adam, with a rate that falls as a cosine."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from jax import Array
from numpy.typing import NDArray

CURVE = NDArray[np.float32]


@dataclass(frozen=True)
class Schedule:
    """How long to learn. kept: epochs between states that are written down."""

    epochs: int = 300
    batch: int = 64
    rate: float = 2e-3
    checkpoints: int = 10


def learn(
    net: eqx.nn.MLP,
    loss: Callable[..., Array],
    batch: Callable[[np.random.Generator, NDArray[np.int64]], tuple[Any, ...]],
    count: int,
    seed: list[int],
    schedule: Schedule,
    state: Path | None = None,
    report: Callable[[str], Any] = print,
) -> tuple[eqx.nn.MLP, CURVE]:
    """The trained network, and the mean loss of each epoch.

    Args:
        net: as it is to begin with.
        loss: of a network and what `batch` answers.
        batch: what is learned from, for rows of the `count` that there are, with a source of random numbers.
        seed: numbers that, with that of the epoch, random numbers come from.
        state: a file that the state is kept in, and that an interrupted training resumes from.
        report: called with lines on the progress.

    Needs optax.
    """
    import optax  # an extra, for whoever trains

    steps = max(count // schedule.batch, 1)
    optimiser = optax.chain(
        optax.clip_by_global_norm(1.0), optax.adam(optax.cosine_decay_schedule(schedule.rate, schedule.epochs * steps))
    )
    held = (net, optimiser.init(eqx.filter(net, eqx.is_array)), np.zeros(schedule.epochs, np.float32), np.asarray(0))
    if state is not None and state.exists():
        held = eqx.tree_deserialise_leaves(state, held)
    net, memory, curve, begun = held

    @eqx.filter_jit
    def step(net: eqx.nn.MLP, memory: Any, *part: Any) -> tuple[Any, Any, Array]:
        value, slope = eqx.filter_value_and_grad(loss)(net, *part)
        update, memory = optimiser.update(slope, memory)
        return eqx.apply_updates(net, update), memory, value

    for epoch in range(int(begun), schedule.epochs):
        random = np.random.default_rng([*seed, epoch])
        losses = []
        for rows in random.permutation(count)[: steps * schedule.batch].reshape(steps, -1):
            net, memory, value = step(net, memory, *batch(random, rows))
            losses.append(value)
        curve[epoch] = np.mean(losses)
        if (epoch + 1) % schedule.checkpoints == 0 or epoch + 1 == schedule.epochs:
            report(f"epoch {epoch + 1}/{schedule.epochs}, loss {curve[epoch]:.4f}")
            if state is not None:
                temporary = state.with_suffix(".part")
                eqx.tree_serialise_leaves(temporary, (net, memory, curve, np.asarray(epoch + 1)))
                temporary.replace(state)
    return net, curve
