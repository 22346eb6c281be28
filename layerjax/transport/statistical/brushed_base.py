"""Light that has reached a diffuse base under interfaces of two widths: that of interfaces of one width each.

The base forgets where light came from, and beside it each way by itself depends little on the azimuth. So all is
computed with the root mean square of the widths.
"""

import equinox as eqx

from layerjax.stack import Interface, Stack
from layerjax.transport.lobes.statistics import facet_width, mean_width


def with_one_width(stack: Stack) -> Stack:
    """A stack whose interfaces have one width each, which lets through about as much on average over azimuths."""
    layers = tuple(
        eqx.tree_at(
            lambda face: (face.alpha, face.alpha_y, face.tangent),
            layer,
            (mean_width(facet_width(layer)), None, None),
            is_leaf=lambda leaf: leaf is None,
        )
        if isinstance(layer, Interface) and layer.is_anisotropic
        else layer
        for layer in stack.layers
    )
    return Stack(layers, stack.base)
