"""One connection to a server on the page: what the pointer does, and what is drawn, until the server or its model changes."""

from __future__ import annotations

import html
import math
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from palpate_client import ClientError, Connection, Force, Geometry, Tool
from palpate_client.wire import RECORDER, Flags
from palpate_view import motion
from palpate_view.colors import Coloring, nice_ceiling
from palpate_view.frames import tool_state
from palpate_view.hand import LONGEST_SILENCE_S, Grip, Hand
from palpate_view.motion import Floats, Gesture
from palpate_view.panels import (
    DISPLACEMENT,
    ERROR,
    GRAB,
    STRAIN,
    Panels,
    legend_html,
    readout_html,
    session_html,
)
from palpate_view.scene import SCENE_PER_M, Scene, background, camera_position, light
from palpate_view.strain import SurfaceStrain
from palpate_view.surface import Hit, Triangles, ray_hit, touched_points
from palpate_view.watch import Watch

FRAME_PERIOD_S = 1 / 30
SLOWEST_FRAME_S = 0.5
CHART_PERIOD_S = 0.2
PULSE_S = 0.1  # pause between two questions to the page that drags
_PULSE_TIMEOUT_S = LONGEST_SILENCE_S
_SMALLEST_SCALE_M = 1e-3
_SMALLEST_STRAIN = 0.02
_SCALE_HALF_LIFE_S = 4.0  # of the colors' largest value, after the tissue has moved less
_IDENTITY = ("config_sha256", "stiffness_factor")
_ALIGNED = 0.02  # rad: below this angle the shaft counts as aligned
_OPPOSITE = 3.9  # squared distance of two unit vectors; between opposite ones there is no way to turn
_PATCH_SPHERE = 0.4  # of the patch's radius: of the sphere that is drawn for its tool


class Session:
    """Shows the model that a connection's server runs; `run` returns when another model runs there.

    connect(name) makes a connection of another client name to the same server. tell(text, page) tells the user of a page
    something, or with None all users.
    """

    def __init__(
        self,
        page: viser.ViserServer,
        panels: Panels,
        connection: Connection,
        connect: Callable[[str], Connection],
        tell: Callable[[str, int | None], None],
    ) -> None:
        description = connection.description
        self._page, self._panels, self._connection = page, panels, connection
        self._connect, self._tell = connect, tell
        self._tools = {tool.name: tool for tool in description.tools}
        self._model = description.message["model"]
        self._anywhere = self._model.get("kind") == "surface"
        self._watch = Watch(connection, description.tools[0].name)
        self._axis = np.asarray(description.tools[0].normal, float)  # of the tool's shaft
        self._largest: dict[
            str, float
        ] = {}  # value that was drawn last, fading, by the name of what is shown
        self._coloring: Coloring | None = None
        # Round trip of the page that drags, s. Frames are sent no faster, so they do not queue up.
        self._answer_s = 0.0
        page.scene.reset()
        light(page.scene, self._normal())
        page.scene.set_background_image(background(), "png")
        geometry = connection.geometry()
        self._scene = Scene(page.scene, *surface_at_rest(geometry))
        self._strain = SurfaceStrain(self._scene.vertices, self._scene.triangles)
        error = geometry.error_in_band
        self._error = None if error is None else np.frombuffer(error, np.float32)
        self._described = {tool["name"]: tool for tool in description.message["tools"]}
        panels.fill(
            list(self._described.values()), anywhere=self._anywhere, has_error=self._error is not None
        )
        panels.fill_models(
            description.message["model_files"],
            description.message["model_file"],
            self._model["stiffness_factor"] if self._anywhere else None,
        )
        self._load_lock = threading.Lock()  # held during a load: `run` must not close the connection
        self._hand = Hand(connection, tell)  # its thread is ended by `run`
        self._scene.on_drag(self._on_organ, self._on_tool)
        for client in page.get_clients().values():
            self.frame_organ(client)

    def run(self, stop: threading.Event) -> None:
        """Draw until another model runs or `stop` is set. Raises ServerGone."""
        charts_s = 0.0
        try:
            while not stop.wait(max(FRAME_PERIOD_S, min(self._answer_s, SLOWEST_FRAME_S))):
                self._connection.check()
                status = self._connection.status
                if status and any(status["model"][key] != self._model[key] for key in _IDENTITY):
                    return
                if not self._page.get_clients():
                    self._watch.end()
                    continue
                self._watch.begin()
                with self._page.atomic():
                    force = self._draw()
                    if force is not None and time.monotonic() - charts_s > CHART_PERIOD_S:
                        charts_s = time.monotonic()
                        self._draw_panels(force)
        finally:
            self._hand.end()
            self._watch.end()
            with self._load_lock:
                pass

    # Pages

    def frame_organ(self, client: viser.ClientHandle) -> None:
        """Put the camera of a page where the organ fills its picture."""
        scene, camera = self._scene, client.camera
        position = camera_position(scene.center_m, scene.size_m, self._normal(), camera.aspect, camera.fov)
        camera.up_direction = (0.0, 0.0, 1.0)
        camera.position = SCENE_PER_M * position
        camera.look_at = SCENE_PER_M * (scene.center_m + 0.06 * scene.size_m * self._normal())

    def page_closed(self, page: int) -> None:
        self._hand.let_go(page)

    # What is drawn

    def _draw(self) -> Force | None:
        """One picture, of the force that is returned; None before the first messages have come."""
        force, tool, surface = self._watch.force, self._watch.tool_status, self._watch.surface
        if force is None or tool is None or surface is None or len(surface) != len(self._scene.vertices):
            return None
        state = tool_state(force, tool)
        self._coloring = self._color(surface)
        self._scene.draw_organ(surface, self._coloring)
        self._turn_axis()
        radius_m = self._radius_m(tool)
        if self._anywhere:
            center, points = state.tip_m, np.zeros((0, 3))
            if force.flags & Flags.IN_CONTACT:
                points = touched_points(self._scene.shown_m, state.tip_m, radius_m)
        else:
            center = state.tip_m + radius_m * self._axis
            points = np.zeros((0, 3)) if tool["holder"] is None else self._patch_points()
        ghost = self._hand.position_m
        if ghost is None:
            ghost = state.device_m
        self._scene.draw_tool(center, ghost + (center - state.tip_m), radius_m, self._axis)
        self._scene.draw_contact(points, center, state.force_n)
        return force

    def _draw_panels(self, force: Force) -> None:
        columns = self._watch.history.columns()
        status = self._connection.status
        assert status is not None  # the tool's part of it was drawn
        self._panels.draw_charts(columns)
        words, good = self._words(force.flags)
        newtons = math.hypot(*force.force_n)
        self._panels.readout.content = readout_html(newtons, force.touch.penetration_m, words, good)
        self._panels.legend.content = self._legend()
        self._panels.session.content = session_html(self._facts(status))
        self._panels.show_recording(status["recording"] is not None)

    def _color(self, surface: NDArray[np.float32]) -> Coloring | None:
        """What the colors show of a displacement (n, 3), m."""
        shown = self._panels.color.value
        if shown == ERROR and self._error is not None:
            # Supports, where the error is largest by far, would leave no colors for the rest.
            nearly_largest = max(float(np.quantile(self._error, 0.95)), 1e-4)
            return Coloring(shown, self._error, nice_ceiling(nearly_largest))
        if shown == DISPLACEMENT:
            values = np.linalg.norm(surface, axis=1)
            largest = max(float(values.max()), _SMALLEST_SCALE_M)
        elif shown == STRAIN:
            # It is largest by far below the tool, where it is not seen.
            values = self._strain.largest(self._scene.vertices + surface)
            largest = max(float(np.quantile(values, 0.99)), _SMALLEST_STRAIN)
        else:
            return None
        fading = 0.5 ** (FRAME_PERIOD_S / _SCALE_HALF_LIFE_S)
        self._largest[shown] = largest = max(largest, self._largest.get(shown, 0.0) * fading)
        return Coloring(shown, values, nice_ceiling(largest))

    def _legend(self) -> str:
        if self._coloring is None:
            return ""
        if self._coloring.name == DISPLACEMENT:
            return legend_html(f"{1e3 * self._coloring.largest:g} mm")
        return legend_html(f"{100 * self._coloring.largest:g} % and more")

    def _words(self, flags: int) -> tuple[str, bool]:
        """What the tool does, in a few words, and whether all is well."""
        holder = (self._watch.tool_status or {}).get("holder")
        if holder is None:
            return "Drag on the organ, or drag the tool", True
        for flag, words in _LIMITED.items():
            if flags & flag:
                return words, False
        if flags & (Flags.DECAYING | Flags.STALE):
            return "no commands: the force has faded", False
        doing = touch_words(flags) if self._anywhere else "moves its patch"
        mine = holder == self._connection.name
        return doing if mine else f"{html.escape(holder)} holds the tool: it {doing}", True

    def _facts(self, status: dict[str, Any]) -> list[tuple[str, str]]:
        def times(name: str) -> str:
            values = status[name]
            if not values or values["p50"] is None:
                return "-"
            return f"{1e3 * values['p50']:.2f}, {1e3 * values['p99']:.2f} ms"

        return [
            ("model", html.escape(str(self._model["name"]))),
            ("kind, order", f"{self._model.get('kind', 'patch')}, {self._model['order']}"),
            *([("stiffness factor", f"{self._model['stiffness_factor']:g}")] if self._anywhere else ()),
            ("tick lateness, p50, p99", times("tick_lateness_s")),
            ("compute time, p50, p99", times("compute_time_s")),
            ("faults, skipped ticks", f"{status['faults']}, {status['skipped_ticks']}"),
        ]

    def _patch_points(self) -> Floats:
        """(k, 3), m: the points of a patch model's tool where they are now."""
        tool = self._tools[self._watch.tool]
        near = np.linalg.norm(self._scene.vertices - np.asarray(tool.start_m), axis=1) <= tool.radius_m
        return self._scene.shown_m[near]

    def _turn_axis(self) -> None:
        """Turn the shaft a little towards the normal of the tissue that is touched; back when nothing is held."""
        wanted = self._normal() if self._hand.normal is None else self._hand.normal
        away = wanted - self._axis
        if float(np.linalg.norm(away)) < _ALIGNED or away @ away > _OPPOSITE:
            self._axis = wanted
            return
        axis = self._axis + 0.15 * away
        self._axis = axis / max(float(np.linalg.norm(axis)), 1e-9)

    def _normal(self) -> Floats:
        return np.asarray(self._tools[self._watch.tool].normal, float)

    def _radius_m(self, tool: dict[str, Any] | None) -> float:
        """Of the sphere that is drawn."""
        agreed = None if tool is None else tool["radius_m"]
        return float(agreed) if agreed is not None else _PATCH_SPHERE * self._tools[self._watch.tool].radius_m

    # What the pointer does. The callbacks are async so that viser calls them in order.

    async def _on_organ(self, event: Any) -> None:
        page = event.client_id
        if event.phase == "end":
            self._hand.let_go(page)
        elif event.phase == "start":
            gesture = self._begin_on_organ(event)
            if gesture is not None:
                self._take(event.client, gesture)
        elif self._anywhere:
            grip = self._hand.grip
            if grip is None or grip.radius_m is None:
                return
            pointer, hit = _pointer_m(event), self._hit(event)
            radius_m, depth_m = grip.radius_m, self._depth_m()
            self._hand.aim(
                page,
                lambda g: motion.slid(g, hit, radius_m, depth_m) if g.presses else motion.moved(g, pointer),
            )
        else:
            self._move(event)

    async def _on_tool(self, event: Any) -> None:
        if event.phase == "end":
            self._hand.let_go(event.client_id)
        elif event.phase == "start":
            self._take(
                event.client, motion.drag_tool(_pointer_m(event), self._normal(), glued=not self._anywhere)
            )
        else:
            self._move(event)

    def _begin_on_organ(self, event: Any) -> Gesture | None:
        pointer, grabs = _pointer_m(event), self._panels.pointer.value == GRAB
        if not self._anywhere:
            depth_m = 0.0 if grabs else self._depth_m()
            return motion.press_patch(self._home_m(), pointer, self._normal(), depth_m)
        hit = self._hit(event)
        if hit is None:
            return None
        radius_m = self._panels.radius_m()
        if grabs:
            return motion.grab_surface(hit, pointer, radius_m)
        return motion.press_surface(hit, pointer, radius_m, self._depth_m())

    def _move(self, event: Any) -> None:
        pointer = _pointer_m(event)
        self._hand.aim(event.client_id, lambda gesture: motion.moved(gesture, pointer))

    def _take(self, client: viser.ClientHandle, gesture: Gesture) -> None:
        tip = (
            {"radius_m": self._panels.radius_m(), "friction": self._panels.friction.value}
            if self._anywhere
            else {}
        )
        page = client.client_id
        grip = Grip(page, self._watch.tool, **tip)
        if self._load_lock.locked():
            self._tell("A model is being loaded.", page)
            return
        if not self._hand.take(grip, gesture):
            self._tell("No server runs now." if self._hand.ended else "Another page holds the tool.", page)
            return
        threading.Thread(target=self._poll_page, args=(client, grip), name="pulse", daemon=True).start()

    def _poll_page(self, client: viser.ClientHandle, grip: Grip) -> None:
        """Ask the page that drags for a sign of life, again and again: a page that hangs or sleeps does not answer."""
        while self._hand.grip is grip:
            asked_s = time.monotonic()
            try:
                client.local_storage.get_item("palpate", timeout=_PULSE_TIMEOUT_S)
            except TimeoutError:
                self._answer_s = _PULSE_TIMEOUT_S
                continue
            except RuntimeError:  # the page is gone, or its browser blocks storage, which is an answer too
                pass
            self._answer_s = time.monotonic() - asked_s
            self._hand.sign(grip.page)
            time.sleep(PULSE_S)
        self._answer_s = 0.0

    def _hit(self, event: Any) -> Hit | None:
        """Where the pointer is on the undeformed surface."""
        eye = np.asarray(event.client.camera.position, float) / SCENE_PER_M
        scene = self._scene
        return ray_hit(eye, _pointer_m(event) - eye, scene.vertices, scene.normals, scene.triangles)

    def _home_m(self) -> Floats:
        return np.asarray(self._tools[self._watch.tool].start_m, float)

    def _depth_m(self) -> float:
        return 1e-3 * float(self._panels.depth.value)

    # What the buttons do, on threads of viser's

    def choose_tool(self, name: str) -> None:
        if name in self._tools and name != self._watch.tool:
            self._watch.watch_tool(name)
            if self._anywhere:
                self._panels.show_tip(self._described[name])

    def load(self, page: int | None, file: str, stiffness_factor: float) -> None:
        """Have the server run a model of its folder, that many times as stiff, for a page; `run` sees it."""
        if self._hand.grip is not None:
            self._tell("A page holds the tool: let it go first.", page)
            return
        if not self._load_lock.acquire(blocking=False):
            self._tell("A model is being loaded.", page)
            return
        try:
            with Tool(self._connection, self._watch.tool):
                answer = self._connection.control("load", file=file, stiffness_factor=stiffness_factor)
        except (ClientError, RuntimeError) as error:
            self._tell(str(error), page)
            return
        finally:
            self._load_lock.release()
        factor = answer["model"]["stiffness_factor"]
        stiff = "" if factor == 1 else f", {factor:g} times as stiff"
        self._tell(f"The server runs {answer['model']['name']}{stiff}.", None)
        for warning in answer["warnings"]:
            self._tell(warning, page)

    def record(self, page: int | None) -> None:
        """Begin a recording for a page, or end the one that runs, as `palpate record` does and under its name."""
        status = self._connection.status
        running = status is not None and status["recording"] is not None
        file = None if running else time.strftime("view-%Y%m%d-%H%M%S.mcap")
        try:
            with self._connect(RECORDER) as recorder:
                report = recorder.control("record", file=file)["recording"]
            text = f"{report['messages']} messages in {report['file']}" if running else f"Recording to {file}"
            self._tell(text, None)
        except ClientError as error:
            self._tell(str(error), page)


_LIMITED = {
    Flags.FAULT: "the model failed and was put to rest",
    Flags.FORCE_CLAMPED: "the force is at its limit",
    Flags.WORKSPACE_CLAMPED: "at the edge of the workspace",
    Flags.JUMPED: "on its way",
    Flags.SPEED_LIMITED: "at the largest speed",
}


def touch_words(flags: int) -> str:
    """How a tool of a surface model touches."""
    if not flags & Flags.IN_CONTACT:
        return "does not touch"
    if flags & Flags.ATTACHED:
        return "holds the tissue"
    return "slides" if flags & Flags.SLIDING else "touches"


def surface_at_rest(geometry: Geometry) -> tuple[Floats, Triangles]:
    """Vertices (n, 3), m, and triangles (m, 3) of a geometry."""
    vertices = np.frombuffer(geometry.vertices_m, np.float32).reshape(-1, 3).astype(float)
    return vertices, np.frombuffer(geometry.triangles, np.int32).reshape(-1, 3)


def _pointer_m(event: Any) -> Floats:
    """(3,), m: where a drag's pointer is, in the plane through what it took, parallel to the screen."""
    return np.asarray(event.end_position, float) / SCENE_PER_M
