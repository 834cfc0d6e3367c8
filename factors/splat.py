"""Direct alignment of captured panoramas to renderings of a splat at their poses.

A rendering at the last accepted pose, colour and expected depth, is a cloud of points with grey
values. At another pose each point projects elsewhere in the captured frame; the residual is the
captured grey value there minus the rendered one, after one gain and one offset per frame. So the
rasteriser is never differentiated, and all faces of a frame give one 6x6 block. After
Newcombe et al., DTAM, ICCV 2011 (tracking against a rendered model), on the sphere.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factors._terms import pose_rows
from factors.block import Block, PoseSystem
from factors.compiled import kernel_and_part
from factors.reprojection import FaceCameras
from factors.robust import RobustLoss

NAME = "splat"
_kernel, _part = kernel_and_part()
_MIN_SAMPLES = 50  # least samples that constrain a pose
_MIN_SPREAD = 1e-3  # least spread of the residuals, grey values 0..1


@dataclass(frozen=True, slots=True)
class RenderedView:
    """Opaque pixels of a splat rendered at a pose, as points."""

    points_world: np.ndarray  # (N, 3) float64, world: pixels at their expected depth
    grey: np.ndarray  # (N,) float64, 0..1


@dataclass(frozen=True, slots=True)
class _Frame:
    """One frame between two renderings."""

    view: RenderedView
    grey: np.ndarray  # (N,) float64, of the view, after gain and offset
    sigma: float  # of a residual, grey values


Render = Callable[[int, np.ndarray], RenderedView]  # row of keys, world_T_rig (4, 4)


class SplatBlock(Block):
    """Alignment of frames to a fixed splat; implements `factors.block.Block`.

    No two frames share a residual: the map is the splat's, and its gauge is fixed by other factors
    of the graph.

    Attributes:
        keys: (F,) keys of the Pose3 variables `world_T_rig`.
        pairs: (0, 2).
    """

    def __init__(
        self,
        keys: Sequence[int],
        images: Sequence[np.ndarray],
        weights: Sequence[np.ndarray | None],
        cameras: FaceCameras,
        render: Render,
        loss: RobustLoss | None = None,
        correlation: float = 25.0,
        centres: np.ndarray | None = None,
        turns: np.ndarray | None = None,
    ) -> None:
        """Prepare the captured frames for sampling.

        Args:
            keys: (F,) keys of Pose3 variables.
            images: (F,) of (C, H, W) float32 grey values 0..1 of a frame's faces, which should
                overlap by a few pixels for sampling near their edges.
            weights: (F,) of (C, H, W) float or bool, weights of pixels, 0..1: 0 is never
                sampled; or None.
            render: the splat from a pose; called by `refresh`.
            loss: robust loss on each whitened residual; None is Cauchy at one sigma.
            correlation: number of pixels with a common error, which count as one; 25 made the
                errors of aligned poses agree with their covariance, at faces of 48 to 192 pixels.
            centres: (C, 3) float64, centres of the cameras in the rig; None = the rig's.
            turns: (F, 3, 3) float64, rotations of all cameras in each frame's rig; None = none.

        Raises:
            ValueError: images, masks and keys differ in number.
        """
        if not len(keys) == len(images) == len(weights):
            raise ValueError("keys, images and weights must be equally long")
        self.keys = [int(key) for key in keys]
        self.pairs = np.zeros((0, 2), np.int64)
        self.loss = loss or RobustLoss("cauchy", 1.0)
        self.correlation = correlation
        self._cameras, self._render, self._turns = cameras, render, turns
        self._centres = np.zeros((len(cameras.focals), 3)) if centres is None else centres
        self._images = [_spline(image) for image in images]
        whole = np.ones(self._images[0].shape if len(images) else (0, 0, 0), np.float32)
        self._trust = [whole if w is None else np.ascontiguousarray(w, np.float32) for w in weights]
        self._frames: list[_Frame] = []

    def refresh(self, values: gtsam.Values) -> None:
        """Render at accepted poses; fit gain, offset and noise of every frame there."""
        self._frames = []
        for f, key in enumerate(self.keys):
            view = self._render(f, values.atPose3(key).matrix())
            found, _, trust = self._sample(f, view, pose_rows(values, [key])[0], False)
            seen = trust > 0
            gain, offset = _exposure(view.grey[seen], found[seen])
            grey = gain * view.grey + offset
            spread = 1.4826 * np.median(np.abs(found - grey)[seen]) if seen.any() else 0.0
            self._frames.append(_Frame(view, grey, max(float(spread), _MIN_SPREAD)))

    def linearize(self, values: gtsam.Values) -> PoseSystem:
        """Gauss-Newton model with robust weights at `values`."""
        num = len(self.keys)
        diagonal, gradient, cost = np.zeros((num, 6, 6)), np.zeros((num, 6)), 0.0
        for f, pose in enumerate(pose_rows(values, self.keys)):
            residuals, jacobian, trust = self._residuals(f, pose, True)
            squared, shares = residuals**2, trust / self.correlation
            weighted = jacobian * (shares * self.loss.weights(squared))[:, None]
            diagonal[f], gradient[f] = weighted.T @ jacobian, weighted.T @ residuals
            cost += float(shares @ self.loss.rho(squared))
        return PoseSystem(diagonal, np.zeros((0, 6, 6)), gradient, {NAME: cost})

    def propose(self, values: gtsam.Values, steps: np.ndarray) -> float:
        """Robust cost at tentative values."""
        return self.costs(values)[NAME]

    def costs(self, values: gtsam.Values) -> dict[str, float]:
        """Robust cost under the last renderings."""
        poses = pose_rows(values, self.keys)
        return {NAME: sum(self._frame_cost(f, pose) for f, pose in enumerate(poses))}

    def residuals(self, values: gtsam.Values) -> list[np.ndarray]:
        """Whitened residuals (N,) of each frame's samples, 0 where a sample is not visible."""
        poses = pose_rows(values, self.keys)
        return [self._residuals(f, pose, False)[0] for f, pose in enumerate(poses)]

    def _frame_cost(self, f: int, pose: np.ndarray) -> float:
        residuals, _, trust = self._residuals(f, pose, False)
        return float(trust @ self.loss.rho(residuals**2)) / self.correlation

    def _residuals(
        self, f: int, pose: np.ndarray, with_jacobian: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Whitened residuals (N,), their Jacobian (N, 6), and weights (N,), 0 = not visible."""
        if not self._frames:
            raise RuntimeError("refresh() comes before anything else")
        frame = self._frames[f]
        found, jacobian, trust = self._sample(f, frame.view, pose, with_jacobian)
        if np.count_nonzero(trust) < _MIN_SAMPLES:
            return np.zeros(len(trust)), np.zeros((len(trust), 6)), np.zeros(len(trust))
        residuals = np.where(trust > 0, (found - frame.grey) / frame.sigma, 0.0)
        return residuals, jacobian / frame.sigma, trust

    def _sample(
        self, f: int, view: RenderedView, pose: np.ndarray, with_jacobian: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Captured grey (N,), its Jacobian by the pose (N, 6), and weights (N,), 0 = hidden."""
        num, cameras = len(view.points_world), self._cameras
        rotations, centres = cameras.rig_R_faces, self._centres
        if self._turns is not None:
            rotations, centres = self._turns[f] @ rotations, centres @ self._turns[f].T
        grey, trust = np.zeros(num), np.zeros(num)
        jacobian = np.zeros((num if with_jacobian else 0, 6))
        _sample_faces(
            view.points_world,
            pose,
            np.ascontiguousarray(rotations),
            np.ascontiguousarray(centres),
            np.asarray(cameras.focals, np.float64),
            np.asarray(cameras.principals, np.float64),
            self._images[f],
            self._trust[f],
            with_jacobian,
            grey,
            jacobian,
            trust,
        )
        return grey, jacobian, trust


def _spline(image: np.ndarray) -> np.ndarray:
    """Coefficients (C, H, W) of the cubic B-spline through each face."""
    from scipy.ndimage import spline_filter

    faces = [spline_filter(np.asarray(face, np.float64), 3, mode="mirror") for face in image]
    return np.stack(faces)


def _exposure(rendered: np.ndarray, captured: np.ndarray) -> tuple[float, float]:
    """Gain and offset that map rendered grey values (N,) to captured ones, estimated robustly."""
    if len(rendered) < _MIN_SAMPLES or np.ptp(rendered) < _MIN_SPREAD:
        return 1.0, 0.0
    columns = np.column_stack([rendered, np.ones(len(rendered))])
    solution = np.array([1.0, float(np.median(captured - rendered))])
    for _ in range(5):
        residuals = captured - columns @ solution
        scale = max(1.4826 * float(np.median(np.abs(residuals))), _MIN_SPREAD)
        weighted = columns / (1 + (residuals / scale) ** 2)[:, None]
        solution = np.linalg.lstsq(weighted.T @ columns, weighted.T @ captured, rcond=None)[0]
    return float(solution[0]), float(solution[1])


@_part
def _cubic(t, values, slopes):
    """Weights (4,) of a cubic B-spline at a fraction t, and their derivatives."""
    s = 1 - t
    values[0], values[3] = s * s * s / 6, t * t * t / 6
    values[1] = 2 / 3 - 0.5 * t * t * (2 - t)
    values[2] = 2 / 3 - 0.5 * s * s * (2 - s)
    slopes[0], slopes[3] = -0.5 * s * s, 0.5 * t * t
    slopes[1] = t * (1.5 * t - 2)
    slopes[2] = -s * (1.5 * s - 2)


@_kernel
def _sample_faces(
    points, pose, rig_R_faces, rig_t_faces, focals, principals, image, weights, with_jacobian,
    grey, jacobian, trust,
):  # fmt: skip
    """See SplatBlock._sample; a point belongs to the face whose axis it is closest to."""
    num_faces, height, width = image.shape
    across, d_across, down, d_down = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    for n in range(len(points)):
        x, y, z = points[n, 0] - pose[9], points[n, 1] - pose[10], points[n, 2] - pose[11]
        dx = pose[0] * x + pose[3] * y + pose[6] * z
        dy = pose[1] * x + pose[4] * y + pose[7] * z
        dz = pose[2] * x + pose[5] * y + pose[8] * z
        face, depth = 0, -1.0
        for c in range(num_faces):
            R, t = rig_R_faces[c], rig_t_faces[c]
            forward = R[0, 2] * (dx - t[0]) + R[1, 2] * (dy - t[1]) + R[2, 2] * (dz - t[2])
            if forward > depth:
                face, depth = c, forward
        if not depth > 1e-9:
            continue
        R, t, focal = rig_R_faces[face], rig_t_faces[face], focals[face]
        x, y, z = dx - t[0], dy - t[1], dz - t[2]
        right = (R[0, 0] * x + R[1, 0] * y + R[2, 0] * z) / depth
        lower = (R[0, 1] * x + R[1, 1] * y + R[2, 1] * z) / depth
        u = focal * right + principals[face, 0] - 0.5
        v = focal * lower + principals[face, 1] - 0.5
        column, row = int(np.floor(u)), int(np.floor(v))
        if column < 1 or row < 1 or column > width - 3 or row > height - 3:
            continue
        weight = min(weights[face, row, column], weights[face, row + 1, column + 1])
        if weight <= 0:
            continue
        _cubic(u - column, across, d_across)
        _cubic(v - row, down, d_down)
        value = by_u = by_v = 0.0
        for i in range(4):
            for k in range(4):
                coefficient = image[face, row - 1 + i, column - 1 + k]
                value += down[i] * across[k] * coefficient
                by_u += down[i] * d_across[k] * coefficient
                by_v += d_down[i] * across[k] * coefficient
        grey[n], trust[n] = value, weight
        if with_jacobian:
            a, b = focal / depth * by_u, focal / depth * by_v
            c = -(a * right + b * lower)
            gx = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c  # by the point in the rig
            gy = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c
            gz = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c
            jacobian[n, 0] = gy * dz - gz * dy
            jacobian[n, 1] = gz * dx - gx * dz
            jacobian[n, 2] = gx * dy - gy * dx
            jacobian[n, 3], jacobian[n, 4], jacobian[n, 5] = -gx, -gy, -gz
