"""The frequency that a cloud resolves."""

import numpy as np
import pytest

from palpate.discretization.resolution import resolved_frequency_hz
from palpate.geometry.shapes import box_lattice
from palpate.scene.material import Material, PronySeries


def test_an_elastic_cloud_resolves_shear_waves_of_six_spacings():
    cloud = box_lattice((0, 0, 0), (1, 1, 1), (11, 11, 11))
    material = Material(2 * 1.25 * 9.0, 0.25, 1.0)  # G = 9, so c_s = 3 m/s
    assert resolved_frequency_hz(cloud, material) == pytest.approx(3 / 0.6)


def test_a_viscoelastic_cloud_resolves_the_wave_speed_at_that_very_frequency():
    cloud = box_lattice((0, 0, 0), (1, 1, 1), (11, 11, 11))
    prony = PronySeries((0.5, 3.0), (1.0, 0.02))
    material = Material(2 * 1.25 * 9.0, 0.25, 1.0, prony)
    f = resolved_frequency_hz(cloud, material)
    h = prony.transfer_factor(np.array([2j * np.pi * f]))[0]
    assert f == pytest.approx(3 * np.sqrt(abs(h)) / 0.6, rel=1e-10)
    assert 5 < f < 5 * np.sqrt(prony.instant_factor)
