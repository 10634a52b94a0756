"""The search on frames of the night sky: light as fast as a search needs, null and hidden effects, bad input."""

from dataclasses import replace

import numpy as np
import pytest
from sky_frames import SHAPE, sky_frames_of
from slow_cases import first_is_quick

from lsst.fringe_sim.algorithms.discovery import discover_sky, placement_in_frames
from lsst.fringe_sim.algorithms.discovery.sky_exposures import BeamsOverSensor, SkyExposures
from lsst.fringe_sim.algorithms.field_response import SensorPlacement, sensor_response
from lsst.fringe_sim.algorithms.inference import CellShape, Forward
from lsst.fringe_sim.algorithms.sky_frame import sky_response
from lsst.fringe_sim.algorithms.sky_response import bandpass_of
from lsst.fringe_sim.effects import EFFECTS, ImageGeometry
from lsst.fringe_sim.errors import InputError, UnknownNameError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.sky import SkySpectrum
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import SkyFrames, SkyFringe, band_cards, bands_of_header

CATALOGUE = (
    "contrast_loss",
    "rotational_temperature",
    "water_vapour",
    "oh_bands",
    "converging_beam",
    "sky_continuum",
    "epoxy_temperature",
    "sensor_temperature",
)
GRID = (12.0, 0.004, 500)


def pixels_of(shape: tuple[int, int]) -> ImageGeometry:
    return ImageGeometry.of_pixels(shape, np.full(2, 1000.0))


def exposures(model: FringeModel, **parts: object) -> SkyExposures:
    sky = SkySpectrum.dark(airmass=model.setup.airmass)
    return SkyExposures(model, sky, bandpass_of(model), ({}, {"8-4": 0.5}), **parts)


@pytest.mark.parametrize("setup", first_is_quick(["monocam", "lsst_e2v"]))
@pytest.mark.parametrize(
    "settings",
    first_is_quick(
        [
            {"sky_continuum.scale": 1.5},
            {},
            {"rotational_temperature.offset": 20.0},
            {"contrast_loss.factor": 0.7},
            {"thickness_spread.sigma": 20.0},
        ]
    ),
    ids=str,
)
@pytest.mark.slow
def test_the_short_sums_are_the_sky_of_the_simulation(setup: str, settings: dict[str, float]) -> None:
    """The unchanged model to rounding of its table, and a few percent of what an effect changes."""
    base, model = FringeModel.from_setup(setup), FringeModel.from_setup(setup, settings)
    thickness = GRID[0] + GRID[1] * np.arange(GRID[2])
    light = exposures(base)

    def relative(rows: np.ndarray) -> np.ndarray:
        return rows / rows.mean(axis=1, keepdims=True)

    def simulated(each: FringeModel) -> np.ndarray:
        response = sky_response(each, light.sky, thickness_range_um=(thickness[0], thickness[-1] + 0.01))
        return relative(np.concatenate([response.sky(scale).lookup(thickness) for scale in light.scales]))

    expected, found = simulated(model), relative(light.response(model, *GRID))
    change = float(np.std(expected - simulated(base)))
    assert np.std(found - expected) < 2e-6 + 0.04 * change
    if settings:
        assert change > 1e-5


@pytest.mark.slow
def test_every_pixel_sees_its_own_beam() -> None:
    """Behind a telescope: against frames that are simulated with the beam of every pixel."""
    base = FringeModel.from_setup("lsst_e2v")
    detector = Camera.from_name(base.setup.camera).detector("R22_S01")
    placement = SensorPlacement.of(detector, base.setup.pixel_scale_arcsec)
    light = exposures(base, field=BeamsOverSensor.of(base.setup.telescope, placement))
    for settings, tolerance in (({}, 8e-3), ({"contrast_loss.factor": 0.8}, 2.5e-2)):
        model = FringeModel.from_setup("lsst_e2v", settings)
        rows = light.response(model, *GRID)
        shape = (24, GRID[2])
        weight = light.place_weight(pixels_of(shape))
        np.testing.assert_allclose(weight.sum(axis=0), 1.0, atol=1e-9)
        assert rows.shape == (2 * len(weight), GRID[2])
        thickness = np.broadcast_to(GRID[0] + GRID[1] * np.arange(GRID[2]), shape)
        response = sensor_response(model, light.sky, placement, (GRID[0], float(thickness.max()) + 0.01))
        for number, scale in enumerate(light.scales):
            own = rows[number::2] / rows[number::2].mean()
            found = np.einsum("kyx,kx->yx", weight, own)
            frame = np.asarray(response.sky(scale).frame(thickness), dtype=float)
            miss = found / found.mean() - frame / frame.mean()
            fringes = np.std(frame / frame.mean())
            one_beam = found[12] / found[12].mean() - frame / frame.mean()
            assert np.std(miss) < tolerance * fringes
            assert np.std(one_beam) > 0.05 * fringes  # it matters


@pytest.mark.slow
def test_cells_of_many_pixels_see_the_mean_of_their_beams() -> None:
    """Cells of a sensor against its pixels, averaged."""
    base, side, cell_px = FringeModel.from_setup("lsst_e2v"), 64, 8
    detector = Camera.from_name(base.setup.camera).detector("R22_S01")
    placement = SensorPlacement.of(detector, base.setup.pixel_scale_arcsec)
    light = exposures(base, field=BeamsOverSensor.of(base.setup.telescope, placement))
    y, x = np.indices((side, side)) / side
    thickness = 13.0 + 0.05 * y + 0.03 * x
    pixels = pixels_of((side, side))
    centres = cell_px * np.arange(side // cell_px) + 0.5 * (cell_px - 1)
    whole = replace(pixels, y_px=centres, x_px=centres)
    part = replace(whole, y_px=centres[2:5], x_px=centres[1:])  # as of a block that is held out

    def predicted(
        geometry: ImageGeometry, size: int, field: np.ndarray, light: SkyExposures = light
    ) -> np.ndarray:
        shape, weight = CellShape.of_field(field, size), light.place_weight(geometry)
        forward = Forward(
            base, (), geometry, shape, (12.5, 13.6),
            exposures=light, place_weight=weight.reshape(len(weight), -1),
        )  # fmt: skip
        return forward.predict({}, field.ravel())[0].reshape(2, *field.shape)

    def averaged(image: np.ndarray) -> np.ndarray:
        blocks = image.reshape(*image.shape[:-2], side // cell_px, cell_px, side // cell_px, cell_px)
        return blocks.mean(axis=(-3, -1))

    expected, field = averaged(predicted(pixels, 1, thickness)), averaged(thickness)
    fringes = np.std(expected)
    np.testing.assert_allclose(predicted(whole, cell_px, field), expected, atol=0.02 * fringes)
    one_beam = predicted(whole, cell_px, field, exposures(base))
    assert np.abs(one_beam - expected).max() > 0.1 * fringes  # it matters
    found = predicted(part, cell_px, field[2:5, 1:])
    np.testing.assert_allclose(found, expected[:, 2:5, 1:], atol=0.02 * fringes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("setup", "name", "settings"),
    [
        ("lsst_e2v", "", {}),
        ("lsst_e2v", "contrast_loss", {"contrast_loss.factor": 0.75}),
        ("monocam", "rotational_temperature", {"rotational_temperature.offset": 25.0}),
        ("monocam", "epoxy_temperature", {"epoxy_temperature.phase_per_10k": 0.2}),
        ("monocam", "sensor_temperature", {"sensor_temperature.offset": 6.0}),
    ],
)
def test_a_hidden_effect_is_found_on_the_sky(setup: str, name: str, settings: dict[str, float]) -> None:
    seed = int(np.random.SeedSequence().generate_state(1)[0] >> 8)
    # Fringes of cold silicon at 14 um have 2e-4 of the LSST's sky: at 4e6 electrons, a quarter of them stands out by
    # a chi-square of 50, of which the data held out see a third.
    level = 4e7 if setup == "lsst_e2v" else 1e5
    frames, known = sky_frames_of(setup, settings, seed, level)
    catalogue = [effect for effect in EFFECTS if effect.name in CATALOGUE]
    verdict = discover_sky(frames, known, 0.002, setup, catalogue, rng=np.random.default_rng(seed))
    if not name:
        assert verdict.verdict == "no_discrepancy", seed
        return
    assert verdict.verdict == "named", (seed, verdict.summary())
    (found,) = verdict.effects
    assert name in (found.name, *found.ambiguous_with), seed
    if found.name == name:
        ((key, value),) = settings.items()
        item = found.parameters[key.partition(".")[2]]
        assert abs(item.value - value) < 5.0 * item.sigma, seed


@pytest.mark.slow
def test_a_map_that_is_known_is_held_at_its_place() -> None:
    """What a map lacks is no effect, however often fits start anew: the score of noise is that of noise."""
    frames, known = sky_frames_of("monocam", {}, 11, 1e5)
    worse = known + 0.01 * np.random.default_rng(2).standard_normal(SHAPE)
    catalogue = [effect for effect in EFFECTS if effect.name in ("contrast_loss", "sky_continuum")]
    verdict = discover_sky(frames, worse, 0.0102, "monocam", catalogue, rng=np.random.default_rng(1))
    assert verdict.verdict == "no_discrepancy"
    assert verdict.global_probability > 1e-3


def one_frame(**changes: object) -> SkyFringe:
    image = np.random.default_rng(1).poisson(1000.0, SHAPE).astype(np.float32)
    frame = SkyFringe(
        image, np.zeros(SHAPE, np.int32), "electron", 1000.0, 30.0, 1.2, 24.0, None, 0.0, {"BAND 8-4": 1.0}
    )
    return replace(frame, **changes)


@pytest.mark.parametrize(
    ("frames", "setup", "message"),
    [
        ([], "lsst_e2v", "sky frames"),
        ([one_frame()], "ts8_e2v", "behind a telescope"),
        ([one_frame(metadata={})], "lsst_e2v", "OH bands of frames"),
        ([one_frame(), one_frame(airmass=1.9)], "lsst_e2v", "airmass"),
        ([one_frame(detector="R22_S11"), one_frame(detector="R22_S12")], "lsst_e2v", "one sensor"),
        ([one_frame(metadata={"BAND 8-4": 1.0, "FRINGCOR": True})], "lsst_e2v", "corrected|fringe"),
        (
            [one_frame(metadata={"BAND 8-4": 1.0, "FRINGCOR": True}, detector="R22_S11")],
            "lsst_e2v",
            "R22_S11",
        ),
    ],
)
def test_frames_that_do_not_belong_together_are_refused(
    frames: list[SkyFringe], setup: str, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        discover_sky(frames, np.full(SHAPE, 13.0), 0.002, setup, rng=np.random.default_rng(1))


def test_maps_and_bands_that_do_not_fit_are_refused() -> None:
    rng = np.random.default_rng(1)
    with pytest.raises(InputError, match="shape of the thickness map"):
        discover_sky([one_frame()], np.full((3, 4), 13.0), 0.002, "lsst_e2v", rng=rng)
    with pytest.raises(InputError, match="no finite value"):
        discover_sky([one_frame()], np.full(SHAPE, np.nan), 0.002, "lsst_e2v", rng=rng)
    with pytest.raises(UnknownNameError, match="1-0"):
        discover_sky([one_frame()], np.full(SHAPE, 13.0), 0.002, "lsst_e2v", rng=rng, scales=[{"1-0": 1.0}])
    with pytest.raises(InputError, match="one mapping for each"):
        discover_sky([one_frame()], np.full(SHAPE, 13.0), 0.002, "lsst_e2v", rng=rng, scales=[{}, {}])


def test_headers_state_the_bands() -> None:
    cards = band_cards({"8-4": 0.5, "5-2": 2.0})
    assert cards == {"BAND 8-4": 0.5, "BAND 5-2": 2.0}
    assert bands_of_header({**cards, "SETUP": "monocam"}) == {"8-4": 0.5, "5-2": 2.0}


@pytest.mark.parametrize("unit", ["electron", "fraction"])
def test_frames_without_noise_are_refused_though_no_header_says_so(unit: str) -> None:
    sensor = Camera.from_name("lsstCam").detector("R22_S11")
    y, x = np.mgrid[:40, :50]
    light = 2000.0 + 2.0 * np.sin(x / 5.0 + y / 9.0)

    def placement(image: np.ndarray) -> SensorPlacement | None:
        thickness = np.full(light.shape, 14.0)
        (frame,) = SkyFrames.from_arrays(image[None], thickness, metadata={"BEAMS": "centre"}).frames
        if unit == "fraction":
            frame = replace(frame, image=frame.fraction(), unit=unit)
        return placement_in_frames([frame], sensor, 0.2)

    with pytest.raises(InputError, match="scatter of the pixels"):
        placement(light)
    assert placement(np.random.default_rng(1).poisson(light).astype(float)) is None
