"""A GPU beside the processor: the same programs on both, their times and the differences of their results."""

from benchmarks.studies.accelerator.run import study as study
