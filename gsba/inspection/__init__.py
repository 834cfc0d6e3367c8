"""What a camera's file or folder is, before it is refined: layout, times, sensors, lenses.

Takes a path.
Gives an inspection, as data and as text, with the `refine` line to type or why it would be refused.
"""

from gsba.inspection.inspection import Inspection, inspect

__all__ = ["Inspection", "inspect"]
