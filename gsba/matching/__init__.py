"""Correspondences between frames, guided by predicted poses or by nothing at all.

Takes keypoints, poses that predict, and how far to trust them.
Gives matches, and pairs whose geometry was verified.
"""

from gsba.matching.guided_search import Gate, MatchContext, Matcher, SearchableFrames, guided
from gsba.matching.recovery import Recovered

__all__ = ["Gate", "MatchContext", "Matcher", "Recovered", "SearchableFrames", "guided"]
