"""Error against run time, throughput, stability and recovery studies: ``python -m benchmarks --help``."""
