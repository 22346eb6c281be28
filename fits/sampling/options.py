"""What decides how a posterior is sampled, and when its chain is long enough."""

from dataclasses import dataclass

from layerjax._checks import require_count, require_number


@dataclass(frozen=True)
class SamplerOptions:
    """Settings of `fits.sample`; they are kept with the chain.

    Attributes:
        ess: effective sample size, bulk and tail, that every parameter has when sampling ends.
        autocorrelation_times: length of a converged chain, without its burn-in, in autocorrelation times of its slowest
            parameter.
        r_hat: of a converged chain, at most (Vehtari, Gelman, Simpson, Carpenter & Buerkner 2021).
        max_steps: steps after which sampling ends in any case, at least 100.
        walkers: of emcee, even, at least 2 P + 2 for P parameters (None: 20, or 2 P + 2 where that is more), or chains
            of NUTS, at least 2 (None: 4).
        burn_in: share of the chain, at its start, that no estimate uses.
        independent: share of emcee's proposals that are drawn from a mixture that approximates the posterior; the
            others depend on where walkers stand.
        warm_up: steps of each chain of NUTS before its first draw, which find its metric and step size.
        target_acceptance: mean acceptance that the step size of NUTS is adapted to; higher, it follows narrower curved
            posteriors.
        smallest_mode: local minima whose mass, by Laplace's approximation, is below this share of the largest are no
            modes.
    """

    ess: float = 1000.0
    autocorrelation_times: float = 50.0
    r_hat: float = 1.01
    max_steps: int = 20_000
    walkers: int | None = None
    burn_in: float = 0.1
    independent: float = 0.8
    warm_up: int = 300
    target_acceptance: float = 0.9
    smallest_mode: float = 0.005

    def __post_init__(self) -> None:
        require_count("walkers", 1 if self.walkers is None else self.walkers, 1)
        require_count("warm_up", self.warm_up, 1)
        require_count("max_steps", self.max_steps, FIRST_CHECK)
        for name in ("ess", "autocorrelation_times"):
            require_number(name, getattr(self, name), 0.0, open_ends=True)
        for name in ("burn_in", "target_acceptance", "smallest_mode"):
            require_number(name, getattr(self, name), 0.0, 1.0, open_ends=True)
        require_number("r_hat", self.r_hat, 1.0, open_ends=True)
        require_number("independent", self.independent, 0.0, 0.99)


MAX_PARETO_K = 0.7  # of importance weights: above it a part of the posterior may be missing (Vehtari et al. 2024)
FIRST_CHECK = 100  # steps after which a chain is first looked at
