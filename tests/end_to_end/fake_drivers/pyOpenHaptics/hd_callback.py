"""pyOpenHaptics.hd_callback (1.0.1): a function without arguments becomes a callback that opens and closes a frame."""

from pyOpenHaptics import hd


def hd_callback(input_function):
    def _callback(user_data):
        hd.in_frame = True
        input_function()
        hd.in_frame = False
        return 1

    return _callback
