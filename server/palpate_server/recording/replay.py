"""Run a recording's commands through its model again, offline, and compare every force bit for bit.

    palpate replay RECORDING.mcap MODEL.npz

What is repeated begins where everything is known to be at rest, and breaks off where a message was lost that can't be
done without (a status that may have told of other limits is one), the model was reset or another one loaded; from the
next rest on it is repeated again.

Exit code 0: every tick that a status tells of was repeated and gave the recorded displacement and force exactly. 3: all
that could be repeated did, but not all could be. 1: a tick gave another displacement or force. 2: nothing can be replayed.
"""

from __future__ import annotations

import argparse
import itertools
import json
import struct
import sys
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from palpate_server.arguments import need

if __name__ == "__main__":
    need("mcap", "recorder", "palpate replay")

from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader

from palpate.model_file import ModelFileError, ReducedModel, load_model
from palpate_client.wire import MalformedMessage, last_chunk
from palpate_server import wire
from palpate_server.realtime import safety, scheduler, shared_memory
from palpate_server.realtime.frames import Frame
from palpate_server.realtime.native_image import Image, make_image
from palpate_server.realtime.safety import Flags, Limits
from palpate_server.recording.mcap_file import from_json
from palpate_server.session.admission import out_of_range

_MAGIC = b"\x89MCAP0\r\n"  # an MCAP file begins with it
_OF_THE_TICK = int(Flags.LATE | Flags.CAUGHT_UP)  # depend on the machine, not on the model
_NEEDED = {
    "number",
    "ticks",
    "at_rest_since_tick",
    "undisturbed_since_tick",
    "model",
    "contacts",
}  # of a status
_LIMITED = int(Flags.WORKSPACE_CLAMPED | Flags.SPEED_LIMITED)
# So far from their place in time commands and forces may stand in a recording: twice what the server sends late.
_OUT_OF_ORDER_TICKS = 200
Agreed = TypeVar("Agreed", Limits, Frame)


class ReplayError(ValueError):
    """The recording can't be replayed; the message says why."""


class Heard(NamedTuple):
    """A command in a recording, behind the force of a tick, or -1; it may have been refused."""

    command: wire.Command
    after_tick: int


@dataclass
class Session:
    """What is in a recording. commands: by client, sequence and client time, which a client may use more than once, in
    the order in which they were heard; forces: in order of ticks.
    """

    description: dict[str, Any]
    commands: dict[tuple[str, int, int], list[Heard]] = field(default_factory=dict)
    forces: list[dict[str, Any]] = field(default_factory=list)
    statuses: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True)
class Comparison:
    """ticks compared, of so many that a status tells of, from the first recorded one on; with_force: of those compared, how
    many had a force that is not zero; in so many stretches; the first that differed with what was recorded and what came
    out, or None; and lost_commands, how many ticks used one that is not in the recording.

    Commands are best effort: instead of one that the recorder missed, or that can't be told from another, the displacement
    that was really applied is used. It is the same when no limit was met; and which force the device was rendering, which
    only the command tells, is of no account without passivity control. Otherwise the stretch ends there.
    """

    ticks: int
    of: int
    with_force: int
    stretches: int
    difference: str | None
    lost_commands: int


def read_session(path: Path) -> Session:
    """Read a recording, also one that breaks off. Raises ReplayError when it is none."""
    session: Session | None = None
    try:
        with path.open("rb") as stream:
            if stream.read(len(_MAGIC)) != _MAGIC:
                raise ReplayError(f"{path}: not an MCAP file")
            stream.seek(0)
            for kind, key, message in _messages(NonSeekingReader(stream)):
                if kind == "describe":
                    session = session or Session(message)
                elif session is None:
                    raise ReplayError(f"{path}: does not begin with a description of the model")
                elif kind == "force":
                    session.forces.append(message)
                elif kind == "status":
                    if missing := _NEEDED - message.keys():
                        raise ReplayError(
                            f"{path}: a status has no {', '.join(sorted(missing))}: recorded from another version?"
                        )
                    session.statuses.append(message)
                elif kind == "command":
                    _add_command(session, last_chunk(key), message)
    except OSError as error:
        raise ReplayError(f"{path}: {error.strerror}") from error
    except McapError as error:
        raise ReplayError(f"{path}: not an MCAP file that can be read ({error})") from error
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise ReplayError(
            f"{path}: a message is not as expected ({error!r}): recorded by another version?"
        ) from error
    if session is None or not session.forces:
        raise ReplayError(f"{path}: holds no forces")
    return session


def _messages(reader: NonSeekingReader) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """The kind, the key and the content of each."""
    messages = reader.iter_messages(log_time_order=False)
    while True:
        try:
            schema, channel, message = next(messages)
        except StopIteration:
            return
        except (McapError, struct.error):  # the reader's own, when even a length is cut in two
            return  # it breaks off here: a full disk, a crash
        if schema is not None:
            kind = schema.name.removeprefix("palpate.")
            yield kind, channel.topic, from_json(kind, message.data)


def _add_command(session: Session, client: str, message: dict[str, Any]) -> None:
    try:
        command = wire.read_command(message)
    except MalformedMessage:
        return  # the server refused it too
    if out_of_range(command) is None:
        key = client, command.sequence, command.client_time_ns
        after_tick = session.forces[-1]["tick"] if session.forces else -1
        session.commands.setdefault(key, []).append(Heard(command, after_tick))


def compare(session: Session, model: ReducedModel) -> Comparison:
    """Repeat every tick that follows a known rest without a break. Raises ReplayError."""
    names = [contact["name"] for contact in session.description["tools"]]
    models = [session.description["model"], *(status["model"] for status in session.statuses)]
    if names != [contact.name for contact in model.contacts] or not any(_is(m, model) for m in models):
        raise ReplayError(
            f"the recording is of {session.description['model']['name']!r}, this model is {model.name!r}, "
            "from another configuration"
        )
    at_rest = _known_rest(session, model)
    if not at_rest.any():
        raise ReplayError(
            "the tissue was never at rest in this recording: start it before the first command, or reset the model first"
        )
    disturbed = {status["undisturbed_since_tick"] for status in session.statuses}
    untold = _untold(session)
    told_until = max(status["ticks"] for status in session.statuses)  # a change after it would be unheard of
    forces = [message for message in session.forces if message["tick"] < told_until]
    of = forces[-1]["tick"] + 1 - forces[0]["tick"]
    terms = _Terms(session, names)
    used = _UsedCommands(session, names)
    recorded = {message["tick"] for message in forces}
    memory: shared_memory.Memory | None = None
    compared = with_force = stretches = lost = 0
    difference = None
    for k, message in enumerate(forces):
        tick = message["tick"]
        if tick in untold:
            memory = None
            continue
        if tick in disturbed or (k > 0 and tick != forces[k - 1]["tick"] + 1):
            memory = None
        commands = used.by(k)
        missing = [command is None and _is_live(i, message) for i, command in enumerate(commands)]
        if any(m and flags & _LIMITED for m, flags in zip(missing, message["flags"], strict=True)):
            memory = None  # where it wanted the tip to be is not known
            continue
        begins = memory is None
        if memory is None:
            if not at_rest[k]:
                continue
            memory = _memory_at_rest(session, model, k)
            image = make_image(memory)
            terms.agree_on_latest(image, tick)
        else:
            terms.agree(image, tick)
        for i, (name, command) in enumerate(zip(names, commands, strict=True)):
            _hand_over(memory, i, name, message, command)
        energy_unknown = [
            i
            for i, command in enumerate(commands)
            if _is_live(i, message) and not _tells_rendered_force(command, tick, recorded)
        ]
        if np.any(memory.limits[energy_unknown, shared_memory.MAX_DAMPING] > 0.0):
            memory = None  # its damping goes by the energy
            continue
        scheduler.repeat_tick(image, message["server_time_ns"])
        compared += 1
        stretches += begins
        with_force += int(np.any(message["force_n"]))
        lost += sum(missing)
        if difference := _difference(message, memory, tick % shared_memory.RECORDS):
            difference = f"tick {tick}: {difference}"
            break
        for i in energy_unknown:
            memory.energy[i] = message["energy_j"][i]
    return Comparison(compared, of, with_force, stretches, difference, lost)


def _is(told: dict[str, Any], model: ReducedModel) -> bool:
    """Whether a description's or status's `model` is this one."""
    return bool(told["config_sha256"] == model.config_sha256 and told["order"] == model.order)


def _known_rest(session: Session, model: ReducedModel) -> NDArray[np.bool_]:
    """(forces,), whether this model and all tips were exactly at rest, in the frames of a status, before the tick."""
    ticks = np.array([message["tick"] for message in session.forces])
    known = np.zeros(len(ticks), bool)
    for status in session.statuses:
        since = status["at_rest_since_tick"]
        if since < 0 or not _is(status["model"], model):
            continue
        since = max(since, *(state["since_tick"] for state in status["tools"].values()))
        known |= (since <= ticks) & (ticks < status["ticks"])
    return known


def _memory_at_rest(session: Session, model: ReducedModel, k: int) -> shared_memory.Memory:
    """The loop's memory before the k-th recorded tick; with the forces before it, which a device may still be rendering."""
    limits = Limits(**session.description["limits"])
    memory = shared_memory.make_memory(model.discrete, model.period_s, [limits] * len(model.contacts), 1.0)
    memory.counters[shared_memory.TICKS] = memory.shared[shared_memory.HEAD] = session.forces[k]["tick"]
    for message in session.forces[max(0, k - shared_memory.RECORDS + 1) : k]:
        memory.record_motion[message["tick"] % shared_memory.RECORDS, :, 3:6] = message["force_n"]
    return memory


def _untold(session: Session) -> Set[int]:
    """Ticks in which something may have been agreed, reset or loaded that only a missing status told of."""
    ticks: set[int] = set()
    for before, after in itertools.pairwise(session.statuses):
        if after["number"] != before["number"] + 1:
            contacts = after["tools"].values()
            last = max(after["undisturbed_since_tick"], *(state["since_tick"] for state in contacts))
            # What is agreed is told a little later than it holds.
            ticks.update(range(before["ticks"] - _OUT_OF_ORDER_TICKS, last))
    return ticks


class _Terms:
    """Which limits and frames held from which tick on, as the statuses of a recording tell."""

    def __init__(self, session: Session, names: Sequence[str]) -> None:
        self._limits: list[dict[int, Limits]] = [{} for _ in names]
        self._frames: list[dict[int, Frame]] = [{} for _ in names]
        for status in session.statuses:
            for contact, state in enumerate(status["tools"][name] for name in names):
                self._limits[contact][state["since_tick"]] = Limits(**state["limits"])
                self._frames[contact][state["held_since_tick"]] = _frame(state)

    def agree(self, image: Image, tick: int) -> None:
        """What changes before this tick."""
        for contact, (limits, frames) in enumerate(zip(self._limits, self._frames, strict=True)):
            _agree(image, contact, limits.get(tick), frames.get(tick))

    def agree_on_latest(self, image: Image, tick: int) -> None:
        """What holds at this tick, which everything begins at rest."""
        for contact, (limits, frames) in enumerate(zip(self._limits, self._frames, strict=True)):
            _agree(image, contact, _latest(limits, tick), _latest(frames, tick))


def _frame(state: dict[str, Any]) -> Frame:
    frame = state["frame"]
    return Frame(tuple(map(tuple, frame["rotation"])), frame["scale"], tuple(state["home_m"]))


def _latest(since: dict[int, Agreed], tick: int) -> Agreed | None:
    return since.get(max((first for first in since if first <= tick), default=-1))


def _agree(image: Image, contact: int, limits: Limits | None, frame: Frame | None) -> None:
    if limits is not None:
        scheduler.set_limits(image, contact, np.array(limits))
        scheduler.take_up_change(image)
    if frame is not None:
        rotation, origin = np.array(frame.rotation), np.array(frame.origin_m)
        scheduler.set_frame(image, contact, rotation, frame.scale, origin)
        scheduler.take_up_change(image)


class _UsedCommands:
    """Which recorded commands the ticks used, tick by tick, in order.

    A tick tells a command's sequence and client time. Both may come again, from another client, in another hold, or in a
    command that was refused; so the statuses tell whose it was, and of those of a hold the server took the first.
    """

    def __init__(self, session: Session, names: Sequence[str]) -> None:
        self._session = session
        self._names = names
        self._holders: list[dict[int, set[str]]] = [{} for _ in names]  # by the first tick of their hold
        for status in session.statuses:
            for holders, state in zip(self._holders, (status["tools"][name] for name in names), strict=True):
                told = holders.setdefault(state["held_since_tick"], set())
                if state["holder"] is not None:
                    told.add(state["holder"])
        self._used: list[wire.Command | None] = [None] * len(names)

    def by(self, k: int) -> list[wire.Command | None]:
        """For each contact, the command that the k-th recorded tick used, if it did and the recording has it for certain."""
        message = self._session.forces[k]
        before = self._session.forces[k - 1]
        in_a_row = k > 0 and before["tick"] == message["tick"] - 1
        for i in range(len(self._names)):
            same = all(message[name][i] == before[name][i] for name in ("sequence", "client_time_ns"))
            if not (in_a_row and same):
                self._used[i] = self._find(i, message)
        return self._used

    def _find(self, contact: int, message: dict[str, Any]) -> wire.Command | None:
        """The command that a tick was the first to use."""
        tick, holders = message["tick"], self._holders[contact]
        held_since = max((first for first in holders if first <= tick), default=-1)
        if message["sequence"][contact] < 0 or len(holders.get(held_since, ())) != 1:
            return None
        (client,) = holders[held_since]
        key = client, message["sequence"][contact], message["client_time_ns"][contact]
        begin = self._session.forces[0]["tick"]
        heard = [
            (after_tick, command)
            for command, after_tick in self._session.commands.get(key, ())
            if self._names[contact] in command.position_m
            and abs(max(after_tick, begin) - tick) <= _OUT_OF_ORDER_TICKS
        ]
        if not heard:
            return None
        after_tick, first = heard[0]
        if all(command == first for _, command in heard):
            return first
        # Refused, if it was before the hold or for another contact's sake.
        in_hold = after_tick >= held_since + _OUT_OF_ORDER_TICKS
        alike = all(command.position_m.keys() == first.position_m.keys() for _, command in heard)
        return first if in_hold and alike else None


def _is_live(contact: int, message: dict[str, Any]) -> bool:
    """Whether the tick moved the contact to where a command wanted it, one that was not outdated."""
    return bool(message["sequence"][contact] >= 0 and message["input_age_ns"][contact] <= safety.HOLD_NS)


def _tells_rendered_force(command: wire.Command | None, tick: int, recorded: Set[int]) -> bool:
    """Whether the force is known that the device was rendering: of the recorded tick that it tells, or of the one before."""
    if command is None:
        return False
    rendered = command.rendered_tick
    return not 0 <= rendered < tick or tick - rendered >= shared_memory.RECORDS or rendered in recorded


def _hand_over(
    memory: shared_memory.Memory,
    contact: int,
    name: str,
    message: dict[str, Any],
    command: wire.Command | None,
) -> None:
    """Put the command that the recorded tick used, or one like it, where the repeated tick will find it."""
    sequence, client_time_ns = message["sequence"][contact], message["client_time_ns"][contact]
    if sequence < 0:
        scheduler.forget_command(memory.commands, contact)
        return
    if command is None:
        applied = tuple(message["position_m"][contact])
        command = wire.Command(sequence, client_time_ns, {name: applied}, {name: wire.STILL})
    scheduler.write_command(
        memory.commands,
        contact,
        sequence,
        client_time_ns,
        message["server_time_ns"] - message["input_age_ns"][contact],
        command.rendered_tick,
        int(memory.commands.lease[contact]),
        command.position_m[name],
        command.velocity_m_per_s[name],
    )


def _difference(message: dict[str, Any], memory: shared_memory.Memory, row: int) -> str | None:
    motion = memory.record_motion[row]
    flags = memory.record_inputs[row, :, shared_memory.CONTACT_FLAGS] & ~_OF_THE_TICK
    for name, recorded, repeated in (
        ("position_m", message["position_m"], motion[:, 0:3].tolist()),
        ("force_n", message["force_n"], motion[:, 3:6].tolist()),
        ("force_scale", message["force_scale"], motion[:, shared_memory.SCALE].tolist()),
        ("flags", [f & ~_OF_THE_TICK for f in message["flags"]], flags.tolist()),
    ):
        if recorded != repeated:
            return f"{name} was {recorded}, is {repeated}"
    return None


def main(arguments: Sequence[str] | None = None) -> int:
    about = (__doc__ or "").strip().split("\n\n")
    parser = argparse.ArgumentParser(prog="palpate replay", description=about[0], epilog=about[-1])
    parser.add_argument("recording", type=Path, metavar="RECORDING.mcap")
    parser.add_argument("model", type=Path, metavar="MODEL.npz")
    options = parser.parse_args(arguments)
    try:
        session = read_session(options.recording)
        result = compare(session, load_model(options.model))
    except (OSError, ReplayError, ModelFileError) as error:
        print(f"palpate replay: {error}", file=sys.stderr)
        return 2
    if result.lost_commands:
        print(
            f"{result.lost_commands} ticks used a command that the recording has not: their displacement was used"
        )
    where = "" if result.stretches == 1 else f", in {result.stretches} stretches"
    print(f"{result.ticks} of {result.of} ticks repeated{where}, {result.with_force} with a force: ", end="")
    if result.difference is not None:
        print(result.difference)
        return 1
    if result.ticks < result.of:
        print("these forces are the same, bit for bit; the others could not be compared")
        return 3
    print("every force is the same, bit for bit")
    return 0


if __name__ == "__main__":
    sys.exit(main())
