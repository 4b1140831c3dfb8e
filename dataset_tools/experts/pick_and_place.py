"""The motion of one pick and place, shared by the experts of the X-Arm tasks."""

import numpy as np

OPEN, CLOSED = 1.0, 0.0
PLACE_CLEARANCE = 0.001
"""A block is let go this far above where it will rest, in metres."""


def pick_and_place(origin: np.ndarray, target: np.ndarray, carry_height: float) -> np.ndarray:
    """Above, down, grasp, up, across, down, let go, up: 8 key poses.

    Args:
        origin: (3,) centre of the block, in metres.
        target: (3,) where its centre goes, in metres.
        carry_height: z of the tool when it moves across, in metres.

    Returns:
        (8, 4) rows of x, y, z in metres and opening.
    """
    x, y, z = origin
    to_x, to_y, to_z = target
    return np.array(
        [
            (x, y, carry_height, OPEN),
            (x, y, z, OPEN),
            (x, y, z, CLOSED),
            (x, y, carry_height, CLOSED),
            (to_x, to_y, carry_height, CLOSED),
            (to_x, to_y, to_z + PLACE_CLEARANCE, CLOSED),
            (to_x, to_y, to_z + PLACE_CLEARANCE, OPEN),
            (to_x, to_y, carry_height, OPEN),
        ]
    )
