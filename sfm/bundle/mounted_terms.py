"""What priors about images say of the rigs and sensors that carry them; the tangents are those of `prior_terms`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int32

from sfm.bundle.prior_terms import PriorTerms
from sfm.core.arrays import FloatArray
from sfm.core.geometry.rotation import skew


def on_frames(
    terms: PriorTerms, image_frames: Int32[np.ndarray, " I"], arms: Float64[np.ndarray, "I 3"], frames: int
) -> PriorTerms:
    """The terms by the poses of F frames, in which images are mounted, instead of those of the images.

    Moving a frame by (ω, υ) about its own centre moves an image at the arm a from there by (ω, υ + ω × a). A term whose
    two images are on one frame gets that alone. What their sensors add is in `by_sensors`.

    Args:
        image_frames: the frame of each image.
        arms: C_image − C_frame, in the world.
    """
    images = len(image_frames)
    numbers, jacobians = [], []
    for number, jacobian in ((terms.first, terms.jacobian_first), (terms.second, terms.jacobian_second)):
        of_image = (number >= 0) & (number < images)
        row = np.where(of_image, number, 0)
        moved = jacobian.copy()
        moved[of_image, :, :3] -= (jacobian[:, :, 3:] @ skew(arms[row]))[of_image]
        numbers.append(np.where(of_image, image_frames[row], np.where(number >= 0, number - images + frames, -1)))
        jacobians.append(moved)
    first, second = (number.astype(np.int32) for number in numbers)
    same = first == second
    jacobians[0][same] += jacobians[1][same]
    jacobians[1][same], second[same] = 0.0, -1
    return PriorTerms(terms.residuals, first, second, *jacobians)


def by_sensors(terms: PriorTerms, rotations: Float64[np.ndarray, "I 3 3"]) -> tuple[FloatArray, FloatArray]:
    """Derivatives (n, 3, 6) of the terms by the tangents of the sensors that took the first and the second image.

    A sensor that moves by (ω, υ) on the left, in its own axes, moves its image by (Rᵀ ω, Rᵀ υ) in those of the world.

    Args:
        terms: by images, not by frames; zero where they are about none.
        rotations: of the images' poses `cam_from_world`.
    """
    images, found = len(rotations), []
    for number, jacobian in ((terms.first, terms.jacobian_first), (terms.second, terms.jacobian_second)):
        of_image = (number >= 0) & (number < images)
        back = rotations[np.where(of_image, number, 0)].swapaxes(1, 2) * of_image[:, None, None]
        found.append(np.concatenate([jacobian[:, :, :3] @ back, jacobian[:, :, 3:] @ back], axis=2))
    return found[0], found[1]
