"""Medians of many values by group: by frame, or by direction in the rig."""

import numpy as np


def medians_by_group(
    values: np.ndarray, groups: np.ndarray, num_groups: int, least: int = 1
) -> np.ndarray:
    """Median (G,) float64 of the values of each group; NaN for groups with fewer than `least`.

    Args:
        values: (N,).
        groups: (N,) integers, group of each value.
        num_groups: G.
        least: values that a group needs, at least one.
    """
    counts = np.bincount(groups, minlength=num_groups)
    ordered = values[np.argsort(groups, kind="stable")]
    ends = np.cumsum(counts)
    found = np.full(num_groups, np.nan)
    for group in np.flatnonzero(counts >= least):
        found[group] = np.median(ordered[ends[group] - counts[group] : ends[group]])
    return found
