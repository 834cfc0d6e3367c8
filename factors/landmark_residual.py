"""Residuals of landmarks that others write: one compiled function, called by its address where
`LandmarkBlock` holds its own kinds inline, so that landmarks are still eliminated inside."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from llvmlite import ir
from numba import cfunc, njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.numpy_support import carray

from factors._terms import custom_factor, rig_vectors, whitener_rows

_FLOATS = types.CPointer(types.float64)
_NUM_OUT = 9  # values that a residual writes: two residuals, six of the Jacobian, validity

ResidualFunction = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], bool]


class LandmarkResidual:
    """A residual of two rows of one observation of one landmark, compiled by Numba: its name, and
    the address of its code in this process."""

    def __init__(self, function: ResidualFunction) -> None:
        """Compile a function of the measurement (3,) and the vector from the ray's origin to the
        landmark in the rig frame (3,), which writes the residual (2,), not whitened, and its
        Jacobian by that vector (2, 3), all float64.

        Both are zero when it is called. It returns True where the landmark can be observed. Where
        it cannot, behind a face for instance, it returns False and should write a large constant
        residual, so that no step gains by leading there; the Jacobian counts as zero. It must be
        what Numba compiles, and is not called for a warning: division by zero gives inf or nan.
        TypeError: it does not return True or False on every path.
        """
        compiled = njit(error_model="numpy")(function)

        @cfunc(types.void(_FLOATS, _FLOATS, _FLOATS), error_model="numpy")
        def entry(measurement, vector, out):  # type: ignore[no-untyped-def]
            written = carray(out, (_NUM_OUT,))
            written[:] = 0.0  # the memory holds the observation before
            residual, jacobian = written[:2], written[2:8].reshape((2, 3))
            valid = compiled(carray(measurement, (3,)), carray(vector, (3,)), residual, jacobian)
            written[8] = 1.0 if valid else 0.0

        self.name: str = function.__name__
        returned = types.unliteral(compiled.nopython_signatures[0].return_type)  # type: ignore
        if not isinstance(returned, types.Boolean):
            raise TypeError(f"{self.name} must return True or False on every path, not {returned}")
        self.address = int(entry.address or 0)
        self._compiled, self._entry = compiled, entry  # their code lives as long as they do

    def evaluate(
        self, measurements: np.ndarray, vectors: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals (N, 2), Jacobians (N, 2, 3) and validity (N,) bool of measurements (N, 3) and
        vectors (N, 3), as the function takes and writes them."""
        num, vectors = len(vectors), np.ascontiguousarray(vectors, dtype=np.float64)
        measurements = np.ascontiguousarray(measurements, dtype=np.float64)
        residuals, jacobians = np.zeros((num, 2)), np.zeros((num, 2, 3))
        valid = np.empty(num, dtype=bool)
        rows = zip(measurements, vectors, residuals, jacobians, strict=True)
        for n, (measured, vector, residual, jacobian) in enumerate(rows):
            valid[n] = self._compiled(measured, vector, residual, jacobian)  # type: ignore
        return residuals, jacobians, valid

    def factor(
        self,
        pose_key: int,
        point_key: int,
        measurement: np.ndarray,
        noise_model: gtsam.noiseModel.Base,
    ) -> gtsam.CustomFactor:
        """One observation as an ordinary GTSAM factor, to check the Jacobian by.

        Args:
            pose_key, point_key: keys of a Pose3 `world_T_rig` and of a Point3.
            measurement: (3,) as the function takes it.
            noise_model: of dimension 2.
        """
        measured = np.array(measurement, dtype=np.float64)[None]

        def residual(
            world_T_rig: np.ndarray, point: np.ndarray
        ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            vectors, by_pose, by_point = rig_vectors(world_T_rig, point)
            residuals, jacobians, _ = self.evaluate(measured, vectors)
            return residuals, jacobians @ by_pose, jacobians @ by_point

        return custom_factor(pose_key, point_key, noise_model, residual)


@dataclass(frozen=True, slots=True)
class LandmarkTerm:
    """Observations of the landmarks of a block under a residual that others wrote."""

    frames: np.ndarray  # (O,) int, row of the block's poses
    points: np.ndarray  # (O,) int, row of the block's landmarks
    measured: np.ndarray  # (O, 3) float64, as the residual takes them
    kind: LandmarkResidual
    sigmas: np.ndarray | float = 1.0  # () or (O,) in the residual's unit, per row
    sqrt_infos: np.ndarray | None = None  # (O, 2, 2) 1 / the residual's unit; replaces sigmas
    name: str = "landmarks"  # family that the cost is reported under
    origins_rig: np.ndarray | None = None  # (O, 3) map units, rig frame: origin of each ray;
    # None = the rig's own centre

    def measurements(self) -> np.ndarray:
        """(O, 3) rows as the kernels read them."""
        return np.asarray(self.measured, dtype=np.float64)

    def whiteners(self) -> np.ndarray:
        """(O, 3) upper triangles of the square-root information."""
        return whitener_rows(len(self.frames), self.sigmas, self.sqrt_infos)

    def cameras(self) -> np.ndarray:
        """Empty: there are no faces, (0, 12)."""
        return np.zeros((0, 12))


@intrinsic
def has_functions(_typing: Any, functions: Any) -> Any:
    """True if there are functions, a constant of the compiled code: kernels without these have no
    branches for them, and take half the time."""
    signature = types.boolean(functions)

    def generate(context: Any, _builder: Any, signature: Any, _args: Any) -> Any:
        there = not isinstance(signature.args[0], types.NoneType)
        return context.get_constant(types.boolean, there)

    return signature, generate


@intrinsic
def call_residual(
    _typing: Any, functions: Any, n: Any, mx: Any, my: Any, mz: Any, x: Any, y: Any, z: Any
) -> Any:
    """Valid (1.0 or 0.0), residual (2) and Jacobian (6) of the n-th function, of all addresses;
    zeros where there are none (None)."""
    signature = types.UniTuple(types.float64, _NUM_OUT)(
        functions, types.int64, *[types.float64] * 6
    )

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        if isinstance(signature.args[0], types.NoneType):
            return cgutils.get_null_value(context.get_value_type(signature.return_type))
        double = ir.DoubleType()
        places = [cgutils.alloca_once(builder, double, size=n) for n in (3, 3, _NUM_OUT)]
        for n, value in enumerate(args[2:]):
            builder.store(value, cgutils.gep_inbounds(builder, places[n // 3], n % 3))
        addresses = context.make_array(signature.args[0])(context, builder, value=args[0])
        address = builder.load(builder.gep(addresses.data, [args[1]]))
        kind = ir.FunctionType(ir.VoidType(), [double.as_pointer()] * 3)
        builder.call(builder.inttoptr(address, kind.as_pointer()), places)
        written = [
            builder.load(cgutils.gep_inbounds(builder, places[2], n))
            for n in (_NUM_OUT - 1, *range(_NUM_OUT - 1))
        ]
        return context.make_tuple(builder, signature.return_type, written)

    return signature, generate
