"""The suite of stacks that every model is set against: what they are made of, and where they are looked at.

Each stack is a file ``benchmarks/suite/FAMILY/NAME.toml`` in the syntax of `fits.problem.stack_file`, so that
``layerjax simulate --stack`` and the other commands take it as it is; its table ``[about]`` says where it comes from.

The directions of a stack are fixed. Light comes from five polar angles (10 to 85 degrees, in the family
``grazing_light`` 60 to 88) at azimuth 25 degrees, which no axis of the suite shares. Each is seen at five polar angles
and four azimuths from it (0 retro side, 60, 120, 180 mirror side), in the exact mirror direction and 4 degrees beside
it. A stack without a base is also seen from below, there 4 and 8 degrees beside the straight line through it (which
holds the unscattered light), and lit from below in the same way.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import layerjax as lj
from fits.problem.stack_file import read_problem

DIRECTORY = Path(__file__).parent

FAMILIES = {
    "plastics_and_paints": "plastics and paints",
    "coated_metals": "coated metals",
    "fabrics_and_fibers": "fabrics and fibers",
    "leaves_and_wood": "leaves and wood",
    "transmitting_slabs": "slabs that transmit",
    "thick_and_conservative": "thick and conservative media",
    "grazing_light": "grazing light",
    "smooth_surfaces": "smooth surfaces",
    "brushed_surfaces": "brushed surfaces",
}
"""Directory of each family to its title."""

LIGHT_AZIMUTH = 25.0
AZIMUTHS = (0.0, 60.0, 120.0, 180.0)
INCIDENCE, VIEW = (10.0, 30.0, 50.0, 70.0, 85.0), (5.0, 20.0, 40.0, 60.0, 80.0)
GRAZING_INCIDENCE, GRAZING_VIEW = (60.0, 75.0, 80.0, 85.0, 88.0), (20.0, 45.0, 65.0, 82.0, 87.0)
"""Degrees from the normal, and azimuths relative to the light's."""

BESIDE_MIRROR = ((0.0, 180.0), (-4.0, 176.0))
BESIDE_BALLISTIC = ((-4.0, 176.0), (-8.0, 172.0))
"""Polar angle less that of the light, and relative azimuth, of the directions where narrow lobes stand."""

GROUP = len(VIEW) * len(AZIMUTHS) + len(BESIDE_MIRROR)
"""Pairs with the same light on the same side."""


@dataclass(frozen=True)
class Directions:
    """Pairs of directions, and what they have in common.

    wi, wo: unit vectors, (n, 3). lights: the distinct wi, (k, 3). light: which of them each pair has, (n,).
    """

    wi: NDArray[np.float64]
    wo: NDArray[np.float64]
    lights: NDArray[np.float64]
    light: NDArray[np.intp]

    @cached_property
    def weights(self) -> NDArray[np.float64]:
        """|cos_i cos_o| of each pair, (n,)."""
        return np.abs(self.wi[:, 2] * self.wo[:, 2])

    @cached_property
    def transmits(self) -> NDArray[np.bool_]:
        """Whether the light of each pair passes through the stack, (n,)."""
        return np.sign(self.wi[:, 2]) != np.sign(self.wo[:, 2])

    def some(self, count: int) -> NDArray[np.intp]:
        """Indices of `count` pairs, (count,): in turn from every light and side, all over the views of each."""
        turn = np.arange(min(count, len(self.wi)))
        groups = len(self.wi) // GROUP
        # 7 is prime to the size of a group: no view comes twice before all have come; the first is the mirror direction
        return np.unique(turn % groups * GROUP + (GROUP - 2 + 7 * turn) % GROUP)

    def take(self, indices: NDArray[np.intp]) -> "Directions":
        """The pairs with these indices alone."""
        return Directions(self.wi[indices], self.wo[indices], self.lights, self.light[indices])


@dataclass(frozen=True)
class Case:
    """A stack of the suite. family: key of `FAMILIES`; source: the paper and figure, or "this suite"; differs: why
    solver and walk do not agree on it, if that is known."""

    name: str
    family: str
    source: str
    remark: str
    stack: lj.Stack
    differs: str = ""

    @cached_property
    def directions(self) -> Directions:
        """Where this stack is looked at."""
        grazing = self.family == "grazing_light"
        return _directions(
            GRAZING_INCIDENCE if grazing else INCIDENCE,
            GRAZING_VIEW if grazing else VIEW,
            transmits=self.stack.base is None,
        )


def load(families: Sequence[str] | None = None, stacks: Sequence[str] | None = None) -> list[Case]:
    """The stacks of these families and names (all if None), in the order of `FAMILIES` and of their names.

    Raises:
        ValueError: a family or a stack that is none, or a file that describes no stack, named.
    """
    chosen = list(FAMILIES) if families is None else families
    for family in chosen:
        if family not in FAMILIES:
            raise ValueError(f"family {family!r} is not one of {', '.join(FAMILIES)}")
    ordered = [family for family in FAMILIES if family in chosen]
    paths = [path for family in ordered for path in sorted((DIRECTORY / family).glob("*.toml"))]
    for name in stacks or ():
        if name not in {path.stem for path in paths}:
            raise ValueError(f"stack {name!r} is not one of {', '.join(path.stem for path in paths)}")
    return [_read(path) for path in paths if stacks is None or path.stem in stacks]


def _read(path: Path) -> Case:
    problem = read_problem(path)
    assert isinstance(problem.stack, lj.Stack)
    about = {key: problem.about.get(key, "") for key in ("source", "remark", "differs")}
    return Case(path.stem, path.parent.name, stack=problem.stack, **about)


def _directions(incidence: tuple[float, ...], view: tuple[float, ...], transmits: bool) -> Directions:
    angles = []  # of the light and of the view, in degrees: polar, azimuth, polar, azimuth
    for from_below in (False, True) if transmits else (False,):
        for theta in incidence:
            common = [(polar, azimuth) for polar in view for azimuth in AZIMUTHS]
            for below in (False, True) if transmits else (False,):
                through = below != from_below
                beside = [(theta + step, azimuth) for step, azimuth in (BESIDE_BALLISTIC if through else BESIDE_MIRROR)]
                for polar, azimuth in common + beside:
                    lit = 180.0 - theta if from_below else theta
                    seen = 180.0 - polar if below else polar
                    angles.append((lit, LIGHT_AZIMUTH, seen, LIGHT_AZIMUTH + azimuth))
    theta_i, phi_i, theta_o, phi_o = np.radians(angles).T
    wi = _unit(theta_i, phi_i)
    lights, light = np.unique(theta_i, return_inverse=True)
    return Directions(wi, _unit(theta_o, phi_o), _unit(lights, np.full_like(lights, phi_i[0])), light)


def _unit(theta: NDArray[np.float64], phi: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
