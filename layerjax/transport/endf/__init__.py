"""Rough coats and slabs by extended normal distributions (Guo, Qian & Pan 2015).

In go a rough interface and what lies under it, a metal or a second interface, with absorption between; out comes one
microfacet lobe for each number of bounces. `warping` is one event of a beam, `chains` a coat, `slab` the light that
passes, `sampling` the sampler, and `transport` what users call.
"""

from layerjax.transport.endf.transport import ENDF as ENDF
