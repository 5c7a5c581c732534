"""The three problems of BaniHani & De 2009 (section 4) as systems from a tip displacement to the reaction force."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from palpate.discretization import collocation, conservative
from palpate.discretization.assembled_body import AssembledBody
from palpate.geometry.cloud import NodeCloud
from palpate.geometry.shapes import box_lattice
from palpate.lti.pole_residue import PoleResidueSystem
from palpate.lti.viscoelastic import viscoelastic_system
from palpate.modes.dense import elastic_modes
from palpate.modes.elastic_modes import ElasticModes
from palpate.scene.material import PronySeries
from palpate.scene.tissues import PRESETS
from palpate_paper import membrane
from palpate_paper.membranes import Membrane, disc_membrane, square_membrane
from palpate_paper.time_integration import EquationsOfMotion, equations_of_motion

Array = NDArray[np.float64]
Discretization = Literal["conservative", "collocation"]

PERIOD_S = 0.001
DISC_DRAG_PER_S = 0.01
"""Drag c of rho (u'' + c u'): the disc of the paper is purely elastic, so it has no Gramians and cannot be balanced."""

SQUARE_PRONY = PronySeries((1.0,), (1.0,))
"""E = E_1 = eta_1 = 1: gamma_1 = E_1 / E = 1 and tau_1 = eta_1 / E_1 = 1 s."""

CUBE_MATERIAL = PRESETS["paper-cube"]
CUBE_SINE_HZ = 0.2


@dataclass(frozen=True)
class Example:
    """A full model and the settings of its study.

    name         disc, square or cube
    system       from the tip's displacement, m, to the reaction force, N, one component for membranes, three in space
    equations    the same model, sparse, for Newmark's method; without the disc's drag
    prony        the material's memory
    n_nodes      of the discretization
    n_unknowns   displacement components that are free to move
    order        of the reduced models: the paper's, where it states one
    small_order  a tenth of that
    band_hz      frequencies that the nodes carry, six of them to a wave
    channel      index of the input and output that is driven and plotted
    inputs       (n_samples, n_inputs), tip displacement, m, PERIOD_S apart
    """

    name: str
    system: PoleResidueSystem
    equations: EquationsOfMotion
    prony: PronySeries
    n_nodes: int
    n_unknowns: int
    order: int
    small_order: int
    band_hz: tuple[float, float]
    channel: int
    inputs: Array

    @property
    def times_s(self) -> Array:
        return np.asarray(PERIOD_S * np.arange(len(self.inputs)), dtype=np.float64)


def disc(n_nodes: int = 500, discretization: Discretization = "conservative") -> Example:
    """Section 4.1.1: elastic disc, everything 1, 600 of 800 states in the paper."""
    cloud = disc_membrane(n_nodes)
    tip = center_of(cloud)
    body = _membrane_body(cloud, tip, discretization)
    modes = elastic_modes(body)
    order = round(0.75 * 2 * modes.n_modes / 2) * 2 if n_nodes < 400 else 600
    return Example(
        "disc",
        with_drag(modes, DISC_DRAG_PER_S),
        equations_of_motion(body),
        PronySeries(),
        n_nodes,
        modes.n_modes,
        order,
        order // 10,
        (0.0, 1 / (6 * float(cloud.spacing.max()))),
        0,
        pulse(2.0)[:, None],
    )


def square(count: int = 15, discretization: Discretization = "conservative") -> Example:
    """Section 4.1.2: viscoelastic square, count² nodes; the paper has 200, and reduces 400 states to 200."""
    cloud = square_membrane(count**2)
    tip = center_of(cloud)
    body = _membrane_body(cloud, tip, discretization)
    modes = elastic_modes(body)
    order = 200 if count >= 15 else modes.n_modes
    return Example(
        "square",
        viscoelastic_system(modes, SQUARE_PRONY),
        equations_of_motion(body),
        SQUARE_PRONY,
        cloud.n_nodes,
        modes.n_modes,
        order,
        order // 10,
        (0.0, np.sqrt(SQUARE_PRONY.instant_factor) / (6 * float(cloud.spacing.max()))),
        0,
        pulse(2.0)[:, None],
    )


def cube(nodes_an_edge: int = 10, discretization: Discretization = "conservative") -> Example:
    """Section 4.2: viscoelastic cube on a lattice, bottom fixed, the middle of the top moved up and down; no order given.

    An even number of nodes an edge has no node in the middle: the four around it are the tip.
    """
    cloud, fixed, tip = cube_parts(nodes_an_edge)
    assemble = (conservative if discretization == "conservative" else collocation).assemble
    body = assemble(cloud, CUBE_MATERIAL, fixed, [tip])
    modes = elastic_modes(body)
    order = 300 if nodes_an_edge >= 10 else 100
    times = PERIOD_S * np.arange(5001)
    inputs = np.zeros((len(times), 3))
    inputs[:, 2] = 0.01 * np.sin(2 * np.pi * CUBE_SINE_HZ * times)
    speed = np.sqrt(
        CUBE_MATERIAL.shear_modulus_pa * CUBE_MATERIAL.prony.instant_factor / CUBE_MATERIAL.density_kg_per_m3
    )
    return Example(
        "cube",
        viscoelastic_system(modes, CUBE_MATERIAL.prony),
        equations_of_motion(body),
        CUBE_MATERIAL.prony,
        cloud.n_nodes,
        modes.n_modes,
        order,
        order // 10,
        (0.0, float(speed) / (6 * float(cloud.spacing.max()))),
        2,
        inputs,
    )


def cube_parts(nodes_an_edge: int) -> tuple[NodeCloud, NDArray[np.intp], NDArray[np.intp]]:
    """(cloud, fixed nodes, tip nodes) of the unit cube: the tip nodes lie within 0.6 spacings of the middle of the top."""
    cloud = box_lattice((0, 0, 0), (1, 1, 1), (nodes_an_edge,) * 3)
    spacing = 1 / (nodes_an_edge - 1)
    away = np.abs(cloud.points[:, :2] - 0.5).max(axis=1)
    top = cloud.points[:, 2] == 1
    return (
        cloud,
        np.flatnonzero(cloud.points[:, 2] == 0),
        np.flatnonzero(top & (away < 0.6 * spacing)),
    )


def center_of(cloud: Membrane) -> list[int]:
    """The node in the middle of the membrane."""
    middle = (cloud.points.min(axis=0) + cloud.points.max(axis=0)) / 2
    return [int(np.argmin(np.linalg.norm(cloud.points - middle, axis=1)))]


def pulse(duration_s: float) -> Array:
    """(n_samples,): the paper's u = t / 10 before 0.2 s and 0 from then on, m (Eq. 49 and 53)."""
    times = PERIOD_S * np.arange(round(duration_s / PERIOD_S) + 1)
    return np.where(np.arange(len(times)) < round(0.2 / PERIOD_S), times / 10, 0.0)


def with_drag(modes: ElasticModes, drag_per_s: float) -> PoleResidueSystem:
    """F = K_tt u - sum_k c_k b_k^T / (s² + c s + mu_k) u: an elastic body in a slightly viscous medium, two states a mode.

    Each mode must be underdamped: mu_k real and above c²/4, or complex in conjugate pairs.
    """
    mu = modes.squared_frequencies.astype(np.complex128)
    kept = mu.imag >= 0  # one of each conjugate pair: its two poles stand for the four of the pair
    mu = mu[kept]
    b, c = modes.input_coupling[kept].astype(np.complex128), modes.output_coupling[:, kept]
    root = np.sqrt(mu - drag_per_s**2 / 4)
    poles, rows, columns, group = [], [], [], []
    for sign in (1, -1):
        chosen = np.flatnonzero((mu.imag > 0) | (sign > 0))
        pole = -drag_per_s / 2 + sign * 1j * root[chosen]
        residue = -1 / (sign * 2j * root[chosen])
        down = pole.imag < 0
        row = np.sqrt(residue)[:, None] * b[chosen]
        column = (np.sqrt(residue) * c[:, chosen]).T
        poles.append(np.where(down, pole.conj(), pole))
        rows.append(np.where(down[:, None], row.conj(), row))
        columns.append(np.where(down[:, None], column.conj(), column))
        group.append(chosen)
    order = np.argsort(np.concatenate(group), kind="stable")
    return PoleResidueSystem(
        poles=np.concatenate(poles)[order],
        b=np.vstack(rows)[order],
        c=np.ascontiguousarray(np.vstack(columns)[order].T),
        d=np.array(modes.direct_stiffness, dtype=np.float64),
        group=np.concatenate(group)[order],
    )


def _membrane_body(cloud: Membrane, tip: list[int], discretization: Discretization) -> AssembledBody:
    assemble = membrane.conservative if discretization == "conservative" else membrane.collocation
    return assemble(cloud, [tip])
