"""Ticks of the server's version 1, recorded once, as the referee of today's: the same numbers, bit for bit.

`ticks_of_version_1.npz` was made with the last commit before ports, bodies and couplings were told apart: its loop was driven
by hand for 2,600 ticks of the sample model, with one tool and with two. The commands are a swept sine with noise, jumps,
motion beyond the workspace, velocities, told rendered ticks and gaps; there are other limits, frames, a reset, a release, a
fade over to another model, and passivity control. Arrays end in the number of tools: start_ns (t,); command_integers
(t, n, 4), sequence (-1: no new command), client time, arrival and rendered tick; command_motion (t, n, 6), position and
velocity; forget (t, n); changes (tick, kind, tool, values); the matrices of the two models; and what came out. Version 1's force is the negative of today's.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.model_file import StateSpace
from palpate_client.wire import Flags
from palpate_server.coupling import cross_fade
from palpate_server.diagnostics.sample_model import patches_of
from palpate_server.realtime import scheduler, shared_memory
from palpate_server.realtime.native_image import Image, make_image
from palpate_server.realtime.records import RECORDS, Change
from palpate_server.realtime.safety import Limits
from palpate_server.realtime.shared_memory import Memory

LIMITS = Limits(0.5, 30.0, 0.6, 0.03, 4.0)
FADE_STEP = 0.01
USED = (
    Flags.HELD
    | Flags.DECAYING
    | Flags.STALE
    | Flags.SOFT_START
    | Flags.WORKSPACE_CLAMPED
    | Flags.SPEED_LIMITED
) | (Flags.SLEW_LIMITED | Flags.FORCE_CLAMPED | Flags.PASSIVITY_LIMITED | Flags.JUMPED)


class Today:
    """Today's loop, driven as version 1's was."""

    def __init__(self, n_tools: int, model: StateSpace, other: StateSpace) -> None:
        self.other = other
        self.memory = shared_memory.make_memory(patches_of(model), 1e-3, [LIMITS] * n_tools, 1 / 30)
        self.image: Image = make_image(self.memory)
        self.kept: list[Memory] = [self.memory]

    def change(self, change: Any) -> None:
        values, tool = change["values"].copy(), int(change["tool"])
        match Change(int(change["kind"])):
            case Change.LIMITS:
                scheduler.set_limits(self.image, tool, values[:5])
            case Change.FRAME:
                rotation = values[:9].reshape(3, 3)
                scheduler.set_frame(self.image, tool, rotation, float(values[9]), values[10:13])
            case Change.RESET:
                scheduler.reset(self.image)
            case Change.EXCHANGE:
                running = self.memory.coupling
                if running.fade[1] > 0:
                    coupling = cross_fade.after(running)
                else:
                    displacement = self.memory.displacement.copy()
                    np.testing.assert_array_equal(displacement.ravel(), values[: displacement.size])
                    following = patches_of(self.other, displacement)
                    coupling = cross_fade.to_another(running, following, FADE_STEP)
                self.memory = shared_memory.with_coupling(self.memory, coupling)
                self.kept.append(self.memory)
                scheduler.exchange(self.image, make_image(self.memory))

    def command(self, integers: np.ndarray, motion: np.ndarray) -> None:
        """A message for the tools with a sequence in `integers` (n, 4)."""
        incoming, tools = self.memory.commands.incoming, np.flatnonzero(integers[:, 0] >= 0)
        for place, tool in enumerate(tools):
            incoming["tool"][place], incoming["lease"][place] = tool, self.memory.commands.lease[tool]
            for k, name in enumerate(("sequence", "client_time_ns", "arrival_ns", "rendered_tick")):
                incoming[name][place] = integers[tool, k]
            incoming["position_m"][place] = motion[tool, :3]
            incoming["velocity_m_per_s"][place] = motion[tool, 3:]
        if len(tools):
            assert scheduler.hand_over(self.image, len(tools)) == 0


@pytest.mark.parametrize("n_tools", [1, 2])
def test_every_tick_gives_the_numbers_of_version_1_bit_for_bit(n_tools: int) -> None:
    path = Path(__file__).with_name("ticks_of_version_1.npz")
    with np.load(path, allow_pickle=False) as file:
        old = {name.rpartition("_")[0]: file[name] for name in file.files if name.endswith(f"_{n_tools}")}
    model, other = (
        StateSpace(*(old[f"{name}_{matrix}"] for matrix in ("diagonal", "cross", "b", "c", "d")))
        for name in ("model", "other")
    )
    today = Today(n_tools, model, other)
    for tick, start_ns in enumerate(old["start_ns"].tolist()):
        for change in old["changes"][old["changes"]["tick"] == tick]:
            today.change(change)
        today.command(old["command_integers"][tick], old["command_motion"][tick])
        for tool in np.flatnonzero(old["forget"][tick]).tolist():
            scheduler.forget_command(today.memory.commands, tool)
        scheduler.repeat_tick(today.image, start_ns, start_ns, False)
        ports = today.memory.ring.ports[tick % RECORDS]
        for name, expected in (
            ("position_m", old["displacement_m"]),
            ("force_n", -old["force_n"]),
            ("force_scale", old["force_scale"]),
            ("energy_j", old["energy_j"]),
            ("flags", old["flags"]),
        ):
            np.testing.assert_array_equal(ports[name], expected[tick], f"{name} of tick {tick}")
    assert np.bitwise_or.reduce(old["flags"].ravel()) & USED == USED  # the trace is worth its name
    assert np.any(old["force_n"])
