"""Mitsuba's BSDFs with a texture for every parameter (`llvm_ad_rgb`): a texel of each for every pair of directions."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.peers.functions import VARIANT

PLUGINS: dict[str, dict[str, Any]] = {
    "principled": {"type": "principled"},
    "roughconductor": {"type": "roughconductor", "distribution": "ggx"},
}


class Textured:
    """A BSDF of Mitsuba, its parameters read from textures at the texels' centres.

    maps: (N,) or (N, 3) by the plugin's names of its parameters. wi, wo: (N, 3).
    """

    def __init__(self, plugin: str, maps: Mapping[str, NDArray[Any]], wi: NDArray[Any], wo: NDArray[Any]) -> None:
        import drjit as dr
        import mitsuba as mi

        mi.set_variant(VARIANT)
        self.dr = dr
        count = len(wi)
        width = next(side for side in range(math.isqrt(count), 0, -1) if count % side == 0)
        height = count // width
        textures = {name: _texture(mi, value, height, width) for name, value in maps.items()}
        self.bsdf = mi.load_dict(PLUGINS[plugin] | textures)
        self.interaction = dr.zeros(mi.SurfaceInteraction3f, count)
        index = np.arange(count)
        centres = (index % width + 0.5) / width, (index // width + 0.5) / height
        self.interaction.uv = mi.Point2f(*(mi.Float(centre.astype(np.float32)) for centre in centres))
        self.interaction.wi, self.outgoing = (
            mi.Vector3f(*(mi.Float(np.ascontiguousarray(w[:, c], np.float32)) for c in range(3))) for w in (wi, wo)
        )
        dr.eval(self.interaction, self.outgoing)
        self.context = mi.BSDFContext()

    def value(self) -> Any:
        """The BSDF with its cosine, of every texel."""
        found = self.bsdf.eval(self.context, self.interaction, self.outgoing)
        self.dr.eval(found)
        self.dr.sync_thread()
        return found


def _texture(mi: Any, value: NDArray[Any], height: int, width: int) -> dict[str, Any]:
    picture = np.asarray(value, np.float32).reshape(height, width, -1)
    return {"type": "bitmap", "bitmap": mi.Bitmap(picture), "raw": True, "filter_type": "nearest"}
