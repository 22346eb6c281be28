"""Fits of maps: texels a second beside scipy, by processes and by a cluster, and what larger maps cost on paper."""

from benchmarks.studies.maps.run import study as study
