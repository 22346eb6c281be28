"""The two references beside their peers, and how fast the exact one is to call, to fit with and to sample with."""

from benchmarks.studies.references.run import study as study
