"""Layered materials by directional statistics (Belcour 2018), with diffuse bases (de Dinechin & Belcour 2022).

In goes a stack of interfaces and hazes over any base; out comes one GGX lobe for each group of paths, whose energy and
`variance` follow from `adding`. `lobes` takes them off a stack, `shaped` gives them their shape, the `diffuse` files
and `coated_base` add a diffuse base, `drawing` samples, and `transport` is what users call.
"""

from layerjax.transport.statistical.transport import Statistical as Statistical
