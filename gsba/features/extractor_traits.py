"""Measured traits of each extractor: noise and offset of its keypoints, likeness of true matches.

Measured on panoramas turned about all axes; see
`benchmarks/results/learned.md`.
"""

from dataclasses import dataclass

from gsba.config import MatchingSettings, RefineSettings


@dataclass(frozen=True, slots=True)
class ExtractorTraits:
    """Traits of an extractor's keypoints and descriptors."""

    min_similarity: float  # cosine that 95 % of true matches exceed
    max_ratio: float  # ratio of distances, best over second best, below which 90 % of them are
    sigma_px: float | None = None  # per-axis noise, face pixels; None = by a keypoint's size
    offset_px: tuple[float, float] = (0.0, 0.0)  # (u, v) to add to the network's pixels


TRAITS = {
    "sift": ExtractorTraits(0.8, 0.9),
    "aliked": ExtractorTraits(0.55, 0.95, 0.28, (-0.35, 0.1)),
    "disk": ExtractorTraits(0.55, 0.95, 0.37, (-0.45, -0.35)),
    "xfeat": ExtractorTraits(0.78, 0.97, 0.42, (-0.1, 1.05)),
    "superpoint": ExtractorTraits(0.8, 0.9, 0.5),  # not measured
}


def search_settings(settings: RefineSettings) -> MatchingSettings:
    """Settings of the descriptor search, with the extractor's limits where none are given."""
    chosen, traits = settings.matching, TRAITS[settings.features.extractor]
    measured = {"min_similarity": traits.min_similarity, "max_ratio": traits.max_ratio}
    missing = {name: value for name, value in measured.items() if getattr(chosen, name) is None}
    return chosen.model_copy(update=missing)
