"""A body that takes forces at points of its surface and gives their displacements: modes, and the compliance they leave out.

    u = sum_k phi_k (phi_k . f) / (s² + omega_k² h) + R f / h,   h(s) = 1 + sum_j gamma_j s tau_j / (1 + s tau_j)

The modes are stepped by the implicit midpoint rule with the force held over the tick, so that the change of their energy plus
what they dissipate is the work of the force exactly. Each frequency is prewarped, omega_eff = (2/T) tan(omega T / 2), and its
shape scaled by omega_eff / omega, which keeps resonance and static compliance. The residual R has no mass: f = h y, u = R y by
backward Euler, which takes at least the energy it stores.

The step of the residual is the same combination of y, its memories z_j and f at all points. So R y and R z_j need no product
with R where they are followed from tick to tick: at the *watched* points. Elsewhere R y follows from y when it is asked for.
In the same way the energies in R follow from the products of y and z_j under R alone, a small matrix (`gram`).

A tick: `predict`, `place` for the watched points of interest, `begin_load` and `add_load` for each force, `finish_load`, `commit`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.model_file import SurfaceModel
from palpate_server.bodies.state_space import aligned
from palpate_server.realtime.compiled import compiled
from palpate_server.realtime.dot import FLOAT32_LANES, dot

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Integers = NDArray[np.int64]

_TINY = 1e-150  # smaller states are set to zero: denormal numbers are slow
NOBODY = -1

# Elements of ElasticSurface.energy, J
STORED, WORK, FREE_WORK, SELF_WORK = range(4)


class ElasticSurface(NamedTuple):
    """m points, r modes (rounded up to FLOAT32_LANES), t Prony terms, n slots of watched points, g groups of forces (one a tool).

    Constants
    period_s   (1,)
    squared, gain  (r,): omega_eff², and the change of a modal coordinate under a unit modal force in one tick
    shapes     (3 m, r), phi_eff; residual (3 m, 3 m), R; compliance (3 m, 3 m), m/N: displacement after one tick under a unit force
    gamma, kappa, alpha  (t,): gamma_j, T / 2 tau_j, 1 / (1 + T / tau_j)
    instant    (1,), y after one tick under a unit force
    transition (1 + t, 1 + t), injection (1 + t,): one step of (y, z_1, ...) under a force

    State
    q, v (r,), z (t, r): modal coordinates, velocities, memories
    y    (1 + t, 3 m): y and its memories; y[0] is what R acts on
    gram (1 + t, 1 + t): their products under R
    force (3 m,), N, and modal_force (r,): held over the last tick
    watched (n,): point of each slot, or NOBODY; images (1 + t, n, 3): R y and R z_j there; image_of_force (n, 3): R f
    energy (4,): stored in the body; work done on it by all forces since rest; and of the present load, see `finish_load`

    Of one tick
    free, hold (r,): change of q without a force, and under the force of the tick before; q_single, hold_single (r,): float32
    displacement, step (n, 3), m: of watched points at the start of the tick, and its change under the force of the tick before
    loaded (n,), n_loaded (1,), loads (n, 3), group (n,): slots with a force, N, and whose it is
    new_image (n, 3): R f of the present load; group_force (g, r): phi f; group_work (g,), J: of the last tick
    products (2, 1 + t), following (3 m,), weighted (r,): scratch
    """

    period_s: Floats
    squared: Floats
    gain: Floats
    shapes: Singles
    residual: Singles
    compliance: Singles
    gamma: Floats
    kappa: Floats
    alpha: Floats
    instant: Floats
    transition: Floats
    injection: Floats
    q: Floats
    v: Floats
    z: Floats
    y: Floats
    gram: Floats
    force: Floats
    modal_force: Floats
    watched: Integers
    images: Floats
    image_of_force: Floats
    energy: Floats
    free: Floats
    hold: Floats
    q_single: Singles
    hold_single: Singles
    displacement: Floats
    step: Floats
    loaded: Integers
    n_loaded: Integers
    loads: Floats
    group: Integers
    new_image: Floats
    group_force: Floats
    group_work: Floats
    products: Floats
    following: Floats
    weighted: Floats


STATE = (
    "q", "v", "z", "y", "gram", "force", "modal_force", "watched", "images", "image_of_force", "energy",
    "displacement", "step",
)  # fmt: skip
"""What a tick leaves to the next one."""


def make_body(model: SurfaceModel, n_slots: int, n_groups: int) -> ElasticSurface:
    """The body at rest, sampled with the model's period, with nothing watched.

    Raises ValueError for a mode at or above half the sampling rate.
    """
    period, gamma, tau = model.period_s, model.gamma, model.tau_s
    r, t, m3 = model.n_modes, len(gamma), 3 * model.n_points
    frequency = np.sqrt(model.squared_frequencies)
    if np.any(frequency * period >= np.pi):
        raise ValueError(
            f"squared_frequencies: a mode of {frequency.max() / (2 * np.pi):.6g} Hz is not below half the "
            f"sampling rate, {0.5 / period:.6g} Hz"
        )
    effective = 2 / period * np.tan(frequency * period / 2)
    # Modes that nothing drives fill the last lanes of `dot`.
    padding = -r % FLOAT32_LANES
    kappa, alpha = period / (2 * tau), 1 / (1 + period / tau)
    gain = 1 / (2 / period**2 + effective**2 / 2 * (1 + np.sum(gamma / (1 + kappa))))
    shapes = np.asarray(model.shapes, float).reshape(m3, r) * (effective / frequency)
    shapes = np.pad(shapes, ((0, 0), (0, padding)))
    squared, gain, r = np.pad(effective**2, (0, padding)), np.pad(gain, (0, padding)), r + padding
    instant = 1 / (1 + np.sum(gamma * alpha))
    transition, injection = _residual_step(gamma, alpha, instant)
    shapes_single = np.ascontiguousarray(shapes, dtype=np.float32)
    return ElasticSurface(
        period_s=np.array([period]),
        squared=aligned(squared),
        gain=aligned(gain),
        shapes=shapes_single,
        residual=np.require(model.residual, np.float32, ["C", "W"]),
        compliance=one_tick_compliance(shapes_single, gain, model.residual, instant),
        gamma=np.array(gamma),
        kappa=kappa,
        alpha=alpha,
        instant=np.array([instant]),
        transition=transition,
        injection=injection,
        q=aligned(np.zeros(r)),
        v=aligned(np.zeros(r)),
        z=aligned(np.zeros((t, r))),
        y=aligned(np.zeros((1 + t, m3))),
        gram=np.zeros((1 + t, 1 + t)),
        force=np.zeros(m3),
        modal_force=aligned(np.zeros(r)),
        watched=np.full(n_slots, NOBODY),
        images=np.zeros((1 + t, n_slots, 3)),
        image_of_force=np.zeros((n_slots, 3)),
        energy=np.zeros(4),
        free=aligned(np.zeros(r)),
        hold=aligned(np.zeros(r)),
        q_single=np.zeros(r, np.float32),
        hold_single=np.zeros(r, np.float32),
        displacement=np.zeros((n_slots, 3)),
        step=np.zeros((n_slots, 3)),
        loaded=np.zeros(n_slots, np.int64),
        n_loaded=np.zeros(1, np.int64),
        loads=np.zeros((n_slots, 3)),
        group=np.zeros(n_slots, np.int64),
        new_image=np.zeros((n_slots, 3)),
        group_force=aligned(np.zeros((n_groups, r))),
        group_work=np.zeros(n_groups),
        products=np.zeros((2, 1 + t)),
        following=aligned(np.zeros(m3)),
        weighted=aligned(np.zeros(r)),
    )


def _residual_step(gamma: Floats, alpha: Floats, instant: float) -> tuple[Floats, Floats]:
    """(1 + t, 1 + t) and (1 + t,): (y, z_1, ...) after a tick, from those before it and from the force."""
    t = len(gamma)
    y = np.concatenate([[np.sum(gamma * alpha)], -gamma * alpha]) * instant
    transition = np.vstack([y, alpha[:, None] * (y - np.eye(1 + t)[0] + np.eye(1 + t)[1:])])
    return transition, instant * np.concatenate([[1.0], alpha])


def one_tick_compliance(shapes: Singles, gain: Floats, residual: Singles, instant: float) -> Singles:
    """(3 m, 3 m), m/N: sum_k phi_k b_k phi_k^T + y_0 R, the displacements one tick after unit forces, in float32."""
    scaled = shapes * np.sqrt(gain).astype(np.float32)
    compliance = scaled @ scaled.T
    compliance += np.float32(instant) * residual
    return np.ascontiguousarray(compliance)


@compiled
def put_to_rest(body: ElasticSurface) -> None:
    """Put all state to zero, and watch nothing."""
    for k in range(body.q.size):
        body.q[k] = body.v[k] = body.modal_force[k] = 0.0
        for j in range(body.gamma.size):
            body.z[j, k] = 0.0
    for i in range(body.force.size):
        body.force[i] = 0.0
        for j in range(body.y.shape[0]):
            body.y[j, i] = 0.0
    for j in range(body.gram.shape[0]):
        for k in range(body.gram.shape[0]):
            body.gram[j, k] = 0.0
    for slot in range(body.watched.size):
        forget(body, slot)
    for i in range(body.energy.size):
        body.energy[i] = 0.0


@compiled
def predict(body: ElasticSurface) -> None:
    """Compute how the modal coordinates change in this tick without a force, and under the force of the tick before."""
    q, v, z, free, hold = body.q, body.v, body.z, body.free, body.hold
    squared, gain, modal_force = body.squared, body.gain, body.modal_force
    q_single, hold_single = body.q_single, body.hold_single
    rate = 2.0 / body.period_s[0]
    for k in range(q.size):
        free[k] = q[k]
    for j in range(z.shape[0]):
        weight = body.gamma[j] / (1.0 + body.kappa[j])
        z_j = z[j]
        for k in range(q.size):
            free[k] += weight * z_j[k]
    for k in range(q.size):
        free[k] = gain[k] * (rate * v[k] - squared[k] * free[k])
        hold[k] = free[k] + gain[k] * modal_force[k]
        q_single[k] = q[k]
        hold_single[k] = hold[k]


@compiled
def watch(body: ElasticSurface, slot: int, point: int) -> None:
    """Follow a point in a slot. Costs 3 (2 + t) products of 3 m numbers."""
    body.watched[slot] = point
    for c in range(3):
        row = body.residual[3 * point + c]
        for j in range(body.y.shape[0]):
            body.images[j, slot, c] = dot(row, body.y[j])
        body.image_of_force[slot, c] = dot(row, body.force)


@compiled
def forget(body: ElasticSurface, slot: int) -> None:
    """Empty a slot."""
    body.watched[slot] = NOBODY
    for c in range(3):
        body.image_of_force[slot, c] = body.displacement[slot, c] = body.step[slot, c] = 0.0
        for j in range(body.images.shape[0]):
            body.images[j, slot, c] = 0.0


@compiled
def place(body: ElasticSurface, slot: int) -> None:
    """Write a watched point's displacement, and its step in this tick if the force of the tick before stays."""
    point = body.watched[slot]
    for c in range(3):
        row = body.shapes[3 * point + c]
        image = body.images[0, slot, c]
        body.displacement[slot, c] = dot(row, body.q_single) + image
        following = _free_image(body, slot, c) + body.injection[0] * body.image_of_force[slot, c]
        body.step[slot, c] = dot(row, body.hold_single) + following - image


@compiled
def _free_image(body: ElasticSurface, slot: int, c: int) -> float:
    """R y after this tick without a force."""
    following = 0.0
    for j in range(body.images.shape[0]):
        following += body.transition[0, j] * body.images[j, slot, c]
    return following


@compiled
def begin_load(body: ElasticSurface) -> None:
    """Start the load of this tick: no force."""
    body.n_loaded[0] = 0
    for g in range(body.group_force.shape[0]):
        total = body.group_force[g]
        for k in range(total.size):
            total[k] = 0.0


@compiled
def add_load(body: ElasticSurface, group: int, slot: int, x: float, y: float, z: float) -> None:
    """Add a force, N, at a watched point; at most one a slot."""
    n = body.n_loaded[0]
    body.loaded[n], body.group[n] = slot, group
    body.loads[n, 0], body.loads[n, 1], body.loads[n, 2] = x, y, z
    body.n_loaded[0] = n + 1
    first, total = 3 * body.watched[slot], body.group_force[group]
    rows_x, rows_y, rows_z = body.shapes[first], body.shapes[first + 1], body.shapes[first + 2]
    for k in range(total.size):
        total[k] += x * rows_x[k] + y * rows_y[k] + z * rows_z[k]


@compiled
def finish_load(body: ElasticSurface) -> None:
    """Write the work of the load over this tick into energy: a FREE_WORK + a² SELF_WORK if it is scaled by a."""
    _images_of_load(body)
    modal_force, group_force = body.modal_force, body.group_force
    gain, free = body.gain, body.free
    for k in range(modal_force.size):
        modal_force[k] = 0.0
    free_work, self_work = 0.0, 0.0
    for g in range(group_force.shape[0]):
        total = group_force[g]
        for k in range(modal_force.size):
            modal_force[k] += total[k]
    free_work += dot(modal_force, free)
    weighted = body.weighted
    for k in range(modal_force.size):
        weighted[k] = gain[k] * modal_force[k]
    self_work += dot(weighted, modal_force)
    for n in range(body.n_loaded[0]):
        slot = body.loaded[n]
        for c in range(3):
            free_work += body.loads[n, c] * (_free_image(body, slot, c) - body.images[0, slot, c])
            self_work += body.loads[n, c] * body.injection[0] * body.new_image[slot, c]
    body.energy[FREE_WORK], body.energy[SELF_WORK] = free_work, self_work


@compiled
def _images_of_load(body: ElasticSurface) -> None:
    """Write R f of the load at every watched point."""
    residual, watched, new_image = body.residual, body.watched, body.new_image
    for slot in range(watched.size):
        new_image[slot, 0] = new_image[slot, 1] = new_image[slot, 2] = 0.0
    for n in range(body.n_loaded[0]):
        first = 3 * watched[body.loaded[n]]
        f0, f1, f2 = body.loads[n, 0], body.loads[n, 1], body.loads[n, 2]
        row_x, row_y, row_z = residual[first], residual[first + 1], residual[first + 2]
        for slot in range(watched.size):
            i = 3 * max(watched[slot], 0)
            new_image[slot, 0] += f0 * row_x[i] + f1 * row_y[i] + f2 * row_z[i]
            new_image[slot, 1] += f0 * row_x[i + 1] + f1 * row_y[i + 1] + f2 * row_z[i + 1]
            new_image[slot, 2] += f0 * row_x[i + 2] + f1 * row_y[i + 2] + f2 * row_z[i + 2]


@compiled
def commit(body: ElasticSurface, share: float) -> None:
    """Advance the body by one tick under `share` times the load, which is held over the tick."""
    _count_work(body, share)
    _advance_gram(body, share)
    _advance_modes(body)
    _advance_residual(body, share)
    _advance_images(body, share)
    body.energy[STORED] = stored_energy(body)


@compiled
def _count_work(body: ElasticSurface, share: float) -> None:
    """The work of each group over the tick, J."""
    hold, group_work = body.hold, body.group_work
    for k in range(hold.size):
        body.modal_force[k] *= share
        hold[k] = body.free[k] + body.gain[k] * body.modal_force[k]
    for g in range(group_work.size):
        group_work[g] = share * dot(body.group_force[g], hold)
    for n in range(body.n_loaded[0]):
        slot = body.loaded[n]
        for c in range(3):
            following = _free_image(body, slot, c) + share * body.injection[0] * body.new_image[slot, c]
            moved = following - body.images[0, slot, c]
            group_work[body.group[n]] += share * body.loads[n, c] * moved
    for g in range(group_work.size):
        body.energy[WORK] += group_work[g]


@compiled
def _advance_gram(body: ElasticSurface, share: float) -> None:
    """The products of (y, z_1, ...) under R after the tick: V+ = A V + B f, so G+ = A G A^T + A h B^T + B h^T A^T + B B^T f.Rf."""
    gram, a, b = body.gram, body.transition, body.injection
    with_force, driven = body.products[0], body.products[1]
    n = gram.shape[0]
    own = 0.0
    for j in range(n):
        with_force[j] = 0.0
    for k in range(body.n_loaded[0]):
        slot = body.loaded[k]
        for c in range(3):
            force = share * body.loads[k, c]
            own += force * share * body.new_image[slot, c]
            for j in range(n):
                with_force[j] += force * body.images[j, slot, c]
    for i in range(n):
        driven[i] = 0.0
        for j in range(n):
            driven[i] += a[i, j] * with_force[j]
    for column in range(n):  # A G, in place
        for i in range(n):
            with_force[i] = gram[i, column]
        for i in range(n):
            gram[i, column] = 0.0
            for j in range(n):
                gram[i, column] += a[i, j] * with_force[j]
    for row in range(n):  # (A G) A^T, in place
        for i in range(n):
            with_force[i] = gram[row, i]
        for i in range(n):
            gram[row, i] = driven[row] * b[i] + b[row] * driven[i] + b[row] * b[i] * own
            for j in range(n):
                gram[row, i] += with_force[j] * a[i, j]


@compiled
def _advance_modes(body: ElasticSurface) -> None:
    q, v, z, hold = body.q, body.v, body.z, body.hold
    rate = 2.0 / body.period_s[0]
    for k in range(q.size):
        q_k, v_k = q[k] + hold[k], rate * hold[k] - v[k]
        q[k] = 0.0 if abs(q_k) < _TINY else q_k
        v[k] = 0.0 if abs(v_k) < _TINY else v_k
    for j in range(z.shape[0]):
        z_j, kappa = z[j], body.kappa[j]
        for k in range(q.size):
            following = ((1.0 - kappa) * z_j[k] + hold[k]) / (1.0 + kappa)
            z_j[k] = 0.0 if abs(following) < _TINY else following


@compiled
def _advance_residual(body: ElasticSurface, share: float) -> None:
    y, force, instant = body.y[0], body.force, body.instant[0]
    for i in range(force.size):
        force[i] = 0.0
    for n in range(body.n_loaded[0]):
        first = 3 * body.watched[body.loaded[n]]
        for c in range(3):
            force[first + c] += share * body.loads[n, c]
    # y+ is written into `y` last: the memories take y+ - y.
    weight = body.transition[0, 0]
    following = body.following
    for i in range(y.size):
        following[i] = weight * y[i] + instant * force[i]
    for j in range(1, body.y.shape[0]):
        z, weight = body.y[j], body.transition[0, j]
        for i in range(y.size):
            following[i] += weight * z[i]
    for j in range(1, body.y.shape[0]):
        z, alpha = body.y[j], body.alpha[j - 1]
        for i in range(y.size):
            z_i = alpha * (z[i] + following[i] - y[i])
            z[i] = 0.0 if abs(z_i) < _TINY else z_i
    for i in range(y.size):
        y[i] = 0.0 if abs(following[i]) < _TINY else following[i]


@compiled
def _advance_images(body: ElasticSurface, share: float) -> None:
    images, alpha = body.images, body.alpha
    for slot in range(body.watched.size):
        if body.watched[slot] == NOBODY:
            continue
        for c in range(3):
            image = share * body.new_image[slot, c]
            body.image_of_force[slot, c] = image
            following = _free_image(body, slot, c) + body.injection[0] * image
            change = following - images[0, slot, c]
            for j in range(1, images.shape[0]):
                images[j, slot, c] = alpha[j - 1] * (images[j, slot, c] + change)
            images[0, slot, c] = following


@compiled
def stored_energy(body: ElasticSurface) -> float:
    """J, in modes and residual: kinetic, and elastic with the springs of the memory."""
    q, v, squared = body.q, body.v, body.squared
    energy = 0.5 * body.gram[0, 0] + 0.5 * dot(v, v)
    for j in range(body.gamma.size):
        energy += 0.5 * body.gamma[j] * body.gram[1 + j, 1 + j]
    weighted = body.weighted
    for k in range(q.size):
        weighted[k] = squared[k] * q[k]
    energy += 0.5 * dot(weighted, q)
    for j in range(body.gamma.size):
        z_j = body.z[j]
        for k in range(q.size):
            weighted[k] = squared[k] * z_j[k]
        energy += 0.5 * body.gamma[j] * dot(weighted, z_j)
    return energy
