"""Close the loop with a haptic device: read its position, send it, render the force. Here the device is simulated.

To use a real one, write a class like SimulatedDevice around its driver: `palpate_client.bridge` does the rest, and says how it ends.

Frames and units. This driver speaks as many do: millimeters, millimeters a second and newtons along axes of its own, x to the
right, y away from the person, z up, out of the tissue. Positions and velocities are divided by 1000 on the way out; forces stay
as they are. Never run on hardware: it is none.
"""

import math
import sys
import time

from palpate_client import bridge
from palpate_client.arguments import positive

LONGEST_STEP_S = 5e-3


class SimulatedDevice:
    """A handle on a line, held by a hand that is a spring to where the person wants to be."""

    profile = "generic"
    right, outward = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    neutral_m = (0.0, 0.0, 0.0)

    def __init__(self, mass_kg, damping_n_s_per_m, hand_n_per_m, reach_mm):
        self.mass_kg, self.damping_n_s_per_m = mass_kg, damping_n_s_per_m
        self.hand_n_per_m, self.reach_mm = hand_n_per_m, reach_mm
        self.z_mm, self.speed_mm_per_s, self.force_n, self.time_s = 0.0, 0.0, 0.0, 0.0
        self.read_at_s = time.monotonic()

    def render(self, force_n):
        """The force on the hand from now on; a real driver sends it to the motors, which keep it."""
        self.force_n = force_n[2]

    def read(self):
        before_s, self.read_at_s = self.read_at_s, time.monotonic()
        self.move(min(self.read_at_s - before_s, LONGEST_STEP_S))
        return (0.0, 0.0, 1e-3 * self.z_mm), (0.0, 0.0, 1e-3 * self.speed_mm_per_s)

    def move(self, seconds):
        """Semi-implicit Euler: it does not gain energy by itself. A real device is moved by the hand."""
        wanted_mm = -self.reach_mm * (1 - math.cos(2 * math.pi * self.time_s)) / 2
        hand_n = self.hand_n_per_m * 1e-3 * (wanted_mm - self.z_mm)
        damping_n = self.damping_n_s_per_m * 1e-3 * self.speed_mm_per_s
        self.speed_mm_per_s += 1e3 * (hand_n + self.force_n - damping_n) / self.mass_kg * seconds
        self.z_mm += self.speed_mm_per_s * seconds
        self.time_s += seconds

    def close(self):
        pass


def main():
    parser = bridge.parser(__doc__.splitlines()[0], duration_s=5.0)
    for name, default, text in (
        ("--mass-kg", 0.1, "of the handle"),
        ("--damping-n-s-per-m", 0.5, "of the device"),
        ("--hand-n-per-m", 100.0, "how stiffly the hand holds it"),
        ("--reach-m", 0.01, "how deep the hand wants to go"),
    ):
        parser.add_argument(name, type=positive, default=default, help=f"{text} (%(default)s)")
    options = parser.parse_args()
    properties = options.mass_kg, options.damping_n_s_per_m, options.hand_n_per_m, 1e3 * options.reach_m
    return bridge.run(lambda: SimulatedDevice(*properties), options)


if __name__ == "__main__":
    sys.exit(main())
