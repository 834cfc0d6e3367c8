"""World of an export: a similarity of the run's world, and the offset that stays beside it."""

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsba.disk import write_json
from gsba.geometry import local_origin, pose
from gsba.log import GsbaError
from gsba.similarity import Sim3
from gsba.types import Reconstruction
from gsba.version import __version__


@dataclass(frozen=True, slots=True)
class Placement:
    """Transform of a run's world: placed = similarity of the run; world = placed + offset."""

    similarity: Sim3 = field(default_factory=Sim3)
    unit: str = "map units"  # of the placed world
    up: str | None = None  # axis of the placed world that points up: "-y", "y", "z"; None = unknown
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))  # (3,), unit of the placed
    origin: tuple[float, float, float] | None = None  # latitude, longitude, altitude of placed 0
    grounds: dict[str, Any] = field(default_factory=dict)  # data it was computed from, and sigmas
    map_number: int = 1  # map of the run that is placed, 1 = the largest
    map_digest: str = ""  # of that map, see `gsba.store.finished.map_digest`; "" = not known

    @property
    def matrix(self) -> np.ndarray:
        """(4, 4) float64: placed = matrix @ run, homogeneous."""
        move = self.similarity
        return pose(move.scale * move.rotation, move.translation)

    @property
    def inverse(self) -> np.ndarray:
        """(4, 4) float64: run = inverse @ placed, homogeneous."""
        move = self.similarity
        back = move.rotation.T / move.scale
        return pose(back, -back @ move.translation)

    def apply(self, reconstruction: Reconstruction) -> Reconstruction:
        """Reconstruction in the placed world; bearings and rotation sigmas do not change."""
        poses, move = reconstruction.world_T_rigs, self.similarity
        stretch = np.array([1.0, 1, 1, *[move.scale] * 3])  # tangents are in the rig frame
        joint, origins = reconstruction.joint_errors, reconstruction.observation_origins
        lenses = reconstruction.lens_baseline
        return dataclasses.replace(
            reconstruction,
            world_T_rigs=move.poses(poses),
            points_world=move.points(reconstruction.points_world),
            pose_covariances=reconstruction.pose_covariances * stretch[:, None] * stretch,
            joint_errors=joint and joint.scaled(np.tile(stretch, (len(poses), 1))),
            observation_origins=None if origins is None else move.scale * origins,
            lens_baseline=lenses and (move.scale * lenses[0], move.scale * lenses[1]),
        )

    def of_trajectory(self, origin: np.ndarray | None) -> "Placement":
        """With the offset to the world of the trajectory, see `Reconstruction.origin`."""
        if origin is None:
            return self
        move = self.similarity
        return dataclasses.replace(self, offset=move.scale * move.rotation @ origin)

    def near_origin(self, placed: np.ndarray) -> "Placement":
        """With the offset split off, where placed positions (N, 3) are far from the origin."""
        origin, move = local_origin(placed), self.similarity
        if origin is None:
            return self
        move = dataclasses.replace(move, translation=move.translation - origin)
        return dataclasses.replace(self, similarity=move, offset=self.offset + origin)

    def to_json(self) -> dict[str, Any]:
        """Content of transform.json."""
        names = ("latitude", "longitude", "altitude")
        return {
            "gsba": __version__,
            "meaning": "placed = scale * rotation @ run + translation; world = placed + offset",
            "scale": self.similarity.scale,
            "rotation": self.similarity.rotation.tolist(),
            "translation": self.similarity.translation.tolist(),
            "matrix": self.matrix.tolist(),
            "inverse": self.inverse.tolist(),
            "unit": self.unit,
            "up": self.up,
            "offset": self.offset.tolist(),
            "origin": None if self.origin is None else dict(zip(names, self.origin, strict=True)),
            "grounds": self.grounds,
            "map": self.map_number,
            "map_digest": self.map_digest,
        }

    def write(self, path: Path) -> None:
        """Write transform.json."""
        write_json(path, self.to_json())


def read_placement(path: Path) -> Placement:
    """Placement of an export, from its transform.json; GsbaError if gsba did not write it."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        scale, rotation = float(content["scale"]), np.array(content["rotation"], np.float64)
        translation = np.array(content["translation"], np.float64)
        origin, up = content["origin"], content["up"]
        if origin is not None:
            origin = origin["latitude"], origin["longitude"], origin["altitude"]
        return Placement(
            Sim3(scale, rotation.reshape(3, 3), translation.reshape(3)),
            str(content["unit"]),
            up,
            np.array(content["offset"], np.float64).reshape(3),
            origin,
            content["grounds"],
            int(content.get("map", 1)),
            str(content.get("map_digest", "")),
        )
    except OSError as error:
        raise GsbaError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        raise GsbaError(f"{path} is not a transform.json of gsba: export again") from None
