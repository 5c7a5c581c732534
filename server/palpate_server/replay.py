"""Run a recording's commands through its model again, offline, and compare every force bit for bit.

    python -m palpate_server.replay RECORDING.mcap MODEL.npz

Exit code 0: every tick gave the recorded displacement and force exactly. 1: one did not. 2: it can't be replayed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader

from palpate.model import ModelFileError, ReducedModel, load_model
from palpate_server import loop, wire
from palpate_server.frames import read_frame
from palpate_server.image import Image, make_image
from palpate_server.safety import Flags, Limits

_OF_THE_TICK = int(Flags.LATE | Flags.CAUGHT_UP)  # depend on the machine, not on the model


class ReplayError(ValueError):
    """The recording can't be replayed; the message says why."""


@dataclass
class Session:
    """What is in a recording. commands: by contact name's client sequence and time; forces: in order of ticks."""

    description: dict[str, Any]
    commands: dict[tuple[int, int], wire.Command] = field(default_factory=dict)
    forces: list[dict[str, Any]] = field(default_factory=list)
    statuses: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True)
class Comparison:
    """ticks compared, the first that differed with what was recorded and what came out, or None; and lost_commands.

    Commands are best effort: of one that the recorder missed, the displacement that was really applied is used.
    """

    ticks: int
    difference: str | None
    lost_commands: int


def read_session(path: Path) -> Session:
    """Read a recording, also one that breaks off. Raises ReplayError when it is none."""
    session: Session | None = None
    try:
        with path.open("rb") as stream:
            for kind, message in _messages(NonSeekingReader(stream)):
                if kind == "palpate.describe":
                    session = session or Session(message)
                elif session is None:
                    raise ReplayError(f"{path}: does not begin with a description of the model")
                elif kind == "palpate.force":
                    session.forces.append(message)
                elif kind == "palpate.status":
                    session.statuses.append(message)
                elif kind == "palpate.command":
                    _add_command(session, message)
    except (McapError, OSError) as error:
        raise ReplayError(f"{path}: not an MCAP file that can be read ({error})") from error
    if session is None or not session.forces:
        raise ReplayError(f"{path}: holds no forces")
    return session


def _messages(reader: NonSeekingReader) -> Iterator[tuple[str, dict[str, Any]]]:
    messages = reader.iter_messages(log_time_order=False)
    while True:
        try:
            schema, _, message = next(messages)
        except StopIteration:
            return
        except McapError:
            return  # it breaks off here: a full disk, a crash
        if schema is not None:
            yield schema.name, json.loads(message.data)


def _add_command(session: Session, message: dict[str, Any]) -> None:
    try:
        command = wire.read_command(message)
    except wire.MalformedMessage:
        return  # the server refused it too
    session.commands[command.sequence, command.client_time_ns] = command


def compare(session: Session, model: ReducedModel) -> Comparison:
    """Repeat every tick until the first lost message, reset or change of model. Raises ReplayError."""
    names = [contact["name"] for contact in session.description["contacts"]]
    if session.description["model"]["config_sha256"] != model.config_sha256 or names != [
        contact.name for contact in model.contacts
    ]:
        raise ReplayError(
            f"the recording is of {session.description['model']['name']!r}, this model is {model.name!r}, "
            "from another configuration"
        )
    if np.any(session.forces[0]["force_scale"]):
        raise ReplayError(
            "the recording begins in the middle of a movement: start it before the first command"
        )
    ceiling = Limits(**session.description["limits"])
    memory = loop.make_memory(model.discrete, model.period_s, [ceiling] * len(names), 1.0)
    image = make_image(memory)
    first = session.forces[0]["tick"]
    memory.counters[loop.TICKS] = memory.shared[loop.HEAD] = first
    end = min(
        (s["undisturbed_since_tick"] for s in session.statuses if s["undisturbed_since_tick"] > first),
        default=None,
    )
    terms = {
        (state["since_tick"], index): state
        for status in session.statuses
        for index, state in enumerate(status["contacts"][name] for name in names)
    }
    compared = lost = 0
    for k, message in enumerate(session.forces):
        tick = message["tick"]
        if tick != first + k or tick == end:
            break
        start_ns = message["server_time_ns"]
        for i, name in enumerate(names):
            if tick == first:
                earlier = [since for since, index in terms if index == i and since <= first]
                state = terms.get((max(earlier, default=-1), i))
                _agree(image, i, state and state | {"held_since_tick": state["since_tick"]})
            else:
                _agree(image, i, terms.get((tick, i)))
            lost += not _hand_over(session, memory, i, name, message)
        loop.repeat_tick(image, start_ns)
        compared += 1
        row = tick % loop.RECORDS
        if difference := _difference(message, memory, row):
            return Comparison(compared, f"tick {tick}: {difference}", lost)
    return Comparison(compared, None, lost)


def _agree(image: Image, contact: int, state: dict[str, Any] | None) -> None:
    if state is None:
        return
    loop.set_limits(image, contact, np.array(Limits(**state["limits"])))
    if state.get("held_since_tick", state["since_tick"]) != state["since_tick"]:
        return  # other limits in the middle of a hold: the tip stays where it is
    frame = read_frame(state["frame"])
    loop.set_frame(image, contact, np.array(frame.rotation), frame.scale, np.array(frame.origin_m))


def _hand_over(
    session: Session, memory: loop.Memory, contact: int, name: str, message: dict[str, Any]
) -> bool:
    """Put the command that the recorded tick used where the repeated tick will find it; False when it is missing."""
    sequence = message["sequence"][contact]
    if sequence < 0:
        loop.forget_command(memory.commands, contact)
        return True
    client_time_ns = message["client_time_ns"][contact]
    command = session.commands.get((sequence, client_time_ns))
    known = command is not None and name in command.displacement_m
    if command is None or not known:
        applied = tuple(message["displacement_m"][contact])
        command = wire.Command(sequence, client_time_ns, {name: applied}, {name: wire.STILL})
    loop.write_command(
        memory.commands,
        contact,
        sequence,
        client_time_ns,
        message["server_time_ns"] - message["input_age_ns"][contact],
        command.rendered_tick,
        command.displacement_m[name],
        command.velocity_m_per_s[name],
    )
    return known


def _difference(message: dict[str, Any], memory: loop.Memory, row: int) -> str | None:
    motion = memory.record_motion[row]
    flags = memory.record_inputs[row, :, loop.CONTACT_FLAGS] & ~_OF_THE_TICK
    for name, recorded, repeated in (
        ("displacement_m", message["displacement_m"], motion[:, 0:3].tolist()),
        ("force_n", message["force_n"], motion[:, 3:6].tolist()),
        ("force_scale", message["force_scale"], motion[:, loop.SCALE].tolist()),
        ("flags", [f & ~_OF_THE_TICK for f in message["flags"]], flags.tolist()),
    ):
        if recorded != repeated:
            return f"{name} was {recorded}, is {repeated}"
    return None


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="palpate replay", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("recording", type=Path, metavar="RECORDING.mcap")
    parser.add_argument("model", type=Path, metavar="MODEL.npz")
    options = parser.parse_args(arguments)
    try:
        session = read_session(options.recording)
        result = compare(session, load_model(options.model))
    except (OSError, ReplayError, ModelFileError) as error:
        print(f"palpate replay: {error}", file=sys.stderr)
        return 2
    total = len(session.forces)
    if result.lost_commands:
        print(
            f"{result.lost_commands} ticks used a command that the recording has not: their displacement was used"
        )
    print(f"{result.ticks} of {total} recorded ticks repeated: ", end="")
    print("every force is the same, bit for bit" if result.difference is None else result.difference)
    return 0 if result.difference is None else 1


if __name__ == "__main__":
    sys.exit(main())
