"""Whole stages on small inputs, as recorded; other tests, most of them slow, say whether their results are right."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from foreign_sky import foreign_map
from recorded_numbers import Record
from scipy.ndimage import gaussian_filter

from lsst.fringe_sim.algorithms import fit_thickness
from lsst.fringe_sim.algorithms.correction.empirical import TemplateOptions
from lsst.fringe_sim.algorithms.map_from_range import map_from_range
from lsst.fringe_sim.algorithms.observed_frames import make_templates
from lsst.fringe_sim.algorithms.public_evidence.kinds import SeenOnSky, public_kinds
from lsst.fringe_sim.algorithms.public_evidence.models import models_with
from lsst.fringe_sim.algorithms.public_evidence.verdict import DECIDING, compare
from lsst.fringe_sim.algorithms.thickness_fit import SiliconSearch, silicon_map
from lsst.fringe_sim.challenge.sealed_cases import expose
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube, ObservedFrame
from lsst.fringe_sim.products.mask import mask_bits

SETTINGS = {"contrast_loss.factor": 0.6, "bandwidth.fwhm": 3.0}


@pytest.mark.parametrize(
    "name",
    [
        "pixel, 12 wavelengths", "contrast of the 960 nm flat", "shape of the 960 nm fringe",
        "phase of the 960 nm flat", "published map", "quantum efficiency, e2v", "quantum efficiency, itl",
        "sky of monocam",
    ],
)  # fmt: skip
def test_public_data_and_what_models_foretell_of_them_are_as_recorded(name: str, recorded: Record) -> None:
    (kind,) = (one for one in public_kinds() if one.name == name)
    models = (
        [models_with(SETTINGS)] if isinstance(kind, SeenOnSky) else [models_with({}), models_with(SETTINGS)]
    )
    foretold = [kind.predict(each) for each in models]
    recorded({
        "data": kind, "foretold": foretold, "chi2": [kind.chi2(each) for each in foretold],
        "misfit": [kind.misfit(each) for each in foretold], "size": kind.size,
    })  # fmt: skip


@pytest.mark.slow
def test_a_comparison_of_the_flats_of_a_pixel_is_as_recorded(recorded: Record) -> None:
    pixel, _, _, phase, published, *_ = public_kinds()
    found = compare([["contrast_loss"], ["bandwidth"]], [pixel, phase, published])
    recorded({
        "rows": found.rows, "wavelengths": found.wavelengths, "probabilities": found.probabilities,
        "values": [fit.values for fit in found.fits],
    })  # fmt: skip


def test_what_would_decide_is_as_recorded(recorded: Record) -> None:
    recorded([each.expect(SETTINGS) for each in DECIDING[:4]])


BROAD, NARROW = np.arange(880.0, 991.0, 10.0), np.array([925.0, 938.0, 946.0, 957.0, 969.0, 983.0])


def flats(narrow: bool, tilt: float) -> FringeCube:
    """Broad and narrow flats of a small sensor whose silicon is thicker than that of the model, and tilted."""
    model, rng = FringeModel.from_setup("ts8_e2v"), np.random.default_rng(8)
    rows, columns = 40, 44
    y, x = np.mgrid[:rows, :columns]
    truth = 14.0 + 0.5 * np.sin(x / 20.0) + 0.4 * np.cos(y / 17.0)
    parts = [(BROAD, 2.0), (NARROW, 0.3)][: 2 if narrow else 1]
    image = []
    for wavelength, width in parts:
        one = np.empty((wavelength.size, rows, columns))
        for column, place in enumerate(np.linspace(-1.0, 1.0, columns)):
            settings = {"silicon_thickness.offset": 0.052 + tilt * place, "bandwidth.fwhm": width}
            one[:, :, column] = model.with_effects(settings).response(truth[:, column], wavelength)
        image.append(one)
    light = np.concatenate(image)
    light /= light.mean(axis=(1, 2), keepdims=True)
    light += 0.004 * rng.standard_normal(light.shape)
    widths = np.concatenate([np.full(wavelength.size, width) for wavelength, width in parts])
    return FringeCube(
        light.astype(np.float32), np.full(light.shape, 1.6e-5, np.float32), np.zeros(light.shape, np.int16),
        FlatExposures(np.concatenate([one for one, _ in parts]), widths, np.array(model.setup.temperature_k)),
        "relative",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("degree", "narrow"),
    [
        pytest.param(0, True, id="one", marks=pytest.mark.slow),
        pytest.param(1, True, id="plane"),
        pytest.param(1, False, id="broad flats", marks=pytest.mark.slow),
    ],
)
def test_silicon_of_a_small_sensor_is_as_recorded(degree: int, narrow: bool, recorded: Record) -> None:
    model = FringeModel.from_setup("ts8_e2v")
    search = SiliconSearch(degree=degree, span_um=0.1, tilt_um=0.05)
    cube = flats(narrow, 0.01 * degree)
    if degree and narrow:  # some values are not there, others say nothing
        mask, variance = np.array(cube.mask), np.array(cube.variance)
        mask[2, 10:14, 20:24] = mask[14, 25:, 30] = mask_bits("NO_DATA")
        variance[5, 30:34, 5:9] = 4.0
        cube = replace(cube, mask=mask, variance=variance)
    found = fit_thickness(cube, model, silicon=search)
    recorded({"adhesive": found, "silicon": silicon_map(found, model)})


def test_a_map_from_a_range_is_as_recorded(recorded: Record) -> None:
    def light(thickness_um):
        phase = 2.0 * np.pi * np.asarray(thickness_um)
        return 1000.0 * (1.0 + 4e-3 * np.cos(phase / 0.3) + 3e-3 * np.cos(phase / 0.37))

    rng = np.random.default_rng(4)
    layer = foreign_map(rng, (32, 36), 13.1, 13.7)
    seen = light(layer) / 1000.0 - 1.0
    values = [size * seen + 3e-3 * rng.standard_normal(layer.shape) + 1e-4 for size in (0.7, 1.0, 1.3, 0.9)]
    weights = [np.full(layer.shape, 3e-3**-2) for _ in values]
    values[1][20:24, 10:14], weights[1][20:24, 10:14] = np.nan, 0.0
    recorded(map_from_range(values, weights, (13.0, 13.9), light, 0.3, order_error=0.02))


def test_a_fit_of_smoothed_flats_is_as_recorded(recorded: Record) -> None:
    """Their pixels share noise, so that a hundred of them tell less than a hundred that do not."""
    rng = np.random.default_rng(5)
    cube, _ = expose(foreign_map(rng, (24, 28), 14.0, 14.7), {}, rng)
    noise = rng.standard_normal(cube.shape) * np.sqrt(cube.variance)
    smooth = gaussian_filter(noise, (0.0, 1.3, 1.3))
    noisy = cube.image + smooth * noise.std() / smooth.std()
    cube = replace(cube, image=noisy.astype(np.float32), variance=2.0 * np.asarray(cube.variance))
    recorded(fit_thickness(cube, FringeModel.from_setup("ts8_e2v"), noise_correlation_px=1.3))


@pytest.mark.slow
def test_a_fit_beside_a_void_is_as_recorded(recorded: Record) -> None:
    rng = np.random.default_rng(12)
    void = {"void.centre_x": 24.0, "void.centre_y": 17.0, "void.radius": 8.0, "void.thickness": 190.0}
    cube, _ = expose(foreign_map(rng, (40, 44), 14.0, 14.9), void, rng)
    recorded(fit_thickness(cube, FringeModel.from_setup("ts8_e2v", void)))


def test_the_number_of_templates_is_as_recorded(recorded: Record) -> None:
    """That which tells frames that the templates were not made of."""
    rng = np.random.default_rng(6)
    y, x = np.mgrid[:64, :72]
    patterns = np.sin(x / 3.0 + y / 9.0), np.cos(y / 3.5 - x / 20.0)
    frames = []
    for number in range(7):
        sky = 2000.0 * (
            1.0 + 0.03 * (1.0 + 0.3 * np.sin(number)) * patterns[0] + 0.02 * np.cos(number) * patterns[1]
        )
        image = rng.poisson(sky).astype(np.float32)
        frame = ObservedFrame(
            image, np.zeros(image.shape, np.int32), image.copy(), detector="R22_S11", physical_filter="y_10"
        )
        frames.append(partial(replace, frame))
    made = make_templates(frames, "2026-11-21T03:43:40", TemplateOptions())
    recorded({"patterns": made.patterns, "scores": made.scores, "variance": made.variance})
