"""The page of all figures: what the paper found, what we find, and where and why they differ."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from palpate.files import write_atomically
from palpate_paper.examples import DISC_DRAG_PER_S
from palpate_paper.figure import Figure

_PAPER: dict[int, str] = {
    2: "The deflection of the disc's center by PCMFS with 500 nodes and by 146 linear triangular finite elements.",
    3: 'Convergence in the L2 norm of PCMFS and finite elements; PCMFS is "clearly less accurate" at the same number of nodes. '
    "No orders are stated.",
    4: "600 of 800 states. TBR captures most of the dynamics; Hankel-optimal has a steady error at high frequencies; modal "
    "truncation has the highest error and misses peaks.",
    5: "TBR has the lowest relative error, modal truncation the shortest solution time.",
    6: "Convergence in the L2 norm of PCMFS and linear triangles; the text compares no accuracies and states no orders.",
    7: "200 of 400 states. Hankel-optimal is poor at high frequencies, modal truncation at low ones; TBR captures most of "
    "the dynamics with a steady error at high frequencies.",
    8: "TBR has the lowest error, modal truncation the shortest time.",
    9: "Convergence in the L2 norm of linear tetrahedra and of PCMFS with linear consistency; the text compares no accuracies and "
    "states no orders.",
    10: "3,000 degrees of freedom, the reduced order is not stated. Hankel-optimal and modal truncation are poor at high "
    "frequencies, TBR captures most of the dynamics.",
    11: "The reaction force in the middle of the upper face over 5 s at steps of 1 ms, full and reduced.",
    12: "TBR has the best accuracy, modal truncation takes the least time.",
    13: "TBR has the lowest product of error and time, Hankel-optimal the highest.",
}

_INTRODUCTION = f"""# The paper's figures, regenerated

S. BaniHani and S. De, *A comparison of some model order reduction methods for fast simulation of soft tissue response using
the point collocation-based method of finite spheres*, Engineering with Computers 25 (2009) 37-47,
[doi:10.1007/s00366-008-0103-4](https://doi.org/10.1007/s00366-008-0103-4).

This page is written by `palpate reproduce --out docs`, numbers included; every plot has a table of the same name
(`.csv`) beside it. HOM is Hankel-optimal reduction, MT modal truncation, TBR truncated balanced realization.

## What the paper leaves open, and what we do

- **D.** The paper sets D = 0 in Eq. 35. With a displacement as input and a force as output D is the instant stiffness of the
  tip, several times its stiffness at rest. We keep it.
- **E and ν** of the cube are not stated: 1 Pa and 0.3 here. Neither are the amplitude and frequency of its sine: 10 mm and
  0.2 Hz, one period in the 5 s; nor the order of its reduced models.
- **States.** The paper counts two states a degree of freedom. The memory of the material (Eq. 9) is a third one in our exact
  system; the tables give both counts.
- **Node counts.** 500 nodes in rings of about 2πk nodes (a polar grid with equally many nodes on each ring fails near the
  center), 15 x 15 nodes instead of 200 on the square so that one lies in the middle, and 10³ on the cube with the four nodes
  around the middle of the top as the tip.
- **Damping of the disc.** Its material is purely elastic: all poles lie on the imaginary axis, no Gramian exists, and
  neither TBR nor HOM is defined. We add a drag of {DISC_DRAG_PER_S:g} /s (ρ (u″ + c u′)), which takes {100 * (1 - 2.718281828 ** (-DISC_DRAG_PER_S)):.1g} % of a wave's amplitude in the
  2 s that are computed, and leaves two states a mode.
- **Relative error.** The paper sums |u_full - u_reduced| / u_full over nodes, at a time that it does not state; a quotient by values
  that pass through zero. A reduced model from displacement to force has no nodes, so we take the reaction force and
  Σ|F_full - F_reduced| / Σ|F_full| over the samples of the history.
- **A point has no limit.** The displacement of a point (or the force on one) of a membrane or a solid has no continuum solution of
  finite energy: with finer nodes the reaction goes to zero or the deflection to infinity. Convergence (figures 2, 3, 6, 9) is therefore
  studied with the same input spread over a smooth spot; the reductions use the single node as the paper does.
- **Round-off.** Errors below 1e-9 % are round-off, whatever the bound says; where an order is above what round-off leaves, the
  reduction stops there, and the tables show the order that it reached.
- **Discretization.** Figures 4 to 14 use our `conservative` discretization, which is symmetric, stable and passive; figure 15 has the
  paper's collocation beside it.
- **Solution time.** Reduced models run as real 2 x 2 blocks in one compiled loop, 1 ms a step; processor time, the median of five
  runs. The full model runs in the same loop with all its modes, and by Newmark's method with one sparse factorization (SuperLU
  through SciPy, some tens of µs of interpreter a step). Reductions are timed once by the wall clock, beside other
  work: differences below a factor of two are the machine's.
"""


def write_page(figures: Sequence[Figure], path: Path, quick: bool) -> None:
    """One section a figure, the plots referred to relative to the page."""
    parts = [_INTRODUCTION]
    if quick:
        parts.append("**Made with `--quick`: small node clouds, numbers for orientation only.**\n")
    parts.append("## In short\n")
    parts.append("\n".join(f"- {f.headline} (figure {f.number})" for f in figures if f.headline) + "\n")
    for figure in figures:
        whose = (
            f"Figure {figure.number}"
            if figure.number in _PAPER
            else f"Beyond the paper: figure {figure.number}"
        )
        parts.append(f"## {whose}. {figure.title}\n")
        if figure.number in _PAPER:
            parts.append(f"*The paper:* {_PAPER[figure.number]}\n")
        parts.append(f"![{figure.title}](images/paper/{figure.stem}.png)\n")
        parts.append(f"{figure.findings}\n")
    write_atomically(path, "\n".join(parts).encode())
