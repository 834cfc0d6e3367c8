"""Keypoints of a picture to localise, prepared for matching."""

from dataclasses import dataclass

import numpy as np

from gsba.matching.guided_search import Searchable
from gsba.types import Features


@dataclass(frozen=True, slots=True)
class Query:
    """Keypoints of a picture to localise."""

    features: Features
    bearings: np.ndarray  # (K, 3) unit, corrected directions of the keypoints, rig frame
    origins_rig: np.ndarray | None  # (K, 3) origins of their rays; None = the centre
    strongest: Searchable  # prepared for matching
    all: Searchable
