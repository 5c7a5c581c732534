"""What `palpate client --record` keeps of each force."""

from __future__ import annotations

import gc

from palpate_client.poke import row_of


def test_pythons_garbage_collector_does_not_look_at_what_is_recorded() -> None:
    """Else it holds commands up: with minutes of ticks for longer than a force takes to fade."""
    message = {
        "tick": 7,
        "server_time_ns": 10**18,
        "sequence": [5, -1],
        "flags": [0, 4],
        "force_scale": [1.0, 0.0],
        "position_m": [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]],
        "force_n": [[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]],
    }
    row = row_of(message)
    assert row == (
        7,
        10**18,
        5,
        0,
        1.0,
        0.1,
        0.2,
        0.3,
        1.0,
        2.0,
        3.0,
        -1,
        4,
        0.0,
        0.4,
        0.5,
        0.6,
        0.0,
        0.0,
        0.0,
    )
    gc.collect()  # a first look tells it that there are numbers only
    assert not gc.is_tracked(row)
