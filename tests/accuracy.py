"""Accuracy of runs, compared by the errors that they predict."""

from pathlib import Path

import numpy as np

from gsba.store.finished import load_run


def predicted_error(run: Path) -> float:
    """Position error that a run predicts by its covariances: RMS over its frames, in its units."""
    covariances = load_run(run)[0].pose_covariances[:, 3:, 3:]
    return float(np.sqrt(np.nanmean(np.trace(covariances, axis1=1, axis2=2))))


def assert_as_accurate(run: Path, error: float, other: Path, ratio: float) -> None:
    """A run predicts errors at most `ratio` times as large as another one, and the true error of
    its positions is a likely one.

    True errors are not compared with each other: over ten frames, that of one solution of the same
    pictures scatters by more than half with the kind of the CPU's code, and a predicted one by a
    twentieth.
    """
    predicted = predicted_error(run)
    assert predicted < ratio * predicted_error(other)
    assert error < 4 * predicted
