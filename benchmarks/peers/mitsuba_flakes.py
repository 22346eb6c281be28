"""Mitsuba's `sggx` phase function with its sampling put right.

The plugin of Mitsuba 3.9.1 draws directions that do not follow its own density (a transposed frame, mitsuba3 issue
1728): a lossless slab then scatters up to 9 % more light than falls on it. Values, extinction and all the rest stay
Mitsuba's; only the drawing of a visible normal is ours, as a cosine-weighted direction stretched by the root of S.
"""

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray


def flakes(mi: Any, s: NDArray[np.float64]) -> dict[str, Any]:
    """The phase function of flakes with the symmetric matrix S, (3, 3), for `mi.load_dict`."""
    _register(mi)
    return {"type": "layerjax_flakes", "S": _plugin(mi, s)}


def _plugin(mi: Any, s: NDArray[np.float64]) -> dict[str, Any]:
    numbers = np.array([s[0, 0], s[1, 1], s[2, 2], s[0, 1], s[0, 2], s[1, 2]], np.float32)
    grid = mi.VolumeGrid(numbers.reshape(1, 1, 1, 6))
    volume = {"type": "gridvolume", "grid": grid, "raw": True, "filter_type": "nearest"}
    return {"type": "sggx", "S": volume}


@functools.cache
def _register(mi: Any) -> None:
    import drjit as dr

    class Flakes(mi.PhaseFunction):
        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.inner = properties["S"]
            s = np.array(mi.traverse(self.inner)["S.data"], dtype=float).ravel()
            matrix = np.array([[s[0], s[3], s[4]], [s[3], s[1], s[5]], [s[4], s[5], s[2]]])
            values, vectors = np.linalg.eigh(matrix)
            self.root = (vectors * np.sqrt(values)) @ vectors.T
            self.m_flags = self.inner.flags()

        def sample(self, ctx: Any, interaction: Any, _: Any, sample2: Any, active: Any = True) -> Any:
            frame = mi.Frame3f(dr.normalize(self._stretch(interaction.wi)))
            normal = dr.normalize(self._stretch(frame.to_world(mi.warp.square_to_cosine_hemisphere(sample2))))
            wo = dr.normalize(2.0 * dr.dot(interaction.wi, normal) * normal - interaction.wi)
            return wo, mi.Color3f(1.0), self.inner.eval_pdf(ctx, interaction, wo, active)[1]

        def eval_pdf(self, ctx: Any, interaction: Any, wo: Any, active: Any = True) -> Any:
            return self.inner.eval_pdf(ctx, interaction, wo, active)

        def projected_area(self, interaction: Any, active: Any = True) -> Any:
            return self.inner.projected_area(interaction, active)

        def max_projected_area(self) -> Any:
            return self.inner.max_projected_area()

        def to_string(self) -> str:
            return "layerjax_flakes"

        def _stretch(self, w: Any) -> Any:
            return mi.Vector3f(*(dr.dot(mi.Vector3f(*map(float, row)), w) for row in self.root))

    mi.register_phase("layerjax_flakes", Flakes)
