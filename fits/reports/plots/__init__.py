"""Pictures of data, models and parameters, as matplotlib figures that are neither shown nor written.

Measurements, fits and posteriors go in; figures come out.
"""
