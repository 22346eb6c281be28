"""Which transport when: a page of the documentation, from the results of error-vs-time."""

from benchmarks.studies.side_by_side.run import study as study
