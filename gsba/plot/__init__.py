"""Figures of several runs: trajectories, errors against the truth, residuals.

Takes folders of finished runs, or trajectory files, and the truth if there is one.
Gives PNG, SVG or PDF with reproducible bytes.
"""

from gsba.plot.figures import draw
from gsba.plot.runs import Shown, load

__all__ = ["Shown", "draw", "load"]
