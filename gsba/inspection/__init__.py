"""Inspection of footage before a run (layout, times, sensors, lenses), and of runs.

Takes a path of a video, an image, a folder of images or a run folder.
Gives facts, as data and as text, with the command to give next or the reason why `refine` would
refuse it.
"""

from gsba.inspection.inspection import Inspection, inspect

__all__ = ["Inspection", "inspect"]
