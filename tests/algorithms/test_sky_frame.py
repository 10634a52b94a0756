"""Sky frames against a direct sum over lines and angles, and against laws."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from sky_frames import bright_lines

from lsst.fringe_sim.algorithms.fringe_amplitudes import fringe_amplitudes
from lsst.fringe_sim.algorithms.island_response import IslandTable
from lsst.fringe_sim.algorithms.sky_frame import (
    SkyQuadrature,
    simulate_night,
    simulate_sky_frame,
    sky_response,
    throughput_electrons,
)
from lsst.fringe_sim.effects import ImageGeometry
from lsst.fringe_sim.errors import InputError, OutOfRangeError, UnknownNameError
from lsst.fringe_sim.instrument.bandpass import Bandpass
from lsst.fringe_sim.instrument.night import NightHistory
from lsst.fringe_sim.instrument.sky import EmissionLines, SkySpectrum, airglow_continuum
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.optics import Beam, Illumination, layer_absorption
from lsst.fringe_sim.products import mask_bits

RANGE = (15.0, 16.0)


@pytest.fixture(scope="module")
def monocam() -> FringeModel:
    return FringeModel.from_setup("monocam")


@pytest.fixture(scope="module")
def sky() -> SkySpectrum:
    return SkySpectrum.dark(airmass=1.2)


@pytest.fixture(scope="module")
def response(monocam, sky):
    return sky_response(monocam, sky, thickness_range_um=RANGE)


@pytest.fixture
def thickness(rng):
    return rng.uniform(*RANGE, (40, 50))


def test_frame_is_the_direct_sum_over_lines_and_angles(monocam):
    """Eq. 5 with the plain transfer matrix, line by line and angle by angle."""
    few = SkySpectrum(bright_lines(12), airmass=1.0)
    beam = Beam.cone(4.0, nodes=24)
    model = replace(monocam, base_system=replace(monocam.base_system, beam=beam))
    thickness = np.array([[15.03, 15.41], [15.77, 15.98]])
    exact = SkyQuadrature(line_shift_nm=0.0, table_tolerance=1e-9)
    frame = simulate_sky_frame(
        thickness, model, response=sky_response(model, few, thickness_range_um=RANGE, quadrature=exact)
    )

    band, stack = Bandpass.from_name("lsst_y"), model.system.stack
    expected = np.zeros(thickness.shape)
    lines = few.lines
    wave = lines.wavelength_nm
    photons = lines.photon_radiance * lines.transmission * band.air.scattering(wave) * band.transmission(wave)
    for wavelength, weight in zip(wave, photons, strict=True):
        index = stack.indices(wavelength, model.system.temperature_k)
        for theta, share in zip(beam.theta, beam.weight, strict=True):
            for place in np.ndindex(thickness.shape):
                layers = stack.thickness_um.copy()
                layers[stack.position("adhesive")] = thickness[place]
                absorbed = layer_absorption(index, layers, 1e-3 * wavelength, theta)
                expected[place] += weight * share * absorbed[stack.position("detection")]
    expected *= 60.0 * 1.327 * 0.397**2
    np.testing.assert_allclose(frame.image, expected, rtol=1e-6)
    assert frame.mean_electrons == pytest.approx(expected.mean(), rel=1e-6)


def test_finer_sums_stay_within_the_stated_error(monocam, sky, response):
    points = np.linspace(*RANGE, 23)
    components = sky.components(Bandpass.from_name("lsst_y"), continuum_step_nm=0.1)
    wavelength = np.concatenate([item.wavelength_nm for item in components])
    photons = np.concatenate([item.photons for item in components])
    exact = monocam.respond(Illumination.spectrum(wavelength, photons, monocam.system.beam), points)[0]
    exact *= photons.sum()
    table = response.sky()
    difference = np.abs(exact - table.lookup(points)[0]).max() / exact.mean()
    assert difference < response.quadrature_error + table.interpolation_error / exact.mean()
    assert response.quadrature_error < 2e-5


def test_coarse_sums_state_a_large_error(monocam, sky):
    coarse = SkyQuadrature(line_shift_nm=0.3, continuum_step_nm=2.0, continuum_angles=4)
    rough = sky_response(monocam, sky, thickness_range_um=RANGE, quadrature=coarse)
    assert rough.quadrature_error > 1e-3


@pytest.mark.rng("components add up")
def test_components_add_up(response, thickness):
    """A frame with everything equals the sum of frames with one component each."""
    names = response.component
    whole = response.sky().lookup(thickness)
    parts = sum(
        response.sky({other: float(other == name) for other in names}).lookup(thickness) for name in names
    )
    np.testing.assert_allclose(parts, whole, rtol=1e-12)
    assert set(response.bands) == {
        name for name in names if name not in ("airglow continuum", "zodiacal light")
    }


@pytest.mark.rng("continuum alone hardly fringes")
def test_continuum_alone_hardly_fringes(response, thickness):
    dark = dict.fromkeys(response.bands, 0.0)
    lines = {name: 0.0 for name in response.component if name not in response.bands}
    continuum = fringe_amplitudes(response.sky(dark).lookup(thickness))
    emission = fringe_amplitudes(response.sky(lines).lookup(thickness))
    assert continuum.rms < 0.3 * emission.rms


@pytest.mark.rng("electrons scale with time and level")
def test_electrons_scale_with_time_and_level(monocam, response, thickness):
    one, two = (simulate_sky_frame(thickness, monocam, response=response, exposure_s=t) for t in (30.0, 90.0))
    np.testing.assert_allclose(two.image, 3 * one.image, rtol=1e-6)
    given = simulate_sky_frame(thickness, monocam, response=response, mean_electrons=2717.0)
    assert given.image.mean(dtype=float) == pytest.approx(2717.0, rel=1e-6)
    np.testing.assert_allclose(given.fraction(), one.fraction(), atol=1e-6)


@pytest.mark.rng("header states errors and amplitudes")
def test_header_states_errors_and_amplitudes(monocam, response, thickness):
    frame = simulate_sky_frame(thickness, monocam, response=response, detector="R22_S11", physical_filter="y")
    amplitudes = fringe_amplitudes(frame.image)
    assert frame.metadata["FRINGRMS"] == pytest.approx(amplitudes.rms, rel=1e-5)
    assert frame.metadata["FRINGPTP"] == pytest.approx(amplitudes.half_peak_to_peak, rel=1e-5)
    assert frame.metadata["FRING198"] == pytest.approx(amplitudes.half_range_1_99, rel=1e-5)
    assert 0 < frame.metadata["INTERR"] < 1e-4
    assert frame.quadrature_error == response.quadrature_error
    assert (frame.detector, frame.physical_filter, frame.airmass) == ("R22_S11", "y", 1.2)


@pytest.mark.rng("unknown thickness is masked")
def test_unknown_thickness_is_masked(monocam, response, thickness):
    thickness[3, 4] = np.nan
    frame = simulate_sky_frame(thickness, monocam, response=response, seed=1)
    assert frame.mask[3, 4] == mask_bits("NO_DATA")
    assert np.count_nonzero(frame.mask) == 1
    assert np.all(np.isfinite(frame.image))


@pytest.mark.rng("noise is poisson plus read noise and repeatable")
def test_noise_is_poisson_plus_read_noise_and_repeatable(monocam, response, rng):
    thickness = rng.uniform(*RANGE, (200, 200))
    clean = simulate_sky_frame(thickness, monocam, response=response)
    noisy, again, other = (
        simulate_sky_frame(thickness, monocam, response=response, seed=seed, read_noise_e=8.0)
        for seed in (5, 5, 6)
    )
    np.testing.assert_array_equal(noisy.image, again.image)
    assert not np.array_equal(noisy.image, other.image)
    pull = (noisy.image - clean.image) / np.sqrt(clean.image + 64.0)
    assert pull.mean() == pytest.approx(0, abs=5 / 200)
    assert pull.std() == pytest.approx(1, abs=5 / np.sqrt(2) / 200)
    assert noisy.seed == 5
    # the amplitudes in the header are those of the fringe, not of the noise
    assert noisy.metadata["FRINGRMS"] == clean.metadata["FRINGRMS"]


@pytest.mark.rng("airglow level multiplies the image")
def test_airglow_level_multiplies_the_image(monocam, response, thickness):
    gradient = np.linspace(0.9, 1.1, 50)
    tilted = simulate_sky_frame(thickness, monocam, response=response, airglow_level=gradient)
    flat = simulate_sky_frame(thickness, monocam, response=response)
    np.testing.assert_allclose(tilted.image, flat.image * gradient.astype(np.float32), rtol=1e-6)


@pytest.mark.rng("night follows its history")
def test_night_follows_its_history(monocam, response, thickness):
    night = NightHistory.guo2022()
    frames = list(simulate_night(thickness, monocam, response, night, seed=3, read_noise_e=5.0))
    assert [frame.hour for frame in frames] == [19.0 + hour for hour in range(11)]
    assert len({frame.seed for frame in frames}) == 11
    scale = night.band_scale(4, response.bands)
    alone = simulate_sky_frame(thickness, monocam, response=response, scale=scale)
    assert frames[4].mean_electrons == pytest.approx(alone.mean_electrons)
    assert frames[0].mean_electrons > 1.5 * frames[5].mean_electrons


@pytest.mark.rng("effects reach the sky")
def test_effects_reach_the_sky(monocam, sky, thickness):
    lines = SkySpectrum(bright_lines(30), airmass=1.0)
    plain, damped = (
        simulate_sky_frame(
            thickness,
            FringeModel.from_setup("monocam", effects),
            response=sky_response(
                FringeModel.from_setup("monocam", effects), lines, thickness_range_um=RANGE
            ),
        )
        for effects in ({}, {"contrast_loss": {"factor": 0.4}})
    )
    assert damped.metadata["FRINGRMS"] == pytest.approx(0.4 * plain.metadata["FRINGRMS"], rel=0.02)
    diffused = FringeModel.from_setup("monocam", {"charge_diffusion": {"sigma": 1.0}})
    smooth = simulate_sky_frame(
        thickness, diffused, response=sky_response(diffused, lines, thickness_range_um=RANGE)
    )
    assert smooth.metadata["FRINGRMS"] < 0.7 * plain.metadata["FRINGRMS"]


def test_level_of_the_measured_quantum_efficiency():
    model = FringeModel.from_setup("lsst_e2v")
    electrons = throughput_electrons(SkySpectrum.dark(), Bandpass.from_name("lsst_y"), model)
    assert electrons == pytest.approx(2717, rel=0.10)


def test_amplitudes_of_a_sine():
    phase = np.linspace(0, 2 * np.pi, 10_001)
    found = fringe_amplitudes(5.0 * (1 + 0.02 * np.sin(phase)))
    assert found.rms == pytest.approx(0.02 / np.sqrt(2), rel=1e-3)
    assert found.half_peak_to_peak == pytest.approx(0.02, rel=1e-6)
    assert found.half_range_1_99 == pytest.approx(0.02 * np.cos(np.pi * 0.01), rel=1e-3)
    masked = np.array([1.0, 1.0, 50.0, np.nan])
    assert fringe_amplitudes(masked, [0, 0, 1, 0]).half_peak_to_peak == 0.0


@pytest.mark.rng("bad input is named")
def test_bad_input_is_named(monocam, sky, response, thickness):
    with pytest.raises(InputError, match="two axes"):
        simulate_sky_frame(thickness[0], monocam, response=response)
    with pytest.raises(InputError, match="no finite value"):
        simulate_sky_frame(np.full((2, 2), np.nan), monocam, response=response)
    with pytest.raises(OutOfRangeError, match="thickness"):
        simulate_sky_frame(thickness + 5, monocam, response=response)
    with pytest.raises(OutOfRangeError, match="exposure time"):
        simulate_sky_frame(thickness, monocam, response=response, exposure_s=0.0)
    with pytest.raises(OutOfRangeError, match="mean level"):
        simulate_sky_frame(thickness, monocam, response=response, mean_electrons=-1.0)
    with pytest.raises(UnknownNameError, match="component of the sky"):
        simulate_sky_frame(thickness, monocam, response=response, scale={"8-3": 1.0})
    with pytest.raises(OutOfRangeError, match="scale of 8-4"):
        response.sky({"8-4": -1.0})
    with pytest.raises(OutOfRangeError, match="photons of the sky"):
        response.sky(dict.fromkeys(response.component, 0.0))
    with pytest.raises(InputError, match="one of the sky, or a bandpass"):
        sky_response(FringeModel.from_setup("ts8_e2v"), sky)
    with pytest.raises(OutOfRangeError, match="thickness range"):
        sky_response(monocam, sky, thickness_range_um=(16.0, 15.0))
    nothing = SkySpectrum(EmissionLines.oh().scaled(dict.fromkeys(EmissionLines.oh().bands, 0.0)))
    with pytest.raises(InputError, match="no light behind the bandpass"):
        sky_response(monocam, nothing)
    with pytest.raises(InputError, match="a positive mean"):
        fringe_amplitudes(np.array([np.nan]))


def test_continuum_without_lines(monocam):
    nothing = EmissionLines.oh().scaled(dict.fromkeys(EmissionLines.oh().bands, 0.0))
    only = sky_response(monocam, SkySpectrum(nothing, (airglow_continuum(),)), thickness_range_um=RANGE)
    assert only.component == ("airglow continuum",)
    assert only.bands == ()


def test_cells_on_an_island_have_its_light_and_those_of_its_rim_of_both() -> None:
    """A pixel of which a part is covered has that part of the light of the island."""
    part = np.array([[0.0, 0.25], [1.0, 0.5]])
    shapes = []

    def coverage(system: object, geometry: ImageGeometry) -> np.ndarray:
        shapes.append((geometry.y_px.size, geometry.x_px.size))
        return part

    tables = [
        SimpleNamespace(
            frame=lambda d, slope=slope: (slope * d).astype(np.float32),
            wavelength_nm=np.array([970.0]),
            interpolation_error=slope,
        )
        for slope in (2.0, 6.0)
    ]
    model = SimpleNamespace(base_system=None)
    table = IslandTable(model, tables[0], ((SimpleNamespace(coverage=coverage), tables[1]),))  # type: ignore[arg-type]
    thickness = np.array([[13.0, 14.0], [15.0, 16.0]])
    np.testing.assert_allclose(table.frame(thickness), (2.0 + 4.0 * part) * thickness, rtol=1e-6)
    assert shapes == [(2, 2)]
    assert table.interpolation_error == 6.0
