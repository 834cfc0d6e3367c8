"""What is installed, what of it works, and the one command for each part that does not.

Takes nothing: it looks at this machine and at this Python.
Gives an examination, as data and as text; whatever is broken is a finding of it, never a failure.
"""

from gsba.doctor.examination import Examination, Group, examine
from gsba.doctor.packages import Package

__all__ = ["Examination", "Group", "Package", "examine"]
