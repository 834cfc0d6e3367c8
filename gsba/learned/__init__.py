"""Learned keypoints and matchers (extra `learned`), with the interfaces of SIFT and guided search.

Takes weights, which their authors publish under their own licences: none are bundled.
Gives an extractor or a matcher; networks come from kornia and transformers, imported on use.
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
