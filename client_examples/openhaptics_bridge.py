"""3D Systems Touch and other OpenHaptics devices, through pyOpenHaptics and OpenHaptics' HD library.

Frames and units. The library speaks millimeters and newtons along right-handed axes of the device: x to the right of the person,
y up, z towards the person. Positions are divided by 1000; the velocity is not read. The device's y is the tissue's outward normal, its x a
direction along the surface. The tissue begins where the stylus is when the bridge starts.

The library calls back a thousand times a second from a thread of its own: there the newest force is set, or zero when the bridge has
not set one for 20 ms.

pyOpenHaptics (MIT) and OpenHaptics are installed by you. Never run on hardware: tested against modules with the functions used
here. Check the axes first, with a light hand.
"""

import sys
import threading
import time

from palpate_client import DeviceLost, bridge

try:
    from pyOpenHaptics import hd
    from pyOpenHaptics.hd_callback import hd_callback
    from pyOpenHaptics.hd_device import HapticDevice
except (ImportError, OSError) as error:  # OSError: the package is there, OpenHaptics' library is not
    print(f"openhaptics bridge: needs pyOpenHaptics and OpenHaptics: {error}", file=sys.stderr)
    sys.exit(2)

HOLD_S = 0.02
SILENCE_S = 0.1


class Touch:
    """The default device."""

    profile = "touch"
    damping_n_s_per_m = None
    right, outward = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)

    def __init__(self):
        self.position_m, self.read_at_s = None, 0.0
        self.force_n, self.set_at_s = bridge.NO_FORCE, 0.0
        self.called = threading.Event()
        self.callback = hd_callback(self.servo)  # kept: the library holds no reference
        self.handle = HapticDevice(callback=self.callback, scheduler_type="async")
        if not self.called.wait(1.0):
            self.handle.close()
            raise DeviceLost("OpenHaptics does not call back: is a device connected and calibrated?")
        self.neutral_m, _ = self.read()

    def servo(self):
        """On the library's thread."""
        now_s = time.monotonic()
        x_mm, y_mm, z_mm = hd.get_transform()[3][:3]
        self.position_m, self.read_at_s = (1e-3 * x_mm, 1e-3 * y_mm, 1e-3 * z_mm), now_s
        fresh = now_s - self.set_at_s <= HOLD_S
        hd.set_force(list(self.force_n if fresh else bridge.NO_FORCE))
        self.called.set()

    def render(self, force_n):
        self.force_n, self.set_at_s = force_n, time.monotonic()

    def read(self):
        if time.monotonic() - self.read_at_s > SILENCE_S:
            raise DeviceLost("OpenHaptics calls back no longer: the device is gone, or it reported an error")
        return self.position_m, None

    def close(self):
        time.sleep(HOLD_S)  # the last force, of zero, is set by the library's thread
        self.handle.close()


def main():
    return bridge.run(Touch, bridge.parser(__doc__.splitlines()[0]).parse_args())


if __name__ == "__main__":
    sys.exit(main())
