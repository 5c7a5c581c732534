"""Force Dimension omega, delta, sigma or lambda, through forcedimension-core and the maker's SDK (3.16 or later).

Frames and units. The SDK speaks m, m/s and N along right-handed axes of the device: x towards the person, y to the right of
the person, z up. Nothing is converted but by the frame: the device's z is the tissue's outward normal, its y a direction along the surface.
The tissue begins where the handle is when the bridge starts.

forcedimension-core (LGPL-3.0, Python up to 3.12) and the SDK are installed by you. Never run on hardware: tested against a module with
the functions used here. Check the axes first, with a light hand.
"""

import sys

from palpate_client import DeviceLost, bridge

try:
    from forcedimension_core import dhd
except (ImportError, OSError) as error:  # OSError: the package is there, the SDK's library is not
    print(
        f"force dimension bridge: needs forcedimension-core and the Force Dimension SDK: {error}",
        file=sys.stderr,
    )
    sys.exit(2)


class ForceDimension:
    """The first device that the SDK finds. Its functions return a negative number when they fail."""

    profile = "omega"
    damping_n_s_per_m = None
    right, outward = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)

    def __init__(self):
        self.id = dhd.open()
        if self.id < 0:
            raise DeviceLost(f"no Force Dimension device can be opened: {dhd.errorGetLastStr()}")
        try:
            self.check(dhd.enableForce(True, self.id))
            self.render(bridge.NO_FORCE)
            self.neutral_m, _ = self.read()
        except DeviceLost:
            self.close()
            raise

    def check(self, code):
        if code < 0:
            raise DeviceLost(f"the Force Dimension device does not answer: {dhd.errorGetLastStr()}")

    def render(self, force_n):
        self.check(dhd.setForce(list(force_n), self.id))

    def read(self):
        position_m, velocity_m_per_s = [0.0] * 3, [0.0] * 3
        self.check(dhd.getPosition(position_m, self.id))
        self.check(dhd.getLinearVelocity(velocity_m_per_s, self.id))
        return tuple(position_m), tuple(velocity_m_per_s)

    def close(self):
        dhd.close(self.id)


def main():
    return bridge.run(ForceDimension, bridge.parser(__doc__.splitlines()[0]).parse_args())


if __name__ == "__main__":
    sys.exit(main())
