"""The reductions on whole bodies: the paper's cube with 8,067 states and the shipped liver."""

from pathlib import Path

import numpy as np
import pytest

from palpate.build import build_model
from palpate.discretization import collocation, conservative
from palpate.geometry.shapes import box_lattice
from palpate.lti.frequencies import band_frequencies
from palpate.lti.pole_residue import PoleResidueSystem
from palpate.lti.viscoelastic import viscoelastic_system
from palpate.modes.dense import elastic_modes
from palpate.reduction import reduce
from palpate.reduction.accuracy import hinf_error, in_band_error
from palpate.reduction.balancing import balance
from palpate.reduction.gramians import gramians, real_form
from palpate.scene.schema import check_config, load_config
from palpate.scene.tissues import PRESETS


def cube(n, discretization):
    """The paper's section 4.2: bottom fixed, a tip of the nodes around the top center."""
    cloud = box_lattice((0, 0, 0), (1, 1, 1), (n, n, n))
    material = PRESETS["paper-cube"]
    bottom = np.flatnonzero(cloud.points[:, 2] < 1e-9)
    distance = np.linalg.norm(cloud.points - (0.5, 0.5, 1.0), axis=1)
    tip = np.flatnonzero(distance < 0.75 / (n - 1))
    modes = elastic_modes(discretization.assemble(cloud, material, bottom, [tip]))
    return modes, viscoelastic_system(modes, material.prony)


def static_error(full, reduced):
    return in_band_error(full, reduced, np.zeros(1))


@pytest.mark.slow
def test_balanced_truncation_of_the_cube_with_a_thousand_nodes_is_below_one_percent_at_order_200():
    _, full = cube(10, conservative)
    assert full.n_states == 8067
    assert full.is_symmetric
    largest = np.linalg.norm(full.d, 2)
    errors = {}
    for order in (120, 200):
        reduction = reduce(full, "tbr", order=order)
        errors[order] = hinf_error(full, reduction.system)
        assert reduction.system.spectral_abscissa < 0
        assert errors[order] <= reduction.error_bound / largest
    assert errors[200] < 0.01
    assert errors[200] < errors[120]
    # What the criterion hides, and the file states beside it: the hand feels ten times that error.
    band = band_frequencies((full, reduction.system), (0.0, 0.4))
    assert errors[200] < in_band_error(full, reduction.system, band) < 0.05
    assert errors[200] < static_error(full, reduction.system) < 0.05


@pytest.mark.slow
def test_hankel_optimal_reduction_of_eight_thousand_states_reaches_the_next_singular_value():
    _, full = cube(10, conservative)
    reduced = reduce(full, "hankel-optimal", order=100)
    other = reduced.system
    difference = PoleResidueSystem(
        np.concatenate([full.poles, other.poles]),
        np.concatenate([full.b, other.b]),
        np.concatenate([full.c, -other.c], axis=1),
        full.d - other.d,
    )
    hankel_norm = balance(real_form(difference), gramians(difference)).sigma[0]
    assert hankel_norm == pytest.approx(reduced.hankel_singular_values[reduced.order], rel=1e-6)


@pytest.mark.slow
def test_band_limited_truncation_of_the_cube_is_exact_to_four_digits_in_its_band_at_order_100():
    _, full = cube(10, conservative)
    band_hz = (0.0, 0.4)
    reduced = reduce(full, "tbr-band", order=100, band_hz=band_hz).system
    assert in_band_error(full, reduced, band_frequencies((full, reduced), band_hz)) < 1e-4


def test_the_collocated_cube_reduces_to_stable_models_inside_the_bound():
    _, full = cube(6, collocation)
    assert full.spectral_abscissa < 0
    assert not full.is_symmetric
    largest = np.linalg.norm(full.d, 2)
    for order in (40, 80):
        reduction = reduce(full, "tbr", order=order)
        assert reduction.system.spectral_abscissa < 0
        assert hinf_error(full, reduction.system) <= reduction.error_bound / largest
    band_hz = (0.0, 0.2)
    reduced = reduce(full, "tbr-band", tolerance=0.01, band_hz=band_hz).system
    assert in_band_error(full, reduced, band_frequencies((full, reduced), band_hz)) <= 0.0101
    assert reduced.n_states < 60


def liver(**changes):
    """The shipped scene, with entries of its tables replaced: {"table__key": value}, or whole tables."""
    folder = Path(__file__).parents[3] / "configs"
    tables = load_config(folder / "liver-coarse.toml").model_dump(
        mode="json", exclude_none=True, exclude_unset=True
    )
    for key, value in changes.items():
        table, _, entry = key.partition("__")
        if not entry:
            tables[table] = value
            continue
        (tables[table][0] if table == "contact" else tables[table])[entry] = value
    return check_config(tables, "liver"), folder


def test_a_coarse_liver_by_band_limited_truncation_is_within_two_percent_at_order_140():
    config, folder = liver(
        reduction={
            "method": "tbr-band",
            "order": 140,
        },  # 0.7 %; with 120 states 2.1 to 3.7 %, as the cloud has it
        geometry__spacing_m=0.02,
        contact__radius_m=0.012,
        contact__spacing_m=0.008,
    )
    accuracy = build_model(config, folder).accuracy
    assert accuracy.error_in_band < 0.02
    assert accuracy.error_static < 0.02


@pytest.mark.slow
def test_the_shipped_liver_is_passive_and_true_in_the_band_and_plain_balancing_is_useless_for_it():
    config, folder = liver()
    assert config.reduction.method == "passive"
    model = build_model(config, folder)
    assert model.n_nodes >= 1000
    assert model.contacts[0].n_nodes >= 19
    assert model.order <= 600
    assert model.accuracy.error_in_band <= config.reduction.tolerance
    assert model.accuracy.error_static < 1e-9
    assert model.accuracy.error_step < 0.05
    assert model.accuracy.error_surface_in_band <= config.reduction.tolerance_surface
    assert model.accuracy.gain_above_band < 2  # measured 1.64, at a narrow dip of the full model's force
    assert model.accuracy.passivity_margin > -1e-12
    assert model.accuracy.passive_up_to_hz == pytest.approx(0.5 / model.period_s)
    full = model.full
    plain = reduce(full, "tbr", order=120)
    assert static_error(full, plain.system) > 1  # why band-limited balancing is the default for organs
    assert hinf_error(full, plain.system) <= plain.error_bound / np.linalg.norm(full.d, 2)
