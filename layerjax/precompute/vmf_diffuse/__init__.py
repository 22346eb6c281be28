"""What flakes of a `layerjax.VMFDiffuse` scatter in all orders, tabulated from a solver of its half space."""

from layerjax.precompute.vmf_diffuse.maker import make as make
