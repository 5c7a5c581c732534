"""Loads another model into a running server: checks it in a process of its own, then cross-fades. No tick waits for it."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from palpate.files import LONGEST_NAME_BYTES, is_plain_name
from palpate.model_file import ModelFileError, ReducedModel, SurfaceModel
from palpate.model_file.advice import force_advice
from palpate_server.coupling import cross_fade, models
from palpate_server.coupling.models import Model
from palpate_server.coupling.running import Tip
from palpate_server.coupling.settle import Touch
from palpate_server.errors import Refused
from palpate_server.realtime import shared_memory
from palpate_server.recording.snapshot import identity
from palpate_server.session.devices import warnings_for
from palpate_server.session.fields import shown
from palpate_server.session.model_process import load_model_elsewhere
from palpate_server.session.state import SessionState
from palpate_server.session.tips import tip_warnings, tips_for

log = logging.getLogger("palpate_server")

CROSS_FADE_S = 0.5  # from one model to another
_MOST_FILES = 100


class ModelLoader:
    """Exchanges the model of a session for one from a folder."""

    def __init__(self, state: SessionState, folder: Path) -> None:
        self._state = state
        self._folder = folder

    def load(self, client: str, file: object, stiffness_factor: float) -> dict[str, Any]:
        """Check a model file, cross-fade to its model with its moduli times a factor, and drop the old one. Raises Refused."""
        state = self._state
        if not state.exchanging.acquire(blocking=False):
            raise Refused("busy", "another model is being loaded, or a tool acquired")
        try:
            state.check_alone(client)
            model = self._read(file, stiffness_factor)
            tips = self._tips(model)
            memory = self._fade_to(model, list(tips.values()))
            with state.model_in_use:
                self._end_exchange(memory, model)
                state.tips = tips
            state.model_file = str(file)
            log.info("now serving %s (order %d)", model.name, model.order)
            for warning in accuracy_warnings(model):
                log.warning("%s", warning)
            return {
                "model": identity(model),
                "warnings": accuracy_warnings(model) + warnings_of(state, state.leases.held_by(client)),
            }
        finally:
            state.exchanging.release()

    def _fade_to(self, model: Model, tips: Sequence[Tip]) -> shared_memory.Memory:
        """Cross-fade to a model that starts settled at the present displacement. Returns the memory to continue with."""
        state = self._state
        step = model.period_s / CROSS_FADE_S
        memory = state.memory
        displacement = memory.displacement.copy()
        if isinstance(state.model, SurfaceModel) and (away := models.off_the_patches(model, displacement)):
            raise Refused("bad_model", f"tool {away[0]!r} is not on its patch: bring it to its start first")
        touch = Touch(memory.wanted.copy(), memory.reactions.copy())
        try:
            following = models.make_settled(model, tips, displacement, touch)
        except ValueError as error:  # such as a tool too large for its points
            raise Refused("bad_model", str(error)) from error
        coupling = cross_fade.to_another(state.memory.coupling, following, step)
        fading = shared_memory.with_coupling(state.memory, coupling)
        memory = shared_memory.with_coupling(state.memory, cross_fade.after(coupling))
        state.exchange(fading, state.model, model)
        while coupling.fade[0] < 1.0:
            if state.stopping.wait(model.period_s):
                raise Refused("stopping", "the server is stopping")
        return memory

    def _tips(self, model: Model) -> dict[str, Tip]:
        """The tips that the tools are to have on another model, as their holders asked for them. Raises Refused."""
        try:
            return tips_for(model, self._state.leases.settings)
        except Refused as error:
            raise Refused(
                "bad_model", f"{model.name!r} can't be touched as it was asked for: {error}"
            ) from error

    def _end_exchange(self, memory: shared_memory.Memory, model: Model) -> None:
        """Drop the old model. Ticks may be late, so this is tried until it succeeds or the server stops."""
        while True:
            try:
                self._state.exchange(memory, model, None)
                return
            except Refused as error:
                if error.reason != "busy":
                    raise

    def _read(self, name: object, stiffness_factor: float) -> Model:
        if not is_plain_name(name):
            raise Refused(
                "bad_model",
                f"file is {shown(name)}: expected a file's name, without a folder and of at most "
                f"{LONGEST_NAME_BYTES} bytes",
            )
        path = self._folder / name
        try:
            if path.is_symlink() and path.resolve().parent != self._folder.resolve():
                raise Refused("bad_model", f"{name}: leads out of the folder of models")
            model = load_model_elsewhere(path, self._state.stopping, stiffness_factor)
        except (OSError, RuntimeError, ModelFileError) as error:  # RuntimeError: links in a circle
            raise Refused("bad_model", str(error).replace(f"{self._folder}/", "")) from error
        if (names := tuple(tool.name for tool in models.tools_of(model))) != self._state.tools:
            raise Refused(
                "bad_model", f"{name}: its tools are {names}, the running model's are {self._state.tools}"
            )
        if model.period_s != self._state.model.period_s:
            raise Refused(
                "bad_model",
                f"{name}: its period is {model.period_s} s, the running model's {self._state.model.period_s} s",
            )
        return model


def model_files(folder: Path) -> list[str]:
    """The names that `load` may be asked for: of the files *.npz in a folder, sorted, the first _MOST_FILES."""
    names = sorted(path.name for path in folder.glob("*.npz") if is_plain_name(path.name))
    return names[:_MOST_FILES]


def accuracy_warnings(model: Model) -> list[str]:
    """Warnings that follow from a model's own accuracy report; empty for a good one."""
    return [f"model {model.name!r}: {text}" for text in force_advice(model)]


def warnings_of(state: SessionState, tools: Iterable[str]) -> list[str]:
    """Warnings about the model that runs, for the tips of these tools and the devices that they are rendered with."""
    warnings: list[str] = []
    for name in tools:
        settings = state.leases.settings[name]
        index = state.tool_index[name]
        warnings += tip_warnings(state.model, index, state.tips.get(name))
        if settings.device is not None and isinstance(state.model, ReducedModel):  # others are soft enough
            warnings += warnings_for(settings.device, state.model, index, settings.frame.scale)
    return list(dict.fromkeys(warnings))  # tools are often alike
