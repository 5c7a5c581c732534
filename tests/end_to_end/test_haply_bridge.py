"""The bridge to Haply's service, against one that speaks the same JSON: whatever dies, the device is left without a force."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import math
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.server import ServerConnection, serve

from inverse_service import InverseService
from palpate.model_file import SurfaceModel
from palpate_client import DeviceLost
from palpate_client.local_server import free_endpoint

EXAMPLES = Path(__file__).parents[2] / "client_examples"
NO_FORCE = (0.0, 0.0, 0.0)
START_M = (0.02, -0.11, 0.08)  # where the hand is when the bridge starts


def pressing(t: float) -> tuple[float, float, float]:
    """A second outside, for the bridge to start, then between 1 mm outside and 3 mm deep, four times a second."""
    x, y, z = START_M
    return x, y, z if t < 1 else z - 1e-3 + 2e-3 * math.cos(8 * math.pi * t)


@pytest.fixture
def service() -> Iterator[InverseService]:
    with InverseService(pressing) as service:
        yield service
    assert service.errors == []


@pytest.fixture
def run_bridge(
    run_example: Callable[..., Any], service: InverseService, wait_for: Callable[..., Any]
) -> Callable[..., Any]:
    """The bridge with a server's endpoint, as soon as the device renders a force; held there by a hand that stays pressed."""

    def run(endpoint: str, *options: str) -> Any:
        bridge = run_example("haply_bridge.py", endpoint, "--service", service.url, *options)

        def pushed() -> bool:
            assert bridge.process.poll() is None, bridge.printed()
            return service.force_n[2] > 0

        wait_for(pushed, "a force at the device", seconds=240.0)
        return bridge

    return run


def deep(t: float) -> tuple[float, float, float]:
    x, y, z = START_M
    return x, y, z - 3e-3


def wait_for_no_force(service: InverseService, wait_for: Callable[..., Any]) -> None:
    """Until the device is left without a force, and stays so."""
    wait_for(lambda: service.force_n == NO_FORCE, "no force at the device")
    count = len(service.forces)
    time.sleep(0.05)
    assert all(force == NO_FORCE for _, force in service.forces[count:])


@pytest.fixture(scope="module")
def shared(serve_for_module: Callable[..., Any]) -> Any:
    """A server that no test harms."""
    return serve_for_module()


@pytest.mark.slow
def test_a_surface_model_is_touched_through_the_bridge(
    serve: Callable[..., Any],
    run_bridge: Callable[..., Any],
    service: InverseService,
    make_surface_model: Callable[..., SurfaceModel],
) -> None:
    bridge = run_bridge(serve(model=make_surface_model()).endpoint)
    assert bridge.stop(signal.SIGINT) == 130
    assert service.force_n == NO_FORCE
    # The hand moves along the normal: the force is along it, too, and never pulls.
    for x, y, z in (force for _, force in service.forces if force != NO_FORCE):
        assert math.hypot(x, y) < 0.1 * z


def test_the_device_is_left_without_a_force_when_the_server_is_killed(
    serve: Callable[..., Any],
    run_bridge: Callable[..., Any],
    service: InverseService,
    wait_for: Callable[..., Any],
) -> None:
    served = serve()
    bridge = run_bridge(served.endpoint)
    service.hand = deep
    wait_for(
        lambda: all(z > 0 for _, (_, _, z) in service.forces[-50:]), "forces up on a hand that stays deep"
    )
    served.process.kill()
    code, _, err = bridge.finish()
    assert code == 1
    assert "the server is gone" in err
    assert service.force_n == NO_FORCE


@pytest.mark.slow
def test_a_stale_force_is_not_kept(
    serve: Callable[..., Any],
    run_bridge: Callable[..., Any],
    service: InverseService,
    wait_for: Callable[..., Any],
) -> None:
    """A server that is stopped keeps its token for seconds: what is noticed is that no force comes."""
    served = serve()
    bridge = run_bridge(served.endpoint)
    service.hand = deep
    served.process.send_signal(signal.SIGSTOP)
    try:
        wait_for_no_force(service, wait_for)
        assert bridge.process.poll() is None
    finally:
        served.process.send_signal(signal.SIGCONT)
    assert bridge.stop() == 130


@pytest.mark.parametrize("number", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=pytest.mark.slow)])
def test_the_guard_lets_go_when_the_bridge_dies_or_hangs(
    shared: Any,
    run_bridge: Callable[..., Any],
    service: InverseService,
    wait_for: Callable[..., Any],
    number: int,
) -> None:
    bridge = run_bridge(shared.endpoint)
    service.hand = deep
    wait_for(lambda: service.force_n != NO_FORCE, "a force")
    os.kill(bridge.process.pid, number)
    wait_for_no_force(service, wait_for)
    bridge.process.kill()


def test_a_bridge_whose_service_dies_gives_its_tool_back(
    shared: Any,
    run_bridge: Callable[..., Any],
    service: InverseService,
    connect: Callable[..., Any],
) -> None:
    with connect(shared.endpoint) as observer:
        bridge = run_bridge(shared.endpoint)
        assert observer.next_status()["tools"]["tip"]["holder"] is not None
        service.die()
        code, _, err = bridge.finish()
        assert code == 1
        assert f"the Inverse service at {service.url} is gone" in err
        observer.status_when(lambda status: status["tools"]["tip"]["holder"] is None, "a free tool")


@pytest.mark.slow
def test_a_bridge_whose_service_falls_silent_ends_without_a_force(
    shared: Any,
    run_bridge: Callable[..., Any],
    service: InverseService,
) -> None:
    bridge = run_bridge(shared.endpoint)
    service.hand = deep
    service.silent = True
    code, _, err = bridge.finish()
    assert code == 1
    assert "is silent" in err
    assert service.force_n == NO_FORCE


@pytest.fixture
def haply() -> Any:
    spec = importlib.util.spec_from_file_location("haply_bridge", EXAMPLES / "haply_bridge.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_device_begins_where_the_hand_is_without_a_force_and_warns_when_it_is_not_ready(
    haply: Any, service: InverseService, capfd: pytest.CaptureFixture[str]
) -> None:
    service.ready = False
    device = haply.Inverse3(service.url)
    try:
        assert device.neutral_m == START_M
        assert [force for _, force in service.forces] == [NO_FORCE]
        device.render((0.1, 0.2, 0.3))
        assert device.read() == (START_M, (0.0, 0.0, 0.0))
        assert service.force_n == (0.1, 0.2, 0.3)
    finally:
        device.close()
    assert device.guard.returncode == 0
    assert capfd.readouterr().err == "warning: the service says of the Inverse3 04a1: not ready\n"


def test_a_device_that_is_not_there_or_is_unplugged_is_told(haply: Any, service: InverseService) -> None:
    service.connected = False
    with pytest.raises(DeviceLost, match="no Inverse3 is connected to the service at ws://"):
        haply.Inverse3(service.url)
    service.connected = True
    device = haply.Inverse3(service.url)
    try:
        service.connected = False
        device.render(NO_FORCE)
        with pytest.raises(DeviceLost, match="the Inverse3 04a1 is no longer connected"):
            device.read()
    finally:
        device.close()


@contextlib.contextmanager
def serving(talk: Callable[[ServerConnection], None]) -> Iterator[str]:
    """The address of a service that does this with each client."""
    with serve(talk, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        server.shutdown()
        thread.join()


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        ("[]", "sent what can't be read: AttributeError"),
        ("{", "sent what can't be read: JSONDecodeError"),
        ('{"inverse3": [{"device_id": "04a1"}]}', "sent what can't be read: KeyError('state')"),
        (
            '{"inverse3": [{"device_id": "04a1", "state": {"cursor_position": {"x": null}}}]}',
            "sent what can't be read: TypeError",
        ),
        (None, "is gone"),
    ],
)
def test_a_service_that_says_something_else_or_hangs_up_is_told(
    haply: Any, answer: str | None, says: str
) -> None:
    """Once in the first message, and once after a good one."""

    def talk(client: ServerConnection, first: str) -> None:
        client.send(first)
        for _ in client:
            if answer is None:
                client.close_socket()
                return
            client.send(answer)

    good = '{"inverse3": [{"device_id": "04a1"}]}'
    for first in {good, answer or good}:
        with (
            serving(functools.partial(talk, first=first)) as url,
            pytest.raises(DeviceLost, match=re.escape(says)),
        ):
            haply.Inverse3(url)


def test_without_its_guard_a_bridge_ends_and_can_still_let_go(haply: Any, service: InverseService) -> None:
    device = haply.Inverse3(service.url)
    try:
        device.guard.kill()
        device.guard.wait()
        for force in ((0.0, 0.0, 1.0), NO_FORCE):
            with pytest.raises(DeviceLost, match="the guard has ended"):
                device.render(force)
            assert device.read() == (START_M, (0.0, 0.0, 0.0))  # the command has been taken
            assert service.force_n == force
    finally:
        device.close()


def test_a_service_that_is_not_there_is_told(shared: Any, run_example: Callable[..., Any]) -> None:
    nowhere = free_endpoint().replace("tcp/", "ws://")
    code, _, err = run_example("haply_bridge.py", shared.endpoint, "--service", nowhere).finish()
    assert code == 2
    assert f"no Inverse service at {nowhere}" in err
    assert len(err.splitlines()) == 1
