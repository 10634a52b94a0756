"""The bandpass moves with the angles at the filter: by how much over the field, and what the fringes make of it."""

from dataclasses import replace

import batoid
import numpy as np
import pytest

from lsst.fringe_sim.algorithms.sky_frame import sky_response
from lsst.fringe_sim.instrument.bandpass import Bandpass
from lsst.fringe_sim.instrument.sky import EmissionLines, SkySpectrum
from lsst.fringe_sim.model import FringeModel

ENTRANCE = "LSST.LSSTCamera.Filter.Filter_entrance"
EFFECTIVE_INDEX = 1.9
"""Of an interference filter: between those of its layers, oxides of 1.45 to 2.3; an assumption."""


def mean_square_of_the_sine(field_deg: float) -> float:
    """Of the angle of incidence on the filter, over the rays that arrive at the sensor."""
    optic = batoid.Optic.fromYaml("LSST_y.yaml")
    rays = batoid.RayVector.asPolar(
        optic=optic, wavelength=960e-9, theta_x=np.deg2rad(field_deg), theta_y=0.0, nrad=40, naz=160
    )
    passed = optic.traceFull(rays)
    key = next(name for name in passed if name.endswith("Filter_entrance"))
    last = optic.trace(rays.copy())
    surface = optic[ENTRANCE]
    met = passed[key]["out"].toCoordSys(surface.coordSys)
    velocity = passed[key]["in"].toCoordSys(surface.coordSys).v
    normal = surface.surface.normal(met.x, met.y)
    cosine = (velocity * normal).sum(axis=1) / np.linalg.norm(velocity, axis=1)
    return float((1.0 - cosine**2)[~(last.vignetted | last.failed)].mean())


def test_the_bandpass_moves_by_less_than_a_third_of_a_nanometre() -> None:
    squares = [mean_square_of_the_sine(field) for field in (0.0, 1.0, 1.44, 1.75)]
    assert squares == pytest.approx([0.1041, 0.1053, 0.1052, 0.1037], abs=4e-4)
    shift = 960.0 * np.ptp(squares) / (2.0 * EFFECTIVE_INDEX**2)
    assert 0.1 < shift < 0.3


@pytest.mark.slow
def test_fringes_do_not_see_it() -> None:
    model, band = FringeModel.from_setup("lsst_e2v"), Bandpass.from_name("lsst_y")
    sky, grid = SkySpectrum(EmissionLines.oh()), np.linspace(14.0, 18.0, 2001)[np.newaxis]
    frames = [
        sky_response(
            model,
            sky,
            replace(band, wavelength_nm=band.wavelength_nm + shift),
            thickness_range_um=(13.9, 18.1),
        )
        .sky()
        .frame(grid)[0]
        .astype(float)
        for shift in (0.0, 0.3)
    ]
    one, other = (frame / frame.mean() - 1.0 for frame in frames)
    left = other - one * (other @ one) / (one @ one)
    assert np.std(left) < 0.015 * np.std(one)
    assert abs(frames[1].mean() / frames[0].mean() - 1.0) < 0.005
