"""Similarities between two maps: proposals, and the covariance against many drawn ones."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsba.geometry import inverse, pose
from gsba.loop_closure.map_similarity import Meeting, propose, refined, similarity_covariance
from gsba.similarity import Sim3

_NUM_DRAWS = 60


def test_covariances_of_similarities_are_as_large_as_their_errors() -> None:
    rng = np.random.default_rng(0)
    num, move = (
        12,
        Sim3.of(1.4, pose(Rotation.from_rotvec([0.1, 0.5, 0.0]).as_matrix(), np.ones(3))),
    )
    positions = rng.uniform(-3, 3, (2 * num, 3))
    poses = np.tile(np.eye(4), (2 * num, 1, 1))
    poses[:, :3, 3] = positions
    world = [positions[n] + 3 * rng.normal(size=(30, 3)) for n in range(num)]
    errors = np.zeros((_NUM_DRAWS, 7))
    claimed = np.zeros((_NUM_DRAWS, 7, 7))
    inverse_move = move.inverse()
    for draw in range(_NUM_DRAWS):
        meetings = []
        for n in range(num):  # frame n knows the points in the other map, frame num + n in the own
            common = 0.003 * rng.normal(size=3)  # all points of a meeting share an error
            seen = world[n] + common + 0.002 * rng.normal(size=world[n].shape)
            theirs = (seen - poses[n, :3, 3]) @ poses[n, :3, :3]
            own = inverse_move.points(world[n])
            back = inverse(poses[num + n])
            meetings.append(Meeting(num + n, n, own @ back[:3, :3].T + back[:3, 3], theirs))
        found = refined(meetings, move, poses)
        turn = Rotation.from_matrix(found.rotation @ move.rotation.T).as_rotvec()
        errors[draw, :3], errors[draw, 3:6] = turn, found.translation - move.translation
        errors[draw, 6] = np.log(found.scale / move.scale)
        claimed[draw] = similarity_covariance(meetings, found, poses)
    sigmas = np.sqrt(np.diagonal(claimed, axis1=1, axis2=2).mean(axis=0))
    ratios = np.sqrt(np.mean(errors**2, axis=0)) / sigmas
    # 60 draws scatter by a tenth; a covariance of 12 meetings by more, its correction for so few
    # is rough
    assert (ratios > 0.6).all() and (ratios < 1.4).all(), ratios


@pytest.mark.parametrize("with_points", [1, 2])
def test_the_covariance_by_one_or_two_meetings_is_not_known(with_points: int) -> None:
    """A similarity fits the common error of a meeting: its residuals claimed no error at all."""
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (24, 1, 1))
    poses[:, :3, 3] = rng.uniform(-3, 3, (24, 3))
    meetings = []
    for n in range(12):  # of the others, the map has no point where the part has it
        world = poses[n, :3, 3] + 3 * rng.normal(size=(30, 3))
        seen = world + 0.002 * rng.normal(size=world.shape)
        seen += 0.0 if n < with_points else 50.0
        meetings.append(Meeting(12 + n, n, world - poses[12 + n, :3, 3], seen - poses[n, :3, 3]))
    found = refined(meetings[:with_points], Sim3(), poses)
    assert np.isnan(similarity_covariance(meetings[:with_points], found, poses)).all()
    assert np.isnan(similarity_covariance(meetings, found, poses)).all()


def test_nudging_by_nothing_changes_nothing() -> None:
    move = Sim3.of(2.0, pose(Rotation.from_rotvec([0.3, 0.1, 0.2]).as_matrix(), np.arange(3.0)))
    same = move.moved(np.zeros(7), move.translation)
    assert same.scale == move.scale and np.allclose(same.new_T_old, move.new_T_old)


def test_pairs_beside_one_another_that_share_few_points_propose_together() -> None:
    """Three pairs of neighbours share four points each, of which two are the same in all."""
    rng = np.random.default_rng(0)
    move = Sim3.of(1.4, pose(Rotation.from_rotvec([0.1, 0.5, 0.0]).as_matrix(), np.ones(3)))
    world = 4 * rng.normal(size=(8, 3))  # of the map
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, :3, 3] = rng.uniform(-1, 1, (20, 3))

    def seen(f: int, points: np.ndarray) -> np.ndarray:
        return Sim3.of(1.0, inverse(poses[f])).points(points)

    meetings = []
    for n in range(3):
        shared = world[[0, 1, 2 + 2 * n, 3 + 2 * n]]
        own = seen(10 + n, move.inverse().points(shared))
        meetings.append(Meeting(10 + n, n, own, seen(n, shared)))
    (found,) = propose(meetings, poses, 4.0, seed=0)
    assert np.isclose(found.move.scale, move.scale)
    np.testing.assert_allclose(found.move.new_T_old, move.new_T_old, atol=1e-6)
    # The two that all see are no six points, and pairs far from one another propose nothing.
    twice = [Meeting(m.f, m.g, m.own[:2], m.theirs[:2]) for m in meetings]
    assert not propose(twice, poses, 4.0, seed=0)
    apart = [Meeting(4 * n + 8, 4 * n, m.own, m.theirs) for n, m in enumerate(meetings)]
    assert not propose(apart, poses, 4.0, seed=0)
