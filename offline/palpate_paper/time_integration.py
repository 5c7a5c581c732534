"""Full-order time integration as in BaniHani & De 2009: Newmark's method with the recursion for the internal variables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import block_array, csc_array, csr_array, diags_array, eye_array, kron
from scipy.sparse.linalg import splu

from palpate.discretization.assembled_body import AssembledBody
from palpate.discretization.supports import components
from palpate.scene.material import PronySeries

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EquationsOfMotion:
    """A semi-discrete model, sparse: mass x'' + elastic w + algebraic x = driving u, with w the viscoelastic image of x.

    w = x + sum_j gamma_j z_j with the internal variables z_j, dz_j/dt = -z_j / tau_j + dx/dt (Eq. 7-9). The unknowns x are
    the parameters of the displacement, and the forces that hold the prescribed nodal values.

    mass, elastic, algebraic  (n, n); rows of zeros in mass are constraints and forces
    driving                   (n, n_inputs), by the displacements of the tips, m
    force                     (n_inputs, n), force on the tips, N = force x
    value                     (n_components n_nodes, n), nodal displacements = value x, components of node 0 first
    """

    mass: csr_array
    elastic: csr_array
    algebraic: csr_array
    driving: csr_array
    force: csr_array
    value: csr_array


def equations_of_motion(body: AssembledBody) -> EquationsOfMotion:
    """The equations of an assembled body. As in the modal model, held and driven nodes carry no mass."""
    c, held = body.n_components, body.supports
    identity = np.eye(c)
    value = csr_array(kron(body.basis.value, identity))
    test = value if body.symmetric else csr_array(eye_array(value.shape[0]))
    nodal_mass = np.zeros(body.n_nodes)
    nodal_mass[held.free] = body.mass[held.free]
    return with_multipliers(
        csr_array(test.T @ diags_array(np.repeat(nodal_mass, c)) @ value),
        body.stiffness,
        value,
        test,
        components(held.prescribed, c),
        csr_array(kron(held.tips, identity)),
    )


def with_multipliers(
    mass: csr_array,
    stiffness: csr_array,
    value: csr_array,
    test: csr_array,
    prescribed: NDArray[np.int64],
    tips: csr_array,
) -> EquationsOfMotion:
    """A model whose prescribed nodal values are held by multipliers, which are the reaction forces in newton.

    mass, stiffness (n, n) act on parameters U. value (n_values, n) U are the nodal values; those with the indices
    `prescribed` equal tips (n_values, n_inputs) times the input. test (n_values, n) weights the forces f at the nodal
    values: mass U'' + stiffness W = test^T f.
    """
    held, driven = csr_array(value[prescribed]), csr_array(tips[prescribed])
    n, m, n_inputs = stiffness.shape[0], len(prescribed), tips.shape[1]
    empty = csr_array((m, m))
    return EquationsOfMotion(
        mass=csr_array(block_array([[mass, None], [None, empty]])),
        elastic=csr_array(block_array([[stiffness, None], [None, empty]])),
        algebraic=csr_array(
            block_array([[csr_array((n, n)), -csr_array(test[prescribed].T)], [held, empty]])
        ),
        driving=csr_array(block_array([[csr_array((n, n_inputs))], [driven]])),
        force=csr_array(block_array([[csr_array((n_inputs, n)), driven.T]])),
        value=csr_array(block_array([[value, csr_array((value.shape[0], m))]])),
    )


@dataclass(frozen=True)
class TimeHistory:
    """forces (n_samples, n_inputs), N; displacements (n_samples, n_observed), m, at the observed nodal values."""

    forces: Array
    displacements: Array


def newmark(
    equations: EquationsOfMotion,
    prony: PronySeries,
    inputs: Array,
    period_s: float,
    *,
    observed: ArrayLike | Sequence[int] = (),
) -> TimeHistory:
    """Newmark's average acceleration (beta 1/4, gamma 1/2), one factorization, second order in the step.

    The stress memories follow Eq. 24: q_j+ = e^(-dt/tau_j) q_j + gamma_j Q_j (sigma_0+ - sigma_0) with
    Q_j = (1 - e^(-dt/tau_j)) / (dt/tau_j), so the step solves (4/dt² mass + (1 + sum gamma_j Q_j) elastic + algebraic).

    inputs    (n_samples, n_inputs), m, period_s apart; the body is at rest one period before the first sample
    observed  indices of nodal values (rows of equations.value) whose displacement is returned

    Raises ValueError when shapes do not match or inputs are not finite.
    """
    inputs = np.asarray(inputs, dtype=np.float64)
    n_inputs = equations.driving.shape[1]
    if inputs.ndim != 2 or inputs.shape[1] != n_inputs or not np.all(np.isfinite(inputs)):
        raise ValueError(f"inputs has shape {inputs.shape}: expected (n_samples, {n_inputs}) finite numbers")
    if not (np.isfinite(period_s) and period_s > 0):
        raise ValueError(f"period_s = {period_s}: expected a time above 0")
    rows = np.asarray(observed, dtype=np.int64)
    n_values = equations.value.shape[0]
    outside = (rows < 0) | (rows >= n_values)
    if np.any(outside):
        raise ValueError(f"observed = {rows[outside].tolist()}: expected indices from 0 to {n_values - 1}")
    watch = equations.value[rows]
    mass, elastic = equations.mass, equations.elastic
    n = elastic.shape[0]
    ratio = period_s / np.array(prony.tau_s)
    decay, gain = np.exp(-ratio), np.array(prony.gamma) * -np.expm1(-ratio) / ratio
    inertia = 4 / period_s**2
    factor = splu(csc_array(inertia * mass + (1 + gain.sum()) * elastic + equations.algebraic))

    x, velocity, acceleration = np.zeros(n), np.zeros(n), np.zeros(n)
    stress: Array = np.zeros(n)
    memory = np.zeros((len(gain), n))
    forces = np.empty_like(inputs)
    displacements = np.empty((len(inputs), watch.shape[0]))
    for i, u in enumerate(inputs):
        faded = decay[:, None] * memory
        right = equations.driving @ u + mass @ (inertia * (x + period_s * velocity) + acceleration)
        right -= faded.sum(axis=0) - gain.sum() * stress
        following = factor.solve(right)
        step = following - x
        acceleration = inertia * (step - period_s * velocity) - acceleration
        velocity = 2 / period_s * step - velocity
        x = following
        stress_next: Array = elastic @ x
        memory = faded + gain[:, None] * (stress_next - stress)
        stress = stress_next
        forces[i] = equations.force @ x
        displacements[i] = watch @ x
    return TimeHistory(forces, displacements)
