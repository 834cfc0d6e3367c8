"""A run, from frames and a coarse trajectory to refined poses, a cloud and datasets."""

from gsba.pipeline.refine import RunResult, load_run, refine

__all__ = ["RunResult", "load_run", "refine"]
