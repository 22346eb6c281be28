"""What ties the channels of a number together: a power law of the wavelength."""

import dataclasses
import inspect
from collections.abc import Sequence
from typing import Any, ClassVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import layerjax as lj
from fits.problem.parameters import Free, is_free
from fits.problem.values import shown
from layerjax._parameters import PER_CHANNEL
from layerjax._shown import Shown
from layerjax.mixture import stacks_by_name


class PowerLaw(Shown):
    """A number a channel, ``amplitude (wavelength / reference)^-exponent``: in the place of one in a stack.

    amplitude: the number at the reference, in its unit, or `Free` with low >= 0. exponent: unitless, or `Free`; of
    reduced scattering 0.5 to 4 are common. wavelengths: one a channel, in nm. reference: in nm; the geometric mean of
    the wavelengths by default.

    Raises:
        ValueError: nothing is free, a number a channel, fewer than two wavelengths, or one that is not above 0.
    """

    amplitude: Any
    exponent: Any
    wavelengths: tuple[float, ...] = eqx.field(static=True)
    reference: float = eqx.field(static=True)

    __layerjax_placeholder__: ClassVar[bool] = True

    def __init__(
        self, amplitude: Any, exponent: Any, wavelengths: Sequence[float], reference: float | None = None
    ) -> None:
        self.amplitude, self.exponent = amplitude, exponent
        given = np.asarray(wavelengths, float)
        if given.ndim != 1 or given.size < 2:
            raise ValueError(f"PowerLaw.wavelengths has shape {given.shape}; it must be one a channel, two or more")
        self.wavelengths = tuple(given.tolist())
        self.reference = float(np.exp(np.mean(np.log(given)))) if reference is None else float(reference)
        for name, values in (("wavelengths", given), ("reference", np.array([self.reference]))):
            if not np.all(np.isfinite(values) & (values > 0.0)):
                raise ValueError(f"PowerLaw.{name} is {shown(values.tolist())}; it must be finite and above 0")
        ends = {"amplitude": amplitude, "exponent": exponent}
        if not any(map(is_free, ends.values())):
            raise ValueError("PowerLaw: nothing is free; write the number of each channel instead")
        for name, value in ends.items():
            shape = value.shape if is_free(value) else np.shape(value)
            if shape != ():
                raise ValueError(f"PowerLaw.{name} has {shape[0]} channels; it must be one number")
        if _ends(amplitude)[0] < 0.0:
            raise ValueError(f"PowerLaw.amplitude reaches down to {_ends(amplitude)[0]:g}; it must be at least 0")

    def values(self) -> Array:
        """(C,), of numbers that are not free."""
        ratio = np.asarray(self.wavelengths) / self.reference
        return jnp.asarray(self.amplitude) * jnp.exp(-jnp.asarray(self.exponent) * jnp.log(ratio))

    def extremes(self) -> tuple[np.ndarray, np.ndarray]:
        """The least and the largest of each channel, (C,), within the bounds of what is free."""
        ratio = np.asarray(self.wavelengths) / self.reference
        corners = np.array([a * ratio**-b for a in _ends(self.amplitude) for b in _ends(self.exponent)])
        return corners.min(axis=0), corners.max(axis=0)


def is_law(leaf: Any) -> bool:
    """Whether this leaf is a power law."""
    return isinstance(leaf, PowerLaw)


def with_values(tree: Any) -> Any:
    """The tree with the numbers of each channel in place of power laws."""
    return jax.tree.map(lambda leaf: leaf.values() if is_law(leaf) else leaf, tree, is_leaf=is_law)


def require_in_range(material: Any) -> None:
    """Refuse power laws where no number a channel stands, or that leave its range: ValueError that names the place."""
    seen = 0
    stacks = stacks_by_name(material) if isinstance(material, lj.Stack | lj.Mixture) else {}
    for prefix, stack in stacks.items():
        named = [(f"{prefix}layers[{place}]", layer) for place, layer in enumerate(stack.layers)]
        for where, part in (*named, (f"{prefix}base", stack.base)):
            for name, law in _laws(part):
                seen += 1
                for end in law.extremes():
                    try:
                        dataclasses.replace(cast(Any, part), **{name: end})
                    except ValueError as error:
                        raise ValueError(f"{where}: within the bounds of its power law {error}") from None
    if seen < sum(map(is_law, jax.tree.leaves(material, is_leaf=is_law))):
        raise ValueError("PowerLaw stands where no number a channel may; it may be in a layer or base of a stack")


def _laws(part: Any) -> list[tuple[str, PowerLaw]]:
    """Power laws of a layer or a base, in the place of numbers that may differ by channel."""
    if not dataclasses.is_dataclass(part):
        return []
    kinds = [kind.__name__ for kind in inspect.getmro(type(part))]
    named = [(field.name, getattr(part, field.name)) for field in dataclasses.fields(part)]
    return [
        (name, value)
        for name, value in named
        if is_law(value) and any(f"{kind}.{name}" in PER_CHANNEL for kind in kinds)
    ]


def _ends(value: Any) -> tuple[float, float]:
    if isinstance(value, Free):
        return float(value.arrays()[1]), float(value.arrays()[2])
    return float(value), float(value)
