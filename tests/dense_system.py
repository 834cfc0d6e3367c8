"""Systems of blocks of six, written out."""

import numpy as np

from factors import PoseSystem


def dense(system: PoseSystem, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Hessian (6 F, 6 F) and gradient (6 F,)."""
    num = len(system.diagonal)
    H = np.zeros((num, num, 6, 6))
    H[np.arange(num), np.arange(num)] = system.diagonal
    H[pairs[:, 0], pairs[:, 1]] = system.off_diagonal
    H[pairs[:, 1], pairs[:, 0]] = np.swapaxes(system.off_diagonal, 1, 2)
    return H.swapaxes(1, 2).reshape(6 * num, 6 * num), system.gradient.ravel()
