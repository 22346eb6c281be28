"""Parameters by instruments, of mixtures and from tables of bins: are they recovered, and their errors honest?"""

from benchmarks.studies.pulls.run import study as study
