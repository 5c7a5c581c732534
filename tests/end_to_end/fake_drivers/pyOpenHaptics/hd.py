"""The functions of pyOpenHaptics.hd (1.0.1) that the bridge calls. Millimeters; y is up. Valid inside of a frame only."""

import fake_hand

in_frame = False


def get_transform():
    assert in_frame
    x, y, z = (1e3 * c for c in fake_hand.START_M)
    return ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (x, y - 1e3 * fake_hand.depth_m(), z, 1))


def set_force(feedback) -> None:
    assert in_frame
    fake_hand.push(feedback)
