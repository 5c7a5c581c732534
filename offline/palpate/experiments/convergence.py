"""Figures 3, 6 and 9: the L2 error of the displacement against the number of nodes, PCMFS and finite elements."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.discretization import collocation, conservative, membrane
from palpate.experiments import finite_element_fields, spot_load
from palpate.experiments.examples import CUBE_MATERIAL, CUBE_SINE_HZ, SQUARE_PRONY
from palpate.experiments.figure import Figure, tidy
from palpate.experiments.study import Study
from palpate.geometry.cloud import NodeCloud
from palpate.geometry.membranes import Membrane, disc_membrane, square_membrane
from palpate.geometry.shapes import box_lattice
from palpate.geometry.tributary import tributary_measures
from palpate.material import PronySeries
from palpate.system import ElasticModes

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

TIME_S = 1.0
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
    """Relative L2 error of one model, a fraction; nodes over the whole body."""

    method: str
    n_nodes: int
    value: float


def observed_order(errors: Sequence[Error], dimensions: int, last: int = 3) -> float:
    """The slope of log(error) over log(h), h = n_nodes^(-1/dimensions), fitted to the finest `last` models."""
    chosen = sorted(errors, key=lambda e: e.n_nodes)[-last:]
    h = np.array([e.n_nodes for e in chosen], dtype=float) ** (-1 / dimensions)
    return float(np.polyfit(np.log(h), np.log([e.value for e in chosen]), 1)[0])


def disc(study: Study) -> Figure:
    """Figure 3: the deflection of the elastic disc at 1 s against the Bessel series."""
    levels = (60, 125, 250) if study.quick else (60, 125, 250, 500, 1000)
    study.note("disc: convergence")
    errors = membrane_errors(
        [disc_membrane(n) for n in levels], PronySeries(), DISC_SPOT, spot_load.disc_modes
    )
    return _figure(3, "Disc: convergence of the deflection in L2", errors, 2, _MEMBRANE_FINDINGS)


def square(study: Study) -> Figure:
    """Figure 6: the deflection of the viscoelastic square at 1 s against the sine series."""
    counts = (9, 13, 17) if study.quick else (9, 13, 17, 23, 31)
    study.note("square: convergence")
    lattices = [square_membrane(n * n) for n in counts]
    errors = membrane_errors(lattices, SQUARE_PRONY, SQUARE_SPOT, spot_load.square_modes)
    scattered = [jittered(cloud) for cloud in lattices]
    errors += [
        Error(f"{e.method}, scattered", e.n_nodes, e.value)
        for e in membrane_errors(scattered, SQUARE_PRONY, SQUARE_SPOT, spot_load.square_modes)
    ]
    return _figure(6, "Square: convergence of the deflection in L2", errors, 2, _MEMBRANE_FINDINGS)


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
    return _figure(9, "Cube: convergence of the displacement in L2", errors, 3, _CUBE_FINDINGS)


def membrane_errors(
    clouds: Sequence[Membrane],
    prony: PronySeries,
    spot_radius: float,
    exact_modes: Callable[[Array, float], tuple[Array, Array, Array]],
) -> list[Error]:
    """Errors of both discretisations and of linear triangles on the same nodes, weighted with the nodal areas."""
    errors = []
    for cloud in clouds:
        middle = (cloud.points.min(axis=0) + cloud.points.max(axis=0)) / 2
        exact = deflection(*exact_modes(cloud.points, spot_radius), prony)
        pressure = spot_load.spot(np.linalg.norm(cloud.points - middle, axis=1), spot_radius)

        def add(method: str, field: Array, cloud: Membrane = cloud, exact: Array = exact) -> None:
            square_error = cloud.areas @ (field - exact) ** 2 / (cloud.areas @ exact**2)
            errors.append(Error(method, cloud.n_nodes, float(np.sqrt(square_error))))

        for method, modes in _meshfree(cloud):
            load = spot_load.modal_load(modes.shapes, pressure)
            add(method, deflection(modes.squared_frequencies, modes.shapes, load, prony))
        elements = finite_element_fields.membrane_modes(cloud.points, cloud.on_edge, middle, spot_radius)
        add("linear finite elements", deflection(*elements, prony))
    return errors


def deflection(mu: Any, shapes: Any, load: Any, prony: PronySeries) -> Array:
    """(n_points,): the deflection at TIME_S, m, for a unit of the load's history in N."""
    q = spot_load.modal_history(mu, prony, spot_load.LOAD_ENDS_S, round(TIME_S / spot_load.LOAD_ENDS_S))[-1]
    return np.real(shapes @ (load * q))


def cube_errors(counts: Sequence[int], reference_elements: int) -> list[Error]:
    """Errors of both discretisations and of linear tetrahedra on lattices of counts³ nodes, weighted with the volumes.

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
        for method, elastic_modes in (
            ("conservative", conservative.elastic_modes),
            ("collocation, linear", collocation.elastic_modes),
        ):
            modes = elastic_modes(cloud, CUBE_MATERIAL, fixed, tips)
            for i, omega in enumerate(omegas):
                add(method, i, harmonic_field(modes, omega, motion.ravel()).reshape(-1, 3))
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
    """(3 n_nodes,): complex displacements under tip displacements motion (n_inputs,) times e^{j omega t}."""
    h = CUBE_MATERIAL.prony.transfer_factor(np.array([1j * omega]))[0]
    q = -h * (modes.input_coupling @ motion) / (h * modes.squared_frequencies - omega**2)
    return np.asarray(modes.shapes @ q + modes.patch_shapes @ motion, dtype=np.complex128)


def _pressed_top(x: Array, y: Array) -> Array:
    """u_z of the top: (1 - (r/a)²)² around its middle, zero from a on."""
    return np.clip(1 - ((x - 0.5) ** 2 + (y - 0.5) ** 2) / CUBE_SPOT**2, 0, None) ** 2


def _meshfree(cloud: Membrane) -> list[tuple[str, ElasticModes]]:
    return [
        ("conservative", membrane.conservative_modes(cloud)),
        ("collocation, linear", membrane.collocation_modes(cloud, order=1)),
        ("collocation, quadratic", membrane.collocation_modes(cloud, order=2)),
    ]


_MEMBRANE_FINDINGS = (
    "Deflection at 1 s under the paper's history as a force on a smooth spot, error at the nodes weighted with their areas, the "
    "same nodes for all methods; exact in time, so that only the discretisation counts. "
)
_CUBE_FINDINGS = (
    f"Complex displacement at {CUBE_FREQUENCIES_HZ[0]:g} Hz, below all resonances, and at {CUBE_SINE_HZ:g} Hz, between them, under a smooth press of the whole top, error at the nodes weighted with their volumes, "
    "against quadratic hexahedra (scikit-fem). Where free and held faces meet the stress is singular, which limits every method's "
    "order; between resonances an error in frequency is an error in phase, so that all errors are larger. "
)


def _figure(number: int, title: str, errors: list[Error], dimensions: int, findings: str) -> Figure:
    methods = list(dict.fromkeys(e.method for e in errors))
    by_method = {m: [e for e in errors if e.method == m] for m in methods}
    orders = {m: observed_order(by_method[m], dimensions) for m in methods}

    def draw(canvas: Any) -> None:
        axis = canvas.subplots()
        for method in methods:
            own = by_method[method]
            dashed = method.endswith(_VARIANTS)
            colour, marker = next(style for name, style in _STYLES.items() if method.startswith(name))
            axis.loglog(
                [e.n_nodes for e in own],
                [e.value for e in own],
                marker + ("--" if dashed else "-"),
                color=colour,
                markersize=5,
                markerfacecolor="none" if dashed else colour,
                linewidth=1.2,
                label=f"{method} (order {orders[method]:.1f})",
            )
        n = np.array(sorted({e.n_nodes for e in errors}), dtype=float)
        start = max(e.value for e in errors if e.n_nodes == n[0])
        axis.loglog(n, start * (n / n[0]) ** (-2 / dimensions), ":", color="0.5", label="second order")
        axis.set(xlabel="nodes", ylabel="relative L2 error")
        axis.legend(frameon=False, fontsize="small", loc="center left", bbox_to_anchor=(1, 0.5))
        tidy(axis)

    return Figure(
        number,
        title,
        ("method", "nodes", "relative_l2_error", "observed_order"),
        [[e.method, e.n_nodes, e.value, orders[e.method]] for e in errors],
        draw,
        findings + "\n\n" + _order_table(by_method, orders),
        (9.0, 4.2),
        f"{title.split(':')[0]}, observed orders of convergence: "
        + "; ".join(f"{m} {o:.1f}" for m, o in orders.items())
        + ".",
    )


def _order_table(by_method: dict[str, list[Error]], orders: dict[str, float]) -> str:
    lines = ["| method | coarsest | finest | observed order in h |", "|---|---|---|---|"]
    for method, own in by_method.items():
        lines.append(
            f"| {method} | {100 * own[0].value:.2g} % at {own[0].n_nodes:,} | {100 * own[-1].value:.2g} % at "
            f"{own[-1].n_nodes:,} nodes | {orders[method]:.1f} |"
        )
    finest = {m: own[-1].value for m, own in by_method.items()}
    most_accurate = min(finest, key=finest.__getitem__)
    lines += ["", f"Most accurate at the finest nodes: {most_accurate}."]
    ratio = finest["conservative"] / finest["linear finite elements"]
    lines[-1] += (
        f" At equal nodes the conservative discretisation has {ratio:.2g} times the error of linear finite elements "
        "(the paper: PCMFS less accurate)."
    )
    stuck = [m for m, order in orders.items() if order < 0.5]
    if stuck:
        lines[-1] += f" Not converging (observed order below 0.5): {'; '.join(stuck)}."
    return "\n".join(lines)
