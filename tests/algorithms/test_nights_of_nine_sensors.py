"""Thirty visits of nine sensors at reduced size: fringes left, errors of scales, photometry; nothing is named."""

from importlib.resources import files

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from lsst.fringe_sim.algorithms.correction import AmplifierGrid, BackgroundTerms, fit_scales
from lsst.fringe_sim.algorithms.fringe_correction import TemplateSet
from lsst.fringe_sim.algorithms.laboratory_shift import ADHESIVE_PHASE_SIGMA, template_pair
from lsst.fringe_sim.algorithms.observed_frames import correct_frame
from lsst.fringe_sim.algorithms.sky_response import sky_response
from lsst.fringe_sim.cli.inputs import placed_model
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.sky import SkySpectrum
from lsst.fringe_sim.mock.visits import VisitConditions, write_mock_visits
from lsst.fringe_sim.model import Setup
from lsst.fringe_sim.products.observed_files import observed_images

SIDE, VISITS, SENSORS, SECONDS = 128, 30, 9, 100.0
NOW = "2026-01-01T00:00:00"


BEAM = "{kind: telescope, telescope: LSST}", "{kind: cone, f_number: 2.25, obscuration: 0.61}"
"""A slower beam, whose fringes are large enough for so few pixels to show them in exposures of 100 s."""


@pytest.fixture
def slower(tmp_path):
    """The LSST Camera behind another telescope."""
    content = (files("lsst.fringe_sim") / "data/setups/lsst_e2v.yaml").read_text(encoding="utf-8")
    path = tmp_path / "slower.yaml"
    content = content.replace("exposure_s: 30.0", f"exposure_s: {SECONDS}").replace(*BEAM)
    path.write_text(content, encoding="utf-8")
    return str(path)


def beside(image):
    """An image without a smooth background and levels of amplifiers."""
    background = BackgroundTerms(image.shape, amplifiers=AmplifierGrid(2, 8))
    fit = fit_scales(image, np.ones(image.shape, np.float32), [], background, clip_sigma=np.inf)
    return image - background.surface(fit.coefficient)


def one_sensor(setup, name, rng, folder):
    """Fringes left in each visit and what errors let expect, pulls of scales, errors of fluxes before and after."""
    v, u = (np.linspace(-1.0, 1.0, SIDE) + rng.uniform(-0.4, 0.4) for _ in range(2))
    thickness = 14.0 + 0.5 * (u**2 + v[:, None] ** 2) + 0.1 * np.sin(3.0 * u + rng.uniform(0.0, 6.0))
    described = Setup.from_file(setup)
    sensor = Camera.from_name(described.camera).detector(name)
    model = placed_model(described, {}, sensor)
    span = float(thickness.min()) - 0.4, float(thickness.max()) + 0.4
    response = sky_response(model, SkySpectrum.dark(airmass=described.airmass), thickness_range_um=span)
    pair = template_pair(thickness, model, response, ADHESIVE_PHASE_SIGMA, NOW)
    known = TemplateSet.of(pair)
    basis = np.stack([beside(each).ravel() for each in known.patterns], axis=1)
    left, pulls, fluxes = [], [], []
    visits = write_mock_visits(
        folder,
        setup=setup,
        detector=name,
        thickness_um=thickness,
        rng=rng,
        conditions=VisitConditions(VISITS),
    )
    for visit in visits:
        frame = observed_images(visit.path)[0].read()
        done = correct_frame(frame, known)
        truth = beside(visit.fringes)
        after = beside(visit.fringes - done.fringes)
        scale = np.linalg.lstsq(basis, truth.ravel(), rcond=None)[0]
        # The scales' errors, times the templates, are what a good template leaves.
        noise = np.sqrt(np.sum(done.correction.covariance * (basis.T @ basis)) / truth.size)
        left.append(np.array([after.std(), noise]) / truth.std())
        pulls.append((done.correction.scale - scale) / done.correction.sigma)
        # Light of the fringes in apertures of 9 x 9 px.
        fluxes.append([81.0 * uniform_filter(each, 9).std() for each in (truth, after)])
    return left, pulls, fluxes


@pytest.mark.slow
@pytest.mark.rng("thirty visits of nine sensors")
def test_thirty_visits_of_nine_sensors(rng, slower, tmp_path):
    """Visits come from the simulator of the mock, templates from the model; nobody names the amplifiers."""
    left, pulls, fluxes = [], [], []
    for number, stream in enumerate(rng.spawn(SENSORS)):
        name = f"R22_S{number // 3}{number % 3}"
        found = one_sensor(slower, name, stream, tmp_path / name)
        for total, part in zip((left, pulls, fluxes), found, strict=True):
            total.extend(part)
    before, after = np.array(fluxes).T
    parts, expected = np.array(left).T
    assert np.median(parts) < 0.15
    # Beside the errors of the scales, bands have patterns that two templates do not hold.
    assert np.median(parts / expected) < 1.5
    # 540 pulls know their scatter to 0.03.
    assert np.std(pulls) == pytest.approx(1.0, abs=0.1 + 2.0 * 0.03)
    assert abs(np.mean(pulls)) < 0.3
    assert np.median(after / before) < 0.15
