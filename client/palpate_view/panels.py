"""The controls and charts beside the picture. They last for as long as the page; a model fills them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from palpate_view import colors
from palpate_view.history import SHOWN_S

PRESS, GRAB = "Press and slide", "Hold and pull"
DISPLACEMENT, STRAIN, NO_COLOR = "Displacement", "Strain of the surface", "None"
ERROR = "Error of the model in its band"
RECORD, STOP = "Record", "Stop recording"

_AXIS = "#8a919c"
_GRID = "rgba(138, 145, 156, 0.18)"
# uPlot's words for: the axis fits the data with a margin, but shows 0 and 0.2 always.
_FROM_ZERO = {"min": {"pad": 0.1, "soft": 0, "mode": 1}, "max": {"pad": 0.1, "soft": 0.2, "mode": 1}}


@dataclass(frozen=True)
class Line:
    """A line of a chart: a column of `History.columns`, its label, its color, and what to multiply it with."""

    column: str
    label: str
    color: str
    factor: float = 1.0


_CHARTS = (
    ("Force, N", 125, [Line("force_n", "", "#46c8ff")]),
    ("Depth, mm", 125, [Line("depth_m", "", "#ffb454", 1e3)]),
    (
        "Energy, mJ",
        165,
        [
            Line("work_j", "work of the tool", "#e8ecf1", 1e3),
            Line("tissue_j", "in the tissue", "#ff7a70", 1e3),
            Line("lost_j", "lost", "#8fa1b3", 1e3),
            Line("spring_j", "in the spring", "#7ee081", 1e3),
            Line("withheld_j", "withheld, not in the sum", "#c792ea", 1e3),
        ],
    ),
    (
        "Timing, ms",
        125,
        [
            Line("input_age_s", "input age", "#46c8ff", 1e3),
            Line("lateness_s", "tick lateness", "#ffb454", 1e3),
        ],
    ),
)


class Chart:
    """Lines over the last seconds, and what they are."""

    def __init__(self, gui: viser.GuiApi, title: str, lines: Sequence[Line], height: int) -> None:
        self._lines = lines
        gui.add_html(chart_title_html(title, lines))
        nothing = (np.array([-SHOWN_S, 0.0]), *(np.zeros(2) for _ in lines))
        axis = uplot.Axis(
            stroke=_AXIS, grid=uplot.Axis_Grid(stroke=_GRID, width=1), ticks=uplot.Axis_Ticks(show=False)
        )
        self._chart = gui.add_uplot(
            nothing,
            (
                uplot.Series(label="s"),
                *(uplot.Series(label=line.label, stroke=line.color, width=1.6) for line in lines),
            ),
            scales={"x": uplot.Scale(time=False, range=(-SHOWN_S, 0.0)), "y": uplot.Scale(range=_FROM_ZERO)},
            axes=(uplot.Axis(**axis, size=24), uplot.Axis(**axis, size=46)),
            legend=uplot.Legend(show=False),
            height=height,
            padding=(10, 14, 0, 0),
        )

    def draw(self, columns: dict[str, NDArray[np.float64]]) -> None:
        if len(columns["time_s"]) > 1:
            self._chart.data = (
                columns["time_s"],
                *(columns[line.column] * line.factor for line in self._lines),
            )


class Panels:
    """The panel of controls, docked at the right, and that of charts, docked at the left; sheets on a phone."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self.readout = gui.add_html("")
        with gui.add_folder("Touch"):
            self.pointer = gui.add_dropdown(
                "Pointer",
                (PRESS, GRAB),
                hint="What dragging on the organ does. The tool itself can be dragged too.",
            )
            self.depth = gui.add_slider("Press, mm", 0.0, 15.0, 0.5, 5.0)
            self.tool = gui.add_dropdown("Tool", ("-",), visible=False)
            self.radius = gui.add_slider("Radius, mm", 0.5, 10.0, 0.1, 5.0, visible=False)
            self.friction = gui.add_slider("Friction", 0.0, 2.0, 0.05, 0.3, visible=False)
        with gui.add_folder("Colors"):
            self.color = gui.add_dropdown("Show", (DISPLACEMENT, STRAIN, NO_COLOR))
            self.legend = gui.add_html("")
        with gui.add_folder("Session"):
            self.model = gui.add_dropdown("Model", ("-",), hint="Of the server's folder of models")
            self.stiffness = gui.add_slider(
                "Stiffness", 0.1, 10.0, 0.1, 1.0, visible=False, hint="All moduli, times the file's"
            )
            self.model.on_update(self._model_chosen)
            self.load = gui.add_button("Load")
            self.record = gui.add_button(RECORD, icon=viser.Icon.PLAYER_RECORD)
            self.session = gui.add_html("")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(310)
        charts = gui.add_panel()
        with charts.add_tab("Charts", viser.Icon.CHART_LINE):
            self._charts = [Chart(gui, title, lines, height) for title, height, lines in _CHARTS]
        charts.dock_left()
        charts.set_width(310)

    def draw_charts(self, columns: dict[str, NDArray[np.float64]]) -> None:
        for chart in self._charts:
            chart.draw(columns)

    def fill_models(self, files: Sequence[str], running: str | None, stiffness_factor: float | None) -> None:
        """Show the files that can be loaded, the one that runs, and its stiffness factor, None for patches."""
        self.model.options = tuple(files) or ("-",)
        _set(self.model, running if running in files else self.model.options[0])
        self.stiffness.visible = stiffness_factor is not None
        _set(self.stiffness, 1.0 if stiffness_factor is None else stiffness_factor)

    def _model_chosen(self, event: Any) -> None:
        """Another file is loaded with its own stiffness, unless the user says otherwise then."""
        if event.client is not None:
            _set(self.stiffness, 1.0)

    def fill(self, tools: Sequence[Mapping[str, Any]], *, anywhere: bool, has_error: bool) -> None:
        """Show what a model's tools can be asked for: `name`, `radius_m` and `friction` of each, as the server describes it."""
        self.color.options = (DISPLACEMENT, STRAIN, *((ERROR,) if has_error else ()), NO_COLOR)
        self.tool.options = tuple(tool["name"] for tool in tools)
        _set(self.tool, tools[0]["name"])
        self.tool.visible = len(tools) > 1
        self.radius.visible = self.friction.visible = anywhere
        if anywhere:
            largest_mm = 1e3 * max(tool["radius_m"] for tool in tools)
            self.radius.min, self.radius.step, self.radius.max = largest_mm / 5, largest_mm / 50, largest_mm
            self.show_tip(tools[0])

    def show_tip(self, tool: Mapping[str, Any]) -> None:
        """Set radius and friction to those of a tool in the model file."""
        _set(self.radius, 1e3 * tool["radius_m"])
        _set(self.friction, tool["friction"])

    def show_no_server(self) -> None:
        self.readout.content = readout_html(0.0, 0.0, "No server: waiting for the next one", False)

    def radius_m(self) -> float:
        return 1e-3 * float(self.radius.value)

    def show_recording(self, runs: bool) -> None:
        self.record.label = STOP if runs else RECORD
        self.record.color = "red" if runs else None


def _set(handle: Any, value: object) -> None:
    """Set the value of a control; mypy does not see that viser's property can be set."""
    handle.value = value


def readout_html(force_n: float, depth_m: float, words: str, good: bool) -> str:
    """The numbers that a person looks at while touching, and one line of words."""

    def number(value: str, unit: str, name: str) -> str:
        return (
            f'<div style="flex:1"><div style="font-size:1.9em;font-weight:600;line-height:1.1;font-variant-numeric:tabular-nums">'
            f'{value}<span style="font-size:0.5em;font-weight:400;opacity:0.7"> {unit}</span></div>'
            f'<div style="font-size:0.8em;opacity:0.65">{name}</div></div>'
        )

    dot = "#7ee081" if good else "#ffb454"
    return (
        f'<div style="padding:0.6em 0.9em 0.2em 0.9em"><div style="display:flex;gap:0.8em">'
        f"{number(f'{force_n:.2f}', 'N', 'force')}{number(f'{1e3 * depth_m:.1f}', 'mm', 'depth')}</div>"
        f'<div style="margin-top:0.5em;font-size:0.85em"><span style="color:{dot}">&#9679;</span> {words}</div></div>'
    )


def chart_title_html(title: str, lines: Sequence[Line]) -> str:
    """A chart's title, and each line's color and name."""
    names = "".join(
        f'<span style="white-space:nowrap"><span style="color:{line.color}">&#9644;</span> {line.label}</span>'
        for line in lines
        if line.label
    )
    return (
        '<div style="display:flex;flex-wrap:wrap;gap:0.1em 0.8em;padding:0.5em 1em 0 1em;font-size:0.8em;line-height:1.4">'
        f'<span style="font-weight:600">{title}</span>{names}</div>'
    )


def legend_html(largest: str) -> str:
    """The bar of colors from 0 to the largest value."""
    stops = ", ".join(f"rgb{colors.color_at(i / 10)}" for i in range(11))
    return (
        f'<div style="padding:0.2em 0.9em 0.5em 0.9em;font-size:0.8em"><div style="height:0.7em;border-radius:0.35em;'
        f'background:linear-gradient(90deg,{stops})"></div><div style="display:flex;justify-content:space-between;'
        f'opacity:0.75;margin-top:0.2em"><span>0</span><span>{largest}</span></div></div>'
    )


def session_html(lines: Sequence[tuple[str, str]]) -> str:
    """Names and values, one a line."""
    rows = "".join(
        f'<div style="display:flex;justify-content:space-between;gap:1em"><span style="opacity:0.65">{name}</span>'
        f'<span style="text-align:right;font-variant-numeric:tabular-nums">{value}</span></div>'
        for name, value in lines
    )
    return f'<div style="padding:0.2em 0.9em 0.6em 0.9em;font-size:0.8em;line-height:1.5">{rows}</div>'
