"""Where a collision in a medium sends the light: one phase function a file, all by the contract in `contract`.

In go directions as components, out come extinction, values, drawn directions and quadrature nodes. A new phase function
is one class derived from `PhaseFunction`, in a file of one's own: nothing else has to know of it.
"""

from layerjax.phase.contract import Flakes as Flakes
from layerjax.phase.contract import PhaseFunction as PhaseFunction
from layerjax.phase.henyey_greenstein import HenyeyGreenstein as HenyeyGreenstein
from layerjax.phase.rayleigh import Rayleigh as Rayleigh
from layerjax.phase.sggx import SGGX as SGGX
