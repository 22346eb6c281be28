"""layerjax: evaluate, sample and differentiate the BSDF of layered materials as pure JAX functions."""

from layerjax._parameters import RANGES as RANGES
from layerjax.compiling import compiler_options as compiler_options
from layerjax.compiling import keep_programs as keep_programs
from layerjax.directions import angles as angles
from layerjax.directions import direction as direction
from layerjax.evaluate import albedo as albedo
from layerjax.evaluate import evaluate as evaluate
from layerjax.evaluate import evaluate_with_error as evaluate_with_error
from layerjax.evaluate import pdf as pdf
from layerjax.evaluate import sample as sample
from layerjax.evaluate import specular as specular
from layerjax.evaluate import unscattered as unscattered
from layerjax.mixture import Mixture as Mixture
from layerjax.optical_constants import cauchy as cauchy
from layerjax.optical_constants import metal as metal
from layerjax.optical_constants import sellmeier as sellmeier
from layerjax.phase import SGGX as SGGX
from layerjax.phase import HenyeyGreenstein as HenyeyGreenstein
from layerjax.phase import PhaseFunction as PhaseFunction
from layerjax.phase import Rayleigh as Rayleigh
from layerjax.preparation import Prepared as Prepared
from layerjax.preparation import choose_transport as choose_transport
from layerjax.preparation import prepare as prepare
from layerjax.stack import Interface as Interface
from layerjax.stack import Medium as Medium
from layerjax.stack import Stack as Stack
from layerjax.stack import TurbidMedium as TurbidMedium
from layerjax.surfaces import Conductor as Conductor
from layerjax.surfaces import Lambertian as Lambertian
from layerjax.surfaces import OrenNayar as OrenNayar
from layerjax.surfaces import ThinFilm as ThinFilm
from layerjax.surfaces import VMFDiffuse as VMFDiffuse
from layerjax.transport import ENDF as ENDF
from layerjax.transport import AddingDoubling as AddingDoubling
from layerjax.transport import RandomWalk as RandomWalk
from layerjax.transport import SingleScattering as SingleScattering
from layerjax.transport import SpongeCake as SpongeCake
from layerjax.transport import Statistical as Statistical
from layerjax.transport import Transport as Transport
from layerjax.transport import WeidlichWilkie as WeidlichWilkie
from layerjax.transport.adding_doubling import ResolutionWarning as ResolutionWarning
from layerjax.transport.random_walk.goniophotometer import Goniogram as Goniogram
from layerjax.transport.random_walk.goniophotometer import goniophotometer as goniophotometer

__version__ = "0.2.0"
