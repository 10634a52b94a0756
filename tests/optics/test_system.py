"""The wavelengths that a monochromator delivers."""

import dataclasses

import numpy as np
import pytest

from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.optics.system import OpticalSystem


@pytest.fixture
def system() -> OpticalSystem:
    return FringeModel.from_setup("ts8_e2v").base_system


def test_errors_of_single_exposures_are_interpolated_and_add_up(system: OpticalSystem) -> None:
    errors = ((880.0, 0.4), (890.0, -0.2), (900.0, 0.0))
    moved = dataclasses.replace(system, wavelength_errors_nm=(errors,), wavelength_offset_nm=1.0)
    nominal = np.array([870.0, 880.0, 885.0, 890.0, 910.0])
    np.testing.assert_allclose(
        moved.true_wavelength(nominal) - nominal, [1.4, 1.4, 1.1, 0.8, 1.0], atol=1e-12
    )
    twice = dataclasses.replace(moved, wavelength_errors_nm=(errors, errors))
    np.testing.assert_allclose(
        twice.true_wavelength(nominal) - nominal, [1.8, 1.8, 1.2, 0.6, 1.0], atol=1e-12
    )
