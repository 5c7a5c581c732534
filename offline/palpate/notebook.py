"""Models in a notebook: how they look as a cell's result, and pictures of their stages. Needs the extra `plots`.

`%load_ext palpate.notebook` shows every model by its accuracy report and every figure as a picture. The functions take the
dataclasses of the stages and return matplotlib figures.
"""

from __future__ import annotations

import html
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from palpate.build import FullModel
from palpate.geometry.cloud import NodeCloud
from palpate.lti.errors import ReductionError
from palpate.lti.frequencies import band_frequencies, relative_errors, spectral_norms
from palpate.lti.stepping import step_through
from palpate.model_file import ReducedModel, StateSpace, SurfaceModel
from palpate.reduction.methods import reductions
from palpate.report import accuracy_text
from palpate.scene.quantities import SystemMethod
from palpate.scene.schema import Config
from palpate.scene_cloud import shown_surface
from palpate_server.simulation import Simulation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Press:
    """A contact of a patch model, or a tool of a surface model, that was pressed in along the inward normal.

    time_s   (n,), s
    depth_m  (n,), m, of the tip
    force_n  (n,), N, along the outward normal: what pushes the tip out
    """

    time_s: Array
    depth_m: Array
    force_n: Array


def press(
    model: ReducedModel | SurfaceModel,
    depth_m: float,
    *,
    ramp_s: float = 0.1,
    hold_s: float = 0.9,
    contact: int = 0,
) -> Press:
    """Press a contact or tool in by `depth_m` in `ramp_s`, hold it for `hold_s`; the others stay. Steps as the server does.

    A tool begins where it touches the surface point nearest to its home; it is held by the spring of `Simulation`.

    Raises ValueError for a contact or tool that the model does not have, or times that hold no step.
    """
    count = len(model.tools if isinstance(model, SurfaceModel) else model.contacts)
    if not 0 <= contact < count:
        raise ValueError(f"contact = {contact}: expected 0 to {count - 1}")
    if ramp_s < model.period_s or hold_s < 0:
        raise ValueError(
            f"ramp_s = {ramp_s:g}, hold_s = {hold_s:g}: expected a ramp of at least a period, {model.period_s:g} s, and no "
            "negative hold"
        )
    time: Array = model.period_s * np.arange(1 + round((ramp_s + hold_s) / model.period_s), dtype=np.float64)
    depth = depth_m * np.minimum(time / ramp_s, 1.0)
    if isinstance(model, SurfaceModel):
        return Press(time, depth, _on_tool(model, contact, depth))
    return Press(time, depth, _on_contact(model, contact, depth))


def _on_contact(model: ReducedModel, contact: int, depth_m: Array) -> Array:
    """(n,), N: the force along the outward normal at each depth (n,), m, one a period."""
    normal = np.asarray(model.contacts[contact].normal)
    own = slice(3 * contact, 3 * contact + 3)
    moved = np.zeros((len(depth_m), model.n_inputs))
    moved[:, own] = -depth_m[:, None] * normal
    holding, _ = step_through(model.discrete, moved)
    return np.asarray(-holding[:, own] @ normal)


def _on_tool(model: SurfaceModel, index: int, depth_m: Array) -> Array:
    """The same for the tool of this index."""
    tool = model.tools[index]
    nearest = int(np.argmin(np.linalg.norm(model.points - tool.home_m, axis=1)))
    point, normal = model.points[nearest], model.normals[nearest]
    simulation = Simulation(model)
    centers = point + (tool.radius_m - depth_m)[:, None] * normal
    return np.array([simulation.step({tool.name: center})[tool.name].force_n @ normal for center in centers])


def plot_press(pressed: Press) -> Figure:
    """Force over time, and over depth."""
    figure = _figure(9.0, 3.2)
    over_time, over_depth = figure.subplots(1, 2)
    over_time.plot(pressed.time_s, pressed.force_n, color="tab:red")
    over_time.set(xlabel="time, s", ylabel="force on the tip, N")
    over_depth.plot(1e3 * pressed.depth_m, pressed.force_n, color="tab:red")
    over_depth.set(xlabel="depth, mm")
    return _tidy(figure)


def plot_cloud(cloud: NodeCloud) -> Figure:
    """The nodes, cut open at the middle of the longest axis but one; colored by the spacing."""
    figure = _figure(7.0, 5.5)
    axis = figure.add_subplot(projection="3d")
    cut = int(np.argsort(np.ptp(cloud.points, axis=0))[1])
    kept = cloud.points[:, cut] >= np.median(cloud.points[:, cut])
    drawn = axis.scatter(*(1e3 * cloud.points[kept]).T, c=1e3 * cloud.spacing[kept], s=9, cmap="viridis")
    _equal_axes(axis, cloud.points)
    axis.view_init(elev=20, azim=(-140, -50, -50)[cut])
    axis.set_title(
        f"{cloud.n_nodes:,} nodes, {int(cloud.boundary.sum()):,} on the surface (half of them drawn)"
    )
    figure.colorbar(drawn, ax=axis, shrink=0.6, label="spacing, mm")
    return figure


def plot_modes(full: FullModel, config: Config, count: int = 4) -> Figure:
    """The modes of lowest frequency, seen along the first patch's normal; the largest displacement is drawn as a tenth of the body.

    config  the scene that `full` was built from

    Raises ValueError where the modes are complex (of `collocation`) or fewer than `count`.
    """
    modes = full.modes
    if np.iscomplexobj(modes.squared_frequencies):
        raise ValueError("the modes of 'collocation' are complex: expected a body by 'conservative'")
    if not 1 <= count <= modes.n_modes:
        raise ValueError(f"count = {count}: expected 1 to {modes.n_modes}")
    shown = shown_surface(config, full.cloud)
    shapes = np.real(full.body.basis.values_at(shown.vertices, modes.parameters[:, :count]))
    size = float(np.max(np.ptp(shown.vertices, axis=0)))
    figure = _figure(3.2 * count, 3.0)
    for number in range(count):
        shape = shapes[:, number].reshape(-1, 3)
        moved = np.linalg.norm(shape, axis=1)
        axis = figure.add_subplot(1, count, number + 1, projection="3d")
        drawn = shown.vertices + 0.1 * size / float(moved.max()) * shape
        _draw_surface(axis, drawn, shown.triangles, moved / float(moved.max()), "magma")
        _look_along(axis, np.asarray(full.patches[0].normal))
        axis.set_axis_off()
        axis.set_title(f"{np.sqrt(modes.squared_frequencies[number]) / (2 * np.pi):.3g} Hz", y=0.95)
    return figure


def plot_error_map(model: SurfaceModel) -> Figure:
    """The error of the force in the band over the surface, in percent: at each point that of the nearest one where it was measured.

    It is more where the points are too far apart for the smallest tool, and 0 at held points.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    figure = _figure(7.0, 5.0)
    axis = figure.add_subplot(projection="3d")
    error = 100 * model.accuracy.error_map.astype(np.float64)
    largest = float(np.max(error))
    _draw_surface(axis, model.points, model.triangles, error / max(largest, 1e-300), "viridis")
    _look_along(axis, model.normals[~model.held].mean(axis=0))
    figure.colorbar(
        ScalarMappable(Normalize(0.0, largest), "viridis"),
        ax=axis,
        shrink=0.6,
        label="largest force error in the band, %",
    )
    axis.set_title(f"{model.name}: {model.n_modes:,} modes")
    return figure


def plot_response(model: ReducedModel) -> Figure:
    """Bode magnitude: the largest singular value of the force response, full and as it runs, up to half the sampling rate.

    Raises ValueError for a surface model.
    """
    if isinstance(model, SurfaceModel):
        raise ValueError(f"{model.name!r} is a surface model: plot_response expects a model with [[contact]]")
    highest = 0.5 / model.period_s
    frequencies = np.geomspace(1e-3 * model.accuracy.band_hz[1], 0.999 * highest, 500)
    omega = 2 * np.pi * frequencies
    full = spectral_norms(model.full.transfer(1j * omega))
    running = spectral_norms(_transfer(model.discrete, np.exp(1j * omega * model.period_s)))
    figure = _figure(7.5, 3.8)
    axis = figure.subplots()
    axis.loglog(frequencies, full, color="0.6", linewidth=3, label=f"full, {model.n_states_full:,} states")
    axis.loglog(frequencies, running, color="tab:red", label=f"as it runs, {model.order} states")
    axis.axvspan(
        max(model.accuracy.band_hz[0], frequencies[0]),
        model.accuracy.band_hz[1],
        color="tab:green",
        alpha=0.08,
    )
    axis.set(
        xlabel="frequency, Hz (green: the haptic band)",
        ylabel="force over displacement, N/m",
        xlim=frequencies[[0, -1]],
    )
    axis.legend(frameon=False)
    return _tidy(figure)


def error_against_order(
    full: FullModel, methods: Sequence[SystemMethod], orders: Sequence[int], band_hz: tuple[float, float]
) -> dict[str, Array]:
    """By method, (len(orders),): the largest force error in the band before sampling, a fraction.

    Not a number where the method has no stable model of this order or below. Raises ReductionError or ValueError as
    `palpate.reduction.methods.reductions`.
    """
    omega = band_frequencies((full.system,), band_hz)
    exact = full.system.transfer(1j * omega)
    errors: dict[str, Array] = {}
    for method in methods:
        family = reductions(full.system, method, band_hz)
        errors[method] = np.full(len(orders), np.nan)
        for i, order in enumerate(orders):
            available = family.orders[family.orders <= order]
            if not len(available):
                continue
            try:
                reduced = family.at(int(available[-1]))
            except ReductionError:  # poles that nearly coincide: other orders have a diagonal form
                continue
            if reduced.spectral_abscissa < 0:
                errors[method][i] = np.max(relative_errors(exact, reduced.transfer(1j * omega)))
    return errors


def plot_error_against_order(orders: Sequence[int], errors: dict[str, Array]) -> Figure:
    """What `error_against_order` returns, over the orders."""
    figure = _figure(6.0, 3.8)
    axis = figure.subplots()
    for method, values in errors.items():
        axis.semilogy(orders, 100 * values, marker="o", markersize=4, label=method)
    axis.set(xlabel="order, states", ylabel="largest force error in the band, %")
    axis.legend(frameon=False)
    return _tidy(figure)


def as_html(model: ReducedModel | SurfaceModel) -> str:
    """The model's accuracy report, with its verdict and advice, as a notebook shows it."""
    return f"<pre>{html.escape(accuracy_text(model).strip())}</pre>"


def load_ipython_extension(ipython: Any) -> None:
    """What `%load_ext palpate.notebook` calls."""
    from matplotlib.figure import Figure

    formatters = ipython.display_formatter.formatters
    for kind in (ReducedModel, SurfaceModel):
        formatters["text/html"].for_type(kind, as_html)
    formatters["image/png"].for_type(Figure, _png)


def _png(figure: Figure) -> bytes:
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    return picture.getvalue()


def _transfer(system: StateSpace, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """(n, n_outputs, n_inputs): C (z - A)^-1 B + D at the points z (n,), pair of states by pair of states."""
    a, b = system.diagonal[0::2], system.cross[0::2]
    c, d = system.cross[1::2], system.diagonal[1::2]
    rows = (system.b[0::2], system.b[1::2])
    columns = (system.c[:, 0::2], system.c[:, 1::2])
    determinant = (z[:, None] - a) * (z[:, None] - d) - b * c
    inverse = ((z[:, None] - d, b), (c, z[:, None] - a))
    found = np.tile(system.d.astype(np.complex128), (len(z), 1, 1))
    for i in range(2):
        for j in range(2):
            found += np.einsum(
                "pk,nk,km->npm", columns[i], inverse[i][j] / determinant, rows[j], optimize=True
            )
    return found


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _tidy(figure: Figure) -> Figure:
    for axis in figure.axes:
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    return figure


def _draw_surface(
    axis: Any, vertices: Array, triangles: NDArray[np.int32], values: Array, colors: str
) -> None:
    """Triangles colored by values (n_vertices,) from 0 to 1."""
    from matplotlib import colormaps
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    faces = colormaps[colors](values[triangles].mean(axis=1))
    axis.add_collection3d(
        Poly3DCollection(
            1e3 * vertices[triangles], facecolors=faces, edgecolors=faces, linewidths=0.3, shade=True
        )
    )
    _equal_axes(axis, vertices)


def _look_along(axis: Any, normal: Array) -> None:
    """Look at the side that the outward normal (3,) belongs to."""
    x, y, z = normal
    axis.view_init(
        elev=float(np.degrees(np.arctan2(z, np.hypot(x, y)))), azim=float(np.degrees(np.arctan2(y, x)))
    )


def _equal_axes(axis: Any, points: Array) -> None:
    """The same scale along x, y and z, in mm."""
    middle, extent = 500 * (points.min(axis=0) + points.max(axis=0)), 1e3 * np.ptp(points, axis=0)
    extent = np.maximum(extent, 0.05 * extent.max())  # a flat body has a box, too
    low, high = middle - extent / 2, middle + extent / 2
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axis.set(xlabel="x, mm", ylabel="y, mm", zlabel="z, mm")
    axis.set_box_aspect(high - low)
