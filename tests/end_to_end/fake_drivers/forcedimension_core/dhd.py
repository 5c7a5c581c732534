"""The functions of forcedimension_core.dhd (1.0.0) that the bridge calls, with its names, arguments and codes. z is up."""

import os

import fake_hand

_is_open = False


def open() -> int:
    global _is_open
    _is_open = "FAKE_NONE" not in os.environ
    return 0 if _is_open else -1


def close(ID: int = -1) -> int:
    global _is_open
    _is_open = False
    return 0


def enableForce(enable: bool, ID: int = -1) -> int:
    return 0 if _is_open and enable else -1


def setForce(f, ID: int = -1) -> int:
    if not _is_open:
        return -1
    fake_hand.push((f[0], f[1], f[2]))
    return 0


def getPosition(out, ID: int = -1) -> int:
    if not _is_open or fake_hand.is_gone():
        return -1
    out[0], out[1], out[2] = fake_hand.START_M
    out[2] -= fake_hand.depth_m()
    return 0


def getLinearVelocity(out, ID: int = -1) -> int:
    out[0], out[1], out[2] = 0.0, 0.0, 0.0
    return 0 if _is_open else -1


def errorGetLastStr() -> str:
    return "no device found"
