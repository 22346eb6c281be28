"""How the commands use JAX."""

import os
from pathlib import Path


def use_jax() -> None:
    """Double precision, all cores, and compiled programs kept in the user's cache folder from one run to the next."""
    import warnings

    import jax

    from fits.problem.compiled import devices_of_cores

    # arviz announces its next version on import; compiled programs that cannot be kept are compiled again
    warnings.filterwarnings("ignore", category=FutureWarning, module="arviz")
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache")
    jax.config.update("jax_enable_x64", True)
    devices_of_cores()
    if jax.config.values["jax_compilation_cache_dir"] is None:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        jax.config.update("jax_compilation_cache_dir", str(Path(home) / "layerjax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
