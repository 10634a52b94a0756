"""The sky that shares no code with the package: energy, noise, and the size of its fringes."""

import numpy as np
import pytest
from foreign_sky import CONTINUUM, ForeignClutter, ForeignSky, foreign_map, foreign_night

from lsst.fringe_sim.optics import layer_absorption


def test_plane_waves_are_those_of_the_package() -> None:
    """Amplitudes of waves there, matrices of fields here."""
    sky, thickness = ForeignSky(), np.array([14.3, 17.0])
    silicon = complex(3.61, 4e-4)
    index = np.array([1.0, 1.375, 2.10, silicon, 1.451, silicon, 1.451, 1.6, silicon, 1.99])
    for polarised in "sp":
        for sine in (0.0, 0.35):
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr("foreign_sky._silicon", lambda *_: silicon)
                seen = sky.absorbed(960.0, np.array([sine]), polarised, thickness)[0]
            for epoxy, absorbed in zip(thickness, seen, strict=True):
                depth = [np.inf, 0.1221, 0.0441, 100.0, 0.1, 0.3, 1.0, epoxy, 165.0, np.inf]
                own = layer_absorption(index, depth, 0.960, np.arcsin(sine), polarised)[3]
                assert absorbed == pytest.approx(own, rel=1e-12)


@pytest.mark.slow
def test_fringes_of_the_lsst_have_a_tenth_of_a_per_cent() -> None:
    """Guo, Walter, Lage & Lupton 2022: 0.14 % rms at the centre of the LSST, with other silicon and no continuum."""
    thickness = np.linspace(14.0, 22.0, 2001)[np.newaxis]
    parts = ForeignSky(continuum=0.0).detected(thickness)
    assert parts.pop(CONTINUUM).max() == 0.0
    total = sum(parts.values())
    assert total.mean() == pytest.approx(1.0, abs=1e-4)
    assert 0.0010 < total.std() < 0.0015


@pytest.mark.rng("foreign night")
def test_a_night_has_the_noise_that_it_states(rng) -> None:
    sky = ForeignSky(f_number=4.0, obscuration=0.0, edges_nm=(955.0, 965.0))
    clutter = ForeignClutter(stars=1.0, cosmic_rays=0.5, gradient=0.02, amplifier_steps=0.004, moon=0.3)
    thickness = foreign_map(rng, (64, 64), 14.0, 18.0)
    for frame in foreign_night(sky, thickness, rng, 2, clutter):
        truth = frame.gain * (frame.sky + frame.fringes + frame.objects)
        pull = ((frame.image - truth) / np.sqrt(frame.variance))[~frame.hit]
        assert abs(pull.mean()) < 0.1
        assert pull.std() == pytest.approx(1.0, abs=0.05)
        assert frame.hit.any()
        assert frame.objects.max() > 100.0
        assert 0.001 < frame.fringes.std() / frame.sky.mean() < 0.05
