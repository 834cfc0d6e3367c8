"""The pinhole cameras that splats are rendered with: views of rigs."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gsba.camera.views import View


@dataclass(frozen=True, slots=True)
class FaceCamera:
    """One pinhole image."""

    world_R_face: np.ndarray  # (3, 3) float64, face axes right, down, forward
    face_in_world: np.ndarray  # (3,) float64, map units
    width: int  # pixels
    height: int  # pixels
    focal: float  # pixels
    principal: tuple[float, float]  # pixels, corner origin

    @property
    def share(self) -> float:
        """Number of pixels, relative to a face of 90 degrees of the same focal length."""
        return self.width * self.height / (2 * self.focal) ** 2

    def packed(self) -> np.ndarray:
        """`[face_R_world row-major (9), centre (3), focal, principal (2), width, height]`, (17,)
        float64."""
        tail = [self.focal, *self.principal, self.width, self.height]
        return np.concatenate([self.world_R_face.T.ravel(), self.face_in_world, tail])


def rig_cameras(world_T_rig: np.ndarray, views: Iterable[View]) -> list[FaceCamera]:
    """Cameras of some views of a rig (4, 4)."""
    return [view_camera(world_T_rig, view) for view in views]


def view_camera(world_T_rig: np.ndarray, view: View) -> FaceCamera:
    """Camera of one view of a rig (4, 4)."""
    rotation = world_T_rig[:3, :3]
    centre = world_T_rig[:3, 3] + rotation @ view.centre
    size = view.width, view.height
    return FaceCamera(rotation @ view.rig_R_view, centre, *size, view.focal, view.principal)
