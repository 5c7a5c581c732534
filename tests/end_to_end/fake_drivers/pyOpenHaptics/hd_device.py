"""pyOpenHaptics.hd_device (1.0.1): a device calls back a thousand times a second from a thread of the library's."""

import os
import threading

import fake_hand


class HapticDevice:
    def __init__(self, callback, device_name="Default Device", scheduler_type="async"):
        assert scheduler_type == "async"
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(callback,), daemon=True)
        if "FAKE_NONE" not in os.environ:  # the library prints that no device is there, and goes on
            self._thread.start()

    def _run(self, callback):
        while not self._stop.wait(0.001) and not fake_hand.is_gone():
            callback(None)

    def close(self):
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
