"""How the commands use JAX."""

import os


def use_jax() -> None:
    """Double precision, all cores, and compiled programs kept in the user's cache folder from one run to the next."""
    # XLA reads it as it is loaded: below 3 it prints an alarm, as an error, for every program that is slow to compile.
    # What fails is raised all the same.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    import jax

    from fits.engines.worker import quieten
    from fits.problem.compilation import devices_of_cores
    from layerjax.compiling import keep_programs

    quieten()
    jax.config.update("jax_enable_x64", True)
    devices_of_cores()
    keep_programs()
