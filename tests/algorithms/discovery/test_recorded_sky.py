"""Records of what a search makes of frames of the night sky, of few lines and pixels."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from recorded_numbers import Record
from sky_frames import bright_sky, sky_frames_of

from lsst.fringe_sim.algorithms.discovery import discover_sky, sky_exposures
from lsst.fringe_sim.algorithms.discovery.sky_exposures import BeamsOverSensor, SkyExposures
from lsst.fringe_sim.algorithms.discovery.sky_search import SKY_SEARCH
from lsst.fringe_sim.algorithms.field_response import SensorPlacement
from lsst.fringe_sim.algorithms.sky_response import bandpass_of
from lsst.fringe_sim.effects import EFFECTS, ImageGeometry
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.model import FringeModel

LINES, MAP_UM = 6, 0.002


def test_a_search_on_the_sky_is_as_recorded(recorded: Record) -> None:
    """With a class that is made wide, so that what would tell its effects apart is asked."""
    sky = bright_sky(LINES)
    hidden = {"contrast_loss.factor": 0.6}
    frames, known = sky_frames_of("monocam", hidden, 8, 3e6, shape=(24, 24), span=1.4, sky=sky)
    known[3:5, 7] = np.nan
    catalogue = [effect for effect in EFFECTS if effect.name in ("contrast_loss", "sky_continuum")]
    verdict = discover_sky(
        frames, known, MAP_UM, "monocam", catalogue,
        rng=np.random.default_rng(8), sky=sky, options=replace(SKY_SEARCH, class_width=1e4),
    )  # fmt: skip
    (effect,) = verdict.effects
    assert effect.name == "contrast_loss"
    assert abs(effect.parameters["factor"].value - 0.6) < 5.0 * effect.parameters["factor"].sigma
    recorded(verdict)


def test_light_in_the_beams_of_a_sensor_is_as_recorded(
    monkeypatch: pytest.MonkeyPatch, recorded: Record
) -> None:
    """Of the sky of two hours, where the beam is narrower away from the axis, and behind one beam."""
    base = FringeModel.from_setup("lsst_e2v")
    cone = base.base_system.beam
    slower = SimpleNamespace(beam=lambda radius: replace(cone, theta=cone.theta * (1.0 - 0.1 * radius)))
    monkeypatch.setattr(sky_exposures, "beam_field", lambda telescope: slower)
    detector = Camera.from_name(base.setup.camera).detector("R22_S01")
    placement = SensorPlacement.of(detector, base.setup.pixel_scale_arcsec)
    field = BeamsOverSensor.of(base.setup.telescope, placement)
    assert field is not None
    fewer = replace(
        field, radius_deg=field.radius_deg[::4], beams=field.beams[::4],
        few_radius_deg=field.few_radius_deg[::2], few_beams=field.few_beams[::2],
    )  # fmt: skip
    sky, grid, found = bright_sky(2), (13.0, 0.01, 24), {}
    for name, own in (("one beam", None), ("all", fewer)):
        light = SkyExposures(base, sky, bandpass_of(base), ({}, {sky.lines.bands[0]: 0.5}), own)
        for change in ({}, {"sky_continuum.scale": 1.5, "contrast_loss.factor": 0.8}):
            rows = light.response(FringeModel.from_setup("lsst_e2v", change), *grid)
            found[f"{name} {change}"] = [rows, rows[0], rows[-1]]
        found[f"weight of {name}"] = light.place_weight(ImageGeometry.of_pixels((6, 5), np.full(2, 1000.0)))
        found[f"light of {name}"] = [
            light.wavelength_nm(),
            *(other.scales for _, _, other in light.further()),
        ]
    radii = [field.radius_deg, field.few_radius_deg, field.between]
    recorded({**found, "radii": radii, "weight": field.weight(ImageGeometry.of_pixels((6, 5), np.ones(2)))})
