"""Settings: one frozen model per stage, defaults that run a sensible job with no file."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class _Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


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
    sigma_px: float = Field(0.6, gt=0)  # localisation noise of the smallest keypoints, face pixels


class RefineSettings(_Settings):
    """Everything a run depends on."""

    read: ReadSettings = ReadSettings()
    cubemap: CubemapSettings = CubemapSettings()
    features: FeatureSettings = FeatureSettings()
    seed: int = 0
