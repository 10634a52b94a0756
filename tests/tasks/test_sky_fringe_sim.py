"""The tasks that make a sky of a map, or its templates, without a repository."""

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest
from lsst.pex.config import FieldValidationError
from recorded_numbers import Record

from lsst.fringe_sim.algorithms.sky_frame import simulate_sky_frame
from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.night import NightHistory
from lsst.fringe_sim.instrument.sky import EmissionLines, SkySpectrum
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FringeTemplates, SkyFringe, ThicknessMap, bands_of_header, mask_bits
from lsst.fringe_sim.tasks import (
    MapTemplatesConfig,
    MapTemplatesTask,
    RaftConfig,
    SkyFringeSimConfig,
    SkyFringeSimTask,
)
from lsst.fringe_sim.tasks.fringe_forecast import FringeForecastConfig
from lsst.fringe_sim.tasks.sky_fringe_sim import SkyExposure

ROWS, COLUMNS = 12, 16
DETECTOR = Camera.from_name("lsstCam").detector("R22_S11")
EXPOSURE = SkyExposure(7026112100660, 20261121, 23.0, 30.0, 1.2, "y_10")


def thickness(**changes: Any) -> ThicknessMap:
    y, x = np.mgrid[:ROWS, :COLUMNS]
    zero = np.zeros((ROWS, COLUMNS))
    mask = zero.astype(int)
    mask[0, :3] = mask_bits("NO_DATA")
    mask[5, 5] = mask_bits("SLIP")
    values: dict[str, Any] = {
        "value": 14.0 + 0.02 * x + 0.01 * y,
        "sigma": zero + 1e-3,
        "chi2": zero + 1,
        "slip_probability": zero,
        "mask": mask,
        "layer": "adhesive",
    }
    return ThicknessMap(**(values | changes))


def run(
    thickness_map: ThicknessMap | None = None, exposure: SkyExposure = EXPOSURE, **config: Any
) -> SkyFringe:
    made = SkyFringeSimConfig(**({"beams": "centre", "level": "model", "noise": False} | config))
    made.validate()
    given = thickness() if thickness_map is None else thickness_map
    sky: SkyFringe = SkyFringeSimTask(config=made).run(given, exposure, DETECTOR).sky
    return sky


@functools.cache
def usual() -> SkyFringe:
    """The frame of the usual configuration; not to be changed."""
    return run()


def test_the_frame_is_that_of_the_algorithm_with_the_hour_in_the_bands() -> None:
    frame = usual()
    lines = EmissionLines.oh()
    scale = NightHistory.guo2022().band_scale(4, lines.bands)  # 23 h
    sky = SkySpectrum.dark(lines, 1.2).with_band_scale(scale)
    expected = simulate_sky_frame(thickness().value, FringeModel.from_setup("lsst_e2v"), sky, exposure_s=30.0)
    good = frame.mask == 0
    np.testing.assert_allclose(frame.image[good], expected.image[good], rtol=2e-6)
    assert frame.metadata["BAND 8-4"] == scale["8-4"] == 0.57
    assert (frame.hour, frame.airmass, frame.exposure_s) == (23.0, 1.2, 30.0)
    assert (frame.detector, frame.physical_filter, frame.seed) == ("R22_S11", "y_10", None)
    assert 0 < frame.quadrature_error < 1e-4
    assert frame.metadata["LINELIST"].startswith("PALACE")


def test_doubts_about_the_map_reach_the_frame() -> None:
    frame = usual()
    np.testing.assert_array_equal(frame.mask, thickness().mask)
    assert np.isfinite(frame.image).all()


@pytest.mark.slow
def test_every_pixel_has_the_beam_of_its_place() -> None:
    """At the centre of the field the corners of the sensor differ most from its middle."""
    one, pixel = usual(), run(beams="pixel")
    difference = pixel.fraction() - one.fraction()
    assert 0.1 * np.ptp(one.fraction()) < np.abs(difference).max() < 2.0 * np.ptp(one.fraction())
    assert pixel.metadata["BEAMS"] == "pixel"
    assert 0 < pixel.quadrature_error < 1e-4


@pytest.mark.slow
def test_photons_migrate() -> None:
    """Nine tenths of them stay in their pixel or the next, so that the frame is hardly smoother."""
    pixel, blurred = run(beams="pixel"), run(beams="pixel", migration=True)
    assert 0.8 * pixel.fraction().std() < blurred.fraction().std() < pixel.fraction().std()


@pytest.mark.slow
def test_a_sensor_without_a_map_gets_a_stand_in_if_that_is_wanted() -> None:
    config = SkyFringeSimConfig(beams="centre", stand_in=True, stand_in_shape=[20, 24])
    frame = SkyFringeSimTask(config=config).run(None, EXPOSURE, DETECTOR).sky
    assert frame.shape == (20, 24)
    assert frame.metadata["STANDIN"] is True
    with pytest.raises(InputError, match="one, or stand_in=True"):
        SkyFringeSimTask(config=SkyFringeSimConfig()).run(None, EXPOSURE, DETECTOR)


def test_between_two_hours_the_bands_are_interpolated() -> None:
    half = run(exposure=dataclasses.replace(EXPOSURE, hour=23.5))
    assert half.metadata["BAND 8-4"] == pytest.approx((0.57 + 0.5) / 2)


@pytest.mark.parametrize("hour", [18.9, 29.1])
def test_an_hour_outside_the_tabulated_night_is_refused(hour: float) -> None:
    with pytest.raises(OutOfRangeError, match="beginning of the night"):
        run(exposure=dataclasses.replace(EXPOSURE, hour=hour))


def test_a_random_night_is_one_night_for_all_its_exposures() -> None:
    later = dataclasses.replace(EXPOSURE, exposure_id=7026112100661, hour=23.1)
    other_date = dataclasses.replace(EXPOSURE, day_obs=20261122)
    first, close, again, other = (
        run(exposure=item, night="random").metadata["BAND 8-4"]
        for item in (EXPOSURE, later, EXPOSURE, other_date)
    )
    assert first == again != other
    assert abs(close / first - 1) < 0.2
    assert run(exposure=EXPOSURE, night="random", seed=1).metadata["BAND 8-4"] != first


def test_a_steady_night_has_the_reference_sky_at_any_hour() -> None:
    first, last = (run(exposure=dataclasses.replace(EXPOSURE, hour=h), night="steady") for h in (19.0, 29.0))
    np.testing.assert_array_equal(first.image, last.image)
    assert set(bands_of_header(first.metadata).values()) == {1.0}


def test_noise_is_that_of_exposure_and_sensor() -> None:
    first, again = run(noise=True), run(noise=True)
    other = run(noise=True, exposure=dataclasses.replace(EXPOSURE, exposure_id=EXPOSURE.exposure_id + 1))
    reseeded = run(noise=True, seed=1)
    np.testing.assert_array_equal(first.image, again.image)
    assert len({item.seed for item in (first, other, reseeded)}) == 3
    clean = usual()
    residual = (first.image - clean.image)[clean.mask == 0] / np.sqrt(clean.image[clean.mask == 0])
    assert 0.7 < residual.std() < 1.3


def test_level_of_the_throughput_tables() -> None:
    frame = run(level="throughput", night="steady", exposure=dataclasses.replace(EXPOSURE, airmass=1.0))
    # The inventory of the paper: 2717 electrons per pixel in 30 s at the zenith, within 10 %.
    assert frame.mean_electrons == pytest.approx(2717, rel=0.1)
    assert frame.image[frame.mask == 0].mean() == pytest.approx(frame.mean_electrons, rel=1e-5)


def test_effects_of_the_sensor_change_the_frame_those_of_the_lamp_do_not() -> None:
    plain = usual()
    config = SkyFringeSimConfig(beams="centre")
    config.effects.update({"bandwidth.fwhm": 3.0, "roughness.sigma": 120.0})
    frame = SkyFringeSimTask(config=config).run(thickness(), EXPOSURE, DETECTOR).sky
    assert frame.metadata["FRINGRMS"] < 0.9 * plain.metadata["FRINGRMS"]
    assert (frame.metadata["EFFECT0"], frame.metadata["EFFVAL0"]) == ("roughness.sigma", 120.0)
    assert "EFFECT1" not in frame.metadata


def test_a_map_fitted_with_other_effects_is_refused() -> None:
    header = {"SETUP": "ts8_e2v", "EFFECT0": "roughness.sigma", "EFFVAL0": 50.0}
    with pytest.raises(InputError, match="with which the thickness was fitted"):
        run(thickness(metadata=header))
    # An effect of the lamp says nothing about the sky.
    run(thickness(metadata={**header, "EFFECT0": "bandwidth.fwhm", "EFFVAL0": 2.4}))


def test_a_map_of_another_layer_is_refused() -> None:
    with pytest.raises(InputError, match="layer of the thickness map is 'detection'; allowed: adhesive"):
        run(thickness(layer="detection"))


def test_a_map_without_any_thickness_is_refused() -> None:
    with pytest.raises(InputError, match="no known thickness"):
        run(thickness(mask=np.full((ROWS, COLUMNS), mask_bits("NO_DATA"))))


def test_the_light_of_the_flat_field_is_that_of_the_configuration() -> None:
    known = thickness().known_um()
    for given, name in (("white", "white"), ("gaussian:970:30", "gaussian:970:30"), (None, None)):
        made = SkyFringeSimConfig(flat_spectrum=given).sky_model(DETECTOR, 1.2, known, {})
        flat = made.spectrum().flat
        assert (flat.name if flat else None) == name


def test_every_sensor_has_a_forecast() -> None:
    made = FringeForecastConfig(stand_in_shape=[20, 24]).map_of(None, DETECTOR)
    assert made.value.shape == (20, 24)
    SkyFringeSimConfig(setup="monocam").validate()  # photons do not migrate unless that is asked for


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda c: setattr(c, "setup", "ts8_e2v"), "does not see the sky"),
        (lambda c: setattr(c, "seed", -1), "must not be negative"),
        (lambda c: c.update(setup="monocam", migration=True), "needs a traced telescope"),
        (lambda c: c.rafts.update({"R01": RaftConfig(setup="ts8_itl")}), "does not see the sky"),
    ],
)
def test_configurations_that_make_no_sense(spoil: Any, message: str) -> None:
    config = SkyFringeSimConfig()
    spoil(config)
    with pytest.raises(FieldValidationError, match=message):
        config.validate()


MADE = "2026-11-21T03:43:40"
WARM_K = 183.0


def warm_map() -> ThicknessMap:
    """A map of flats that were taken warmer than the sky is."""
    return thickness(metadata={"LABTEMP": WARM_K})


def templates_of(layer: ThicknessMap | None = None, **config: Any) -> FringeTemplates:
    made = MapTemplatesConfig(beams="centre", **config)
    made.validate()
    task = MapTemplatesTask(config=made)
    found: FringeTemplates = task.run(layer or warm_map(), DETECTOR, EXPOSURE.physical_filter, MADE).templates
    return found


def fringes(layer: ThicknessMap, **config: Any) -> np.ndarray:
    frame = run(layer, night="steady", **config)
    good = frame.mask == 0
    relative = frame.image / frame.image[good].mean(dtype=float)
    return np.asarray(np.where(good, relative - 1.0, 0.0))


def test_templates_are_the_sky_of_the_map_and_what_the_phase_changes() -> None:
    templates = templates_of()
    good = templates.mask == 0
    sky = fringes(warm_map())[good]
    first, second = (pattern[good] - pattern[good].mean() for pattern in templates.patterns)
    assert np.abs(first - sky).max() < 1e-5
    # Half the difference of the skies at both ends of what is not known.
    longer, shorter = (
        fringes(warm_map(), effects={"epoxy_temperature.phase_per_10k": sign * 0.3})[good] for sign in (1, -1)
    )
    change = 0.5 * (longer - shorter)
    error = 2.0 * run(warm_map(), night="steady").quadrature_error
    assert np.abs(change - second).max() < error < 0.5 * np.std(change)


def test_what_the_templates_say_of_themselves() -> None:
    templates = templates_of()
    assert (templates.detector, templates.physical_filter) == (DETECTOR.name, EXPOSURE.physical_filter)
    assert templates.creation_datetime == MADE
    assert {"CFGHASH", "SETUP", "LINELIST", "PHASESIG"} <= templates.metadata.keys()
    # Doubts about the map stay doubts; pixels without a thickness have no template.
    assert templates.mask[5, 5] & mask_bits("SLIP")
    assert not templates.coverage[0, :3].any()
    assert not templates.patterns[:, 0, :3].any()


def test_a_map_of_the_temperature_of_the_sky_leaves_no_phase_open() -> None:
    assert len(templates_of(phase_sigma=0.0).patterns) == 1


def test_templates_need_a_map_unless_a_stand_in_is_wanted() -> None:
    task = MapTemplatesTask(config=MapTemplatesConfig(beams="centre"))
    with pytest.raises(InputError, match="thickness map"):
        task.run(None, DETECTOR, "y_10", MADE)


def test_frame_and_templates_are_as_recorded(recorded: Record) -> None:
    """A record, beside the algorithm that the tests above compare with."""
    recorded({"usual": usual(), "other": run(night="steady", level="model", noise=True)})
