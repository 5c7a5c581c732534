"""The forces between rigid spheres and the points they touch in one tick: unilateral, with friction, and bonds.

A *row* is a point in contact with one tool, with the inward normal n of the tissue and the tilt e of the sphere against it. Its force f
on the tissue has the normal part lambda = n . f and the tangential part t. The tool feels M f, M = 1 + e n^T: a side force where the
sphere slopes. With the relative displacement of this tick, r = (u+ - u) - M^T (c+ - c),

    lambda >= -bond   and   n . r >= -slack, one of them with equality;  slack = max(gap, 0)
    |t| <= mu max(lambda, 0) + bond;  r tangential is zero, or opposite to t at the limit.

So a row never takes energy from the tissue: a gap that was open may close, what penetrates may not penetrate more, and a gap is
never closed beyond that (complementary to min(0, gap), not to 0). A bond is what a grip holds: above all forces while the tool
is attached, none without.

r is linear in the forces: A f, the displacement of the tissue after one tick, and M^T times how far each sphere moves on its
coupling spring under the sum of M f. The rows are solved in turns, by projection (Gauss-Seidel), from the forces of the tick before.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_server.realtime.compiled import compiled

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

TOLERANCE = 1e-6
"""Of the largest force: sweeps end when no force changes by more."""

_TANGENTIAL_STEP = 1.9
"""Over the trace of a tangential block, which is not below its largest eigenvalue: converges below 2 / eigenvalue."""


class Rows(NamedTuple):
    """Up to n rows; those of one tick are the first n_rows[0].

    n_rows  (1,); slot, tool (n,): of each row; fixed (n,): 1 where the force is given, not solved
    normal, tilt  (n, 3); slack (n,), m; friction (n,), bond (n,), N
    force   (n, 3), N: before the tick, then solved
    slip    (3 n,), m: r, but for the springs; with them after `solve`
    matrix  (9 n²,), m/N: A, of the first 3 n_rows[0] rows and columns
    spring  (n_tools,), m/N; more (n_tools, 3), N: what each tool feels by M f more than in the tick before
    sweeps  (2,): how many are allowed, and were made
    """

    n_rows: Integers
    slot: Integers
    tool: Integers
    fixed: Integers
    normal: Floats
    tilt: Floats
    slack: Floats
    friction: Floats
    bond: Floats
    force: Floats
    slip: Floats
    matrix: Floats
    spring: Floats
    more: Floats
    sweeps: Integers


def make_rows(n: int, n_tools: int, sweeps: int) -> Rows:
    """Room for n rows."""
    return Rows(
        n_rows=np.zeros(1, np.int64),
        slot=np.zeros(n, np.int64),
        tool=np.zeros(n, np.int64),
        fixed=np.zeros(n, np.int64),
        normal=np.zeros((n, 3)),
        tilt=np.zeros((n, 3)),
        slack=np.zeros(n),
        friction=np.zeros(n),
        bond=np.zeros(n),
        force=np.zeros((n, 3)),
        slip=np.zeros(3 * n),
        matrix=np.zeros(9 * n * n),
        spring=np.zeros(n_tools),
        more=np.zeros((n_tools, 3)),
        sweeps=np.array([sweeps, 0]),
    )


@compiled
def release_fixed(rows: Rows) -> None:
    """Take the force off the rows whose force is given: zero."""
    for i in range(rows.n_rows[0]):
        if rows.fixed[i]:
            _change(rows, i, -rows.force[i, 0], -rows.force[i, 1], -rows.force[i, 2])


@compiled
def solve(rows: Rows) -> None:
    """Sweep over the rows until their forces stay, or the sweeps are used up."""
    release_fixed(rows)
    sweep = 0
    while sweep < rows.sweeps[0]:
        sweep += 1
        largest, change = 0.0, 0.0
        for i in range(rows.n_rows[0]):
            if not rows.fixed[i]:
                change = max(change, _solve_row(rows, i))
                for c in range(3):
                    largest = max(largest, abs(rows.force[i, c]))
        if change <= TOLERANCE * largest:
            break
    rows.sweeps[1] = sweep
    for i in range(rows.n_rows[0]):
        x, y, z = _on_spring(rows, i)
        rows.slip[3 * i] += x
        rows.slip[3 * i + 1] += y
        rows.slip[3 * i + 2] += z


@compiled
def _on_spring(rows: Rows, i: int) -> tuple[float, float, float]:
    """What a row's tool adds to its slip by moving on its spring, m."""
    more, normal, tilt, spring = (
        rows.more[rows.tool[i]],
        rows.normal[i],
        rows.tilt[i],
        rows.spring[rows.tool[i]],
    )
    tilted = tilt[0] * more[0] + tilt[1] * more[1] + tilt[2] * more[2]
    return (
        spring * (more[0] + tilted * normal[0]),
        spring * (more[1] + tilted * normal[1]),
        spring * (more[2] + tilted * normal[2]),
    )


@compiled
def _solve_row(rows: Rows, i: int) -> float:
    """Solve one row, the others' forces held. Returns the largest change of a component of its force, N."""
    force, slip, matrix, size = rows.force, rows.slip, rows.matrix, 3 * rows.n_rows[0]
    first = 3 * i
    a = first * size + first
    n0, n1, n2 = rows.normal[i, 0], rows.normal[i, 1], rows.normal[i, 2]
    bond = rows.bond[i]
    tilt, spring = rows.tilt[i], rows.spring[rows.tool[i]]
    x, y, z = _on_spring(rows, i)
    x, y, z = x + slip[first], y + slip[first + 1], z + slip[first + 2]
    # A n + M^T M n, of the row's own block: M n = n + e, and e is across n
    an0 = matrix[a] * n0 + matrix[a + 1] * n1 + matrix[a + 2] * n2
    an1 = matrix[a + size] * n0 + matrix[a + size + 1] * n1 + matrix[a + size + 2] * n2
    an2 = matrix[a + 2 * size] * n0 + matrix[a + 2 * size + 1] * n1 + matrix[a + 2 * size + 2] * n2
    steep = 1.0 + tilt[0] * tilt[0] + tilt[1] * tilt[1] + tilt[2] * tilt[2]
    an0 += spring * (steep * n0 + tilt[0])
    an1 += spring * (steep * n1 + tilt[1])
    an2 += spring * (steep * n2 + tilt[2])
    normal_compliance = n0 * an0 + n1 * an1 + n2 * an2
    trace = matrix[a] + matrix[a + size + 1] + matrix[a + 2 * size + 2] + spring * (2.0 + steep)

    approach = n0 * x + n1 * y + n2 * z
    before = n0 * force[i, 0] + n1 * force[i, 1] + n2 * force[i, 2]
    normal = max(-bond, before - (approach + rows.slack[i]) / normal_compliance)
    change = normal - before
    # Slip after the normal part, its tangential part, and the tangential force that would stop it
    s0, s1, s2 = x + an0 * change, y + an1 * change, z + an2 * change
    along = n0 * s0 + n1 * s1 + n2 * s2
    step = _TANGENTIAL_STEP / (trace - normal_compliance)
    t0 = force[i, 0] - before * n0 - step * (s0 - along * n0)
    t1 = force[i, 1] - before * n1 - step * (s1 - along * n1)
    t2 = force[i, 2] - before * n2 - step * (s2 - along * n2)
    length = math.sqrt(t0 * t0 + t1 * t1 + t2 * t2)
    limit = rows.friction[i] * max(normal, 0.0) + bond
    if length > limit:
        scale = limit / length
        t0, t1, t2 = t0 * scale, t1 * scale, t2 * scale
    d0, d1, d2 = (
        normal * n0 + t0 - force[i, 0],
        normal * n1 + t1 - force[i, 1],
        normal * n2 + t2 - force[i, 2],
    )
    if d0 != 0.0 or d1 != 0.0 or d2 != 0.0:
        _change(rows, i, d0, d1, d2)
    return max(abs(d0), abs(d1), abs(d2))


@compiled
def _change(rows: Rows, i: int, x: float, y: float, z: float) -> None:
    """Add to a row's force, and to all rows' slip what that does."""
    rows.force[i, 0] += x
    rows.force[i, 1] += y
    rows.force[i, 2] += z
    more, normal, tilt = rows.more[rows.tool[i]], rows.normal[i], rows.tilt[i]
    pressing = normal[0] * x + normal[1] * y + normal[2] * z
    more[0] += x + pressing * tilt[0]
    more[1] += y + pressing * tilt[1]
    more[2] += z + pressing * tilt[2]
    size = 3 * rows.n_rows[0]
    row = 3 * i * size
    slip = rows.slip[:size]
    row_x = rows.matrix[row : row + size]
    row_y = rows.matrix[row + size : row + 2 * size]
    row_z = rows.matrix[row + 2 * size : row + 3 * size]
    for k in range(size):
        slip[k] += x * row_x[k] + y * row_y[k] + z * row_z[k]
