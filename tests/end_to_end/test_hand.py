"""The mouse as a device, without a browser: it presses, follows, is silent, is refused, and lets go."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from palpate.model_file import SurfaceModel
from palpate_client import Connection
from palpate_client.wire import Flags
from palpate_view.hand import Grip, Hand
from palpate_view.motion import drag_tool, grab_surface, moved, press_surface
from palpate_view.surface import Hit

UP = np.array([0.0, 0.0, 1.0])
MIDDLE = Hit(np.zeros(3), UP)
PAGE, OTHER_PAGE = 1, 2
GRIP = Grip(PAGE, "tip", radius_m=0.0045, friction=0.2)


@pytest.fixture(scope="module")
def endpoint(serve_for_module: Callable[..., Any], make_surface_model: Callable[..., SurfaceModel]) -> str:
    return str(serve_for_module(model=make_surface_model()).endpoint)


@contextmanager
def hand_on(endpoint: str) -> Iterator[tuple[Hand, list[str]]]:
    told: list[str] = []
    with Connection(endpoint, "test") as connection:
        hand = Hand(connection, lambda text, page: told.append(text))
        try:
            yield hand, told
        finally:
            hand.end()


@contextmanager
def living(hand: Hand, page: int) -> Iterator[None]:
    """A page that gives signs of life."""
    stop = threading.Event()

    def live() -> None:
        while not stop.wait(0.05):
            hand.sign(page)

    thread = threading.Thread(target=live)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def newtons(message: dict[str, Any]) -> float:
    return float(np.linalg.norm(message["force_n"][0]))


def test_it_presses_with_the_tool_that_was_asked_for_and_lets_go(
    endpoint: str, connect: Callable[..., Any]
) -> None:
    with connect(endpoint) as client, hand_on(endpoint) as (hand, told), living(hand, PAGE):
        assert hand.take(GRIP, press_surface(MIDDLE, np.zeros(3), 0.0045, 0.003))
        pressed = client.force_when(lambda m: newtons(m) > 0.1 and m["force_scale"][0] == 1, "a force")
        assert pressed["flags"][0] & Flags.IN_CONTACT
        tool = client.next_status()["tools"]["tip"]
        assert (tool["radius_m"], tool["friction"]) == (0.0045, 0.2)
        # 3 mm below the plane, when the smoothing has arrived
        client.force_when(lambda m: abs(m["position_m"][0][2] - 0.0015) < 1e-5, "the depth")
        let_go_ns = time.monotonic_ns()
        hand.let_go(OTHER_PAGE)
        assert hand.grip is GRIP
        hand.let_go(PAGE)
        client.force_when(lambda m: newtons(m) == 0, "no force")
        first = next(m for m in client.forces if m["server_time_ns"] > let_go_ns and newtons(m) == 0)
        held = [m for m in client.forces if let_go_ns < m["server_time_ns"] < first["server_time_ns"]]
        assert len(held) < 100  # ticks: 50 to fade, and a request's way
        assert not told
        assert client.next_status()["tools"]["tip"]["holder"] is None


def test_held_tissue_is_pulled(endpoint: str, connect: Callable[..., Any]) -> None:
    with connect(endpoint) as client, hand_on(endpoint) as (hand, _), living(hand, PAGE):
        hand.take(GRIP, grab_surface(MIDDLE, np.zeros(3), 0.0045))
        client.force_when(lambda m: m["flags"][0] & Flags.ATTACHED, "a hold")
        hand.aim(PAGE, lambda gesture: moved(gesture, np.array([0.0, 0.0, 0.004])))
        client.force_when(
            lambda m: m["force_n"][0][2] < -0.05, "a force that pulls the tool back to the tissue"
        )


def test_a_silent_page_loses_the_tool(
    endpoint: str, connect: Callable[..., Any], wait_for: Callable[..., Any]
) -> None:
    with connect(endpoint) as client, hand_on(endpoint) as (hand, told):
        hand.take(GRIP, drag_tool(np.zeros(3), UP, glued=False))
        client.status_when(lambda s: s["tools"]["tip"]["holder"] is not None, "a hold")
        client.status_when(lambda s: s["tools"]["tip"]["holder"] is None, "its end")
        wait_for(lambda: hand.grip is None, "a hand that knows it")  # the server's status may come first
        assert told == ["The page was silent, so the tool was let go."]


def test_another_page_and_another_client_are_told(endpoint: str, connect: Callable[..., Any]) -> None:
    gesture = drag_tool(np.zeros(3), UP, glued=False)
    with connect(endpoint) as client, hand_on(endpoint) as (hand, told), living(hand, PAGE):
        assert hand.take(GRIP, gesture)
        assert not hand.take(Grip(OTHER_PAGE, "tip"), gesture)
        hand.let_go(PAGE)
        client.status_when(lambda s: s["tools"]["tip"]["holder"] is None, "a free tool")
        assert client.acquire("tip")[0]
        hand.take(GRIP, gesture)
        end_s = time.monotonic() + 60
        while not told:
            assert time.monotonic() < end_s
            time.sleep(0.005)
        assert "held" in told[0]


def test_a_place_beyond_the_workspace_is_told(endpoint: str, wait_for: Callable[..., Any]) -> None:
    with hand_on(endpoint) as (hand, told), living(hand, PAGE):
        hand.take(GRIP, press_surface(Hit(np.array([0.5, 0.0, 0.0]), UP), np.zeros(3), 0.0045, 0.003))
        wait_for(lambda: told, "words")
        assert "workspace ends at 100 mm" in told[0]
        wait_for(lambda: hand.grip is None, "the end")
