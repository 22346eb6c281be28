"""The statistical model: parameters with priors, noise, model discrepancy, instrument, and one log-density of all.

A stack with `fits.Free` in it, `fits.Measurements` and a transport go in; pure functions of a vector come out.
Problems are also read from TOML files here, and measurements are simulated.
"""
