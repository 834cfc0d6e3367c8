"""Values of GTSAM variables as arrays, so that runs can store them."""

from collections.abc import Callable, Sequence
from typing import Any

import gtsam
import numpy as np

from gsba.log import GsbaError
from gsba.types import FamilyVariables

_READERS: dict[str, Callable[[gtsam.Values, int], Any]] = {  # RuntimeError for another type
    "double": gtsam.Values.atDouble,
    "Point2": gtsam.Values.atPoint2,
    "Point3": gtsam.Values.atPoint3,
    "Vector": gtsam.Values.atVector,
    "Rot3": gtsam.Values.atRot3,
    "Pose3": gtsam.Values.atPose3,
    "Unit3": gtsam.Values.atUnit3,
    "Similarity3": gtsam.Values.atSimilarity3,
    "ConstantBias": gtsam.Values.atConstantBias,
}


def _numbers(value: Any) -> np.ndarray:
    """A value as an array: a matrix row by row where it is one, a similarity's scale last."""
    if isinstance(value, gtsam.Unit3):
        return np.ravel(value.point3())
    if isinstance(value, gtsam.imuBias.ConstantBias):
        return np.ravel(value.vector())
    if isinstance(value, gtsam.Similarity3):
        rigid = gtsam.Pose3(value.rotation(), value.translation())
        return np.append(rigid.matrix().ravel(), value.scale())
    if isinstance(value, (gtsam.Rot3, gtsam.Pose3)):
        return value.matrix().ravel()
    return np.ravel(np.asarray(value, np.float64))


def _value(kind: str, numbers: np.ndarray) -> Any:
    """The inverse of `_numbers`."""
    if kind == "double":
        return float(numbers[0])
    if kind == "Rot3":
        return gtsam.Rot3(numbers.reshape(3, 3))
    if kind == "Pose3":
        return gtsam.Pose3(numbers.reshape(4, 4))
    if kind == "Unit3":
        return gtsam.Unit3(numbers)
    if kind == "Similarity3":
        rigid = gtsam.Pose3(numbers[:16].reshape(4, 4))
        return gtsam.Similarity3(rigid.rotation(), rigid.translation(), float(numbers[16]))
    if kind == "ConstantBias":
        return gtsam.imuBias.ConstantBias(numbers[:3], numbers[3:])
    return numbers


def kept(values: gtsam.Values, keys: Sequence[int]) -> FamilyVariables:
    """Variables as arrays.

    Raises:
        GsbaError: a variable of a type that is not among those above.
    """
    kinds, numbers = list[str](), list[np.ndarray]()
    for key in keys:
        for kind, read in _READERS.items():
            try:
                value = read(values, key)
            except RuntimeError:
                continue
            kinds.append(kind)
            numbers.append(_numbers(value))
            break
        else:
            raise GsbaError(
                f"variable {gtsam.DefaultKeyFormatter(key)} is of a type that runs cannot store; "
                f"use {', '.join(_READERS)}"
            )
    counts = np.array([len(part) for part in numbers], np.int64)
    data = np.concatenate([np.zeros(0), *numbers])
    return FamilyVariables(np.array(keys, np.int64), tuple(kinds), counts, data)


def restored(variables: FamilyVariables | None) -> gtsam.Values:
    """The variables that arrays hold; None = there are none."""
    values = gtsam.Values()
    if variables is None:
        return values
    ends = np.cumsum(variables.counts)
    for key, kind, count, end in zip(
        variables.keys.tolist(), variables.kinds, variables.counts, ends, strict=True
    ):
        values.insert(key, _value(kind, variables.data[end - count : end]))
    return values
