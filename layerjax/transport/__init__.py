"""Ways of carrying light through a stack: each is one `Transport` and takes the same `Stack`.

A transport takes a stack and directions, and returns BSDF values, samples, densities and energies, see `contract`. A
transport is a file, or a folder where one file is too small; `layerjax.evaluate` and its like choose and call them.
"""

from layerjax.transport.adding_doubling import AddingDoubling as AddingDoubling
from layerjax.transport.contract import DeterministicTransport as DeterministicTransport
from layerjax.transport.contract import RandomTransport as RandomTransport
from layerjax.transport.contract import Side as Side
from layerjax.transport.contract import Transport as Transport
from layerjax.transport.endf import ENDF as ENDF
from layerjax.transport.random_walk import RandomWalk as RandomWalk
from layerjax.transport.single_scattering import SingleScattering as SingleScattering
from layerjax.transport.spongecake import SpongeCake as SpongeCake
from layerjax.transport.statistical import Statistical as Statistical
from layerjax.transport.weidlich_wilkie import WeidlichWilkie as WeidlichWilkie
