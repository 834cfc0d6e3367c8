"""A panorama as a smooth function on the sphere: cubic B-spline through its pixels."""

from dataclasses import dataclass

import numpy as np

from factors._image_kernels import filter_columns, filter_rows, sample_vectors


@dataclass(frozen=True, slots=True)
class SphereImage:
    """An equirectangular image that can be sampled at any bearing, with its gradient.

    The spline is periodic across the seam, and continues over a pole on the meridian opposite.
    """

    coefficients: np.ndarray  # (H, 2H) float32, of the cubic B-spline, not pixel values

    @classmethod
    def of(cls, grey: np.ndarray, smooth: bool = False) -> "SphereImage":
        """Fit the spline through all pixels, or one that smooths them.

        Unser, "Splines: a perfect fit for signal and image processing", IEEE SPM 16(6), 1999.

        Args:
            grey: (H, 2H) any real type, equirectangular, H at least 2.
            smooth: use pixel values as coefficients, which blurs by 0.58 pixels (standard deviation
                per axis) equally at all positions between pixels, and reduces noise.

        Raises:
            ValueError: the image has another shape.
        """
        height, width = grey.shape
        if width != 2 * height or height < 2:
            raise ValueError(f"a panorama is (H, 2H), not {grey.shape}")
        rows = np.array(grey, dtype=np.float32, order="C")
        if smooth:
            return cls(rows)
        filter_rows(rows)
        # Two opposite meridians are one circle: down the first, and up the second.
        circles = np.concatenate([rows[:, :height], rows[::-1, height:]])
        filter_columns(circles)
        rows[:, :height], rows[:, height:] = circles[:height], circles[height:][::-1]
        return cls(rows)

    def sample(self, vectors_rig: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values and their gradients at directions.

        Args:
            vectors_rig: (..., 3) float64, not zero, of any length, rig frame.

        Returns:
            values (...) float64 in grey values; gradients (..., 3) by the vector, across it.
        """
        vectors = np.asarray(vectors_rig, dtype=np.float64)
        flat = np.ascontiguousarray(vectors.reshape(-1, 3))
        values, gradients = np.empty(len(flat)), np.empty((len(flat), 3))
        sample_vectors(self.coefficients, flat, values, gradients)
        return values.reshape(vectors.shape[:-1]), gradients.reshape(vectors.shape)
