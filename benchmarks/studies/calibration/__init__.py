"""Simulation-based calibration (Talts et al. 2018): whether posteriors with all orders of scattering are calibrated.

Booleans drawn from the prior, data simulated from them, and the rank of each truth among draws of its posterior.
"""

from benchmarks.studies.calibration.run import study as study
