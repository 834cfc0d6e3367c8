"""Medians by group against the groups' own."""

import numpy as np

from gsba.report.report import medians_by_group


def test_medians_of_groups() -> None:
    groups = np.array([0, 0, 0, 0, 0, 0, 2, 2, 2, 2, 2, 1])
    values = np.array([6.0, 1, 2, 3, 4, 5, 9, 8, 7, 5, 6, 1])
    np.testing.assert_array_equal(medians_by_group(values, groups, 4), [3.5, 1, 7, np.nan])
    np.testing.assert_array_equal(
        medians_by_group(values, groups, 4, least=5), [3.5, np.nan, 7, np.nan]
    )


def test_medians_of_nothing() -> None:
    none = np.empty(0)
    assert np.isnan(medians_by_group(none, none.astype(np.int32), 3)).all()
