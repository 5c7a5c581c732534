"""The first ten frequencies of the disc and of the square against the exact ones, by each discretization."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import jn_zeros

from palpate.discretization.assembled_body import AssembledBody
from palpate.modes.dense import elastic_modes
from palpate_paper import membrane
from palpate_paper.finite_element_fields import require_scikit_fem
from palpate_paper.membranes import Membrane, disc_membrane, square_membrane

Array = NDArray[np.float64]

COUNT = 10


@dataclass(frozen=True)
class FrequencyErrors:
    """Largest relative error of the first COUNT frequencies, a fraction, for each number of nodes, ascending."""

    method: str
    n_nodes: tuple[int, ...]
    values: tuple[float, ...]

    @property
    def order(self) -> float:
        """Observed in h = n_nodes^(-1/2) between the two finest."""
        h_ratio = np.sqrt(self.n_nodes[-1] / self.n_nodes[-2])
        return float(np.log(self.values[-2] / self.values[-1]) / np.log(h_ratio))


def disc_frequencies() -> Array:
    """(COUNT,), rad/s: the zeros of the Bessel functions, twice but for those of J_0; everything 1."""
    zeros = [np.repeat(jn_zeros(m, COUNT), 1 if m == 0 else 2) for m in range(COUNT)]
    return np.asarray(np.sort(np.concatenate(zeros))[:COUNT])


def square_frequencies() -> Array:
    """(COUNT,), rad/s: pi sqrt(m² + n²); everything 1."""
    waves = np.arange(1, COUNT + 1)
    return np.asarray(np.sort(np.pi * np.hypot(waves[:, None], waves), axis=None)[:COUNT])


def disc(quick: bool = False) -> list[FrequencyErrors]:
    """Both discretizations with each number of nodes, and linear triangles with about as many."""
    require_scikit_fem()
    from palpate_paper import finite_elements

    counts, refinements = ((60, 125, 250), (2, 3)) if quick else ((125, 500, 2000), (3, 4, 5))
    meshes = [finite_elements.disc(r) for r in refinements]
    exact = disc_frequencies()
    triangles = {
        m.n_dofs: finite_elements.frequencies(m, m.at(_on_circle), COUNT) / exact - 1 for m in meshes
    }
    return [
        *_meshfree([disc_membrane(n) for n in counts], exact),
        _errors("linear finite elements", triangles),
    ]


def square(quick: bool = False) -> list[FrequencyErrors]:
    """Both discretizations and linear triangles on the same lattices."""
    require_scikit_fem()
    from palpate_paper import finite_elements

    counts = (8, 12, 16) if quick else (8, 14, 28)
    meshes = [finite_elements.square(n - 1) for n in counts]
    exact = square_frequencies()
    triangles = {
        m.n_dofs: finite_elements.frequencies(m, m.at(_on_square), COUNT) / exact - 1 for m in meshes
    }
    lattices = [square_membrane(n * n) for n in counts]
    return [*_meshfree(lattices, exact), _errors("linear finite elements", triangles)]


def table(errors: Sequence[FrequencyErrors], exact: str) -> str:
    """Markdown: the errors against what `exact` names and the observed orders."""
    lines = [
        f"The first {COUNT} frequencies against {exact}, largest relative error:",
        "",
        "| method | coarsest | | finest | order in h between the two finest |",
        "|---|---|---|---|---|",
    ]
    for e in errors:
        middle = len(e.values) // 2
        cells = (
            f"{100 * e.values[i]:.2g} % at {e.n_nodes[i]:,} nodes" for i in (0, middle, len(e.values) - 1)
        )
        lines.append(f"| {e.method} | {' | '.join(cells)} | {e.order:.2f} |")
    return "\n".join(lines)


def _meshfree(clouds: Sequence[Membrane], exact: Array) -> list[FrequencyErrors]:
    assemble = {"conservative": membrane.conservative, "collocation, quadratic": membrane.collocation}
    return [
        _errors(name, {cloud.n_nodes: _frequencies(body(cloud)) / exact - 1 for cloud in clouds})
        for name, body in assemble.items()
    ]


def _frequencies(body: AssembledBody) -> Array:
    """(COUNT,), rad/s, ascending: the lowest."""
    lowest = elastic_modes(body).squared_frequencies[:COUNT]
    return np.sort(np.sqrt(lowest.astype(np.complex128)).real)


def _errors(method: str, by_nodes: dict[int, Array]) -> FrequencyErrors:
    return FrequencyErrors(
        method, tuple(by_nodes), tuple(float(np.max(np.abs(e))) for e in by_nodes.values())
    )


def _on_circle(places: Array) -> NDArray[np.bool_]:
    return np.linalg.norm(places, axis=1) > 1 - 1e-9


def _on_square(places: Array) -> NDArray[np.bool_]:
    return np.any((places < 1e-9) | (places > 1 - 1e-9), axis=1)
