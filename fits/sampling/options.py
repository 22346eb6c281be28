"""What decides how a posterior is sampled, and when its chain is long enough."""

from dataclasses import dataclass

from layerjax._checks import require_count, require_number


@dataclass(frozen=True)
class SamplerOptions:
    """Settings of `fits.sample`; they are kept with the chain."""

    ess: float = 1000.0
    """Effective sample size, bulk and tail, that every parameter has when sampling ends."""

    autocorrelation_times: float = 50.0
    """Length of a converged chain, without its burn-in, in autocorrelation times of its slowest parameter."""

    r_hat: float = 1.01
    """R-hat of a converged chain, at most (Vehtari, Gelman, Simpson, Carpenter & Buerkner 2021)."""

    max_steps: int = 20_000
    """Steps after which sampling ends in any case, at least 100."""

    walkers: int | None = None
    """Walkers of emcee, even, at least 2 P + 2 for P parameters (None: 32, or 2 P + 2), or chains of NUTS, at least 2
    (None: 4)."""

    burn_in: float = 0.1
    """Share of the chain, at its start, that no estimate uses."""

    independent: float = 0.5
    """Share of emcee's proposals that are drawn from the fitted mixture; the others depend on where walkers stand."""

    warm_up: int = 300
    """Steps of each chain of NUTS before its first draw, which find its metric and step size."""

    target_acceptance: float = 0.9
    """Mean acceptance that the step size of NUTS is adapted to; higher, it follows narrower curved posteriors."""

    smallest_mode: float = 0.005
    """Local minima whose mass, by Laplace's approximation, is below this share of the largest are no modes."""

    def __post_init__(self) -> None:
        for name, least in (("walkers", 1), ("warm_up", 1), ("max_steps", FIRST_CHECK)):
            if not (name == "walkers" and self.walkers is None):
                require_count(name, getattr(self, name), least)
        for name in ("ess", "autocorrelation_times"):
            require_number(name, getattr(self, name), 0.0, open_ends=True)
        for name in ("burn_in", "target_acceptance", "smallest_mode"):
            require_number(name, getattr(self, name), 0.0, 1.0, open_ends=True)
        require_number("r_hat", self.r_hat, 1.0, open_ends=True)
        require_number("independent", self.independent, 0.0, 0.99)


FIRST_CHECK = 100
"""Steps after which a chain is first looked at."""
