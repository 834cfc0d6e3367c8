"""Learned keypoints and matchers (extra `learned`), behind the same interfaces as our own.

Nothing is bundled: weights are their authors', under their own licences (`weights`). Networks come
from kornia and transformers; imported only when one is used.
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
