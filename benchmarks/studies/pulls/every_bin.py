"""A fit to every bin of a MERL table, in a process of its own whose memory is that of the fit."""

import json
import resource
import sys
import time
from pathlib import Path


def main(path: str) -> None:
    """Print what was fitted, and what it took, as JSON."""
    import jax

    from fits.problem.compilation import devices_of_cores

    jax.config.update("jax_enable_x64", True)
    devices_of_cores()

    import fits
    import layerjax as lj
    from benchmarks.studies.pulls.cases import FLOOR, NOISE, materials

    began = time.perf_counter()
    data = fits.read(Path(path), bins="all")
    _, free = materials()["flakes over paint"]
    noise = fits.Noise(relative=NOISE, floor=FLOOR, discrepancy=False)
    fit = fits.fit(free, data, transport=lj.SingleScattering(), noise=noise, starts=2)
    unit = 1 if sys.platform == "darwin" else 1024
    content = {
        "measurements": len(data),
        "seconds": time.perf_counter() - began,
        "bytes": unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        "values": fit.values,
        "errors": dict(zip(fit.problem.names, map(float, fit.errors), strict=True)),
    }
    print(json.dumps(content))


if __name__ == "__main__":
    main(*sys.argv[1:])
