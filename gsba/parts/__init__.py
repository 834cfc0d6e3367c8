"""Maps too large for one process: cut into parts, whose own unknowns are eliminated where they lie.

Takes poses, points and observations that `PartsWriter` writes to disk part by part.
Gives the poses and points that `gsba.bundle.optimizer.optimize` finds undivided.
"""

from gsba.parts.adjustments import DividedAdjustments
from gsba.parts.divided_system import divided_covariances, optimize_divided
from gsba.parts.folder import PartsWriter

__all__ = ["DividedAdjustments", "PartsWriter", "divided_covariances", "optimize_divided"]
