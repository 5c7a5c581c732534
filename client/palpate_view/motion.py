"""From a pointer on the screen to the position of a device: smoothing, and what a gesture asks for.

A page tells where its pointer is some 20 times a second, and only while it moves. A device has to move smoothly at the rate of the
loop. Everything here is in the model's frame, m.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate_view.surface import Hit

Floats = NDArray[np.float64]

RATE_RAD_PER_S = 30.0  # of the smoothing: 0.1 s until a step is followed to 80 %
MAX_SPEED_M_PER_S = 0.4
CLEARANCE_M = 0.003  # a tool that is above the tissue is this far from it
GRAB_DEPTH_M = 0.001  # so deep a tool is pressed in that is to take hold
MAX_PULL_M = 0.02  # farther than this the pointer does not carry tissue that is held: the models are linear


@dataclass(frozen=True)
class Motion:
    """Position (3,), m, and velocity (3,), m/s."""

    position_m: Floats
    velocity_m_per_s: Floats


def follow(motion: Motion, target_m: Floats, elapsed_s: float) -> Motion:
    """The motion after `elapsed_s` of a critically damped second-order filter with the rate RATE_RAD_PER_S.

    It is exact for a target that stays, whatever the time step; it doesn't overshoot. Faster than MAX_SPEED_M_PER_S it does
    not go.
    """
    w, t = RATE_RAD_PER_S, elapsed_s
    away = motion.position_m - target_m
    slope = motion.velocity_m_per_s + w * away
    decay = math.exp(-w * t)
    position = target_m + decay * (away + slope * t)
    velocity = decay * (motion.velocity_m_per_s - w * slope * t)
    way = position - motion.position_m
    longest = MAX_SPEED_M_PER_S * t
    if np.linalg.norm(way) > longest:
        way *= longest / np.linalg.norm(way)
        return Motion(motion.position_m + way, way / t)
    return Motion(position, velocity)


@dataclass(frozen=True)
class Gesture:
    """A drag that has begun. Points are (3,), m.

    start_m    where the device waits until the force has faded in; None: at the tool's home
    target_m   where it goes then
    pointer_m  where the pointer was at first, in the plane through what it took, parallel to the screen
    base_m     where the device is to be while the pointer is there
    normal     (3,): outward, of the tissue at the device
    presses    whether the pointer slides the tool over the surface; otherwise the tool moves as the pointer does
    attach     whether the tool holds the tissue
    reach_m    how far the pointer carries the tool from `base_m`
    """

    start_m: Floats | None
    target_m: Floats
    pointer_m: Floats
    base_m: Floats
    normal: Floats
    presses: bool = False
    attach: bool = False
    reach_m: float = math.inf


def drag_tool(pointer_m: Floats, normal: Floats, *, glued: bool) -> Gesture:
    """The pointer takes the tool, at its home, and moves it parallel to the screen; one that is glued to its patch not too far."""
    nowhere = np.zeros(3)  # until `at_home`
    reach_m = MAX_PULL_M if glued else math.inf
    return Gesture(None, nowhere, pointer_m, nowhere, normal, reach_m=reach_m)


def at_home(gesture: Gesture, home_m: Floats) -> Gesture:
    """The gesture with the tool's home, which is known when the tool is acquired."""
    if gesture.start_m is not None:
        return gesture
    way = gesture.target_m - gesture.base_m
    return replace(gesture, start_m=home_m, base_m=home_m, target_m=home_m + way)


def press_patch(home_m: Floats, pointer_m: Floats, normal: Floats, depth_m: float) -> Gesture:
    """A tool that is glued to a patch goes in, and follows the pointer."""
    base = home_m - depth_m * normal
    return Gesture(home_m, base, pointer_m, base, normal, reach_m=MAX_PULL_M)


def press_surface(hit: Hit, pointer_m: Floats, radius_m: float, depth_m: float) -> Gesture:
    """A sphere comes from outside to the point under the pointer, and presses."""
    start = hit.point_m + (radius_m + CLEARANCE_M) * hit.normal
    target = hit.point_m + (radius_m - depth_m) * hit.normal
    return Gesture(start, target, pointer_m, target, hit.normal, presses=True)


def grab_surface(hit: Hit, pointer_m: Floats, radius_m: float) -> Gesture:
    """A sphere takes hold of the tissue under the pointer, which then follows the pointer."""
    base = hit.point_m + (radius_m - GRAB_DEPTH_M) * hit.normal
    start = hit.point_m + (radius_m + CLEARANCE_M) * hit.normal
    return Gesture(start, base, pointer_m, base, hit.normal, attach=True, reach_m=MAX_PULL_M)


def moved(gesture: Gesture, pointer_m: Floats) -> Gesture:
    """The gesture when the pointer is elsewhere, for those where the tool moves as the pointer does."""
    way = pointer_m - gesture.pointer_m
    length = float(np.linalg.norm(way))
    if length > gesture.reach_m:
        way = way * (gesture.reach_m / length)
    return replace(gesture, target_m=gesture.base_m + way)


def slid(gesture: Gesture, hit: Hit | None, radius_m: float, depth_m: float) -> Gesture:
    """The gesture when the pointer is over another point of the surface; without one, the tool lifts off where it is."""
    if hit is None:
        return replace(gesture, target_m=gesture.target_m + _lift(gesture, depth_m) * gesture.normal)
    target = hit.point_m + (radius_m - depth_m) * hit.normal
    return replace(gesture, target_m=target, base_m=target, normal=hit.normal)


def _lift(gesture: Gesture, depth_m: float) -> float:
    """How far outwards a tool goes from its target until it is clear of the tissue; 0 when it is clear."""
    lifted = float((gesture.target_m - gesture.base_m) @ gesture.normal)
    return depth_m + CLEARANCE_M - lifted
