"""The report of a fitted map, on the command line."""

import sys
from argparse import Namespace
from pathlib import Path

from fits.cli.places import refuse_existing
from fits.maps.fitted_map import open_map
from fits.progress import show_progress

DONE = 0


def report_map(arguments: Namespace) -> int:
    """Write the report of a map, beside its store if no other place is given, and print its numbers."""
    if arguments.compare:
        raise ValueError(f"--compare: {arguments.directory} is a map, which is not compared with others")
    path = Path(arguments.directory)
    out = arguments.out or (path if path.name else path.resolve()).with_suffix(".html")
    refuse_existing(str(out), arguments.force)
    map = open_map(arguments.directory)
    from fits.maps.report import page, tables, verdicts
    from fits.reports.tables import print_table

    with show_progress() as progress:
        found = page.report(map, out, arguments.force, progress)
    print_table(tables.count_table(found), sys.stdout)
    if found.fitted:
        print_table(tables.quartile_table(found, map), sys.stdout)
    for sentence in verdicts.in_short(found, map)[0]:
        print(sentence)
    print(f"Report: {out}")
    return DONE
