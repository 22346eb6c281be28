"""What tests of ENDF share: its two forms, and the lower face of a slab."""

import layerjax as lj

RECIPROCAL, PAPER = lj.ENDF(), lj.ENDF(form="paper")
OUTSIDE = lj.Interface(1.0, 0.4, distribution="vmf")
