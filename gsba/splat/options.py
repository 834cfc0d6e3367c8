"""Options of a splat's training that no command sets."""

from pydantic import Field

from gsba.config import SplatSettings


class TrainingOptions(SplatSettings):
    """Options of a splat's training; learning rates are those of Kerbl et al., 2023."""

    sh_degree: int = Field(default=3, ge=0, le=3)
    rate_means: float = Field(default=1.6e-4, gt=0)  # at the start, part of the extent
    rate_means_end: float = Field(default=1.6e-6, gt=0)
    rate_scales: float = Field(default=5e-3, gt=0)
    rate_fade: float = Field(default=1.0, gt=0, le=1)  # factor at the end on all rates but means'
    seed: int = Field(default=0, ge=0)
