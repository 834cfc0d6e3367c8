"""Groups of covisible frames, and their motions as one."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factors._schur_kernels import GROUP_DIM, merge_capped

_MIN_GROUP_SIZE = 4  # least frames of a group
_MAX_GROUPS = 640  # number of groups whose dense system is factorized within seconds
_MEAN_PAIRS = 24  # strongest pairs of a frame that are used, on average


@dataclass(frozen=True, slots=True)
class Groups:
    """Variables that move together."""

    labels: np.ndarray  # (N,) int64, group of each; -1 = none
    num: int  # G

    def bases(self, poses: np.ndarray) -> np.ndarray:
        """Motion (N, 6, 7) of each variable when its group rotates, translates, scales in the
        world.

        Args:
            poses: (N, 12) rows [world_R_rig row-major, rig_in_world]; arbitrary for other
                variables.
        """
        there = self.labels >= 0
        labels = self.labels[there]
        rotations = np.swapaxes(poses[there, :9].reshape(-1, 3, 3), 1, 2)  # rig_R_world
        sums = np.zeros((self.num, 3))
        np.add.at(sums, labels, poses[there, 9:])
        sizes = np.maximum(np.bincount(labels, minlength=self.num), 1)
        arms = poses[there, 9:] - (sums / sizes[:, None])[labels]
        turning = np.zeros((len(arms), 3, 3))  # turn x arm
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            turning[:, i, j], turning[:, j, i] = arms[:, k], -arms[:, k]
        out = np.zeros((len(poses), 6, GROUP_DIM))
        moved = np.zeros((len(arms), 6, GROUP_DIM))
        moved[:, :3, :3], moved[:, 3:, :3] = rotations, rotations @ turning
        moved[:, 3:, 3:6] = rotations
        moved[:, 3:, 6] = np.einsum("nij,nj->ni", rotations, arms)
        out[there] = moved
        return out


def covisible_groups(num: int, pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Groups:
    """Groups of the most covisible variables, none much larger than another.

    Pairs join groups, the strongest first (Kruskal's algorithm), as long as they stay small.

    Args:
        pairs: rows (P, 2) of variables, and the number (P,) of landmarks that each two share, which
            is normalised by both variables' totals. Variables without a pair stay alone.
    """
    rows = np.concatenate([p for p, _ in pairs])
    shared = np.concatenate([s for _, s in pairs]).astype(np.float64)
    totals = np.bincount(rows.ravel(), np.repeat(shared, 2), minlength=num)
    weights = shared / np.sqrt(totals[rows[:, 0]] * totals[rows[:, 1]])
    most = _MEAN_PAIRS * num
    if len(weights) > most:
        least = np.partition(weights, len(weights) - most)[len(weights) - most]
        rows, weights = rows[weights >= least], weights[weights >= least]
    rows = rows[np.argsort(-weights, kind="stable")].astype(np.int64)
    size = max(_MIN_GROUP_SIZE, -(-num // _MAX_GROUPS))
    labels, sizes = np.arange(num), np.ones(num, np.int64)
    merge_capped(rows[:, 0].copy(), rows[:, 1].copy(), size, labels, sizes)
    labels[totals == 0] = -1
    found, labels = np.unique(labels, return_inverse=True)
    alone = int(len(found) > 0 and found[0] < 0)
    return Groups(labels.astype(np.int64) - alone, len(found) - alone)
