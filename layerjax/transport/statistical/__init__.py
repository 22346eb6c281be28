"""Layered materials by directional statistics (Belcour 2018), with diffuse bases (de Dinechin & Belcour 2022).

In goes a stack of interfaces and hazes over any base; out comes one GGX lobe for each group of paths (see
`layerjax.transport.lobes`). A diffuse base is added by `coated_base` (one coat), `streamed_base` (several, and haze),
`hazy_base` (media on top), `diffuse_base` (an exact solve) or `diffuse_lobe` (the paper's lobe). `sampling` draws
directions, and `transport` is what users call.
"""

from layerjax.transport.statistical.transport import Statistical as Statistical
