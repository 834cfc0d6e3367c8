"""Loop closure and map merging: revisited places that drift displaced, and maps without a tie.

Takes a solution, and features and settings to match its frames.
Gives the solution with loops closed, or its parts joined into one map.
"""

from gsba.loop_closure.connectivity import parted
from gsba.loop_closure.loops import Closed
from gsba.loop_closure.merged_map import Registered

__all__ = ["Closed", "Registered", "parted"]
