"""Accuracy of a run: errors against the truth, consistency of covariances, quality of splats.

Takes trajectories, a finished run, depth, or held-out frames.
Gives errors, their table, and JSON. `gsba.evaluate.splats` is imported by its own name.
"""

from gsba.evaluate.consistency import Consistency, consistency_of, format_consistency
from gsba.evaluate.pixels import InducedErrors, induced_errors
from gsba.evaluate.trajectory import TrajectoryErrors, evaluate, format_table

__all__ = [
    "Consistency",
    "InducedErrors",
    "TrajectoryErrors",
    "consistency_of",
    "evaluate",
    "format_consistency",
    "format_table",
    "induced_errors",
]
