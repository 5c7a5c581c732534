"""The hand and the motors behind the made drivers: outside for a second, then 3 mm deep; each force goes to a file."""

import os
import time

_start_s = time.monotonic()
_forces = open(os.environ["FAKE_FORCES"], "w", buffering=1)  # noqa: PTH123, SIM115
START_M = (0.01, -0.02, 0.03)


def depth_m():
    since_s = time.monotonic() - _start_s
    return 0.0 if since_s < 1 or since_s % 0.5 < 0.1 else 3e-3


def is_gone():
    return time.monotonic() - _start_s > float(os.environ.get("FAKE_GONE_AFTER_S", "inf"))


def push(force_n):
    x, y, z = force_n
    _forces.write(f"{x!r} {y!r} {z!r}\n")
