"""Figures 3, 6 and 9: the L2 error of the displacement against the number of nodes, PCMFS and finite elements."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.discretization import collocation, conservative
from palpate.discretization.assembled_body import AssembledBody
from palpate.geometry.cloud import NodeCloud
from palpate.geometry.shapes import box_lattice
from palpate.geometry.tributary import tributary_measures
from palpate.modes.dense import elastic_modes
from palpate.modes.elastic_modes import ElasticModes
from palpate.scene.material import PronySeries
from palpate_paper import finite_element_fields, membrane, membrane_frequencies, spot_load
from palpate_paper.examples import CUBE_MATERIAL, CUBE_SINE_HZ, SQUARE_PRONY
from palpate_paper.figure import Cell, Figure, tidy
from palpate_paper.membranes import Membrane, disc_membrane, square_membrane
from palpate_paper.study import Study

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

TIME_S = 1.0
"""Of the membranes' errors that are plotted."""

DURATION_S = 2.0
"""Over which the membranes' errors are averaged beside it."""

DISC_SPOT, SQUARE_SPOT, CUBE_SPOT = 0.5, 0.4, 0.4
"""Radius of the spot, m."""

CUBE_FREQUENCIES_HZ = (0.05, CUBE_SINE_HZ)
"""Below all resonances, and that of figure 11, which is above the first ones."""

_STYLES = {
    "conservative": ("tab:blue", "o"),
    "collocation, linear": ("tab:red", "s"),
    "collocation, quadratic": ("tab:orange", "D"),
    "linear finite elements": ("black", "^"),
}
_VARIANTS = (", scattered", f", {CUBE_SINE_HZ:g} Hz")
"""Endings of a method's name whose curves are dashed."""


@dataclass(frozen=True)
class Error:
    """Relative L2 error of one model, a fraction; nodes over the whole body.

    over_time  root mean square over DURATION_S, relative to that of the solution; None for harmonic motion
    """

    method: str
    n_nodes: int
    value: float
    over_time: float | None = None


def observed_order(n_nodes: Sequence[int], errors: Sequence[float], dimensions: int) -> float:
    """The slope of log(error) over log(h), h = n_nodes^(-1/dimensions), fitted to all."""
    h = np.array(n_nodes, dtype=float) ** (-1 / dimensions)
    return float(np.polyfit(np.log(h), np.log(errors), 1)[0])


def disc(study: Study) -> Figure:
    """Figure 3: the deflection of the elastic disc at 1 s against the Bessel series."""
    levels = (60, 125, 250) if study.quick else (60, 125, 250, 500, 1000)
    study.note("disc: convergence")
    errors = membrane_errors(
        [disc_membrane(n) for n in levels], PronySeries(), DISC_SPOT, spot_load.disc_modes
    )
    study.note("disc: frequencies")
    more = membrane_frequencies.table(membrane_frequencies.disc(study.quick), "Bessel zeros")
    return convergence_figure(
        3, "Disc: convergence of the deflection in L2", errors, 2, _MEMBRANE_FINDINGS, more
    )


def square(study: Study) -> Figure:
    """Figure 6: the deflection of the viscoelastic square at 1 s against the sine series."""
    counts = (9, 13, 17) if study.quick else (9, 13, 17, 23, 31)
    study.note("square: convergence")
    lattices = [square_membrane(n * n) for n in counts]
    errors = membrane_errors(lattices, SQUARE_PRONY, SQUARE_SPOT, spot_load.square_modes)
    n_seeds = 2 if study.quick else 6
    errors += scattered_square_errors(lattices, n_seeds)
    study.note("square: frequencies")
    more = membrane_frequencies.table(membrane_frequencies.square(study.quick), "π √(m² + n²)")
    findings = (
        f"{_MEMBRANE_FINDINGS}Scattered: root mean squares over {n_seeds} clouds, the lattice's inner nodes moved by up to "
        "a fifth of the spacing."
    )
    return convergence_figure(6, "Square: convergence of the deflection in L2", errors, 2, findings, more)


def scattered_square_errors(lattices: Sequence[Membrane], n_seeds: int) -> list[Error]:
    """Root mean squares over n_seeds jittered clouds of each lattice; one cloud alone says little about an order."""
    of_seeds = [
        membrane_errors(
            [jittered(c, seed=seed) for c in lattices], SQUARE_PRONY, SQUARE_SPOT, spot_load.square_modes
        )
        for seed in range(n_seeds)
    ]
    return [
        Error(
            f"{same[0].method}, scattered",
            same[0].n_nodes,
            float(np.sqrt(np.mean([e.value**2 for e in same]))),
            float(np.sqrt(np.mean([e.over_time**2 for e in same if e.over_time is not None]))),
        )
        for same in zip(*of_seeds, strict=True)
    ]


def jittered(cloud: Membrane, fraction: float = 0.2, seed: int = 0) -> Membrane:
    """The square [0, 1]² with its inner nodes moved by up to a fraction of the spacing along each axis."""
    rng = np.random.default_rng(seed)
    inner = np.setdiff1d(np.arange(cloud.n_nodes), cloud.on_edge)
    points = cloud.points.copy()
    points[inner] += rng.uniform(-fraction, fraction, (len(inner), 2)) * cloud.spacing[inner, None]
    fine = round(10 / float(cloud.spacing.max()))
    axis = (np.arange(fine) + 0.5) / fine
    samples = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    areas = tributary_measures(points, samples, np.ones(len(samples)), 1.0)
    return replace(cloud, points=points, areas=areas)


def cube(study: Study) -> Figure:
    """Figure 9: the cube under a harmonic displacement of its top, against quadratic hexahedra."""
    study.note("cube: convergence")
    counts = (4, 5, 6) if study.quick else (5, 7, 9, 11)
    errors = cube_errors(counts, 6 if study.quick else 10)
    return convergence_figure(9, "Cube: convergence of the displacement in L2", errors, 3, _CUBE_FINDINGS)


def membrane_errors(
    clouds: Sequence[Membrane],
    prony: PronySeries,
    spot_radius: float,
    exact_modes: Callable[[Array, float], tuple[Array, Array, Array]],
) -> list[Error]:
    """Errors of both discretizations and of linear triangles on the same nodes, weighted with the nodal areas."""
    errors = []
    for cloud in clouds:
        middle = (cloud.points.min(axis=0) + cloud.points.max(axis=0)) / 2
        exact = deflections(*exact_modes(cloud.points, spot_radius), prony)
        pressure = spot_load.spot(np.linalg.norm(cloud.points - middle, axis=1), spot_radius)

        def add(method: str, fields: Array, cloud: Membrane = cloud, exact: Array = exact) -> None:
            difference, norm = (fields - exact) ** 2 @ cloud.areas, exact**2 @ cloud.areas
            at_time = float(np.sqrt(difference[_AT_TIME] / norm[_AT_TIME]))
            over_time = float(np.sqrt(difference.sum() / norm.sum()))
            errors.append(Error(method, cloud.n_nodes, at_time, over_time))

        for method, body in _meshfree(cloud):
            modes = elastic_modes(body)
            shapes = body.basis.values(modes.parameters)
            load = spot_load.modal_load(shapes, body.supports.free, pressure)
            add(method, deflections(modes.squared_frequencies, shapes, load, prony))
        elements = finite_element_fields.membrane_modes(cloud.points, cloud.on_edge, middle, spot_radius)
        add("linear finite elements", deflections(*elements, prony))
    return errors


_AT_TIME = round(TIME_S / spot_load.LOAD_ENDS_S)
_N_STEPS = round(DURATION_S / spot_load.LOAD_ENDS_S)


def deflections(mu: Any, shapes: Any, load: Any, prony: PronySeries) -> Array:
    """(n_times, n_points): deflections, m, every LOAD_ENDS_S up to DURATION_S, for a unit of the load's history in N."""
    q = spot_load.modal_history(mu, prony, spot_load.LOAD_ENDS_S, _N_STEPS)
    return np.real((q * load) @ np.transpose(shapes))


def cube_errors(counts: Sequence[int], reference_elements: int) -> list[Error]:
    """Errors of both discretizations and of linear tetrahedra on lattices of counts³ nodes, weighted with the volumes.

    At every frequency of CUBE_FREQUENCIES_HZ; names end with the frequency but for the first.
    """
    omegas = [2 * np.pi * f for f in CUBE_FREQUENCIES_HZ]
    endings = ["", *(f", {f:g} Hz" for f in CUBE_FREQUENCIES_HZ[1:])]
    references = [
        finite_element_fields.QuadraticCube(reference_elements, CUBE_MATERIAL, omega, _pressed_top)
        for omega in omegas
    ]
    errors = []
    for n in counts:
        cloud = box_lattice((0, 0, 0), (1, 1, 1), (n, n, n))
        exact = [reference(cloud.points) for reference in references]

        def add(method: str, i: int, field: Complex, cloud: NodeCloud = cloud, exact: Any = exact) -> None:
            norm = cloud.volumes @ np.sum(np.abs(exact[i]) ** 2, axis=1)
            difference = cloud.volumes @ np.sum(np.abs(field - exact[i]) ** 2, axis=1)
            errors.append(Error(method + endings[i], cloud.n_nodes, float(np.sqrt(difference / norm))))

        fixed = np.flatnonzero(cloud.points[:, 2] == 0)
        top = np.flatnonzero(cloud.points[:, 2] == 1)
        motion = np.zeros((len(top), 3))
        motion[:, 2] = _pressed_top(cloud.points[top, 0], cloud.points[top, 1])
        tips = [[int(i)] for i in top]
        for method, assemble in (
            ("conservative", conservative.assemble),
            ("collocation, linear", collocation.assemble),
        ):
            body = assemble(cloud, CUBE_MATERIAL, fixed, tips)
            modes = elastic_modes(body)
            for i, omega in enumerate(omegas):
                parameters = harmonic_field(modes, omega, motion.ravel())
                add(method, i, body.basis.values(parameters).reshape(-1, 3))
        for i, omega in enumerate(omegas):
            _, field = finite_element_fields.cube_of_tetrahedra(n, CUBE_MATERIAL, omega, _pressed_top)
            ordered = np.empty_like(field)
            ordered[_lexicographic(cloud.points)] = field
            add("linear finite elements", i, ordered)
    return errors


def _lexicographic(points: Array) -> NDArray[np.intp]:
    """(n,): the order of lattice points (n, 3) by x, then y, then z."""
    return np.lexsort(np.round(points, 9).T[::-1])


def harmonic_field(modes: ElasticModes, omega: float, motion: Array) -> Complex:
    """(3 n_nodes,): parameters of the complex displacements under tip displacements motion (n_inputs,) times e^{j omega t}."""
    h = CUBE_MATERIAL.prony.transfer_factor(np.array([1j * omega]))[0]
    q = -h * (modes.input_coupling @ motion) / (h * modes.squared_frequencies - omega**2)
    return np.asarray(modes.parameters @ q + modes.patch_parameters @ motion, dtype=np.complex128)


def _pressed_top(x: Array, y: Array) -> Array:
    """u_z of the top: (1 - (r/a)²)² around its middle, zero from a on."""
    return np.clip(1 - ((x - 0.5) ** 2 + (y - 0.5) ** 2) / CUBE_SPOT**2, 0, None) ** 2


def _meshfree(cloud: Membrane) -> list[tuple[str, AssembledBody]]:
    return [
        ("conservative", membrane.conservative(cloud)),
        ("collocation, linear", membrane.collocation(cloud, order=1)),
        ("collocation, quadratic", membrane.collocation(cloud, order=2)),
    ]


_MEMBRANE_FINDINGS = (
    f"Deflection at {TIME_S:g} s under the paper's history as a force on a smooth spot, error at the nodes weighted with their "
    "areas, the same nodes for all methods; exact in time, so that only the discretization counts. The orders over "
    f"{DURATION_S:g} s are those of the error's root mean square over all times: at a single instant a phase may happen to be right "
    "on coarse nodes, which the finer ones then seem to improve on too slowly. "
)
_CUBE_FINDINGS = (
    f"Complex displacement at {CUBE_FREQUENCIES_HZ[0]:g} Hz, below all resonances, and at {CUBE_SINE_HZ:g} Hz, between them, under a smooth press of the whole top, error at the nodes weighted with their volumes, "
    "against quadratic hexahedra (scikit-fem). Where free and held faces meet the stress is singular, which limits every method's "
    "order; between resonances an error in frequency is an error in phase, so that all errors are larger. "
)
_FINEST = 3
"""Number of the finest node clouds that an observed order is fitted to; beside it stands that of all clouds."""


@dataclass(frozen=True)
class Orders:
    """Observed orders in h: of the finest clouds, of all, and of the finest over time (None for harmonic motion)."""

    finest: float
    all_clouds: float
    over_time: float | None

    @classmethod
    def of(cls, errors: Sequence[Error], dimensions: int) -> Orders:
        ascending = sorted(errors, key=lambda e: e.n_nodes)
        nodes, values = [e.n_nodes for e in ascending], [e.value for e in ascending]
        over_time = [e.over_time for e in ascending if e.over_time is not None]
        return cls(
            observed_order(nodes[-_FINEST:], values[-_FINEST:], dimensions),
            observed_order(nodes, values, dimensions),
            observed_order(nodes[-_FINEST:], over_time[-_FINEST:], dimensions) if over_time else None,
        )


def convergence_figure(
    number: int, title: str, errors: list[Error], dimensions: int, findings: str, more: str = ""
) -> Figure:
    methods = list(dict.fromkeys(e.method for e in errors))
    by_method = {m: [e for e in errors if e.method == m] for m in methods}
    orders = {m: Orders.of(by_method[m], dimensions) for m in methods}

    def draw(canvas: Any) -> None:
        axis = canvas.subplots()
        for method in methods:
            own = by_method[method]
            dashed = method.endswith(_VARIANTS)
            color, marker = next(style for name, style in _STYLES.items() if method.startswith(name))
            axis.loglog(
                [e.n_nodes for e in own],
                [e.value for e in own],
                marker + ("--" if dashed else "-"),
                color=color,
                markersize=5,
                markerfacecolor="none" if dashed else color,
                linewidth=1.2,
                label=f"{method} (order {_one_digit(orders[method].finest)})",
            )
        n = np.array(sorted({e.n_nodes for e in errors}), dtype=float)
        start = max(e.value for e in errors if e.n_nodes == n[0])
        axis.loglog(n, start * (n / n[0]) ** (-2 / dimensions), ":", color="0.5", label="second order")
        axis.set(xlabel="nodes", ylabel="relative L2 error")
        axis.legend(frameon=False, fontsize="small", loc="center left", bbox_to_anchor=(1, 0.5))
        tidy(axis)

    rows: list[list[Cell]] = [
        [e.method, e.n_nodes, e.value, orders[e.method].finest, orders[e.method].all_clouds] for e in errors
    ]
    for row, e in zip(rows, errors, strict=True):
        row += [] if e.over_time is None else [e.over_time]
    timed = all(e.over_time is not None for e in errors)
    columns = ("method", "nodes", "relative_l2_error", "observed_order", "observed_order_of_all")
    return Figure(
        number,
        title,
        (*columns, "relative_l2_error_over_time") if timed else columns,
        rows,
        draw,
        "\n\n".join(
            part for part in (findings.strip(), _order_table(by_method, orders, number), more) if part
        ),
        (9.0, 4.2),
        f"{title.split(':')[0]}, observed orders of convergence: "
        + "; ".join(f"{m} {_range(o)}" for m, o in orders.items())
        + f" from the finest {_FINEST} clouds (from all).",
    )


def _range(orders: Orders) -> str:
    return f"{_one_digit(orders.finest)} ({_one_digit(orders.all_clouds)})"


def _one_digit(value: float) -> str:
    return f"{round(value, 1) + 0.0:.1f}"  # no minus before a zero


def _order_table(by_method: dict[str, list[Error]], orders: dict[str, Orders], number: int) -> str:
    timed = all(o.over_time is not None for o in orders.values())
    lines = [
        f"| method | coarsest | finest | order in h, finest {_FINEST} (all) | "
        + (f"order over {DURATION_S:g} s | " if timed else "")
        + "error over that of linear finite elements on the same nodes, coarsest to finest |",
        "|---|---|---|---|---|" + ("---|" if timed else ""),
    ]
    ratios = {m: _ratios(by_method, m) for m in by_method}
    for method, own in by_method.items():
        over_time = orders[method].over_time
        lines.append(
            f"| {method} | {100 * own[0].value:.2g} % at {own[0].n_nodes:,} | {100 * own[-1].value:.2g} % at "
            f"{own[-1].n_nodes:,} nodes | {_range(orders[method])} | "
            + ("" if over_time is None else f"{_one_digit(over_time)} | ")
            + (", ".join(f"{r:.2g}" for r in ratios[method]) if method in _compared(ratios) else "1")
            + " |"
        )
    most_accurate = min(by_method, key=lambda m: by_method[m][-1].value)
    said = f"Most accurate at the finest nodes: {most_accurate}. The paper's PCMFS collocates. Against linear finite elements on "
    said += "the same nodes, " + "; ".join(
        f"{m} is {_verdict(r)}"
        for m, r in ratios.items()
        if m.startswith("collocation") and m in _compared(ratios)
    )
    said += "."
    if number == _RANKED_BY_THE_PAPER:
        confirmed = all(min(r) > 1 for m, r in ratios.items() if m.startswith("collocation"))
        said += f" That {'confirms' if confirmed else 'does not confirm'} the paper's finding, for its own method."
    said += " Of the conservative discretization, which is ours, " + "; ".join(
        f"{m} is {_verdict(r)}"
        + (f", over {DURATION_S:g} s {_verdict(_ratios(by_method, m, over_time=True))}" if timed else "")
        for m, r in ratios.items()
        if m.startswith("conservative")
    )
    said += "."
    stuck = [m for m, order in orders.items() if order.finest < 0.5]
    if stuck:
        said += f" Not converging (observed order below 0.5): {'; '.join(stuck)}."
    return "\n".join([*lines, "", said])


_RANKED_BY_THE_PAPER = 3
"""The only figure of convergence whose accuracies the paper's text compares."""


def _compared(ratios: dict[str, list[float]]) -> list[str]:
    return [m for m in ratios if not m.startswith("linear finite elements")]


def _ratios(by_method: dict[str, list[Error]], method: str, over_time: bool = False) -> list[float]:
    """Errors over those of finite elements on the same nodes and in the same variant, by number of nodes."""
    variant = next((v for v in _VARIANTS if method.endswith(v)), "")

    def value(error: Error) -> float:
        return error.over_time if over_time and error.over_time is not None else error.value

    theirs = {e.n_nodes: value(e) for e in by_method["linear finite elements" + variant]}
    return [value(e) / theirs[e.n_nodes] for e in by_method[method]]


def _verdict(ratios: Sequence[float]) -> str:
    if min(ratios) > 1:
        return (
            f"less accurate at every number of nodes ({min(ratios):.2g} to {max(ratios):.2g} times the error)"
        )
    if max(ratios) < 1:
        return (
            f"more accurate at every number of nodes ({min(ratios):.2g} to {max(ratios):.2g} times the error)"
        )
    better = sum(r < 1 for r in ratios)
    return (
        f"more accurate at {better} of {len(ratios)} numbers of nodes ({ratios[0]:.2g} times the error at the coarsest, "
        f"{ratios[-1]:.2g} times at the finest)"
    )
