"""One question a study: ``python -m benchmarks NAME`` runs its `study` and writes tables into `benchmarks/results`."""
