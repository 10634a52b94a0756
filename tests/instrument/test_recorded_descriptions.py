"""A record of set-ups, cameras, skies and telescopes, for edits that are not meant to change them."""

import numpy as np
import pytest
from recorded_numbers import Record

from lsst.fringe_sim.instrument.bandpass import Bandpass, bandpass_names
from lsst.fringe_sim.instrument.beam_field import BeamField
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.flat_spectrum import FlatSpectrum
from lsst.fringe_sim.instrument.night import NightHistory, StochasticNight
from lsst.fringe_sim.instrument.setup import setup_names
from lsst.fringe_sim.instrument.sky import EmissionLines, SkySpectrum, blend_components, zodiacal_light
from lsst.fringe_sim.instrument.telescope import Telescope
from lsst.fringe_sim.model import FringeModel

WAVE_NM = np.linspace(930.0, 1000.0, 23)


@pytest.mark.parametrize("name", setup_names())
def test_response_of_a_set_up(name: str, recorded: Record) -> None:
    model = FringeModel.from_setup(name)
    system = model.base_system
    own = system.stack.layers[system.stack.position(system.varying)].thickness_um
    recorded({"own": own, "response": model.response(own + np.linspace(-0.2, 0.2, 9), WAVE_NM[::7])})


@pytest.mark.parametrize("name", bandpass_names())
def test_light_of_a_filter(name: str, recorded: Record) -> None:
    band = Bandpass.from_name(name)
    low, high = band.support()
    wave = np.linspace(low, high, 17)
    recorded([low, high, band.transmission(wave), band.quantum_efficiency(wave)])


def test_light_of_the_night(recorded: Record) -> None:
    band = Bandpass.from_name("lsst_y")
    lines = EmissionLines.oh()
    dark = SkySpectrum.dark(lines, 1.3)
    light = dark.components(band)
    night = StochasticNight().draw(np.arange(0.0, 8.0, 1.0), np.random.default_rng(12))
    recorded(
        {
            "lines": lines,
            "light": [(one.wavelength_nm, one.photons) for one in light],
            "blended": [(one.wavelength_nm, one.photons) for one in blend_components(light, 0.05)],
            "zodiacal": zodiacal_light(100.0, 30.0).radiance(WAVE_NM),
            "lamp": FlatSpectrum.gaussian(960.0, 20.0).component(band).photons,
            "paper": [NightHistory.guo2022().band_scale(k, lines.bands) for k in (0, 5)],
            "drawn": night.band_scale(3, lines.bands),
        }
    )


@pytest.mark.parametrize("name", ["lsstCam", "ts8"])
def test_sensors_of_a_camera(name: str, recorded: Record) -> None:
    camera = Camera.from_name(name)
    recorded([camera.detector(key.name) for key in camera.science[::40]])


def test_beams_of_telescopes(recorded: Record) -> None:
    lsst = Telescope.from_name("LSST")
    field = BeamField.trace(lsst, nodes=5)
    beams = [lsst.beam(0.7, -0.3), Telescope.from_name("HSC").beam(0.2), field.beam(1.1, 0.4)]
    recorded({"beams": beams, "ends": field.sin_squared_at(0.9, 0.3)})
