"""Maps of stacks: every texel a stack of its own, value and gradient, beside Mitsuba's BSDFs with textures."""

from benchmarks.studies.textured.run import study as study
