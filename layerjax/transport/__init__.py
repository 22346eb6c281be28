"""Ways of carrying light through a stack: each is one `Transport` and takes the same `Stack`."""

from layerjax.transport.adding_doubling.transport import AddingDoubling as AddingDoubling
from layerjax.transport.contract import DeterministicTransport as DeterministicTransport
from layerjax.transport.contract import RandomTransport as RandomTransport
from layerjax.transport.contract import Side as Side
from layerjax.transport.contract import Transport as Transport
from layerjax.transport.endf.transport import ENDF as ENDF
from layerjax.transport.random_walk.transport import RandomWalk as RandomWalk
from layerjax.transport.single_scattering import SingleScattering as SingleScattering
from layerjax.transport.spongecake.transport import SpongeCake as SpongeCake
from layerjax.transport.statistical.transport import Statistical as Statistical
from layerjax.transport.weidlich_wilkie import WeidlichWilkie as WeidlichWilkie
