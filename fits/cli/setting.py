"""How the commands use JAX."""

LEAST_COMPILE = 0.2
"""Programs that took so many seconds to compile are kept."""


def use_jax() -> None:
    """Double precision, all cores, and compiled programs kept in the user's cache folder from one run to the next."""
    import jax

    from fits.engines.worker import compile_cache, quieten
    from fits.problem.compiled import devices_of_cores

    quieten()
    jax.config.update("jax_enable_x64", True)
    devices_of_cores()
    if jax.config.values["jax_compilation_cache_dir"] is None and (directory := compile_cache()):
        jax.config.update("jax_compilation_cache_dir", directory)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", LEAST_COMPILE)
