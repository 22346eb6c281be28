"""Pictures of data, models and parameters: measurements, fits and posteriors go in; matplotlib figures come out."""
