"""Run the ticks of a recording again, offline, and compare every one bit for bit.

    palpate replay RECORDING.mcap MODEL.npz [MODEL.npz ...]

More than one model is needed when others were loaded meanwhile. A recording holds the state that it begins with, the state
after every change of settings, and for each tick the commands as they were used; so nothing has to be guessed. Ticks that
were missed while recording end a stretch; the next state in the recording begins another one.

Exit code 0: every tick of the recording was repeated and gave the same, bit for bit. 3: all that could be repeated did, but
not all could be. 1: a tick gave something else. 2: the file is damaged, or nothing can be replayed.
"""

from __future__ import annotations

import argparse
import json
import os
import struct
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_server.arguments import need

if __name__ == "__main__":
    need("mcap", "recorder", "palpate replay")

from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader

from palpate.files import printable
from palpate.model_file import ModelFileError, SurfaceModel, load_model, stiffened
from palpate_client.arguments import failed
from palpate_client.wire import Flags
from palpate_server.coupling import cross_fade, models
from palpate_server.coupling.models import Model
from palpate_server.realtime import scheduler, shared_memory
from palpate_server.realtime.native_image import make_image
from palpate_server.realtime.records import COMMAND, PORT_RECORD, RECORDS, TICK
from palpate_server.realtime.safety import Limits
from palpate_server.realtime.shared_memory import Memory, Saved
from palpate_server.realtime.tick import rendered_before
from palpate_server.recording import snapshot
from palpate_server.recording.json_records import from_objects

_MAGIC = b"\x89MCAP0\r\n"  # an MCAP file begins and ends with it
_LARGEST_RECORD_BYTES = 2**28
_ANY_LIMITS = Limits(1.0, 1.0, 1.0, 1.0, 0.0)  # until a state is restored


class ReplayError(ValueError):
    """The recording can't be replayed; the message says why."""


@dataclass
class Recorded:
    """What is in a recording.

    settings  by tick: what `snapshot.as_message` made
    ticks     (t,) TICK, in order
    ports     (t, n_tools) PORT_RECORD
    """

    settings: dict[int, dict[str, Any]] = field(default_factory=dict)
    ticks: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, TICK))
    ports: NDArray[np.void] = field(default_factory=lambda: np.zeros((0, 0), PORT_RECORD))


@dataclass(frozen=True)
class Comparison:
    """The result of a replay.

    ticks           ticks that were repeated
    of              ticks from the first recorded one to the last
    with_force      repeated ticks with a force that is not zero
    stretches       runs of consecutive ticks that were repeated
    difference      the first difference, or None
    missing_models  names of models that the recording needs too
    """

    ticks: int
    of: int
    with_force: int
    stretches: int
    difference: str | None
    missing_models: tuple[str, ...]

    @property
    def code(self) -> int:
        """The exit code that tells it."""
        if self.difference is not None:
            return 1
        return 3 if self.ticks < self.of else 0


def read_recording(path: Path) -> Recorded:
    """Read a recording, complete or cut short by a crash or a full disk. Raises ReplayError if it is damaged or no recording."""
    if path.exists() and not path.is_file():  # to open a pipe would wait for its other end
        raise ReplayError(f"{path}: not a plain file")
    try:
        with path.open("rb") as stream:
            return _read(path, stream)
    except OSError as error:
        raise ReplayError(f"{path}: {error.strerror}") from error


def _read(path: Path, stream: Any) -> Recorded:
    if stream.read(len(_MAGIC)) != _MAGIC:
        raise ReplayError(f"{path}: not an MCAP file")
    stream.seek(-len(_MAGIC), os.SEEK_END)
    is_complete = stream.tell() > 0 and stream.read() == _MAGIC
    stream.seek(0)
    recorded, ticks = Recorded(), []
    try:
        for kind, message in _messages(stream, is_complete):
            if kind == "settings":
                snapshot.from_message(message)
                recorded.settings[message["tick"]] = message
            elif kind == "tick":
                ticks.append(message)
        recorded.ticks = from_objects(ticks, TICK)
        n_tools = len(ticks[0]["tools"]) if ticks else 0
        tools = [tool for message in ticks for tool in message["tools"]]
        recorded.ports = from_objects(tools, PORT_RECORD).reshape(len(ticks), n_tools)
    except Exception as error:  # a damaged file can raise anything
        raise ReplayError(f"{path}: damaged, or of another version ({_one_line(error)})") from error
    if not len(recorded.ticks) or not recorded.settings:
        raise ReplayError(f"{path}: holds no ticks")
    if np.any(np.diff(recorded.ticks["tick"]) <= 0):
        raise ReplayError(f"{path}: damaged: its ticks are not in order")
    return recorded


def _messages(stream: Any, is_complete: bool) -> Iterator[tuple[str, dict[str, Any]]]:
    """The kind and the content of each. Raises whatever the reader does when the file is damaged."""
    reader = NonSeekingReader(stream, validate_crcs=True, record_size_limit=_LARGEST_RECORD_BYTES)
    messages = reader.iter_messages(log_time_order=False)
    while True:
        try:
            schema, _, message = next(messages)
        except StopIteration:
            return
        except (EndOfFile, struct.error):
            if is_complete:
                raise
            return  # cut short here
        if schema is not None:
            yield schema.name.removeprefix("palpate."), json.loads(message.data)


def _one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]


def compare(recorded: Recorded, at_hand: Sequence[Model]) -> Comparison:
    """Repeat every tick from each state on for as long as ticks follow one another. Raises ReplayError."""
    ticks, ports = recorded.ticks, recorded.ports
    commands = _commands(ticks, ports)
    compared = with_force = stretches = 0
    difference = None
    missing: dict[str, None] = {}
    memory: Memory | None = None
    begin = 0
    for k, tick in enumerate(ticks["tick"].tolist()):
        follows = k > 0 and ticks["tick"][k - 1] == tick - 1
        if tick in recorded.settings:
            begins = memory is None or not follows
            memory = _restored(recorded.settings[tick], at_hand, memory if follows else None, missing)
            if begins:
                begin = tick
                stretches += memory is not None
            if memory is not None:
                image = make_image(memory)
        elif not follows or ticks["change"][k]:
            memory = None
        if memory is None:
            continue
        _feed(memory, commands[k], ports[k], begin)
        missed = bool(ticks["flags"][k] & Flags.CAUGHT_UP)
        scheduler.repeat_tick(image, ticks["deadline_ns"][k], ticks["start_ns"][k], missed)
        compared += 1
        with_force += bool(np.any(ports["force_n"][k]))
        if difference := _difference(ports[k], memory.ring.ports[tick % RECORDS]):
            difference = f"tick {tick}: {difference}"
            break
    if stretches == 0 and missing:
        raise ReplayError(f"the recording is of other models: {', '.join(missing)}")
    of = int(ticks["tick"][-1] - ticks["tick"][0] + 1)
    return Comparison(compared, of, with_force, stretches, difference, tuple(missing))


def _commands(ticks: NDArray[np.void], ports: NDArray[np.void]) -> NDArray[np.void]:
    """The commands as the ticks used them, (t, n_tools) COMMAND."""
    commands = np.zeros(ports.shape, COMMAND)
    commands["tool"] = np.arange(ports.shape[1])
    for name in ("sequence", "client_time_ns", "rendered_tick", "attach", "velocity_m_per_s"):
        commands[name] = ports[name]
    commands["position_m"] = ports["target_m"]
    commands["arrival_ns"] = ticks["start_ns"][:, None] - ports["input_age_ns"]
    return commands


def _restored(
    message: dict[str, Any],
    at_hand: Sequence[Model],
    before: Memory | None,
    missing: dict[str, None],
) -> Memory | None:
    """Memory in the state of a message, with the ring of the memory `before`; None when a model is not at hand."""
    saved = snapshot.from_message(message)
    found = []
    for told in (message["model"], message["following"]):
        model = None if told is None else _model_of(told, at_hand)
        if told is not None and model is None:
            missing[
                f"{told['name']!r} (order {told['order']}, config_sha256 {told['config_sha256'][:12]})"
            ] = None
            return None
        found.append(model)
    model, following = found
    assert model is not None
    limits = [_ANY_LIMITS] * len(saved.ports)
    if (n_tools := len(models.tools_of(model))) != len(limits):
        raise ReplayError(f"the recording is of {len(limits)} tools, {model.name!r} has {n_tools}")
    memory = shared_memory.make_memory(models.make_running(model), model.period_s, limits, 1.0)
    if following is not None:
        coupling = cross_fade.to_another(memory.coupling, models.make_running(following), 1.0)
        memory = shared_memory.with_coupling(memory, coupling)
    if before is not None:
        memory = memory._replace(ring=before.ring)
    _restore(memory, saved)
    return memory


def _model_of(told: dict[str, Any], at_hand: Sequence[Model]) -> Model | None:
    """The model of an identity, as stiff as it was; None when it is not at hand."""
    factor = told.get("stiffness_factor", 1.0)  # earlier recordings do not tell it
    told = told | {"stiffness_factor": factor}
    for model in at_hand:
        if snapshot.identity(model) | {"stiffness_factor": factor} == told:
            return stiffened(model, factor) if isinstance(model, SurfaceModel) and factor != 1 else model
    return None


def _restore(memory: Memory, saved: Saved) -> None:
    memory.counters[:] = saved.counters
    memory.used[:] = saved.used
    memory.settings[:] = saved.settings
    memory.ports[:] = saved.ports
    memory.coupling.restore(saved.state)


def _feed(memory: Memory, commands: NDArray[np.void], ports: NDArray[np.void], begin: int) -> None:
    """Write the commands of a tick, (n_tools,), and the forces from before the stretch, to where the tick reads them."""
    memory.commands.newest[:] = commands
    tick = int(memory.counters["ticks"][0])
    for tool, rendered in enumerate(commands["rendered_tick"].tolist()):
        rendered = rendered_before(tick, rendered)
        if rendered < begin:  # recorded before this stretch: its force is an input too
            memory.ring.ports["force_n"][rendered % RECORDS, tool] = ports["rendered_force_n"][tool]


def _difference(recorded: NDArray[np.void], repeated: NDArray[np.void]) -> str | None:
    """The first field of a tick's records, (n_tools,) PORT_RECORD, that is not the same bit for bit."""
    if recorded.tobytes() == repeated.tobytes():
        return None
    for name in PORT_RECORD.names or ():
        if recorded[name].tobytes() != repeated[name].tobytes():
            return f"{name} was {recorded[name].tolist()}, is {repeated[name].tolist()}"
    raise AssertionError("records without padding differ in a field")


def main(arguments: Sequence[str] | None = None) -> int:
    about = (__doc__ or "").strip().split("\n\n")
    parser = argparse.ArgumentParser(prog="palpate replay", description=about[0], epilog=about[-1])
    parser.add_argument("recording", type=Path, metavar="RECORDING.mcap")
    parser.add_argument("models", type=Path, nargs="+", metavar="MODEL.npz")
    parser.add_argument("--json", action="store_true", help="print the comparison as JSON")
    options = parser.parse_args(arguments)
    try:
        recorded = read_recording(options.recording)
        result = compare(recorded, [load_model(path) for path in options.models])
    except (OSError, ReplayError, ModelFileError) as error:
        return failed("palpate replay", error, 2)
    if options.json:
        print(json.dumps(asdict(result)))
        return result.code
    where = "" if result.stretches == 1 else f", in {result.stretches} stretches"
    print(f"{result.ticks} of {result.of} ticks repeated{where}, {result.with_force} with a force: ", end="")
    if result.difference is not None:
        print(result.difference)
    elif result.ticks < result.of:
        print("these are the same, bit for bit; the others could not be compared")
        if result.missing_models:
            print(printable(f"models that are needed too: {', '.join(result.missing_models)}"))
    else:
        print("every one is the same, bit for bit")
    return result.code


if __name__ == "__main__":
    sys.exit(main())
