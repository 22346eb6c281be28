"""Multiple scattering of `layerjax.SpongeCake` beside the truth: held-out materials, energy, figures, fits, costs."""

from benchmarks.studies.spongecake.run import study as study
