"""Patches of panoramas aligned to other panoramas: sub-pixel sightings with covariances."""

import copy

import numpy as np

from factors._patch_kernels import (
    ALIGNED,
    FAR,
    FLAT,
    MASKED,
    UNLIKE,
    UNSTEADY,
    Sightings,
    Templates,
    align_templates,
    cut_templates,
)
from factors.sphere_image import SphereImage

REASONS = {
    FLAT: "no texture",
    MASKED: "masked",
    UNLIKE: "look different",
    FAR: "found too far off",
    UNSTEADY: "no convergence",
}  # state of a sighting -> reason of its rejection


class PatchSet:
    """Templates around scene points, cut from one panorama each and aligned to others.

    A patch is a plane: the rays `origin + spread @ (x, y)` of an n x n grid of unit spacing. Images
    are processed one at a time; threads may process several, each with rows of its own.

    Attributes:
        templates: the patches; `states` marks usable ones.
    """

    def __init__(
        self,
        num: int,
        size: int,
        window: float,
        affine_sigma: float,
        blur_sigma: float,
        grey_sigma: float,
    ) -> None:
        """Allocate templates of n = size pixels across, odd, under a Gaussian window whose standard
        deviation is in half patches; affine_sigma: of the affine part's deviation from the
        prediction; blur_sigma: of half the difference of two pictures' blurs, as covariances in
        template pixels squared; grey_sigma: noise of grey values. ValueError: the size is even."""
        if size % 2 == 0 or size < 3:
            raise ValueError(f"a patch's size must be an odd number of pixels, not {size}")
        offsets = (np.arange(size) - size // 2) / (window * size / 2)
        bell = np.exp(-0.5 * offsets**2)
        grey, by_x, by_y = (np.zeros((num, size * size), np.float32) for _ in range(3))
        self.templates = Templates(
            np.outer(bell, bell).ravel(),
            (grey_sigma / affine_sigma) ** 2,
            (grey_sigma / blur_sigma) ** 2,
            grey,
            by_x,
            by_y,
            np.zeros((num, 3, size * size), np.float32),
            np.zeros((num, 11, 11), np.float32),
            np.full(num, FLAT, np.uint8),
        )

    def taken(self, rows: np.ndarray) -> "PatchSet":
        """Some of the templates (T',), by their rows."""
        found = copy.copy(self)
        found.templates = self.templates._replace(
            **{name: array[rows] for name, array in self.columns().items()}
        )
        return found

    def columns(self) -> dict[str, np.ndarray]:
        """Arrays with a row for each template, which `cut` fills, by their names."""
        names = ("grey", "by_x", "by_y", "curvatures", "inverses", "states")
        return {name: getattr(self.templates, name) for name in names}

    def cut(
        self,
        image: SphereImage,
        mask: np.ndarray | None,
        rows: np.ndarray,
        origins: np.ndarray,
        spreads: np.ndarray,
        least_contrast: float,
    ) -> None:
        """Cut the templates `rows (R,)` from their panorama, where the mask (H, 2H) is True: plane
        patches, origins (T, 3) and spreads (T, 3, 2), rig frame of the panorama, of at least
        `least_contrast`, standard deviation in grey values."""
        places = np.ascontiguousarray(origins), np.ascontiguousarray(spreads)
        coefficients = image.coefficients
        cut_templates(coefficients, _usable(mask), rows, *places, least_contrast, self.templates)

    def align(
        self,
        image: SphereImage,
        mask: np.ndarray | None,
        rows: np.ndarray,
        sightings: Sightings,
        max_shift: float,
        max_steps: int,
        tolerance: float,
    ) -> None:
        """Align the sightings `rows (R,)` of a panorama, where the mask (H, 2H) is True, and write
        their results, by `max_steps` Gauss-Newton steps at most; `max_shift` and `tolerance` limit
        the shift and its last step, template pixels."""
        states = self.templates.states[sightings.templates[rows]]
        sightings.states[rows] = states
        rows = rows[states == ALIGNED]
        align_templates(
            image.coefficients, _usable(mask), rows, sightings, max_shift, max_steps, tolerance,
            self.templates,
        )  # fmt: skip

    def shift_covariances(self, rows: np.ndarray, variances: np.ndarray) -> np.ndarray:
        """Covariances (N, 2, 2) of shifts, template pixels squared, of templates rows (N,), by
        residual variances (N,) in their grey values."""
        return self.templates.inverses[:, :2, :2][rows] * np.asarray(variances)[:, None, None]

    def affine_informations(self) -> tuple[np.ndarray, np.ndarray]:
        """Information (T, 4, 4) on each template's affine part, by columns, with its prior and
        without it, for noise of one grey value; zero where a template is not usable."""
        usable = self.templates.states == ALIGNED
        posteriors = np.zeros((len(usable), 4, 4))
        posteriors[usable] = np.linalg.inv(self.templates.inverses[usable, 2:6, 2:6].astype(float))
        prior = np.where(usable, self.templates.affine_prior, 0.0)[:, None, None] * np.eye(4)
        return posteriors, posteriors - prior


def _usable(mask: np.ndarray | None) -> np.ndarray:
    """A mask as the kernels are compiled for: one that cannot be written to is copied."""
    return np.zeros((0, 0), dtype=np.bool_) if mask is None else np.require(mask, bool, ["C", "W"])


def expect(templates: np.ndarray, origins: np.ndarray, spreads: np.ndarray) -> Sightings:
    """Predicted sightings of templates, rows (O,), not yet aligned; origins (O, 3), spreads (O, 3,
    2): the template's plane patch, rig frame of the observing frame."""
    num = len(templates)
    return Sightings(
        np.asarray(templates, np.int64),
        np.ascontiguousarray(origins, np.float64),
        np.ascontiguousarray(spreads, np.float64),
        np.zeros((num, 6)),
        np.zeros(num),
        np.zeros(num),
        np.full(num, UNSTEADY, np.uint8),
    )


def found_at(sightings: Sightings) -> tuple[np.ndarray, np.ndarray]:
    """Bearings (O, 3), unit, rig frame, of the aligned templates' centres; their derivatives (O, 3,
    2) by the shift in the template's axes, radians per template pixel."""
    shift, affine = sightings.warps[:, :2], sightings.warps[:, 2:].reshape(-1, 2, 2)
    rays = sightings.origins + np.einsum("oij,oj->oi", sightings.spreads, shift)
    lengths = np.linalg.norm(rays, axis=1)
    bearings = rays / lengths[:, None]
    warped = sightings.spreads @ (np.eye(2) + np.swapaxes(affine, 1, 2)) / lengths[:, None, None]
    along = np.einsum("oi,oij->oj", bearings, warped)
    return bearings, warped - bearings[:, :, None] * along[:, None, :]
