"""Learned keypoints and matchers (extra `learned`), behind the same interfaces as our own.

Takes weights, which are their authors', under their own licences: nothing is bundled.
Gives an extractor or a matcher; networks come from kornia and transformers, imported when used.
"""

from gsba.learned.extractor import LearnedExtractor, make_extractor
from gsba.learned.matcher import FaceMatcher, make_matcher, overlapping_faces
from gsba.learned.weights import find_weights

__all__ = [
    "FaceMatcher",
    "LearnedExtractor",
    "find_weights",
    "make_extractor",
    "make_matcher",
    "overlapping_faces",
]
