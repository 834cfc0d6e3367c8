"""A photometric block as ordinary GTSAM factors, one for the patches of each host frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import gtsam
import numpy as np

from factors._host_factors import _square_root

if TYPE_CHECKING:
    from factors.photometric import PhotometricBlock


def host_factors(block: PhotometricBlock) -> list[gtsam.CustomFactor]:
    """Factors on poses alone whose errors add up to the block's robust cost.

    The planes of a host's patches are eliminated inside the callback, each at its best for the
    poses asked about, from where the block has them. Observations count as the block's last
    `refresh` left them.
    """
    hosts = block.table.hosts
    observed = np.diff(block.table.offsets) > 0  # the others say nothing
    groups = [np.flatnonzero(observed & (hosts == host)) for host in np.unique(hosts)]
    return [_host_factor(block, rows) for rows in groups if len(rows)]


def _host_factor(block: PhotometricBlock, rows: np.ndarray) -> gtsam.CustomFactor:
    """One factor for some patches of the block."""
    part = block.subset(rows)
    keys = part.pose_keys
    num, starts = len(keys), block.planes[rows].copy()

    def error(_factor, values: gtsam.Values, jacobians) -> np.ndarray:
        part.planes = starts
        cost = part.polish(values)
        out = np.zeros(6 * num + 1)
        if jacobians is not None:
            block.planes[rows] = part.planes
            system = part.linearize(values)
            H = np.zeros((num, 6, num, 6))
            H[np.arange(num), :, np.arange(num), :] = system.diagonal
            H[part.pairs[:, 0], :, part.pairs[:, 1], :] = system.off_diagonal
            root = H.reshape(6 * num, 6 * num)
            out[:-1] = _square_root(root, system.gradient.ravel())
            padded = np.vstack([root, np.zeros((1, 6 * num))])
            for i in range(num):
                jacobians[i] = np.asfortranarray(padded[:, 6 * i : 6 * i + 6])
        out[-1] = np.sqrt(max(2 * cost - float(out @ out), 0.0))
        return out

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(6 * num + 1), keys, error)
