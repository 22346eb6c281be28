"""Readings that a fit has not seen: left out of it, foretold, and scored."""

import sys
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fits._files import write_text
from fits.cli.options import READING, refuse_alone
from fits.cli.places import require_free_place
from fits.cli.reading import reading
from fits.cli.setting import use_jax
from fits.data.geometry import Geometry, slices
from fits.data.measurements import Measurements
from fits.data.reading import of_channels
from fits.data.selection import select

if TYPE_CHECKING:
    from fits.prediction.predict import Prediction

DONE = 0


def print_scores(prediction: "Prediction", readings: Measurements, title: str) -> None:
    """How well readings were foretold."""
    from fits.reports import tables
    from fits.reports.predictions import scores_table

    tables.print_table(scores_table(prediction, readings, title), sys.stdout)


def predict(arguments: Namespace) -> int:
    """Write what would be read elsewhere, or print how well readings are foretold."""
    if (arguments.incidence is None) == (arguments.at is None):
        raise ValueError("predict needs one of --incidence and --at")
    if arguments.at is None and arguments.out is None:
        raise ValueError("predict --incidence needs --out FILE")
    if arguments.at is None:
        refuse_alone(arguments, ("only", *READING), "at")
    else:
        refuse_alone(arguments, ("azimuth",), "incidence")
    if arguments.out is not None:
        require_free_place(arguments, ".csv", "predictions")
    use_jax()
    from fits.prediction.predict import predict as run_prediction
    from fits.reports import results, verdicts
    from fits.reports.predictions import UNRELIABLE, prediction_csv

    directory = Path(arguments.directory)
    posterior = results.load_posterior(directory)
    of = posterior if posterior is not None and verdicts.reportable(posterior) else results.load_fit(directory)
    if arguments.at is None:
        at: Geometry | Measurements = slices(np.concatenate(arguments.incidence), azimuth=arguments.azimuth or (0,))
    else:
        at = _predicted_readings(arguments)
    found = run_prediction(of, at)
    if isinstance(at, Measurements):
        print_scores(found, at, f"Readings of {arguments.at}")
    if arguments.out is not None:
        write_text(arguments.out, prediction_csv(found), force=arguments.force)
        print(
            f"{arguments.out}: in 1/sr, bsdf_* with the model discrepancy, predictive_* of a new measurement, "
            "latent_* of the stack alone"
        )
        if not found.reliable:
            print(UNRELIABLE)
    return DONE


def _predicted_readings(arguments: Namespace) -> Measurements:
    data, only = of_channels(reading(arguments).whole(arguments.at), arguments.only)
    for words in only:
        data = data.where(select(data, words))
    if not data.mask.any():
        raise ValueError(f"{arguments.at}: --only leaves nothing to predict")
    return data
