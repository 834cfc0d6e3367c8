"""Alignment to a rendering: in a room whose views are known in closed form."""

import gtsam
import numpy as np
import pytest
from pixels import pixel_centres

from factors import FaceCameras, RobustLoss, block_factor
from factors.splat import RenderedView, SplatBlock
from gsba.bundle.optimizer import optimize
from gsba.bundle.pose_variables import X
from gsba.camera.rig import RIG_R_FACE, CubeRig
from gsba.geometry import pose

RIG = CubeRig(48, np.deg2rad(100))
CAMERAS = FaceCameras(RIG_R_FACE, np.full(6, RIG.focal), np.full((6, 2), RIG.principal))
GRID = pixel_centres(48, 48)
CENTRES = np.random.default_rng(2).normal(0, 0.1, (6, 3))
TURNS = np.stack(
    [gtsam.Rot3.Expmap(v).matrix() for v in np.random.default_rng(3).normal(0, 0.3, (3, 3))]
)
BEARINGS = np.stack([RIG.bearings(GRID, face) for face in range(6)])  # (6, 48, 48, 3)


def look(world_T_rig: np.ndarray, bearings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (..., 3) where rays meet the walls of a cube of half-width 2, and grey values."""
    rays = bearings @ world_T_rig[:3, :3].T
    centre = world_T_rig[:3, 3]
    reach = np.min((2 - np.sign(rays) * centre) / np.maximum(np.abs(rays), 1e-9), axis=-1)
    points = centre + reach[..., None] * rays
    x, y, z = np.moveaxis(points, -1, 0)
    waves = np.sin(2 * x + 1) + np.sin(2.3 * y - z) + np.cos(1.9 * z + 0.5 * x)
    return points, 0.5 + 0.1 * waves


def render(_frame: int, world_T_rig: np.ndarray) -> RenderedView:
    points, grey = look(world_T_rig, BEARINGS[:, 4:-4:2, 4:-4:2].reshape(-1, 3))
    return RenderedView(points, grey)


def truth(num: int) -> list[gtsam.Pose3]:
    rng = np.random.default_rng(0)
    return [gtsam.Pose3.Expmap(rng.normal(0, 0.4, 6)) for _ in range(num)]


def block_at(
    poses: list[gtsam.Pose3], loss: str = "cauchy", spoil: float = 0.0, apart: bool = False
) -> SplatBlock:
    """Frames captured at these poses with an exposure of their own, partly covered.

    Cameras that are apart have centres of their own, and are turned in each frame's rig.
    """
    centres, turns = (CENTRES, TURNS[: len(poses)]) if apart else (None, None)
    images = []
    for f, world_T_rig in enumerate(poses):
        image = np.empty((6, 48, 48))
        for c in range(6):
            world_T_camera = world_T_rig.matrix()
            if apart:
                world_T_camera = world_T_camera @ pose(TURNS[f], TURNS[f] @ CENTRES[c])
            image[c] = (1.1 - 0.1 * f) * look(world_T_camera, BEARINGS[c])[1] - 0.03
        image[0, : int(spoil * 48)] = 1.0  # somebody in the picture
        images.append(image.astype(np.float32))
    keys, loss_of = [X(f) for f in range(len(poses))], RobustLoss(loss, 1.0)
    given = keys, images, [None] * len(poses), CAMERAS, render, loss_of
    return SplatBlock(*given, centres=centres, turns=turns)


def values_of(poses: list[gtsam.Pose3]) -> gtsam.Values:
    values = gtsam.Values()
    for f, world_T_rig in enumerate(poses):
        values.insert(X(f), world_T_rig)
    return values


def moved(poses: list[gtsam.Pose3], amount: float) -> list[gtsam.Pose3]:
    rng = np.random.default_rng(1)
    return [pose.retract(rng.normal(0, amount, 6)) for pose in poses]


def errors(values: gtsam.Values, poses: list[gtsam.Pose3]) -> np.ndarray:
    found = (pose.localCoordinates(values.atPose3(X(f))) for f, pose in enumerate(poses))
    return np.abs(np.array(list(found)))


LOSSES = [("none", False), ("huber", False), ("cauchy", True), ("geman_mcclure", False)]


@pytest.mark.parametrize(("loss", "apart"), LOSSES)
def test_gradient_is_that_of_the_cost(loss: str, apart: bool) -> None:
    poses = truth(2)
    block, start = block_at(poses, loss, apart=apart), moved(poses, 0.02)
    block.refresh(values_of(start))
    at = moved(start, 0.01)
    gradient = block.linearize(values_of(at)).gradient
    for f in range(2):
        for i in range(6):
            costs = []
            for sign in (1, -1):
                other = list(at)
                other[f] = at[f].retract(sign * 1e-6 * np.eye(6)[i])
                costs.append(block.costs(values_of(other))["splat"])
            expected = (costs[0] - costs[1]) / 2e-6
            assert gradient[f, i] == pytest.approx(expected, abs=1e-7 * np.abs(gradient).max())


@pytest.mark.parametrize(
    ("num", "off", "given", "most"),
    [
        (3, 0.03, {"apart": False}, 5e-4),  # 1.7 degrees, 0.03 of a room 4 wide
        (3, 0.03, {"apart": True}, 5e-4),
        (2, 0.02, {"spoil": 0.5}, 2e-3),  # somebody in the picture
    ],
)
def test_poses_are_found_again(num: int, off: float, given: dict, most: float) -> None:
    """Under another exposure, and beside somebody who is let go."""
    poses = truth(num)
    start = values_of(moved(poses, off))
    result = optimize(gtsam.NonlinearFactorGraph(), start, [block_at(poses, **given)])
    assert errors(start, poses).max() > off
    assert errors(result.values, poses).max() < most


def test_masked_pixels_are_not_sampled() -> None:
    poses = truth(1)
    image = look(poses[0].matrix(), BEARINGS)[1].astype(np.float32)
    image[0] = 1.0
    use = np.ones((6, 48, 48), bool)
    use[0] = False
    block = SplatBlock([X(0)], [image], [use], CAMERAS, render)
    result = optimize(gtsam.NonlinearFactorGraph(), values_of(moved(poses, 0.02)), [block])
    assert errors(result.values, poses).max() < 5e-4


def test_weights_scale_what_pixels_say() -> None:
    poses = truth(1)
    image = look(poses[0].matrix(), BEARINGS)[1].astype(np.float32)
    at = values_of(moved(poses, 0.02))
    systems = []
    for weight in (1.0, 0.25):
        weights = np.full((6, 48, 48), weight, np.float32)
        weights[0] = 1.0
        block = SplatBlock([X(0)], [image], [weights], CAMERAS, render)
        block.refresh(at)
        systems.append(block.linearize(at))
    alone = SplatBlock([X(0)], [image], [weights == 1], CAMERAS, render)
    alone.refresh(at)
    alone._frames = block._frames  # the same gain and offset
    first = alone.linearize(at)
    np.testing.assert_allclose(
        systems[1].diagonal, 0.25 * systems[0].diagonal + 0.75 * first.diagonal, rtol=1e-9
    )
    assert systems[1].costs["splat"] == pytest.approx(
        0.25 * systems[0].costs["splat"] + 0.75 * first.costs["splat"]
    )


def test_a_block_and_its_factor_lead_to_the_same_place() -> None:
    poses = truth(2)
    start = values_of(moved(poses, 0.02))
    block = block_at(poses)
    block.refresh(start)
    graph = gtsam.NonlinearFactorGraph()
    graph.push_back(block_factor(block))
    assert graph.error(start) == pytest.approx(block.costs(start)["splat"])
    system = block.linearize(start)
    hessian, gradient = graph.linearize(start).hessian()
    assert np.allclose(hessian[:6, :6], system.diagonal[0], rtol=1e-6)
    assert np.allclose(-gradient[:6], system.gradient[0], rtol=1e-6)


def test_a_frame_that_shows_nothing_stays_where_it_is() -> None:
    poses = truth(1)
    blind = SplatBlock(
        [X(0)], [np.zeros((6, 48, 48), np.float32)], [np.zeros((6, 48, 48), bool)], CAMERAS, render
    )
    blind.refresh(values_of(poses))
    system = blind.linearize(values_of(poses))
    assert not system.diagonal.any() and not system.gradient.any() and system.costs["splat"] == 0
    with pytest.raises(RuntimeError, match="refresh"):
        SplatBlock([X(0)], [np.zeros((6, 48, 48))], [None], CAMERAS, render).linearize(
            values_of(poses)
        )


def test_lengths_must_agree() -> None:
    with pytest.raises(ValueError, match="equally long"):
        SplatBlock([X(0)], [], [], CAMERAS, render)
