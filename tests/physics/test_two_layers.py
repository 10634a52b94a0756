"""A sky whose pixels have silicon and adhesive of their own, against a transfer matrix for each of them."""

from dataclasses import replace

import numpy as np
import pytest
import tmm
from sky_frames import bright_lines

from lsst.fringe_sim.algorithms.field_response import sensor_response
from lsst.fringe_sim.algorithms.sensor_placement import SensorPlacement
from lsst.fringe_sim.algorithms.sky_frame import sky_response
from lsst.fringe_sim.algorithms.sky_of_maps import silicon_nodes_um, sky_of_maps
from lsst.fringe_sim.algorithms.sky_response import Response, electrons_on_grid
from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.instrument.bandpass import Bandpass
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.setup import Setup
from lsst.fringe_sim.instrument.sky import EmissionLines, SkySpectrum
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.optics import Beam

LINES = SkySpectrum(bright_lines(4))
BEAM = Beam(np.radians([2.0, 5.0, 7.0]), np.array([0.2, 0.5, 0.3]))
ADHESIVE_UM = np.array([[14.2, 15.03, 16.4], [14.9, 15.6, 16.1]])
SILICON_UM = np.array([[99.97, 100.013, 100.04], [100.0, 99.981, 100.031]])


def of_a_beam(settings: dict[str, float] | None = None) -> FringeModel:
    """MonoCam in light of three angles."""
    model = FringeModel.from_setup("monocam", settings)
    return replace(model, base_system=replace(model.base_system, beam=BEAM))


def detected(model: FringeModel, sky: SkySpectrum, adhesive_um: float, silicon_um: float) -> float:
    """Electrons of one pixel: lines, angles and polarisations one by one, layers by `tmm`."""
    stack, total = model.system.stack, 0.0
    lengths_um = [float(length) for length in stack.thickness_um]
    lengths_um[stack.position("adhesive")] = adhesive_um
    place = stack.position("detection")
    lengths_um[place] = silicon_um
    for part in sky.components(Bandpass.from_name("lsst_y")):
        for wave_nm, photons in zip(part.wavelength_nm, part.photons, strict=True):
            index = [complex(n) for n in stack.indices(wave_nm, model.system.temperature_k)]
            for theta, weight in zip(BEAM.theta, BEAM.weight, strict=True):
                for polarization in "sp":
                    solved = tmm.coh_tmm(polarization, index, lengths_um, theta, 1e-3 * wave_nm)
                    absorbed = tmm.absorp_in_each_layer(solved)[place]
                    total += 0.5 * photons * weight * absorbed
    return total


def sky_of_both(model: FringeModel, silicon_um: np.ndarray, span: tuple[float, float]) -> Response:
    place, nodes = SensorPlacement(0.0, 0.0, 0.1, 0.1), silicon_nodes_um(model, silicon_um)
    return sky_of_maps(model, LINES, place, span, nodes).on(silicon_um)


def test_every_pixel_has_the_response_of_its_two_thicknesses() -> None:
    """Single lines, of which the silicon makes fringes a hundred times those of a sky."""
    model = of_a_beam()
    nodes = silicon_nodes_um(model, SILICON_UM)
    # Nothing is interpolated in the upper row.
    silicon = np.stack([nodes[3:6], SILICON_UM[1]])
    own = np.array(
        [
            [detected(model, LINES, *pair) for pair in zip(*rows, strict=True)]
            for rows in zip(ADHESIVE_UM, silicon, strict=True)
        ]
    )
    table = sky_of_both(model, silicon, (14.1, 16.5)).sky()
    difference = np.abs(table.frame(ADHESIVE_UM) - own) / own.mean()
    assert difference[0].max() < 2e-6
    assert difference[1].max() < table.interpolation_error / own.mean() < 2e-3
    without = sky_response(model, LINES, thickness_range_um=(14.1, 16.5)).sky().frame(ADHESIVE_UM)
    assert np.abs(without - own).max() / own.mean() > 0.03


def test_pixels_that_lack_one_of_the_two_are_not_known() -> None:
    silicon, adhesive = SILICON_UM.copy(), ADHESIVE_UM.copy()
    silicon[0, 1], adhesive[1, 2] = np.nan, np.nan
    frame = sky_of_both(of_a_beam(), silicon, (14.1, 16.5)).sky().frame(adhesive)
    np.testing.assert_array_equal(np.isnan(frame), [[False, True, False], [False, False, True]])


def test_silicon_that_is_even_is_one_stack() -> None:
    """Its thickness is that of the map, whatever an effect adds to that of the stack."""
    even = np.full(ADHESIVE_UM.shape, 100.031)
    frames = [
        sky_of_both(of_a_beam(settings), even, (14.1, 16.5)).sky().frame(ADHESIVE_UM)
        for settings in (None, {"silicon_thickness.offset": 0.02})
    ]
    moved = of_a_beam({"silicon_thickness.offset": 0.031})
    expected = sky_response(moved, LINES, thickness_range_um=(14.1, 16.5)).sky().frame(ADHESIVE_UM)
    for frame in frames:
        np.testing.assert_allclose(frame, expected, rtol=2e-6)


@pytest.mark.parametrize(
    ("setup", "settings", "silicon", "error"),
    [
        ("hsc", {}, SILICON_UM, InputError),
        ("monocam", {"silicon_gradient.gradient_x": 0.1}, SILICON_UM, InputError),
        ("monocam", {}, np.full((2, 2), np.nan), InputError),
        ("monocam", {}, np.array([[90.0, 110.0]]), OutOfRangeError),
    ],
)
def test_what_is_no_map_of_the_silicon_is_refused(setup, settings, silicon, error) -> None:
    with pytest.raises(error):
        silicon_nodes_um(FringeModel.from_setup(setup, settings), silicon)


@pytest.mark.slow
def test_a_tenth_of_a_micrometre_of_silicon_is_another_pattern() -> None:
    """LSST, centre of the field, OH lines: correlation of the patterns below 15 and above 18 µm of adhesive."""
    grid = (14.0, 0.01, 800)
    adhesive = grid[0] + grid[1] * np.arange(grid[2])
    band, sky = Bandpass.from_name("lsst_y"), SkySpectrum(EmissionLines.oh())

    def pattern(silicon: str, offset: float) -> np.ndarray:
        setup = Setup.from_name("lsst_e2v").with_silicon(silicon)
        model = FringeModel.from_setup(setup, {"silicon_thickness.offset": offset} if offset else {})
        return np.sum(list(electrons_on_grid(model, sky, band, *grid).values()), axis=0)

    found = {
        silicon: [
            float(np.corrcoef(plain[where], thicker[where])[0, 1])
            for where in (adhesive < 15.0, adhesive > 18.0)
        ]
        for silicon in ("Si_green2008", "Si")
        for plain, thicker in ((pattern(silicon, 0.0), pattern(silicon, 0.1)),)
    }
    # With the constants of the paper, and with those measured in the cold.
    assert found["Si_green2008"] == pytest.approx([0.59, 0.39], abs=0.03)
    assert found["Si"] == pytest.approx([0.73, 0.54], abs=0.03)


@pytest.mark.slow
def test_continua_between_two_thicknesses_of_the_silicon() -> None:
    """In every beam of the LSST they are on a straight line; a thickness between has the pattern of its own sum."""
    model = FringeModel.from_setup("lsst_e2v")
    place = SensorPlacement.of(Camera.from_name("lsstCam").detector("R22_S11"), 0.2)
    sky, span = SkySpectrum.dark(bright_lines(4)), (15.0, 15.6)
    steps = []
    nodes = silicon_nodes_um(model, np.array([99.97, 100.03]))
    made = sky_of_maps(model, sky, place, span, nodes, phase_sigma=0.0, advance=lambda: steps.append(1))
    assert len(steps) == len(nodes) == len(made.responses)
    number = len(nodes) - 3
    system = model.base_system.with_layer("detection", thickness_um=nodes[number])
    own = sensor_response(replace(model, base_system=system), sky, place, made.thickness_range_um)
    thickness = np.linspace(*span, 400).reshape(20, 20)
    ours, theirs = (each.sky().frame(thickness).astype(float) for each in (made.responses[number], own))
    error = own.quadrature_error + 1e-6
    np.testing.assert_allclose(ours / ours.mean(), theirs / theirs.mean(), rtol=0.0, atol=error)
    assert np.ptp(theirs / theirs.mean()) > 10.0 * error
