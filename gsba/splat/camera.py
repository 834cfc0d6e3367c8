"""The pinhole cameras that splats are rendered with: the faces of a rig."""

from dataclasses import dataclass

import numpy as np

from gsba.camera.rig import RIG_R_FACE, CubeRig


@dataclass(frozen=True, slots=True)
class FaceCamera:
    """One square pinhole image, principal point in its middle."""

    world_R_face: np.ndarray  # (3, 3) float64, face axes right, down, forward
    face_in_world: np.ndarray  # (3,) float64, map units
    size: int  # pixels
    focal: float  # pixels

    def packed(self) -> np.ndarray:
        """`[face_R_world row-major (9), centre (3), focal, principal]`, (14,) float64."""
        tail = [self.focal, 0.5 * self.size]
        return np.concatenate([self.world_R_face.T.ravel(), self.face_in_world, tail])


def rig_cameras(world_T_rig: np.ndarray, rig: CubeRig) -> list[FaceCamera]:
    """Cameras of all faces of a rig, in FACES order; see `face_camera`."""
    return [face_camera(world_T_rig, face, rig) for face in range(len(RIG_R_FACE))]


def face_camera(world_T_rig: np.ndarray, face: int, rig: CubeRig) -> FaceCamera:
    """Camera of one face of a rig.

    Args:
        world_T_rig: (4, 4) float64.
        face: index into FACES.
        rig: size and field of view.
    """
    world_R_face = world_T_rig[:3, :3] @ RIG_R_FACE[face]
    return FaceCamera(world_R_face, world_T_rig[:3, 3].copy(), rig.size, float(rig.focal))
