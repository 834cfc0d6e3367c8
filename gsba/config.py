"""Settings: one frozen model per stage, defaults that run a sensible job with no file."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class _Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ReadSettings(_Settings):
    """Frames, trajectory and their association in time."""

    max_interpolation_s: float = Field(10.0, gt=0)  # longer gaps are still filled, but reported
    clock_offset_s: float | None = None  # seconds to add to frame times; None = must not be needed


class CubemapSettings(_Settings):
    """Faces cut from a panorama for detection."""

    hfov_deg: float = Field(96.0, ge=90, le=120)
    face_size: int | None = Field(None, ge=64)  # pixels; None = the panorama's own resolution
    max_face_size: int = Field(1024, ge=64)  # pixels; bound on the automatic size


class FeatureSettings(_Settings):
    """Keypoints on faces."""

    extractor: Literal["sift"] = "sift"
    max_per_face: int = Field(900, ge=16)
    contrast_threshold: float = Field(0.01, gt=0)
    sigma_px: float = Field(0.16, gt=0)  # per-axis noise of the smallest keypoints, face pixels
    sigma_per_size: float = Field(0.033, ge=0)  # further noise, as a part of the keypoint's size


class MatchingSettings(_Settings):
    """Guided descriptor matching."""

    min_similarity: float = Field(0.8, ge=-1, le=1)  # cosine of both descriptors
    max_ratio: float = Field(0.85, gt=0, le=1)  # distance to the best over that to the next


class PairSettings(_Settings):
    """Which frames are matched."""

    window: int = Field(8, ge=2)  # frames in time
    max_baseline_depths: float = Field(1.5, gt=0)  # longest baseline in median scene depths
    max_loop_neighbours: int = Field(8, ge=0)  # nearest frames in space outside the window


class VerifySettings(_Settings):
    """Two-view geometry."""

    max_error_deg: float = Field(0.25, gt=0)  # RANSAC inlier threshold
    min_inliers: int = Field(25, ge=8)
    max_rotation_deg: float = Field(6.0, gt=0)  # disagreement with the trajectory
    max_direction_deg: float = Field(20.0, gt=0)  # disagreement with the trajectory


class TriangulateSettings(_Settings):
    """Scene points."""

    min_track_length: int = Field(2, ge=2)  # observations of a point
    min_parallax_deg: float = Field(0.5, gt=0)  # largest angle between two rays of a point


class PriorSettings(_Settings):
    """What the trajectory is worth in the graph."""

    rotation_deg: float = Field(0.5, gt=0)  # noise of a step's rotation
    translation: float = Field(0.1, gt=0)  # noise of a step's translation, part of the step
    absolute_rotation_deg: float = Field(30.0, gt=0)
    absolute_position: float = Field(0.3, gt=0)  # part of the trajectory's extent
    loss_sigmas: float = Field(2.0, gt=0)  # Cauchy scale: steps further off let go


class SolverSettings(_Settings):
    """Levenberg-Marquardt."""

    max_iterations: int = Field(50, ge=1)
    relative_tolerance: float = Field(1e-5, gt=0, lt=1)  # decrease of the cost that ends a run
    lambda_initial: float = Field(1e-4, gt=0)  # damping, part of the diagonal
    num_threads: int | None = Field(None, ge=1)  # None = all cores


class RefineSettings(_Settings):
    """Everything a run depends on."""

    read: ReadSettings = ReadSettings()
    cubemap: CubemapSettings = CubemapSettings()
    features: FeatureSettings = FeatureSettings()
    matching: MatchingSettings = MatchingSettings()
    pairs: PairSettings = PairSettings()
    verify: VerifySettings = VerifySettings()
    triangulate: TriangulateSettings = TriangulateSettings()
    priors: PriorSettings = PriorSettings()
    solver: SolverSettings = SolverSettings()
    seed: int = 0
