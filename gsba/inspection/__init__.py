"""Inspection of footage before a run: layout, times, sensors, lenses.

Takes a path of a video, an image or a folder.
Gives facts, as data and as text, with the `refine` command or the reason why it would be refused.
"""

from gsba.inspection.inspection import Inspection, inspect

__all__ = ["Inspection", "inspect"]
