"""Ways of carrying light through a stack. Each is one `Transport`, takes the same `Stack`, and says what it supports."""

from layerjax.transport._transport import Side as Side
from layerjax.transport._transport import Transport as Transport
from layerjax.transport.single_scattering import SingleScattering as SingleScattering
