"""A GPU beside the processor: the same programs on both, their times and how far what they find is apart."""

from benchmarks.studies.accelerator.run import study as study
