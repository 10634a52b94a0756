"""What the adhesive and the silicon do between the temperatures of laboratory and sky, against own lines."""

from dataclasses import replace

import numpy as np
import pytest
import tmm
from sky_frames import bright_sky

from lsst.fringe_sim.algorithms.laboratory_shift import phase_change, template_pair, widened_um
from lsst.fringe_sim.algorithms.pca import project
from lsst.fringe_sim.algorithms.sky_frame import simulate_sky_frame, sky_response
from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.model import LABORATORY_TEMPERATURE, FringeModel
from lsst.fringe_sim.optics import Beam

PHASE = "epoxy_temperature.phase_per_10k"
NORMAL_UM = 14.0  # Adhesive of the stack, to which the phase belongs
SPAN = (14.0, 19.0)
MAP_UM = np.linspace(14.2, 18.8, 64 * 64).reshape(64, 64)
DATE = "2026-01-15T00:00:00"


def absorbed(
    model: FringeModel, wave_nm: float, adhesive_um: float, index_factor: float, kelvin: float
) -> float:
    """Part of light at normal incidence that the detection layer absorbs."""
    stack = model.base_system.stack
    lengths_um = [float(length) for length in stack.thickness_um]
    place = stack.position("adhesive")
    lengths_um[place] = adhesive_um
    index = [complex(n) for n in stack.indices(wave_nm, kelvin)]
    index[place] *= index_factor
    solved = tmm.coh_tmm("s", index, lengths_um, 0.0, 1e-3 * wave_nm)
    return float(tmm.absorp_in_each_layer(solved)[stack.position("detection")])


def at_normal_incidence(setup: str, settings: dict[str, float]) -> FringeModel:
    model = FringeModel.from_setup(setup, settings)
    return replace(model, base_system=replace(model.base_system, beam=Beam.collimated()))


@pytest.mark.parametrize(("setup", "colder_k"), [("lsst_e2v", 10.0), ("monocam", 30.0)])
def test_the_phase_turns_the_fringe_of_the_adhesive(setup: str, colder_k: float) -> None:
    """4 pi n d eps / lambda at 960 nm through 14 um, for every 10 K; index 1.6."""
    factor = 1.0 + 0.3 * colder_k / 10.0 * 0.960 / (4.0 * np.pi * 1.6 * NORMAL_UM)
    model, plain = (at_normal_incidence(setup, settings) for settings in ({PHASE: 0.3}, {}))
    kelvin = plain.setup.temperature_k
    adhesive = np.array([14.3, 16.17, 18.02])
    for wave in (935.0, 1002.0):
        own = [absorbed(plain, wave, each, factor, kelvin) for each in adhesive]
        before = [absorbed(plain, wave, each, 1.0, kelvin) for each in adhesive]
        np.testing.assert_allclose(model.response(adhesive, [wave])[0], own, rtol=1e-9)
        assert np.abs(np.subtract(own, before)).max() > 0.01


def test_ten_kelvin_are_nine_ten_thousandths() -> None:
    """0.3 rad in 16 um, which `epoxy_index` makes with an index larger by 1.4e-3."""
    through_16_um = 0.3 * NORMAL_UM / 16.0
    changed = at_normal_incidence("lsst_e2v", {PHASE: through_16_um}).system.stack
    index = changed.layers[changed.position("adhesive")].medium.index(960.0).real
    assert index / 1.6 - 1.0 == pytest.approx(9e-4, rel=0.02)
    assert index - 1.6 == pytest.approx(1.4e-3, rel=0.03)


def test_the_temperature_of_the_map_decides() -> None:
    """That of the header, or else that of the laboratory's set-up; at that of the sky nothing turns."""
    model = at_normal_incidence("lsst_e2v", {PHASE: 0.3})
    adhesive = np.linspace(14.0, 15.0, 7)
    warmer = model.at_laboratory_temperature({LABORATORY_TEMPERATURE: 193.15})
    twice = at_normal_incidence("lsst_e2v", {PHASE: 0.6})
    np.testing.assert_allclose(
        warmer.response(adhesive, [960.0]), twice.response(adhesive, [960.0]), rtol=1e-12
    )
    same = model.at_laboratory_temperature({LABORATORY_TEMPERATURE: 173.15})
    plain = at_normal_incidence("lsst_e2v", {})
    np.testing.assert_array_equal(same.response(adhesive, [960.0]), plain.response(adhesive, [960.0]))
    for wrong in ("cold", 12.0):
        with pytest.raises(InputError):
            model.at_laboratory_temperature({LABORATORY_TEMPERATURE: wrong})


def test_flats_know_nothing_of_the_telescope() -> None:
    settings = {PHASE: 1.0, "sensor_temperature.offset": 5.0}
    adhesive = np.linspace(14.0, 15.0, 7)
    laboratory = [
        FringeModel.from_setup("ts8_e2v", each).response(adhesive, [960.0]) for each in (settings, {})
    ]
    np.testing.assert_array_equal(*laboratory)


def test_a_warmer_sensor_is_silicon_of_its_temperature() -> None:
    model = at_normal_incidence("lsst_e2v", {"sensor_temperature.offset": 4.0})
    adhesive = np.array([14.3, 16.17])
    for wave in (935.0, 1002.0):
        own = [absorbed(model, wave, each, 1.0, 177.15) for each in adhesive]
        np.testing.assert_allclose(model.response(adhesive, [wave])[0], own, rtol=1e-9)


@pytest.fixture(scope="module")
def skies() -> dict[float, np.ndarray]:
    """MonoCam, over the mean, with the phase at both ends of its uncertainty, near it, and without."""
    return {
        phase: simulate_sky_frame(MAP_UM, model, bright_sky()).image
        for phase in (-0.1, 0.0, 0.06, 0.1)
        for model in (FringeModel.from_setup("monocam", {PHASE: phase}),)
    }


def relative(frame: np.ndarray) -> np.ndarray:
    return np.asarray(frame / frame.mean(dtype=float) - 1.0, dtype=float)


def test_the_uncertainty_is_half_the_difference_of_two_skies(skies) -> None:
    """The effect changes the index, which turns light at an angle by sin²θ / n² more than a change of length does."""
    expected = 0.5 * (relative(skies[0.1]) - relative(skies[-0.1]))
    model = FringeModel.from_setup("monocam")
    stated = simulate_sky_frame(MAP_UM, model, bright_sky(), phase_sigma=0.1)
    rms = float(stated.metadata["PHASERMS"])
    assert rms == pytest.approx(expected.std(), rel=1e-2)
    # 0.1 rad for every 10 K are 0.3 for MonoCam, and as much more as the adhesive is thicker than that of the stack.
    assert 0.2 < rms / relative(skies[0.0]).std() < 0.5
    np.testing.assert_allclose(stated.image, skies[0.0], rtol=2e-6)
    assert "PHASERMS" not in simulate_sky_frame(MAP_UM, model, bright_sky()).metadata


def test_a_correction_may_fit_the_phase(skies) -> None:
    """The second template takes away what the first leaves, and its scale is the phase.

    The template is the sine of 0.1 rad per 10 K, times 3 for 30 K and 16.5 / 14 for the thickness; the scale of the
    frame is the tangent of 0.6 of it.
    """
    model = FringeModel.from_setup("monocam")
    span = widened_um(model, SPAN, 0.1)
    pair = template_pair(MAP_UM, model, sky_response(model, bright_sky(), thickness_range_um=span), 0.1, DATE)
    patterns = np.stack([template.image for template in pair]).astype(float)
    assert [template.metadata["TEMPKIND"] for template in pair] == ["sky", "phase"]
    observed = relative(skies[0.06])
    one, both = (project(observed, patterns[:count], 1.0) for count in (1, 2))
    sigma = 0.1 * 3.0 * 16.5 / NORMAL_UM
    expected = np.tan(0.6 * sigma) / np.sin(sigma)
    assert both.coefficient[1] / both.coefficient[0] == pytest.approx(expected, abs=0.01)
    # What is left is of second order in the phase.
    assert both.chi2_per_pixel < 0.02 * one.chi2_per_pixel


def test_a_map_of_the_temperature_of_the_sky_leaves_nothing_open() -> None:
    model = FringeModel.from_setup("monocam").at_laboratory_temperature({LABORATORY_TEMPERATURE: 153.15})
    response = sky_response(model, bright_sky(4), thickness_range_um=SPAN)
    assert phase_change(response.sky(), MAP_UM, model, 0.3) is None
    assert len(template_pair(MAP_UM, model, response, 0.3, DATE)) == 1
    with pytest.raises(OutOfRangeError, match="uncertainty of the phase"):
        widened_um(model, SPAN, -0.1)
