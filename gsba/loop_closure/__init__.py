"""Places met again: loops that drift had hidden, and maps that nothing ties together.

Takes a solution and what matches its frames.
Gives it bent so that places coincide, or its parts joined into one map.
"""

from gsba.loop_closure.connectivity import parted
from gsba.loop_closure.loops import Closed
from gsba.loop_closure.merged_map import Registered

__all__ = ["Closed", "Registered", "parted"]
