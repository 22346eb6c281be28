"""Networks of `layerjax.SpongeCake`, learned from answers of `layerjax.AddingDoubling`: data, training, energies."""

from layerjax.precompute.spongecake.maker import make as make
