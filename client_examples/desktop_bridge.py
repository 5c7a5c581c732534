"""Touch with a mouse, the keyboard or a gamepad, and see the force as a bar; a gamepad rumbles. Needs pygame-ce: palpate[desktop].

Mouse: move over the surface, wheel or left button to press. Keyboard: arrows, W and S. Gamepad: left stick, right trigger. Esc ends.

Frames and units. The window's axes: x to the right, y up, z out of the screen, which is the tissue's outward normal. A pixel is
0.1 mm, a notch of the wheel 0.5 mm, keys and stick move 20 mm/s, the trigger presses up to 10 mm deep. The tip starts 5 mm above the tissue.

Run on no screen and with no gamepad here: tested with SDL's dummy driver and made events.
"""

import math
import os
import signal
import sys
import time
from dataclasses import dataclass

from palpate_client import bridge

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
try:
    import pygame
except ModuleNotFoundError:
    print("desktop bridge: needs the package pygame: pip install 'palpate[desktop]'", file=sys.stderr)
    sys.exit(2)

PIXEL_M, NOTCH_M, SPEED_M_PER_S, TRIGGER_M = 1e-4, 5e-4, 0.02, 0.01
ABOVE_M, DEEPEST_M, ASIDE_M = 5e-3, 0.015, 0.1  # the tip stays between these
FULL_N = 3.0  # where the bar ends and the rumble is strongest
FRAME_S = 1 / 50
STICK_X, STICK_Y, TRIGGER = 0, 1, 5
DEAD_ZONE = 0.1


@dataclass
class Inputs:
    """What the person did since the last look: pixels and notches moved, and what is held down now, -1 to 1."""

    pixels: tuple = (0, 0)  # right, up
    notches: float = 0.0  # towards the tissue
    held: tuple = (0.0, 0.0, 0.0)  # right, up, towards the tissue
    trigger: float = 0.0  # 0 to 1
    ended: bool = False


def moved(position_m, inputs, seconds):
    """The tip's position without the trigger, m: x right, y up, z out of the tissue."""
    x, y, z = position_m
    (right, up), (held_right, held_up, held_in) = inputs.pixels, inputs.held
    step_m = SPEED_M_PER_S * seconds
    return (
        max(-ASIDE_M, min(ASIDE_M, x + PIXEL_M * right + step_m * held_right)),
        max(-ASIDE_M, min(ASIDE_M, y + PIXEL_M * up + step_m * held_up)),
        max(-DEEPEST_M, min(ABOVE_M, z - NOTCH_M * inputs.notches - step_m * held_in)),
    )


class Desktop:
    """A window, the mouse, the keyboard and the first gamepad."""

    profile = "generic"
    damping_n_s_per_m = None
    right, outward = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    neutral_m = (0.0, 0.0, 0.0)

    def __init__(self):
        pygame.display.init()
        pygame.joystick.init()
        self.window = pygame.display.set_mode((480, 360))
        pygame.display.set_caption("palpate")
        self.gamepad = pygame.joystick.Joystick(0) if pygame.joystick.get_count() else None
        self.position_m = (0.0, 0.0, ABOVE_M)
        self.force_n = bridge.NO_FORCE
        self.read_at_s = self.drawn_at_s = time.monotonic()

    def render(self, force_n):
        """Draw and rumble fifty times a second; a rumble ends by itself when no further one comes."""
        ended = force_n == bridge.NO_FORCE != self.force_n
        self.force_n = force_n
        due = time.monotonic() - self.drawn_at_s >= FRAME_S
        if not due and not ended:
            return
        share = min(1.0, math.hypot(*force_n) / FULL_N)
        if self.gamepad:
            self.gamepad.rumble(share, share, round(2000 * FRAME_S))
        if due:
            self.drawn_at_s = time.monotonic()
            self.draw(share)

    def draw(self, share):
        x_m, y_m, z_m = self.position_m
        self.window.fill("black")
        pygame.draw.rect(self.window, "tomato", (10, 340, 460 * share, 10))
        center = (240 + x_m / ASIDE_M * 200, 170 - y_m / ASIDE_M * 150)
        radius = 14 - 800 * z_m  # the nearer the deeper
        pygame.draw.circle(self.window, "white" if z_m > 0 else "gold", center, max(3, radius), width=2)
        pygame.display.flip()

    def read(self):
        inputs = read_inputs(pygame.event.get(), self.gamepad)
        if inputs.ended:
            signal.raise_signal(signal.SIGINT)
        before_s, self.read_at_s = self.read_at_s, time.monotonic()
        self.position_m = moved(self.position_m, inputs, min(self.read_at_s - before_s, FRAME_S))
        x, y, z = self.position_m
        return (x, y, z - TRIGGER_M * inputs.trigger), None

    def close(self):
        pygame.quit()


def read_inputs(events, gamepad=None):
    inputs = Inputs()
    right, up = 0, 0
    for event in events:
        if event.type == pygame.QUIT or (event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE):
            inputs.ended = True
        elif event.type == pygame.MOUSEMOTION:
            right, up = right + event.rel[0], up - event.rel[1]
        elif event.type == pygame.MOUSEWHEEL:
            inputs.notches += event.y
    inputs.pixels = (right, up)
    keys = pygame.key.get_pressed()
    held = [
        keys[pygame.K_RIGHT] - keys[pygame.K_LEFT],
        keys[pygame.K_UP] - keys[pygame.K_DOWN],
        keys[pygame.K_s] - keys[pygame.K_w] or int(pygame.mouse.get_pressed()[0]),
    ]
    if gamepad:
        held[0] += beyond_dead_zone(gamepad.get_axis(STICK_X))
        held[1] -= beyond_dead_zone(gamepad.get_axis(STICK_Y))  # a stick's axis points down
        inputs.trigger = (1 + gamepad.get_axis(TRIGGER)) / 2  # -1 at rest
    inputs.held = tuple(held)
    return inputs


def beyond_dead_zone(value):
    return value if abs(value) > DEAD_ZONE else 0.0


def main():
    return bridge.run(Desktop, bridge.parser(__doc__.splitlines()[0]).parse_args())


if __name__ == "__main__":
    sys.exit(main())
