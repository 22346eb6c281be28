"""Times of models and fits beside plain numpy and other programs, compared in one run."""

from benchmarks.studies.throughput.run import study as study
