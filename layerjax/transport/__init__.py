"""Ways of carrying light through a stack: each is one `Transport` and takes the same `Stack`."""

from layerjax.transport._transport import Side as Side
from layerjax.transport._transport import Transport as Transport
from layerjax.transport.adding_doubling import AddingDoubling as AddingDoubling
from layerjax.transport.endf import ENDF as ENDF
from layerjax.transport.random_walk import RandomWalk as RandomWalk
from layerjax.transport.single_scattering import SingleScattering as SingleScattering
from layerjax.transport.spongecake import SpongeCake as SpongeCake
from layerjax.transport.statistical import Statistical as Statistical
from layerjax.transport.weidlich_wilkie import WeidlichWilkie as WeidlichWilkie
