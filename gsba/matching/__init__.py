"""Correspondences between frames, guided by predicted poses or without any prediction.

Takes keypoints, predicted poses, and gates for their uncertainty.
Gives matches, and pairs whose geometry was verified.
"""

from gsba.matching.guided_search import Gate, MatchContext, Matcher, SearchableFrames, guided
from gsba.matching.recovery import Recovered

__all__ = ["Gate", "MatchContext", "Matcher", "Recovered", "SearchableFrames", "guided"]
