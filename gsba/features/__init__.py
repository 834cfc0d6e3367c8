"""Keypoints on the faces of frames, as bearings.

Takes frames, their masks and an extractor.
Gives features frame by frame, stored on disk, and all keypoints back to back.
"""

from gsba.features.detection import Extractor, FaceKeypoints, SiftExtractor, gather

__all__ = ["Extractor", "FaceKeypoints", "SiftExtractor", "gather"]
