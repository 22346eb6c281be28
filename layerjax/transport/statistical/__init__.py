"""Directional statistics of layers and how they add up: energies and variances of lobes (Belcour 2018)."""
