"""Pictures of data, models and parameters, as matplotlib figures that are neither shown nor written."""
