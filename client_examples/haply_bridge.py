"""Haply Inverse3, through its maker's Inverse service (3.1 or later) on this computer. Needs websockets: palpate[haply].

Frames and units. The service speaks JSON in m, m/s and N, along right-handed axes of the device: x to the right of the person,
y away from the person, z up. Nothing is converted but by the frame: the device's z is the tissue's outward normal, its x a
direction along the surface. The tissue begins where the handle is when the bridge starts.

The service answers each force with the next state and keeps the last force when nobody sends another. So a second process, the
guard, sends a force of zero when this one has ended or has been silent for 0.1 s, whatever the reason.

Never run on hardware: tested against a service that speaks the same JSON. Check the axes first, with a light hand.
"""

import contextlib
import json
import os
import select
import subprocess
import sys

from palpate_client import DeviceLost, bridge

try:
    from websockets.exceptions import WebSocketException
    from websockets.sync.client import connect
except ModuleNotFoundError:
    print("haply bridge: needs the package websockets: pip install 'palpate[haply]'", file=sys.stderr)
    sys.exit(2)

URL = "ws://127.0.0.1:10001"
SILENCE_S = 0.1  # the guard's patience
GONE_S = 1.0  # ours: a service that is silent for so long is given up
QUIET, BEAT, END = "--guard", b".", b"q"


class Inverse3:
    """The first Inverse3 of the service."""

    profile = "inverse3"
    damping_n_s_per_m = None
    reads_at_render = True  # the service answers a force with the state of that moment
    right, outward = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)

    def __init__(self, url):
        self.url, self.guard, self.opened = url, None, contextlib.ExitStack()
        try:
            self.socket = self.opened.enter_context(open_socket(url))
        except (OSError, WebSocketException) as error:
            raise DeviceLost(f"no Inverse service at {url}: {error}") from error
        try:
            self.begin()
        except DeviceLost:
            self.close()
            raise

    def begin(self):
        with talking(self.url):
            devices = json.loads(self.socket.recv(timeout=3.0)).get("inverse3")
            if not devices:
                raise DeviceLost(f"no Inverse3 is connected to the service at {self.url}")
            self.id, status = devices[0]["device_id"], devices[0].get("status", {})
            missing = [name for name in ("power_supply", "calibrated", "ready") if not status.get(name, True)]
        for name in missing:
            print(f"warning: the service says of the Inverse3 {self.id}: not {name}", file=sys.stderr)
        command = (sys.executable, __file__, QUIET, self.url, self.id)
        # In a session of its own: Ctrl-C must not end it before us.
        self.guard = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)
        self.send(bridge.NO_FORCE)
        self.neutral_m, _ = self.read()

    def send(self, force_n):
        with talking(self.url):
            self.socket.send(force_command(self.id, force_n))

    def render(self, force_n):
        self.send(force_n)
        try:
            os.write(self.guard.stdin.fileno(), BEAT)
        except BrokenPipeError as error:
            raise DeviceLost("the guard has ended, which would let go of the device for us") from error

    def read(self):
        """The newest state: the service sends one for each force."""
        with talking(self.url):
            text = self.socket.recv(timeout=GONE_S)
            with contextlib.suppress(TimeoutError):
                while True:
                    text = self.socket.recv(timeout=0)
            states = {device["device_id"]: device["state"] for device in json.loads(text).get("inverse3", [])}
            if self.id not in states:
                raise DeviceLost(f"the Inverse3 {self.id} is no longer connected")
            return tuple(
                tuple(float(states[self.id][name][axis]) for axis in "xyz")
                for name in ("cursor_position", "cursor_velocity")
            )

    def close(self):
        with contextlib.suppress(OSError, WebSocketException):
            self.opened.close()
        if self.guard is None:
            return
        with contextlib.suppress(OSError):
            os.write(self.guard.stdin.fileno(), END)
            self.guard.stdin.close()
        self.guard.wait()


@contextlib.contextmanager
def talking(url):
    """Tells in plain words what goes wrong between the service and us."""
    try:
        yield
    except TimeoutError as error:
        raise DeviceLost(f"the Inverse service at {url} is silent") from error
    except (OSError, WebSocketException) as error:
        raise DeviceLost(f"the Inverse service at {url} is gone") from error
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise DeviceLost(f"the Inverse service at {url} sent what can't be read: {error!r}") from error


def open_socket(url):
    # Compression would cost time, a proxy has no place between, and a service that is gone is not waited for.
    return connect(url, compression=None, proxy=None, open_timeout=1.0, close_timeout=0.1, ping_interval=None)


def force_command(device_id, force_n):
    values = dict(zip("xyz", force_n, strict=True))
    command = {"device_id": device_id, "commands": {"set_cursor_force": {"values": values}}}
    return json.dumps({"inverse3": [command]})


def guard(url, device_id):
    """Send a force of zero when the bridge, at the other end of our input, falls silent in the loop or ends without a word."""
    loop_runs = False
    while True:
        ready, _, _ = select.select([sys.stdin], [], [], SILENCE_S if loop_runs else None)
        beats = os.read(sys.stdin.fileno(), 4096) if ready else b""
        if END in beats:
            return 0
        if not beats:
            with contextlib.suppress(OSError, WebSocketException), open_socket(url) as socket:
                socket.recv(timeout=1.0)
                socket.send(force_command(device_id, bridge.NO_FORCE))
                socket.recv(timeout=1.0)  # it has been taken
            if ready:  # the end of our input: the bridge is dead
                return 1
        loop_runs = bool(beats)


def main():
    if sys.argv[1:2] == [QUIET]:
        return guard(*sys.argv[2:])
    parser = bridge.parser(__doc__.splitlines()[0])
    parser.add_argument("--service", default=URL, metavar="URL", help="the Inverse service (%(default)s)")
    options = parser.parse_args()
    return bridge.run(lambda: Inverse3(options.service), options)


if __name__ == "__main__":
    sys.exit(main())
