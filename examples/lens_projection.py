"""A lens projection of your own: the equisolid fisheye, r = 2 f sin(angle / 2).

python examples/lens_projection.py FRAMES TRAJECTORY CALIBRATION RUN

FRAMES holds raw pictures, and CALIBRATION says `"model": "equisolid"` beside its lenses. A package
registers a projection for `gsba refine` by the entry point group `gsba.projections`.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsba import RunResult, refine
from gsba.camera.projections import PROJECTIONS, RadialProjection


@dataclass(frozen=True, slots=True)
class EquisolidProjection(RadialProjection):
    """Equal solid angles cover equal areas of the picture (Miyamoto, JOSA 1964)."""

    def radii(self, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance from the principal point in focal lengths, and its derivative by the angle."""
        return 2 * np.sin(angles / 2), np.cos(angles / 2)


PROJECTIONS["equisolid"] = EquisolidProjection


def main(frames: Path, trajectory: Path | None, calibration: Path, out: Path) -> RunResult:
    """Refine raw frames of equisolid lenses."""
    return refine(frames, trajectory, out, calibration=calibration)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:5]))
