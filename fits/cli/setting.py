"""How the commands use JAX."""

LEAST_COMPILE = 0.2
"""Programs that took so many seconds to compile are kept."""


def use_jax() -> None:
    """Double precision, all cores, and compiled programs kept in the user's cache folder from one run to the next."""
    import jax

    from fits.engines.compile_cache import keep_programs
    from fits.engines.worker import quieten
    from fits.problem.compiled import devices_of_cores

    quieten()
    jax.config.update("jax_enable_x64", True)
    devices_of_cores()
    keep_programs(LEAST_COMPILE)
