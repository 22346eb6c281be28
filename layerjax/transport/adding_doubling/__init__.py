"""The deterministic reference: every order of scattering, on a grid of directions.

In goes any stack; out come BSDF values to the accuracy of the grid, without noise and with derivatives. `media` and
`interfaces` put layers on the `grid`, where `sampling` keeps their energy; `operators` and `inverse` join two of them,
`solve` a whole stack, and `tables` are read at the requested directions. `proposals` are directions to draw, and
`transport` is what users call.
"""

from layerjax.transport.adding_doubling.transport import AddingDoubling as AddingDoubling
from layerjax.transport.adding_doubling.transport import ResolutionWarning as ResolutionWarning
