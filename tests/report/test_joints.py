"""Notes on recordings that were joined to a map."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gsba.report.findings import _maps
from gsba.trajectory.joining import PLACES, SegmentAlignment


@pytest.mark.parametrize(("variance", "shown"), [(1e-4, "1 %"), (np.nan, "not known")])
def test_the_sigma_of_a_scale_that_few_meetings_give_is_not_known(
    variance: float, shown: str
) -> None:
    frames: Any = SimpleNamespace(names=("a/0", "a/1", "b/0", "b/1"))
    covariance = np.full((7, 7), variance)
    joint = SegmentAlignment(2, 3, 1.5, np.eye(4), PLACES, covariance)
    _, notes = _maps(None, (joint,), frames)
    assert notes == [f"recording b: joined by {PLACES}, scale 1.5 (sigma {shown})"]
