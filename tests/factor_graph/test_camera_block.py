"""A camera that is solved for: Jacobians, the eliminated system, the optimum."""

from functools import partial

import gtsam
import numpy as np
import pytest
from dense_system import dense
from gtsam.symbol_shorthand import A, B, C, D, F, K, L, N, W, X
from scipy.spatial.transform import Rotation
from synthetic import unit

from factors import RobustLoss, tangent_basis
from factors.camera_block import CameraBlock, sightings_of
from factors.camera_rows import CameraVariables, LensVariables, lens_sizes, vector
from gsba.bundle.optimizer import SolverOptions, optimize

FRAMES, POINTS = 5, 24
FISHEYES = np.array(
    [
        [300.0, 480, 470, 0.02, -0.01, 0.003, -0.001, *np.eye(3).ravel()],
        [310.0, 490, 475, 0.01, -0.02, 0.002, 0.001,
         *Rotation.from_rotvec([0.02, np.pi - 0.03, 0.01]).as_matrix().ravel()],
    ]
)  # fmt: skip
THREE = np.array(
    [
        [300.0 + lens, 480, 470, 0.02, -0.01, 0.003, -0.001,
         *Rotation.from_rotvec([0.01 * lens, 2 * lens * np.pi / 3, 0.02]).as_matrix().ravel()]
        for lens in range(3)
    ]
)  # fmt: skip
AXES_OF_THREE = THREE[:, [9, 12, 15]]
KINDS = [
    "centre", "radius", "said radius", "readout", "turns", "all", "raw", "three lenses",
    "three lenses, said radius", "three raw lenses",
]  # fmt: skip


def _variables(kind: str) -> tuple[CameraVariables, gtsam.Values]:
    """Variables of a camera, and values at which it is far from plain."""
    rng, values = np.random.default_rng(1), gtsam.Values()
    frames = range(FRAMES)
    many = 3 if kind.startswith("three") else 2
    given: dict = {"poses": [X(f) for f in frames]}
    shared: dict = {"centres": [C(n) for n in range(many - 1)], "turning": kind in ("turns", "all")}
    values.insert(C(0), np.array([0.01, -0.02, 0.08]))
    if many == 3:
        values.insert(C(1), np.array([0.07, 0.01, -0.04]))
    if kind in ("radius", "all", "three lenses"):
        shared["radius"] = N(0)
        values.insert(N(0), np.array([0.4]))
    if "said radius" in kind:
        shared["front_by_radius"] = 0.03
    if kind in ("readout", "all", "raw", "three raw lenses"):
        velocities = rng.normal(size=(FRAMES, 6)) * np.repeat([0.3, 1.0], 3)
        shared["readout"] = D(0)
        given |= {"motions": [W(f) for f in frames], "velocities": velocities}
        values.insert(D(0), np.array([0.05]))
        for f in frames:
            values.insert(W(f), 0.02 * rng.normal(size=6))
    if kind in ("turns", "all"):
        axes = Rotation.from_rotvec(0.5 * rng.normal(size=(FRAMES, 3))).as_matrix()
        given |= {"axes": axes, "turns": [A(f) for f in frames]}
        for f in frames:
            values.insert(A(f), 0.1 * rng.normal(size=2))
    if "raw" in kind:
        lenses = [F(0), K(0), *(key for n in range(1, many) for key in (F(n), K(n), B(n - 1)))]
        shared |= {"lenses": lenses, "calibration": FISHEYES if many == 2 else THREE}
        for key, dim in zip(lenses, lens_sizes(many), strict=True):
            values.insert(key, 0.01 * rng.normal(size=dim))
    for f in frames:
        pose = gtsam.Pose3(gtsam.Rot3.Expmap(0.3 * rng.normal(size=3)), 0.4 * rng.normal(size=3))
        values.insert(X(f), pose)
    return CameraVariables(cameras=[LensVariables(**shared)], **given), values


def _rotation(vector: np.ndarray) -> np.ndarray:
    """Matrix of a rotation vector; scipy takes seven times as long for a single one."""
    return gtsam.Rot3.Expmap(vector).matrix()


def _predicted(
    camera: CameraVariables, values: gtsam.Values, frame: int, point: np.ndarray, lens: int,
    fraction: float,
) -> np.ndarray:  # fmt: skip
    """Where a camera shows a point: a unit direction, or the pixel of a raw lens."""
    d = values.atPose3(X(frame)).transformTo(point)
    if camera.velocities is not None:
        motion = vector(values, D(0))[0] * camera.velocities[frame] + vector(values, W(frame))
        turn = _rotation(fraction * motion[:3])
        d = turn.T @ (d - fraction * motion[3:])
    (own,) = camera.cameras
    given = [vector(values, key) for key in own.centres]
    centres = [*given, -np.sum(given, axis=0)]
    origin = centres[lens]
    if camera.axes is not None:
        turn = _rotation(np.append(vector(values, A(frame)), 0.0))
        origin = camera.axes[frame] @ turn @ origin
    away = d - origin
    if own.lenses is not None:
        row = own.calibration[lens]
        change, radial = vector(values, F(lens)), vector(values, K(lens))
        turn = row[7:].reshape(3, 3)
        if lens:
            turn = _rotation(vector(values, B(lens - 1))) @ turn
        x, y, z = turn.T @ away
        across = np.hypot(x, y)
        theta = np.arctan2(across, z)
        powers = theta ** np.array([3, 5, 7, 9])
        r = row[0] * np.exp(change[0]) * (theta + (row[3:7] + radial) @ powers)
        return row[1:3] + row[0] * change[1:] + r * np.array([x, y]) / across
    inverse = vector(values, N(0))[0] if own.radius is not None else 0.0
    inverse += own.front_by_radius / (0.5 * np.linalg.norm(centres[0] - centres[1]))
    unit, near = away / np.linalg.norm(away), inverse * origin
    along = near @ unit
    return near + (np.sqrt(1 + along**2 - near @ near) - along) * unit


def _world(
    kind: str, noise: float = 2e-3, loss: RobustLoss | None = None, num_points: int = POINTS
):
    """A block of noisy observations, its values, and each observation's frame, point and so on."""
    camera, values = _variables(kind)
    rng = np.random.default_rng(2)
    points = rng.normal(size=(num_points, 3))
    points *= (rng.uniform(2, 5, num_points) / np.linalg.norm(points, axis=1))[:, None]
    frames, which = np.divmod(np.arange(FRAMES * num_points), num_points)
    axes = AXES_OF_THREE if kind.startswith("three") else np.array([[0.0, 0, 1], [0, 0, -1]])
    seeing = np.argmax(points[which] @ axes.T, axis=1)
    fractions = rng.uniform(-0.5, 0.5, len(which))
    shown = np.array(
        [
            _predicted(camera, values, int(f), points[j], int(lens), float(fraction))
            for f, j, lens, fraction in zip(frames, which, seeing, fractions, strict=True)
        ]
    )
    measured, whiteners = np.zeros((len(which), 3)), rng.normal(size=(len(which), 2, 2))
    whiteners += 3 * np.eye(2)
    if "raw" in kind:
        measured[:, :2] = shown + 300 * noise * rng.normal(size=shown.shape)
        whiteners /= 300 * noise
    else:
        measured = unit(shown + noise * rng.normal(size=shown.shape))
        whiteners /= noise
    rows = frames, which, num_points, measured, whiteners, seeing, fractions
    sightings, order = sightings_of(*rows)
    start = points + 0.02 * rng.normal(size=points.shape)
    return CameraBlock(camera, sightings, start, loss), values, order, rows


def _moved(values: gtsam.Values, key: int, step: np.ndarray) -> gtsam.Values:
    """Values with one of them moved in its tangent space."""
    delta = gtsam.VectorValues()
    delta.insert(key, step)
    return values.retract(delta)


def _slopes(block: CameraBlock, values: gtsam.Values, key: int, dim: int) -> np.ndarray:
    """Central differences (O, 2, dim) of residuals."""
    out = []
    for k in range(dim):
        step = np.zeros(dim)
        step[k] = 1e-6
        there, back = (block.residuals(_moved(values, key, s)) for s in (step, -step))
        out.append((there - back) / 2e-6)
    return np.stack(out, axis=2)


@pytest.mark.parametrize("kind", KINDS)
def test_residuals_are_those_of_plain_numpy(kind: str) -> None:
    block, values, order, (frames, which, _, measured, whiteners, seeing, fractions) = _world(kind)
    points = block.points_world[which]
    for row, found in zip(order, block.residuals(values), strict=True):
        one = int(frames[row]), points[row], int(seeing[row]), float(fractions[row])
        shown = _predicted(block.camera, values, *one)
        if "raw" in kind:
            expected = shown - measured[row, :2]
        else:
            across = tangent_basis(measured[row]) @ shown
            sine = np.linalg.norm(across)
            expected = np.arctan2(sine, shown @ measured[row]) / sine * across
        np.testing.assert_allclose(found, whiteners[row] @ expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_jacobians_are_those_of_differences(kind: str) -> None:
    block, values, _, _ = _world(kind)
    camera, frames = block.camera, block._sightings.frames
    _, _, by_frame, by_shared = block.jacobians(values)
    start = 0
    for keys in camera.of_frames:
        dim = values.dims()[keys[0]]
        for f, key in enumerate(keys):
            expected = _slopes(block, values, key, dim)
            expected[frames != f] = 0
            found = np.where((frames == f)[:, None, None], by_frame[:, :, start : start + dim], 0)
            np.testing.assert_allclose(found, expected, atol=2e-6 * np.abs(by_frame).max())
        start += dim
    start = 0
    for key, dim in camera.shared:
        found, expected = by_shared[:, :, start : start + dim], _slopes(block, values, key, dim)
        np.testing.assert_allclose(found, expected, atol=2e-6 * np.abs(found).max())
        start += dim


def _at(block: CameraBlock, points: np.ndarray) -> CameraBlock:
    return CameraBlock(block.camera, block._sightings, points)


def test_a_landmark_moves_residuals_as_its_jacobian_says() -> None:
    block, values, _, _ = _world("all")
    by_point = block.jacobians(values)[1]
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        there, back = (_at(block, block.points_world + s).residuals(values) for s in (step, -step))
        slope = (there - back) / 2e-6
        np.testing.assert_allclose(by_point[:, :, k], slope, atol=1e-6 * np.abs(slope).max())


@pytest.mark.parametrize("kind", ["all", "raw"])
def test_the_system_is_the_dense_one_without_landmarks(kind: str) -> None:
    block, values, _, _ = _world(kind, loss=RobustLoss("cauchy", 1.5))
    residuals, by_point, by_frame, by_shared = block.jacobians(values)
    roots = np.sqrt(block.loss.weights(np.sum(residuals**2, axis=1)))
    camera, seen = block.camera, block._sightings
    kinds, num = len(camera.of_frames), len(residuals)
    wide = np.zeros((num, 2, 6 * len(block.keys)))
    of_points = np.zeros((num, 2, 3 * POINTS))
    for o in range(num):
        f, j = seen.frames[o], seen.points[o]
        wide[o][:, 6 * kinds * f + camera.own_places] = roots[o] * by_frame[o]
        wide[o][:, 6 * kinds * FRAMES + camera.shared_places] = roots[o] * by_shared[o]
        of_points[o][:, 3 * j : 3 * j + 3] = roots[o] * by_point[o]
    r, x, p = (
        (roots[:, None] * residuals).ravel(),
        *(part.reshape(2 * num, -1) for part in (wide, of_points)),
    )
    left = np.eye(len(p)) - p @ np.linalg.solve(p.T @ p, p.T)
    system = block.linearize(values)
    H, gradient = dense(system, block.pairs)
    expected = x.T @ left @ x
    np.testing.assert_allclose(H, expected, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(gradient, x.T @ left @ r, atol=1e-9 * np.abs(x.T @ r).max())
    assert system.costs == pytest.approx(block.costs(values))


def _priors(values: gtsam.Values, camera: CameraVariables) -> gtsam.NonlinearFactorGraph:
    """Gauge, and where each variable of the camera is thought to be."""
    graph, rng = gtsam.NonlinearFactorGraph(), np.random.default_rng(4)
    for f in range(FRAMES):
        sigma = 1e-4 if f < 2 else 1.0
        model = gtsam.noiseModel.Isotropic.Sigma(6, sigma)
        graph.add(gtsam.PriorFactorPose3(X(f), values.atPose3(X(f)), model))
    vectors = [(key, dim) for key, dim in values.dims().items() if key not in camera.poses]
    for key, dim in vectors:
        off = vector(values, key) + 0.005 * rng.normal(size=dim)
        graph.add(gtsam.PriorFactorVector(key, off, gtsam.noiseModel.Isotropic.Sigma(dim, 0.01)))
    return graph


def _error(camera, one, measured, whitener, raw, keys, _factor, values, jacobians) -> np.ndarray:
    """A sighting as gtsam calls it, its Jacobians by differences."""
    frame, j, lens, fraction = one

    def residual(at: gtsam.Values) -> np.ndarray:
        shown = _predicted(camera, at, frame, vector_or_point(at, L(j)), lens, fraction)
        if raw:
            return whitener @ (shown - measured[:2])
        across = tangent_basis(measured) @ shown
        sine = np.linalg.norm(across)
        return whitener @ across * (np.arctan2(sine, shown @ measured) / sine)

    if jacobians is not None:
        dims = values.dims()
        for n, key in enumerate(keys):
            columns = []
            for k in range(dims[key]):
                step = np.zeros(dims[key])
                step[k] = 1e-6
                ahead, behind = (residual(_moved(values, key, s)) for s in (step, -step))
                columns.append((ahead - behind) / 2e-6)
            jacobians[n] = np.asfortranarray(np.array(columns).T)
    return residual(values)


def vector_or_point(values: gtsam.Values, key: int) -> np.ndarray:
    return np.asarray(values.atPoint3(key))


@pytest.mark.parametrize("kind", ["all", "raw", "three raw lenses"])
def test_optimum_is_that_of_gtsam_on_the_same_factors(kind: str) -> None:
    """Poses, points and the whole camera by GTSAM's own Levenberg-Marquardt, nothing eliminated."""
    block, values, _, rows = _world(kind, num_points=14)
    frames, which, _, measured, whiteners, seeing, fractions = rows
    camera, graph = block.camera, _priors(values, block.camera)
    tight = SolverOptions(relative_tolerance=1e-13, absolute_tolerance=None, max_iterations=100)
    found = optimize(graph, values, [block], tight)
    whole, start = gtsam.NonlinearFactorGraph(graph), gtsam.Values(found.values)
    for j, point in enumerate(block.points_world):
        start.insert(L(j), gtsam.Point3(*point))
    for row in range(len(frames)):
        f, j = int(frames[row]), int(which[row])
        keys = [keys[f] for keys in camera.of_frames] + [key for key, _ in camera.shared] + [L(j)]
        one = f, j, seeing[row], fractions[row]
        given = camera, one, measured[row], whiteners[row], "raw" in kind, keys
        error = partial(_error, *given)
        whole.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(2), keys, error))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    params.setMaxIterations(50)
    reference = gtsam.LevenbergMarquardtOptimizer(whole, start, params).optimize()
    assert found.cost == pytest.approx(whole.error(reference), rel=1e-7)
    for key in block.keys:
        if key in camera.poses:
            np.testing.assert_allclose(
                found.values.atPose3(key).matrix(), reference.atPose3(key).matrix(), atol=1e-5
            )
        else:
            np.testing.assert_allclose(vector(found.values, key), vector(reference, key), atol=1e-5)
