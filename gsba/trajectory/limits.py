"""Limits of two-view geometry, and of its agreement with the trajectory."""

from dataclasses import dataclass

from gsba.config import RefineSettings


@dataclass(frozen=True, slots=True)
class TwoViewLimits:
    """Limits of two-view geometry, and of its agreement with the trajectory."""

    max_error_deg: float = 0.25  # RANSAC inlier threshold, for exact directions
    max_false_alarms: float = 1e-3  # expected number of relative poses that fit random matches as
    # well as the estimated one
    max_error_rate: float = 0.05  # probability of preferring one of two poses that explain the
    # matches equally well
    max_rotation_deg: float = 6.0  # disagreement with the trajectory; the next two as well
    max_direction_deg: float = 20.0
    max_length_ratio: float = 1.5

    @classmethod
    def of(cls, settings: RefineSettings) -> "TwoViewLimits":
        """Limits under the matching gates of a run."""
        return cls(settings.gate_factor * cls().max_error_deg)
