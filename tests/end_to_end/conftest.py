"""A real server in a process of its own, on loopback and a free port, ended whatever happens."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import msgpack
import pytest
import zenoh

from palpate.model import ReducedModel, save_model
from palpate_server.round_trips import free_endpoint

EXAMPLES = Path(__file__).parents[2] / "client_examples"
START_S = 60.0  # the first start compiles
SESSION = "test"


@dataclass
class ServedModel:
    """A server that is running."""

    process: subprocess.Popen[str]
    endpoint: str
    model: ReducedModel
    before: list[str]

    def stop(self, number: int = signal.SIGTERM) -> int:
        self.process.send_signal(number)
        return self.process.wait(20)

    def output(self) -> str:
        """What it printed since it was serving, after its end; also what it printed before, on the way there."""
        assert self.process.stdout is not None
        return "".join(self.before) + self.process.stdout.read()


@dataclass
class RawClient:
    """A client that can misbehave: it sends any bytes, and keeps whatever comes."""

    endpoint: str
    name: str = field(default_factory=lambda: f"test-{uuid.uuid4().hex[:8]}")
    forces: list[dict[str, Any]] = field(default_factory=list)
    statuses: list[dict[str, Any]] = field(default_factory=list)
    sequence: int = 0

    def __enter__(self) -> RawClient:
        config = zenoh.Config()
        for key, value in {
            "mode": "peer",
            "listen/endpoints": [],
            "connect/endpoints": [self.endpoint],
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
        }.items():
            config.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(config)
        self.token = self.session.liveliness().declare_token(f"palpate/{SESSION}/client/{self.name}")
        self._subscribers = [
            self.session.declare_subscriber(
                f"palpate/{SESSION}/{key}", lambda s, to=to: to.append(msgpack.unpackb(s.payload.to_bytes()))
            )
            for key, to in (("force", self.forces), ("status", self.statuses))
        ]
        wait_for(lambda: self.forces and self.statuses, "forces and statuses")
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.session.close()

    def query(self, key: str, request: object = None) -> tuple[bool, dict[str, Any]]:
        """Whether it was granted, and the answer."""
        payload = None if request is None else msgpack.packb(request)
        for reply in self.session.get(f"palpate/{SESSION}/{key}", payload=payload, timeout=5.0):
            result = reply.ok or reply.err
            assert result is not None
            return reply.ok is not None, msgpack.unpackb(result.payload.to_bytes())
        raise AssertionError(f"no answer to {key}")

    def acquire(self, *contacts: str) -> tuple[bool, dict[str, Any]]:
        return self.control("acquire", {"contacts": list(contacts)})

    def control(self, action: str, request: object = None) -> tuple[bool, dict[str, Any]]:
        return self.query(f"control/{self.name}/{action}", request)

    def put(self, payload: bytes) -> None:
        self.session.put(
            f"palpate/{SESSION}/command/{self.name}",
            payload,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def command(self, displacement_m: dict[str, list[float]], sequence: int | None = None) -> int:
        if sequence is None:
            self.sequence += 1
            sequence = self.sequence
        message = {
            "sequence": sequence,
            "client_time_ns": time.monotonic_ns(),
            "displacement_m": displacement_m,
        }
        self.put(msgpack.packb(message))
        return sequence

    @contextmanager
    def pressing(self, displacement_m: dict[str, list[float]]) -> Iterator[None]:
        """A command each millisecond from a thread of its own."""
        stop = threading.Event()

        def press() -> None:
            while not stop.wait(0.001):
                self.command(displacement_m)

        thread = threading.Thread(target=press)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()

    def next_status(self) -> dict[str, Any]:
        """The second status from now: the first may have been made before."""
        count = len(self.statuses)
        wait_for(lambda: len(self.statuses) >= count + 2, "a status")
        return self.statuses[-1]


def wait_for(condition: Callable[[], object], what: str, seconds: float = 20.0) -> None:
    give_up = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < give_up, f"waited {seconds} s for {what}"
        time.sleep(0.005)


@pytest.fixture
def serve(
    tmp_path: Path, make_spring_mass_model: Callable[..., ReducedModel]
) -> Iterator[Callable[..., ServedModel]]:
    processes: list[subprocess.Popen[str]] = []

    def start(*options: str, n_contacts: int = 1, listen: bool = True) -> ServedModel:
        model = make_spring_mass_model(n_contacts, 20)
        path = tmp_path / f"model{n_contacts}.npz"
        save_model(model, path)
        endpoint = free_endpoint()
        place = ("--listen", endpoint) if listen else ()
        process = subprocess.Popen(
            [sys.executable, "-m", "palpate_server", str(path), *place, "--session", SESSION, *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        processes.append(process)
        assert process.stdout is not None
        give_up = time.monotonic() + START_S
        before: list[str] = []
        for line in process.stdout:
            if line.startswith("serving"):
                return ServedModel(process, endpoint, model, before)
            before.append(line)
            assert time.monotonic() < give_up
        raise AssertionError("the server did not start")

    yield start
    for process in processes:
        process.kill()
        process.wait()
        if process.stdout:
            process.stdout.close()


@pytest.fixture
def run_example() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    processes: list[subprocess.Popen[str]] = []

    def run(script: str, endpoint: str, *options: str) -> subprocess.Popen[str]:
        patient = ("--silence-s", "5")  # a busy test machine is no reason to let go
        place = ("--connect", endpoint, "--session", SESSION)
        process = subprocess.Popen(
            [sys.executable, str(EXAMPLES / script), *place, *patient, *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        processes.append(process)
        return process

    yield run
    for process in processes:
        process.kill()
        process.communicate()


@pytest.fixture
def connect() -> type[RawClient]:
    return RawClient
