"""Whether the camera moves: the shift of the background between two pictures."""

import numpy as np
from jaxtyping import Bool, Float


def background_shift(
    first: Float[np.ndarray, "h w"], now: Float[np.ndarray, "h w"], person: Bool[np.ndarray, "h w"]
) -> float:
    """How far the background of two small grey pictures is apart, pixels; what the person covers is left out."""
    from skimage.registration import phase_cross_correlation

    if person.mean() > 0.7 or (now[~person].std() < 0.01):
        return 0.0
    shift = phase_cross_correlation(first, now, reference_mask=~person, moving_mask=~person, overlap_ratio=0.7)[0]
    return float(np.linalg.norm(shift))
