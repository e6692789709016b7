"""Where control points are to be."""

from collections.abc import Sequence

import numpy as np

from maniple.core.geometry import Floats, Pose, rotation


def placed(points: Sequence[tuple[float, float]] | Floats, reference: Pose) -> Floats:
    """A desired formation whose frame is at `reference`, (n, 2)."""
    return np.asarray(points) @ rotation(reference.psi).T + (reference.x, reference.y)
