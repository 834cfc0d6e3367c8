"""A run, from frames and a coarse trajectory to refined poses, a cloud and datasets."""

from gsba.pipeline.outputs import RunResult
from gsba.pipeline.refine import refine, solve

__all__ = ["RunResult", "refine", "solve"]
