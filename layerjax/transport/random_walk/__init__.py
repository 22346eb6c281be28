"""The Monte Carlo reference: unbiased random walks through anything that a `layerjax.Stack` holds.

In go a stack, directions and a random key; out come BSDF values or energies with standard errors. `transport` is what
users call and `walk` the path of light, one event a step: a `flight`, then an event in a medium (`scene`), at a surface
(`surfaces`) or at one facet of it (`microsurface`). `goniophotometer` counts where the light goes instead.
"""

from layerjax.transport.random_walk.transport import RandomWalk as RandomWalk
