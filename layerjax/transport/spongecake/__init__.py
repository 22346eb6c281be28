"""SpongeCake with multiple scattering (Wang et al. 2022, Sec. 5).

In go media over a base or none; out come single scattering, a second lobe for light scattered more often, and a
constant. `layers` makes two media of many, `mapping` is the network that finds the second lobe, `lobes` its BSDF,
`bending` what puts its energy right, and `transport` what users call.
"""

from layerjax.transport.spongecake.transport import SpongeCake as SpongeCake
