"""Compiles the functions of the real-time path before the first tick, or loads them from the cache."""

from __future__ import annotations

import logging
import os
import threading

import numpy as np

from palpate_server import codec
from palpate_server.coupling import running, settle
from palpate_server.coupling.near_points import near_points
from palpate_server.coupling.settle import Touch
from palpate_server.realtime import scheduler, shared_memory
from palpate_server.realtime.native_image import make_image
from palpate_server.realtime.records import REACTION
from palpate_server.realtime.safety import Limits

log = logging.getLogger("palpate_server")

_NOTICE_AFTER_S = 2.0


def warm_up(period_s: float, n_tools: int) -> None:
    """Call every compiled function once, on a model of its own; says so when that takes long."""
    text = "compiling the real-time functions, once for this machine: about a minute"
    notice = threading.Timer(_NOTICE_AFTER_S, log.info, [text])
    notice.daemon = True
    notice.start()
    try:
        _call_each(period_s, n_tools)
    finally:
        notice.cancel()


def _call_each(period_s: float, n_tools: int) -> None:
    limits = [Limits(1.0, 1.0, 1.0, 1.0, 1.0)] * n_tools
    memory = shared_memory.make_memory(running.empty(), period_s, limits, period_s)
    scheduler.forget_command(memory.commands, 0)
    image = make_image(memory)
    scheduler.arrive(image, 1)
    scheduler.records_written(memory.shared)
    ring = memory.ring
    codec.ForceEncoder(n_tools).encode(codec.as_words(ring.ticks)[0], codec.as_words(ring.ports)[0])
    scheduler.is_silent(image, 0)
    scheduler.set_frame(image, 0, np.eye(3), 1.0, np.zeros(3))
    scheduler.set_limits(image, 0, np.ones(len(Limits._fields)))
    scheduler.set_tip(image, 0, np.ones(3), np.zeros(3))
    scheduler.reset(image)
    scheduler.save(image)
    scheduler.exchange(image, make_image(memory))
    scheduler.is_changed(image)
    scheduler.withdraw_change(image)
    scheduler.read_snapshot(image, np.zeros(0), np.zeros((n_tools, 3)))
    settle.press(running.empty(), np.zeros((0, 3)), Touch(np.zeros(0, np.int64), np.zeros(0, REACTION)), [])
    near_points(np.zeros((1, 3)), np.zeros((0, 3), np.int32), 1.0, 1)
    scheduler.stop(memory.shared)
    wake = os.eventfd(0)
    scheduler.run_at_deadlines(image, wake)
    os.close(wake)
