"""What is asked of data: free parameters and priors, noise and likelihood, all put together in a `fits.Problem`.

A stack with `fits.Free` in it, `fits.Measurements` and a transport go in; functions of a vector come out.
"""
