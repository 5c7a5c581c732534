"""Which modes a body gets, and the memory they are said to need."""

import numpy as np
import pytest

from palpate.discretization import conservative
from palpate.geometry.shapes import box_lattice
from palpate.modes import body_modes as module
from palpate.modes.body_modes import body_modes, by_ritz, require_memory
from palpate.scene.material import PRESETS


def test_small_bodies_and_collocated_ones_get_all_modes():
    assert not by_ritz(2000, symmetric=True)
    assert by_ritz(2001, symmetric=True)
    assert not by_ritz(2001, symmetric=False)


def test_both_kinds_of_modes_of_one_body_have_the_same_statics(monkeypatch):
    cloud = box_lattice((0, 0, 0), (0.05, 0.05, 0.03), (6, 6, 4), 0.1, seed=1)
    top = np.flatnonzero(
        (cloud.points[:, 2] == 0.03) & (np.abs(cloud.points[:, :2] - 0.025).max(axis=1) < 0.01)
    )
    bottom = np.flatnonzero(cloud.points[:, 2] == 0)
    liver = PRESETS["liver"]
    body = conservative.assemble(cloud, liver, bottom, [top])
    full = body_modes(body, liver.prony, 30.0)
    monkeypatch.setattr(module, "ALL_MODES_UP_TO", 0)
    ritz = body_modes(body, liver.prony, 30.0)
    assert (full.change, full.solver) == (0.0, "LAPACK")
    assert ritz.change <= module.TOLERANCE
    np.testing.assert_allclose(ritz.modes.static_stiffness, full.modes.static_stiffness, rtol=1e-8)


@pytest.mark.parametrize(
    ("n_nodes", "symmetric", "kind"), [(1500, True, "all"), (3000, True, "Ritz"), (3000, False, "all")]
)
def test_a_cloud_too_large_for_the_machine_is_refused_with_the_memory_it_would_take(
    monkeypatch, n_nodes, symmetric, kind
):
    monkeypatch.setattr("os.sysconf", lambda name: 1024)
    with pytest.raises(
        MemoryError, match=rf"{kind} modes of {n_nodes:,} nodes need about \d+\.\d GiB, this machine has 0.0"
    ):
        require_memory(n_nodes, n_nodes - 100, 1, symmetric, 2.2)
