"""What a client decodes, and that it needs nothing but eclipse-zenoh and msgpack for it."""

from __future__ import annotations

import math
import subprocess
import sys

import msgpack
import numpy as np
import pytest

from palpate_client import Frame, decode_geometry, decode_surface
from palpate_client.wire import MalformedMessage

GEOMETRY = {
    "kind": "geometry",
    "schema_version": 2,
    "n_vertices": 2,
    "n_triangles": 1,
    "vertices_m": np.arange(6, dtype="<f4").tobytes(),
    "triangles": np.array([0, 1, 0], "<i4").tobytes(),
}
SURFACE = {
    "kind": "surface",
    "tick": 7,
    "server_time_ns": 8,
    "displacement_m": np.arange(6, dtype="<f4").tobytes(),
}


def test_geometry_and_surface_are_buffers_that_numpy_wraps_without_a_copy() -> None:
    geometry, surface = decode_geometry(msgpack.packb(GEOMETRY)), decode_surface(msgpack.packb(SURFACE))
    vertices = np.frombuffer(geometry.vertices_m, "f4").reshape(-1, 3)
    np.testing.assert_array_equal(vertices, np.arange(6).reshape(2, 3))
    assert np.shares_memory(vertices, np.frombuffer(geometry.vertices_m, "f4"))
    assert geometry.triangles.tolist() == [0, 1, 0]
    assert geometry.error_in_band is None
    known = decode_geometry(
        msgpack.packb(GEOMETRY | {"error_in_band": np.array([0.25, 0.5], "<f4").tobytes()})
    )
    assert known.error_in_band is not None and known.error_in_band.tolist() == [0.25, 0.5]
    assert (surface.tick, surface.server_time_ns) == (7, 8)
    assert surface.displacement_m.tolist() == list(range(6))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"kind": "surface"}, "wrong_kind"),
        ({"n_vertices": 3}, "wrong_shape"),
        ({"n_triangles": None}, "wrong_shape"),
        ({"vertices_m": bytes(7)}, "wrong_type"),
        ({"triangles": [0, 1, 2]}, "wrong_type"),
        ({"error_in_band": bytes(4)}, "wrong_shape"),
        ({"error_in_band": 0.1}, "wrong_type"),
    ],
)
def test_geometry_that_is_not_as_described_is_refused(change: dict[str, object], reason: str) -> None:
    with pytest.raises(MalformedMessage) as caught:
        decode_geometry(msgpack.packb(GEOMETRY | change))
    assert caught.value.reason == reason


def test_a_direction_of_the_model_is_seen_along_the_clients_axes() -> None:
    """The rotation's columns are the client's axes, so that a model direction along one of them is that axis at the client."""
    turn = math.radians(30)
    x, y = (math.cos(turn), math.sin(turn), 0.0), (-math.sin(turn), math.cos(turn), 0.0)
    frame = Frame(rotation=tuple(zip(x, y, (0.0, 0.0, 1.0), strict=True)))  # type: ignore[arg-type]
    assert frame.direction_at_client(x) == pytest.approx((1, 0, 0), abs=1e-15)
    assert frame.direction_at_client(y) == pytest.approx((0, 1, 0), abs=1e-15)


def test_a_client_imports_eclipse_zenoh_and_msgpack_and_nothing_else() -> None:
    """In a process of its own; what the standard library has does not count."""
    look = (
        "import sys; before = set(sys.modules); import palpate_client, palpate_client.poke, palpate_client.health; "
        "new = {name for name in set(sys.modules) - before if getattr(sys.modules[name], '__file__', None)}; "
        "print(*{name.partition('.')[0] for name in new} - set(sys.stdlib_module_names))"
    )
    done = subprocess.run(
        [sys.executable, "-c", look], capture_output=True, text=True, check=True, timeout=60
    )
    assert set(done.stdout.split()) == {"msgpack", "palpate_client", "zenoh"}
