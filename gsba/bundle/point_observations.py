"""Observations of a map's points, as families of residuals read them."""

from dataclasses import dataclass

import numpy as np

from gsba.types import Keypoints, Landmarks


@dataclass(frozen=True, slots=True)
class PointObservations:
    """O observations of points by frames, each with its noise."""

    frames: np.ndarray  # (O,) int64, row of the frame
    points: np.ndarray  # (O,) int64, row of the point
    bearings_rig: np.ndarray  # (O, 3) float64, unit, rig frame
    sigmas_rad: np.ndarray  # (O,) float64, of either angle on `factors.tangent_basis`
    sqrt_infos: np.ndarray | None  # (O, 2, 2) 1/rad on that basis, in place of sigmas_rad where
    # observations are sharper along one direction; None = they are not
    origins_rig: np.ndarray | None  # (O, 3) map units, rig frame, where each ray starts; None = in
    # the rig's centre
    faces: np.ndarray  # (O,) uint8, cube face that shows the observation
    pixels: np.ndarray  # (O, 2) float64, (u, v) on it, corner origin

    @classmethod
    def of(cls, landmarks: Landmarks, keypoints: Keypoints, noise: float) -> "PointObservations":
        """Observations of landmarks.

        Args:
            noise: of an observation, in units of its keypoint's own sigma.
        """
        tracks, rows = landmarks.tracks, keypoints.rows(landmarks.tracks)
        infos = keypoints.sqrt_infos
        return cls(
            frames=tracks.frames,
            points=tracks.points,
            bearings_rig=keypoints.bearings_rig.take(rows, axis=0),
            sigmas_rad=noise * keypoints.sigmas_rad[rows],
            sqrt_infos=None if infos is None else infos.take(rows, axis=0) / noise,
            origins_rig=keypoints.origins_of(rows),
            faces=keypoints.faces[rows],
            pixels=keypoints.pixels.take(rows, axis=0),
        )
