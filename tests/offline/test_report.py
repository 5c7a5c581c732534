"""What a person is told of a model: verdict and advice, with the number and never with what is in use."""

import dataclasses
from types import SimpleNamespace

import numpy as np

from palpate.lti.block_form import to_block_form
from palpate.lti.pole_residue import PoleResidueSystem
from palpate.model_file import AccuracyReport
from palpate.report import advice


def real_poles(count):
    poles = -1.0 - np.arange(count) + 0j
    return PoleResidueSystem(poles, np.ones((count, 1)) + 0j, np.ones((1, count)) + 0j, np.ones((1, 1)))


def report_with(**changes):
    figures = {field.name: 0.0 for field in dataclasses.fields(AccuracyReport)}
    return AccuracyReport(
        **figures | {"band_hz": (0.0, 30.0), "hankel_singular_values": np.zeros(0)} | changes
    )


def test_advice_gives_the_number_and_what_to_do():
    blocks = to_block_form(real_poles(2))

    def told(method="tbr-band", **changes):
        return advice(
            SimpleNamespace(
                accuracy=report_with(**changes), method=method, continuous=blocks, order=blocks.order
            )
        )

    assert told(error_in_band=0.09, error_static=0.09, error_step=0.09, resolved_frequency_hz=30.0) == []
    in_band = told("modal", error_in_band=0.43)[0]
    assert "43 %" in in_band
    assert "tbr-band" in in_band
    assert "tbr-band" not in told(error_in_band=0.43)[0]
    assert "143 %; raise the order. A model that always answers zero" in told(error_in_band=1.43)[0]
    assert "12 %" in told(error_static=0.12)[0]
    assert "rings" in told(error_step=0.5)[0]


def test_an_odd_number_of_real_poles_is_said_to_be_padded():
    blocks = to_block_form(real_poles(1))
    model = SimpleNamespace(
        accuracy=report_with(resolved_frequency_hz=30.0), method="tbr", continuous=blocks, order=blocks.order
    )
    assert advice(model) == ["Order 1 is stored as 2: states come in pairs, one is padding."]
