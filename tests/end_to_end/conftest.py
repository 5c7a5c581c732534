"""Programs as a user runs them, each a process on loopback that ends with its test, and a client to watch them with.

Nothing here counts on a quick machine: a wait is for what is to happen, never for a time in which it usually has.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from types import TracebackType
from typing import Any

import msgpack
import pytest
import zenoh

from palpate.model_file import ReducedModel, SurfaceModel, save_model
from palpate_client.local_server import free_endpoint
from palpate_client.wire import FORCE_FIELDS, KEEP_ALIVES, LEASE_MS, PER_TICK
from palpate_server.diagnostics.sample_model import spring_mass_model
from palpate_server.recording.replay import read_recording

EXAMPLES = Path(__file__).parents[2] / "client_examples"
SESSION = "test"
PATIENCE_S = 60.0  # what is waited for comes much sooner; a busy machine may take its time
START_S = 240.0  # the first start compiles


def wait_for(
    look: Callable[[], Any],
    what: str,
    condition: Callable[[Any], object] = bool,
    seconds: float = PATIENCE_S,
) -> Any:
    """What `look` returns as soon as that meets the condition."""
    give_up = time.monotonic() + seconds
    while not condition(seen := look()):
        assert time.monotonic() < give_up, f"waited {seconds:g} s for {what}; last seen: {repr(seen)[-2000:]}"
        time.sleep(0.005)
    return seen


# Programs


@pytest.fixture(scope="session", autouse=True)
def interruptible() -> None:
    """Tests that are run in the background of a shell inherit that Ctrl-C is ignored, and so would what they start.

    Under nohup it is the hang-up: what is handled here is as it usually is in what we start.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda *_: None)


@dataclass
class Program:
    """Python in a process of its own; what it prints goes to two files."""

    process: subprocess.Popen[bytes]
    out: Path
    err: Path

    def printed(self) -> str:
        return self.out.read_text() + self.err.read_text()

    def finish(self) -> tuple[int, str, str]:
        """Its exit code, standard output and standard error, once it has ended by itself."""
        code = wait_for(
            lambda: (self.process.poll(), self.printed()),
            f"the end of {self.process.args}",
            lambda seen: seen[0] is not None,
            START_S,
        )[0]
        err = self.err.read_text()
        assert "Traceback" not in err, err
        return code, self.out.read_text(), err

    def stop(self, number: int = signal.SIGTERM) -> int:
        self.process.send_signal(number)
        return self.finish()[0]


@contextmanager
def _programs(folder: Path) -> Iterator[Callable[..., Program]]:
    """Starts programs, and ends those that still run."""
    started: list[Program] = []

    def start(*arguments: str | Path, ready: str = "", cwd: Path | None = None) -> Program:
        """With `ready` it returns when a line has been printed that begins with it."""
        out, err = (folder / f"{len(started)}.{stream}" for stream in ("out", "err"))
        with out.open("wb") as stdout, err.open("wb") as stderr:
            process = subprocess.Popen(
                [sys.executable, *map(str, arguments)], stdout=stdout, stderr=stderr, cwd=cwd
            )
        program = Program(process, out, err)
        started.append(program)

        def seen() -> tuple[bool, int | None, str]:
            ended = process.poll()  # before the look at what it printed by then
            is_ready = any(line.startswith(ready) for line in out.read_text().splitlines())
            return is_ready, ended, program.printed()

        if ready:
            is_ready, code, printed = wait_for(
                seen, f"the line {ready!r} of {process.args}", lambda it: it[0] or it[1] is not None, START_S
            )
            assert is_ready, f"{process.args} has ended with code {code}: {printed}"
        return program

    try:
        yield start
    finally:
        for program in started:
            program.process.kill()
        for program in started:
            program.process.wait()


@pytest.fixture
def start(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Program]]:
    """start(*arguments of Python, ready="", cwd=None) -> Program"""
    with _programs(tmp_path_factory.mktemp("programs")) as start:
        yield start


@pytest.fixture(scope="module")
def start_for_module(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Program]]:
    """As `start`, of programs that several tests share."""
    with _programs(tmp_path_factory.mktemp("programs")) as start:
        yield start


@dataclass
class ServedModel:
    """A server that is running."""

    program: Program
    endpoint: str
    model: Any

    @property
    def process(self) -> subprocess.Popen[bytes]:
        return self.program.process

    def stop(self, number: int = signal.SIGTERM) -> int:
        return self.program.stop(number)


def _serve(
    start: Callable[..., Program],
    folder: Path,
    *options: str,
    n_contacts: int = 1,
    n_modes: int = 20,
    listen: bool = True,
    model: ReducedModel | SurfaceModel | None = None,
) -> ServedModel:
    """A server of its own for the file model{n_contacts}.npz in a folder, or for `model`. Without `listen` the options say where."""
    model = model or spring_mass_model(n_contacts, n_modes)
    path = folder / f"model{n_contacts}.npz"
    save_model(model, path)
    endpoint = free_endpoint()
    place = ("--listen", endpoint) if listen else ()
    command = ("-m", "palpate_server", path, *place, "--session", SESSION, *options)
    return ServedModel(start(*command, ready="serving"), endpoint, model)


@pytest.fixture
def serve(start: Callable[..., Program], tmp_path: Path) -> Callable[..., ServedModel]:
    """serve(*options, n_contacts=1, n_modes=20, listen=True) -> ServedModel"""
    return partial(_serve, start, tmp_path)


@pytest.fixture(scope="module")
def serve_for_module(
    start_for_module: Callable[..., Program], tmp_path_factory: pytest.TempPathFactory
) -> Callable[..., ServedModel]:
    """As `serve`, of a server that several tests share: none of them may change what another looks at."""
    return partial(_serve, start_for_module, tmp_path_factory.mktemp("served"))


@pytest.fixture
def run_example(start: Callable[..., Program]) -> Callable[..., Program]:
    """run_example(script of client_examples or module, endpoint, *options) -> Program"""

    def run(program: str | Path, endpoint: str, *options: str) -> Program:
        patient = ("--silence-s", "30")  # a busy machine is no reason to let go
        place = ("--connect", endpoint, "--session", SESSION)
        is_script = str(program).endswith(".py")
        what = (EXAMPLES / program,) if is_script else ("-m", program)
        return start(*what, *place, *patient, *options)

    return run


@pytest.fixture
def view(start: Callable[..., Program]) -> Callable[[str], str]:
    """view(endpoint of a server) -> address of the page that `palpate view` serves"""

    def view(endpoint: str) -> str:
        port = free_endpoint().rpartition(":")[2]
        options = ("--connect", endpoint, "--session", SESSION, "--port", port)
        program = start("-m", "palpate", "view", *options, ready="palpate view:")
        found = re.search(r"http://\S+", program.out.read_text())
        assert found is not None
        return found[0]

    return view


@pytest.fixture(name="wait_for")
def _wait_for() -> Callable[..., Any]:
    """wait_for(look, what, condition=bool, seconds=60.0)"""
    return wait_for


# A loaded machine

HICCUP_TICKS = 100
"""What a shared machine itself takes from a real-time thread at times. What the tests look for costs hundreds."""


@cache
def _real_time_is_allowed() -> bool:
    """Tried in a thread of its own, which ends with it."""

    def try_it() -> None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
            allowed.append(True)
        except PermissionError:
            pass

    allowed: list[bool] = []
    thread = threading.Thread(target=try_it)
    thread.start()
    thread.join()
    return bool(allowed)


@pytest.fixture(scope="session")
def assert_ticks_went_on() -> Callable[[dict[str, Any], dict[str, Any]], None]:
    """assert_ticks_went_on(status before, status after): no tick was delayed, and no force left unsent, but for a hiccup.

    Without real-time scheduling the other programs of the machine delay ticks at will, and nothing is said.
    """

    def check(before: dict[str, Any], after: dict[str, Any]) -> None:
        if _real_time_is_allowed():
            assert after["skipped_ticks"] - before["skipped_ticks"] <= HICCUP_TICKS
            assert after["dropped"]["unsent_force"] - before["dropped"]["unsent_force"] <= HICCUP_TICKS

    return check


# The client


def request(**fields: Any) -> dict[str, Any]:
    """A control request of this schema version."""
    return {"kind": "request", "schema_version": 2, **fields}


@dataclass
class RawClient:
    """A client that can misbehave: it sends any bytes, and keeps whatever comes.

    place: an endpoint, or a file with a Zenoh configuration
    """

    place: str | Path
    name: str = field(default_factory=lambda: f"test-{uuid.uuid4().hex[:8]}")
    server: str = SESSION
    forces: list[dict[str, Any]] = field(default_factory=list)
    statuses: list[dict[str, Any]] = field(default_factory=list)
    sequence: int = 0

    def __enter__(self) -> RawClient:
        self.open()
        try:
            wait_for(lambda: (len(self.forces), len(self.statuses)), "forces and statuses", all)
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.close()

    def open(self) -> None:
        self.session = zenoh.open(_configuration(self.place))
        self.token = self.session.liveliness().declare_token(self.key(f"client/{self.name}"))
        self._subscribers = [
            self.session.declare_subscriber(
                self.key(key), lambda s, to=to: to.append(msgpack.unpackb(s.payload.to_bytes()))
            )
            for key, to in (("force", self.forces), ("status", self.statuses))
        ]

    def close(self) -> None:
        """Without it the tests would hang at their end."""
        self.session.close()

    def key(self, rest: str) -> str:
        return f"palpate/{self.server}/{rest}"

    def query(self, key: str, request: object = None) -> tuple[bool, dict[str, Any]]:
        """Whether it was granted, and the server's answer. Raises TimeoutError when the server gives none."""
        payload = None if request is None else msgpack.packb(request)
        for reply in self.session.get(self.key(key), payload=payload, timeout=PATIENCE_S):
            result = reply.ok or reply.err
            assert result is not None
            if str(result.encoding).startswith("application/msgpack"):  # or the words are Zenoh's
                return reply.ok is not None, msgpack.unpackb(result.payload.to_bytes())
        raise TimeoutError(f"no answer to {key}")

    def control(self, action: str, **fields: Any) -> tuple[bool, dict[str, Any]]:
        return self.query(f"control/{self.name}/{action}", request(**fields))

    def acquire(self, *tools: str, **fields: Any) -> tuple[bool, dict[str, Any]]:
        return self.control("acquire", tools=list(tools), **fields)

    def record(self, file: str) -> dict[str, Any]:
        """Begin a recording of the server's, and wait until a status has told of its first tick; the report on it.

        That of the recording's beginning may not: it is sent after the answer, with the tick that is the next one.
        """
        granted, answer = self.control("record", file=file)
        assert granted, answer
        ticks = self.next_status()["ticks"]
        self.status_when(lambda status: status["ticks"] > ticks, "a status that tells of a recorded tick")
        report: dict[str, Any] = answer["recording"]
        return report

    def put(self, payload: bytes) -> None:
        """To the server's commands. None is dropped, and they arrive in order, but when they do nobody says."""
        self.session.put(
            self.key(f"command/{self.name}"),
            payload,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def command(self, position_m: dict[str, list[float]], sequence: int | None = None, **fields: Any) -> int:
        if sequence is None:
            self.sequence += 1
            sequence = self.sequence
        message = {
            "kind": "command",
            "sequence": sequence,
            "client_time_ns": time.monotonic_ns(),
            "position_m": position_m,
        }
        self.put(msgpack.packb(message | fields))
        return sequence

    @contextmanager
    def pressing(self, position_m: dict[str, list[float]]) -> Iterator[None]:
        """A command each millisecond from a thread of its own."""
        stop = threading.Event()

        def press() -> None:
            while not stop.wait(0.001):
                self.command(position_m)

        thread = threading.Thread(target=press)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()

    def force_when(self, condition: Callable[[dict[str, Any]], object], what: str) -> dict[str, Any]:
        """The first force that meets a condition, of those whose tick begins from now on."""
        return _first_from_now(self.forces, condition, what)

    def status_when(self, condition: Callable[[dict[str, Any]], object], what: str) -> dict[str, Any]:
        """The first status that meets a condition, of those that the server makes from now on."""
        return _first_from_now(self.statuses, condition, what)

    def next_status(self) -> dict[str, Any]:
        return self.status_when(lambda status: True, "a status")


def _first_from_now(
    messages: list[dict[str, Any]], condition: Callable[[dict[str, Any]], object], what: str
) -> dict[str, Any]:
    """What has come, or is on its way, may be old news: one machine has one monotonic clock, which tells."""
    now_ns, looked_at = time.monotonic_ns(), len(messages)

    def look() -> tuple[dict[str, Any] | None, dict[str, Any]]:
        nonlocal looked_at
        while looked_at < len(messages):
            message = messages[looked_at]
            looked_at += 1
            if message["server_time_ns"] >= now_ns and condition(message):
                return message, message
        return None, messages[-1]

    found: dict[str, Any] = wait_for(look, what, lambda seen: seen[0] is not None)[0]
    return found


def _configuration(place: str | Path) -> zenoh.Config:
    if isinstance(place, Path):
        return zenoh.Config.from_file(place)
    config = zenoh.Config()
    for key, value in {
        "mode": "peer",
        "listen/endpoints": [],
        "connect/endpoints": [place],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/tx/keep_alive": KEEP_ALIVES,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


@pytest.fixture(scope="session")
def forces_in() -> Callable[[Path], list[dict[str, Any]]]:
    """The ticks of a recording as the force messages of the wire."""

    def forces_in(path: Path) -> list[dict[str, Any]]:
        recorded = read_recording(path)
        return [
            {"tick": int(tick["tick"]), "server_time_ns": int(tick["start_ns"])}
            | {name: ports[name].tolist() for name, (count, _) in FORCE_FIELDS.items() if count != PER_TICK}
            for tick, ports in zip(recorded.ticks, recorded.ports, strict=True)
        ]

    return forces_in


@pytest.fixture(scope="session")
def connect() -> type[RawClient]:
    """connect(endpoint or configuration file, name=..., server="test") -> RawClient, for a `with` statement"""
    return RawClient
