"""Recordings that clients start and end, one at a time. A recording belongs to no client: any that may record can end it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from palpate_client.wire import RECORDER
from palpate_server.errors import Refused
from palpate_server.realtime import scheduler
from palpate_server.recording.recorder import Recorder, file_in, room_in
from palpate_server.session.state import SessionState
from palpate_server.session.status import description

_END_TIMEOUT_S = 1.0


class Recordings:
    """Starts and ends recordings in a folder; refuses to if there is none."""

    def __init__(
        self, state: SessionState, publish_status: Callable[[], None], folder: Path | None, max_bytes: int
    ) -> None:
        self._state = state
        self._publish_status = publish_status
        self._folder = folder
        self._max_bytes = max_bytes  # that the folder may hold
        self._changing = threading.Lock()  # held while one begins or ends

    def record(self, client: str, file: object) -> dict[str, Any]:
        """Start a recording in a new file, or end the present one if `file` is None. Raises Refused.

        Only a client that holds a tool, or whose name is RECORDER, may record: others could fill the folder.
        """
        if self._folder is None:
            raise Refused("no_recordings", "the server was started without a folder for recordings")
        if client != RECORDER:
            self._state.leases.check_holder(client)
        if not self._changing.acquire(blocking=False):
            raise Refused("busy", "a recording is being started or ended")
        try:
            report = self._end() if file is None else self._begin(file_in(self._folder, file))
            return {"recording": report}
        finally:
            self._changing.release()

    def close(self) -> None:
        """End what is being recorded, when the server stops."""
        if self._changing.acquire(timeout=_END_TIMEOUT_S) and self._state.recorder is not None:
            self._state.recorder.stop()

    def _begin(self, path: Path) -> dict[str, Any]:
        state = self._state
        state.check_running()
        if state.recorder is not None and state.recorder.error is None:
            raise Refused("busy", f"{state.recorder.file} is being recorded")
        save = partial(state.between_ticks, scheduler.save)
        room = room_in(path.parent, self._max_bytes)
        recorder = Recorder(path, room, state.keys, description(state), state.memory, save)
        state.recorder = recorder
        save()
        return recorder.report()

    def _end(self) -> dict[str, Any]:
        recorder = self._state.recorder
        if recorder is None:
            raise Refused("not_recording", "there is no recording to end")
        self._publish_status()
        self._state.recorder = None
        recorder.stop()
        return recorder.report()
