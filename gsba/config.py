"""Settings: one frozen model per stage, defaults that run a sensible job with no file."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class _Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ReadSettings(_Settings):
    """Frames, trajectory and their association in time."""

    max_interpolation_s: float = Field(
        default=10.0, gt=0
    )  # longer gaps are still filled, but reported
    clock_offset_s: float | None = None  # s to add to frame times; None = clocks agree or one fits


class CubemapSettings(_Settings):
    """Faces cut from a panorama for detection."""

    hfov_deg: float = Field(default=96.0, ge=90, le=120)
    face_size: int | None = Field(default=None, ge=64)  # pixels; None = by oversampling
    oversampling: float = Field(default=1.15, ge=0.25, le=4)  # face pixels per panorama pixel
    min_face_size: int = Field(default=512, ge=64)  # pixels; bounds on the automatic size
    max_face_size: int = Field(default=1024, ge=64)


class FeatureSettings(_Settings):
    """Keypoints on faces."""

    extractor: Literal["sift"] = "sift"
    max_per_face: int = Field(default=1000, ge=16)
    contrast_threshold: float = Field(default=0.01, gt=0)
    sigma_px: float = Field(
        default=0.16, gt=0
    )  # per-axis noise of the smallest keypoints, face pixels
    sigma_per_size: float = Field(
        default=0.033, ge=0
    )  # further noise, as a part of the keypoint's size


class MatchingSettings(_Settings):
    """Guided descriptor matching."""

    min_similarity: float = Field(default=0.8, ge=-1, le=1)  # cosine of both descriptors
    max_ratio: float = Field(default=0.9, gt=0, le=1)  # distance to the best over that to the next


class GateSettings(_Settings):
    """How far a match may stray from what poses predict."""

    rotation_deg: float = Field(gt=0)  # error of the relative rotation
    direction: float = Field(ge=0)  # tangent of the error of the translation's direction


class PairSettings(_Settings):
    """Which frames are matched, and how closely predictions are believed."""

    window: int = Field(default=32, ge=2)  # frames in time
    max_baseline_depths: float = Field(default=2.0, gt=0)  # longest baseline in median scene depths
    max_loop_neighbours: int = Field(default=8, ge=0)  # nearest frames in space outside the window
    max_parallax_deg: float = Field(default=60.0, gt=0, le=180)
    strongest_per_face: int = Field(default=300, ge=16)  # keypoints that find neighbours' geometry
    scarce_matches: int = Field(default=60, ge=0)  # below, a pair is matched with all keypoints
    prior: GateSettings = GateSettings(rotation_deg=4.0, direction=0.4)  # coarse trajectory
    loop_deg: float = Field(default=2.0, gt=0)  # around a known point, besides drift
    refined: GateSettings = GateSettings(rotation_deg=0.4, direction=0.005)  # solved map
    point_deg: float = Field(default=0.6, gt=0)  # around the predicted bearing of a known point
    drift: float = Field(
        default=0.003, gt=0
    )  # of the solved chain, part of the path between two frames
    far_drift: float = Field(
        default=0.05, ge=0, le=1
    )  # the same at its worst: no loop may ask for more


class VerifySettings(_Settings):
    """Two-view geometry."""

    max_error_deg: float = Field(default=0.25, gt=0)  # RANSAC inlier threshold
    min_inliers: int = Field(default=25, ge=8)
    min_share: float = Field(
        default=0.45, ge=0, le=1
    )  # inliers among the matches of neighbours that no trajectory guided: look-alikes have 0.4
    max_rotation_deg: float = Field(default=6.0, gt=0)  # disagreement with the trajectory
    max_direction_deg: float = Field(default=20.0, gt=0)  # disagreement with the trajectory
    min_parallax_deg: float = Field(default=1.0, gt=0)  # median; below it a direction is not judged
    max_length_ratio: float = Field(default=1.5, gt=1)  # disagreement with the trajectory


class TriangulateSettings(_Settings):
    """Scene points."""

    min_track_length: int = Field(default=2, ge=2)  # observations of a point
    min_parallax_deg: float = Field(default=0.5, gt=0)  # largest angle between two rays of a point


class RoundSettings(_Settings):
    """Triangulate, adjust, filter: gates in standard deviations of the observations' noise."""

    chain: tuple[float, ...] = (60.0, 8.0)  # from the coarse trajectory
    dense: tuple[float, ...] = (6.0, 3.0)  # with matches along the solved chain
    loops: tuple[float, ...] = (100.0, 20.0, 4.0)  # with loops closed
    refined: tuple[float, ...] = (6.0, 3.0, 2.5)  # with matches along the solved map
    map_passes: int = Field(default=1, ge=1)  # times the closed map is matched anew
    gate_scale: float = Field(default=10.0, ge=1)  # wider gates loosen the loss in proportion
    tolerance: float = Field(default=1e-3, gt=0, lt=1)  # solver's, in all rounds but a stage's last
    min_support: float = Field(
        default=0.99, gt=0, le=1
    )  # observations a round must go on explaining
    min_noise: float = Field(default=0.5, gt=0)  # floor of the estimated noise, in feature sigmas
    min_observations: int = Field(default=12, ge=1)  # of a frame, or it counts as unrefined


class PriorSettings(_Settings):
    """What the trajectory is worth in the graph."""

    rotation_deg: float = Field(default=0.5, gt=0)  # noise of a step's rotation
    translation: float = Field(default=0.1, gt=0)  # noise of a step's translation, part of the step
    absolute_rotation_deg: float = Field(default=30.0, gt=0)
    absolute_position: float = Field(default=0.3, gt=0)  # part of the trajectory's extent
    loss_sigmas: float = Field(default=2.0, gt=0)  # Cauchy scale: steps further off let go


class SolverSettings(_Settings):
    """Levenberg-Marquardt."""

    max_iterations: int = Field(default=50, ge=1)
    relative_tolerance: float = Field(default=1e-5, gt=0, lt=1)  # least decrease of the cost
    loss: Literal["none", "huber", "cauchy", "geman_mcclure"] = "cauchy"
    loss_sigmas: float = Field(default=1.0, gt=0)  # scale of the loss, standard deviations
    lambda_initial: float = Field(default=1e-4, gt=0)  # damping, part of the diagonal
    num_threads: int | None = Field(default=None, ge=1)  # None = all cores


class ExportSettings(_Settings):
    """Datasets written at the end of a run."""

    formats: tuple[
        Literal["colmap", "colmap-flat", "colmap-erp", "nerfstudio", "ply", "tum"], ...
    ] = ("colmap",)
    face_size: int | None = Field(
        default=None, ge=16
    )  # pixels; None = a quarter of the panorama's width


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
    rounds: RoundSettings = RoundSettings()
    solver: SolverSettings = SolverSettings()
    factors: tuple[Literal["bearing", "reprojection"], ...] = Field(
        default=("bearing",), min_length=1
    )
    export: ExportSettings = ExportSettings()
    seed: int = 0
