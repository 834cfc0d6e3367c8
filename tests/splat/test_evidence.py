"""Scores of paired differences."""

import numpy as np
import pytest

from gsba.splat.refinement import score, together


def test_scores_are_those_of_a_normal_distribution() -> None:
    rng = np.random.default_rng(0)
    found = np.array([score(rng.standard_normal(6)) for _ in range(4000)])
    assert np.mean(found > 2) == pytest.approx(0.0228, abs=0.006)  # 2.5 sigma of the count
    assert np.std(found) == pytest.approx(1, abs=0.03)
    assert score(np.array([3.0, 4.0, 5.0]), chance=12.0) == 0
    assert score(np.array([3.0])) == 0  # of unknown spread
    assert together(3.0, -2.0) == pytest.approx(np.sqrt(5))
    assert together(0.0, -2.0) == -2
