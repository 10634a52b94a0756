"""Where light ends in a stack."""

import numpy as np
import pytest

from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.model import FringeModel

THICKNESS_UM = 15.3


def test_all_light_is_somewhere_and_the_line_averages_to_the_response() -> None:
    model = FringeModel.from_setup("ts8_e2v")
    wavelength = np.arange(955.0, 965.0, 0.01)
    found = model.spectrum(wavelength, THICKNESS_UM)
    everything = found.reflected + found.transmitted + sum(found.absorbed.values())
    np.testing.assert_allclose(everything, 1.0, atol=1e-12)
    assert found.varying == "adhesive"
    width = 2.0 / np.sqrt(8.0 * np.log(2.0))
    line = np.exp(-0.5 * ((wavelength - 960.0) / width) ** 2)
    seen = float((line * found.quantum_efficiency).sum() / line.sum())
    assert model.response(THICKNESS_UM, [960.0])[0] == pytest.approx(seen, abs=1e-4)


def test_the_beam_of_a_telescope_takes_fringes_away() -> None:
    wavelength = np.arange(955.0, 965.0, 0.02)
    parallel, cone = (
        FringeModel.from_setup(name).spectrum(wavelength, 15.0) for name in ("ts8_e2v", "lsst_e2v")
    )
    assert np.std(cone.quantum_efficiency) < 0.5 * np.std(parallel.quantum_efficiency)


def test_a_picture_and_a_table() -> None:
    pytest.importorskip("matplotlib").use("agg")
    found = FringeModel.from_setup("ts8_e2v").spectrum(np.arange(950.0, 955.0, 0.1))
    labels = [line.get_label() for line in found.plot().get_lines()]
    assert "detection (detected)" in labels
    assert "reflected" in labels
    assert "transmitted, mean" in found._repr_html_()
    assert "17.5 µm" in repr(found)  # the middle of the range


def test_what_is_no_stack_of_plane_layers_is_refused() -> None:
    for effects in (
        {"thickness_spread.sigma": 20.0},
        {"contrast_loss.factor": 0.5},
        {"diffuse_gate_side.reflectance": 0.3},
    ):
        with pytest.raises(InputError, match="effects"):
            FringeModel.from_setup("ts8_e2v", effects).spectrum([960.0])
    model = FringeModel.from_setup("ts8_e2v")
    with pytest.raises(OutOfRangeError, match="wavelength"):
        model.spectrum([96.0])
    with pytest.raises(InputError, match="one number"):
        model.spectrum([960.0], [15.0, 16.0])
