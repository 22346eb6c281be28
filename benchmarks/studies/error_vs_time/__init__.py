"""Every model against the truth and its run time, over the suite of stacks."""

from benchmarks.studies.error_vs_time.run import study as study
