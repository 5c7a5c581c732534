"""The server's Zenoh session: what it lets a client send."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from palpate_server.diagnostics.round_trips import free_endpoint
from palpate_server.session import transport

CHANNEL_CAPACITY = 100


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def server(endpoint: str) -> Iterator[zenoh.Session]:
    with transport.open_session(endpoint, None) as session:
        yield session


def test_a_message_beyond_all_mistakes_is_dropped_and_the_link_stays(
    server: zenoh.Session, endpoint: str
) -> None:
    with transport.connect_session(endpoint, None) as client:
        heard = server.declare_subscriber("sizes", zenoh.handlers.FifoChannel(CHANNEL_CAPACITY))
        sizes = [16384, 2 * transport.MAX_MESSAGE_BYTES, 10_000_000, 4096, 0]
        for size in sizes:
            client.put("sizes", bytes(size), congestion_control=zenoh.CongestionControl.BLOCK)
        received = []
        while not received or received[-1] != 0:
            received.append(len(heard.recv().payload))
        assert received == [16384, 10_000_000, 4096, 0]


def test_a_client_hears_a_geometry_of_a_hundred_thousand_vertices(
    server: zenoh.Session, endpoint: str
) -> None:
    geometry = bytes(12 * 100_000 + 12 * 200_000)  # float32 positions, int32 triangles: twice as many
    answering = server.declare_queryable("geometry", lambda query: query.reply("geometry", geometry))
    with transport.connect_session(endpoint, None) as client:
        (reply,) = client.get("geometry", timeout=10.0)
        assert reply.ok is not None
        assert len(reply.ok.payload) == len(geometry)
    answering.undeclare()


@pytest.mark.parametrize("malformed", ["foo", 'a"b', "tcp/", "tcp/127.0.0.1:abc", "nope/127.0.0.1:3"])
def test_a_malformed_endpoint_is_refused_in_words(malformed: str) -> None:
    with pytest.raises(transport.TransportError) as caught:
        transport.open_session(malformed, None)
    message = str(caught.value)
    assert message.startswith(f"endpoint {malformed}: ")
    assert "Json5Err" not in message
    assert ".rs" not in message
    assert "\\" not in message


def test_an_endpoint_in_use_is_refused_without_loose_brackets(server: zenoh.Session, endpoint: str) -> None:
    with pytest.raises(transport.TransportError, match="Address already in use") as caught:
        transport.open_session(endpoint, None)
    assert str(caught.value).count("[") == str(caught.value).count("]")


def test_the_shipped_configuration_has_the_same_bound() -> None:
    shipped = Path(__file__).parents[3] / "configs" / "security" / "server.json5"
    config = zenoh.Config.from_file(shipped)
    assert json.loads(config.get_json("transport/link/rx/max_message_size")) == transport.MAX_MESSAGE_BYTES
    assert json.loads(config.get_json("transport/shared_memory/enabled")) is False
