"""A cloud laid on a scan: where it is known to be, and refused where the scan cannot tell."""

from dataclasses import replace

import numpy as np
import pytest
from scan_world import HALL, INTO_SCAN, SIZE, cloud, rectangles, sampled, scan
from scipy.spatial.transform import Rotation
from synthetic import unit

from gsba.scans import registration, search
from gsba.scans.fit import Noise, _weighted, settle
from gsba.scans.judge import CellGrid, verdict
from gsba.scans.registration import NoPlacementError, register
from gsba.scans.search import Guess, candidates, main_axes
from gsba.scans.types import Scan
from gsba.similarity import Sim3, similarity

MOVED = (
    tuple(
        (tuple(np.add(low, step)), tuple(np.add(high, step)))
        for (low, high), step in zip(HALL[:2], ((0.4, 0.6, 0), (-0.8, -0.4, 0)), strict=True)
    )
    + HALL[2:]
)
OTHER = (((0.7, 2.2, 0.0), (2.1, 2.9, 1.1)), ((3.4, 0.0, 0.0), (3.9, 2.4, 2.2)))

OF_KNOWN_SCALE = Guess(scale=INTO_SCAN.scale)


@pytest.fixture
def _few_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Enough where the placements that a test is about are among the first."""
    monkeypatch.setattr(registration, "_NUM_CANDIDATES", 6)


def _errors(found: Sim3, true: Sim3) -> tuple[float, float]:
    """Relative scale, and the largest shift of the room's corners, units of the room."""
    corners = np.array(np.meshgrid(*[(0, s) for s in SIZE])).reshape(3, -1).T
    off = np.linalg.norm(found.points(corners) - true.points(corners), axis=1)
    return abs(found.scale / true.scale - 1), float(off.max()) / true.scale


def _into_scan(seed: int) -> Sim3:
    rng = np.random.default_rng([seed, 2])
    turn = Rotation.random(random_state=seed).as_matrix()
    return Sim3(float(np.exp(rng.uniform(-1.5, 1.5))), turn, rng.normal(0, 30, 3))


def test_a_place_is_found_though_a_third_is_missing_and_furniture_moved() -> None:
    """Limits: a thousandth of scale, 5 mm of place; the noise of the scan is 5 mm."""
    into = _into_scan(0)
    found = register(cloud(SIZE, HALL, 0), scan(SIZE, MOVED, 0, into))
    scale, place = _errors(found.fit.similarity, into)
    assert scale < 1e-3 and place < 5e-3
    assert 0.4 < found.verdict.share < 0.8  # what is missing explains nothing
    assert found.fit.sigmas[6] < 1e-3 and scale < 6 * found.fit.sigmas[6]


def test_chance_has_no_say() -> None:
    given = cloud(SIZE, HALL, 2, 400), scan(SIZE, MOVED, 2, num=4000), Guess(), 100
    first = candidates(*given)
    search._rows.cache_clear()  # as in another process
    second = candidates(*given)
    assert len(first) == len(second) > 20
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.new_T_old, other.new_T_old)


@pytest.mark.usefixtures("_few_candidates")
def test_a_room_that_looks_the_same_turned_is_refused_unless_told() -> None:
    """An empty box: half a turn around each axis changes nothing."""
    run, surfaces = cloud(SIZE, (), 1), scan(SIZE, (), 1, missing=0.0)
    with pytest.raises(NoPlacementError, match="several placements explain the run about equally"):
        register(run, surfaces, OF_KNOWN_SCALE)
    sources = np.array([[0.0, 0, 0], [6, 0, 0], [0, 4, 2.6]])
    picked = INTO_SCAN.points(sources) + np.array([[0.2, -0.1, 0], [0, 0.2, 0.1], [-0.1, 0, 0.2]])
    found = register(run, surfaces, Guess(similarity=similarity(sources, picked)))
    assert _errors(found.fit.similarity, INTO_SCAN)[1] < 5e-3


@pytest.mark.usefixtures("_few_candidates")
def test_colours_tell_what_shapes_do_not() -> None:
    run, surfaces = cloud(SIZE, (), 2), scan(SIZE, (), 2, missing=0.0)
    shade = lambda points: np.sin(3 * points[:, 0]) + points[:, 1] * points[:, 2]  # noqa: E731
    run = replace(run, brightness=shade(run.points))
    surfaces = replace(surfaces, brightness=shade(INTO_SCAN.points_back(surfaces.points)))
    found = register(run, surfaces, OF_KNOWN_SCALE)
    assert _errors(found.fit.similarity, INTO_SCAN)[1] < 5e-3 and found.rivals > 0


@pytest.mark.parametrize("size", [(6.0, 4.0, 2.6), (9.0, 3.0, 3.5)])
def test_a_wrong_building_is_refused(size: tuple[float, float, float]) -> None:
    with pytest.raises(NoPlacementError):
        register(cloud(SIZE, HALL, 3), scan(size, OTHER, 3, missing=0.1))


@pytest.mark.usefixtures("_few_candidates")
@pytest.mark.parametrize(("num", "num_scanned"), [(1500, 20_000), (800, 8000)])
def test_a_building_in_a_mirror_is_refused(num: int, num_scanned: int) -> None:
    """Its outer walls all fit; the mirrored run leads by much, if not surely."""
    surfaces = scan(SIZE, HALL, 6, Sim3(), num_scanned, missing=0.0)
    flip = np.array([-1.0, 1, 1])
    mirrored = Scan(surfaces.points * flip, surfaces.normals * flip)
    run = cloud(SIZE, HALL, 6, num)
    here = verdict(Sim3(), run, surfaces, CellGrid(surfaces), Noise(0.005))
    assert here.agreement > 0.8
    with pytest.raises(NoPlacementError, match="the mirrored run fits better"):
        register(run, mirrored, Guess(scale=1.0))


def test_a_lead_has_a_p_value() -> None:
    """The hall is not what it is after half a turn; an empty box is, whatever its noise."""
    half = Sim3(1.0, np.diag([-1.0, -1, 1]), np.array([6.0, 4, 0]))
    for boxes, least, most in ((HALL, 0.0, 1e-6), ((), 0.05, 0.95)):
        surfaces, run = scan(SIZE, boxes, 6, Sim3(), missing=0.0), cloud(SIZE, boxes, 6)
        grid, noise = CellGrid(surfaces), Noise(0.005)
        here, turned = (verdict(at, run, surfaces, grid, noise) for at in (Sim3(), half))
        assert least <= here.doubt(turned) <= most


def test_what_is_known_beforehand_rules_the_rest_out() -> None:
    assert Guess(scale=2.0).allows(Sim3(2.1)) and not Guess(scale=2.0).allows(Sim3(2.5))
    up = np.array([0.0, 0, 1])
    turned = Sim3(1.0, Rotation.from_rotvec([0, 0, 2.0]).as_matrix())
    tipped = Sim3(1.0, Rotation.from_rotvec([2.0, 0, 0]).as_matrix())
    assert Guess(axis=(up, up)).allows(turned) and not Guess(axis=(up, up)).allows(tipped)
    assert not Guess(rotation=np.eye(3)).allows(turned)


def test_residuals_follow_their_jacobian() -> None:
    run, surfaces = cloud(SIZE, HALL, 4, num=300), scan(SIZE, HALL, 4, missing=0.0)
    jacobians, _, _, weights, carried, middle = _weighted(INTO_SCAN, run, surfaces, Noise(0.02))
    rows, near = surfaces.tree.query(carried)[1], weights > 0
    h = 1e-6
    for k in range(7):
        sides = []
        for sign in (-h, h):
            points = INTO_SCAN.moved(sign * np.eye(7)[k], middle).points(run.points)
            offsets = points - surfaces.points[rows]
            sides.append(np.einsum("ni,ni->n", surfaces.normals[rows], offsets))
        numerical = (sides[1] - sides[0]) / (2 * h)
        np.testing.assert_allclose(jacobians[near, k], numerical[near], atol=1e-7)


def test_standard_deviations_are_those_of_errors() -> None:
    """Over scans of one room: whitened errors of unit size, within what 16 draws tell."""
    squares = []
    for seed in range(16):
        run, surfaces = cloud(SIZE, HALL, seed, num=800), scan(SIZE, HALL, seed, num=8000)
        fit = settle(INTO_SCAN, run, surfaces, 0.02)
        scale = np.log(fit.similarity.scale / INTO_SCAN.scale)
        here, there = (at.points_back(fit.middle[None])[0] for at in (INTO_SCAN, fit.similarity))
        shift = INTO_SCAN.scale * INTO_SCAN.rotation @ (there - here)
        squares.append(np.r_[shift, scale] ** 2 / fit.sigmas[3:] ** 2)
    assert 0.5 < np.mean(squares) < 2.0


def test_rays_through_a_wall_contradict() -> None:
    """A wall of the scan before what the cloud saw, and none where nothing was scanned."""
    run = cloud(SIZE, (), 5, num=600, sigma=1e-3)
    run = replace(run, eyes=np.tile(np.array(SIZE) / 2, (600, 1)))
    wall = np.array([[[4.5, 0, 0], [0, 4, 0], [0, 0, 2.6], [1, 0, 0]]])
    points, normals = sampled(np.random.default_rng(0), wall, 4000)
    said = verdict(Sim3(), run, surfaces := Scan(points, normals), CellGrid(surfaces), Noise(1e-3))
    inner = (np.abs(run.points - [6, 2, 1.3]) < [0.01, 1, 0.6]).all(axis=1)
    assert inner.sum() > 5 and said.contradicted[inner].all() and not said.explained[inner].any()
    assert not said.contradicted[run.points[:, 0] < 2.0].any()


def test_axes_of_a_room_are_its_walls() -> None:
    turn = Rotation.from_rotvec([0.3, 1.1, -0.6]).as_matrix()
    normals = sampled(np.random.default_rng(1), rectangles(SIZE, HALL), 3000)[1]
    noisy = unit(normals + 0.05 * np.random.default_rng(2).standard_normal(normals.shape))
    found = np.abs(main_axes(noisy @ turn.T) @ turn)
    assert np.sort(found.max(axis=1))[0] > np.cos(np.radians(1)) and np.linalg.det(found) != 0


def test_a_candidate_that_is_ruled_out_hides_no_other() -> None:
    """The smallest scale that is tried is on the border of those allowed."""
    run, surfaces = cloud(SIZE, HALL, 2, 400), scan(SIZE, MOVED, 2, num=4000)
    for seed in range(3):
        guess = Guess(scale=INTO_SCAN.scale * 1.03**seed)
        wide = replace(guess, scale_ratio=guess.scale_ratio * (1 + 1e-12))
        scales = [[fit.scale for fit in search._by_axes(run, surfaces, g)] for g in (guess, wide)]
        inside = [s for s in scales[1] if s > 1.001 * guess.scale / guess.scale_ratio]
        within = [s for s in scales[0] if s > 1.001 * guess.scale / guess.scale_ratio]
        assert len(within) == len(inside) > 1000
