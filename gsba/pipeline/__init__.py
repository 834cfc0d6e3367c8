"""A run: `refine` calls it, `solve` is the method, the other files are its chapters.

Takes frames, a coarse trajectory, settings and a folder.
Gives refined poses, a cloud, datasets and a report.
"""

from gsba.pipeline.growing import add_recordings, merge_runs, remove_recordings
from gsba.pipeline.map import Map
from gsba.pipeline.outputs import RunResult
from gsba.pipeline.prior import Prior
from gsba.pipeline.recordings import Recording
from gsba.pipeline.refine import refine, refine_recordings, solve
from gsba.pipeline.run import Evidence, Run
from gsba.pipeline.state import State

__all__ = [
    "Evidence",
    "Map",
    "Prior",
    "Recording",
    "Run",
    "RunResult",
    "State",
    "add_recordings",
    "merge_runs",
    "refine",
    "refine_recordings",
    "remove_recordings",
    "solve",
]
