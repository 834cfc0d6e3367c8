"""Check of the installation: packages, their faults, and one command that repairs each.

Takes nothing: it examines this machine and this Python.
Gives an examination, as data and as text; a broken package is a finding, not an error.
"""

from gsba.doctor.examination import Examination, Group, examine
from gsba.doctor.packages import Package

__all__ = ["Examination", "Group", "Package", "examine"]
