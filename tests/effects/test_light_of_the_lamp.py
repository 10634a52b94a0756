"""Shapes of the line, lines of the lamp, and the gap, against laws and independent sums."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from scipy.integrate import quad

from lsst.fringe_sim.effects import known_effects
from lsst.fringe_sim.effects.light import xenon_lines
from lsst.fringe_sim.effects.line_profiles import LorentzianProfile, MixedProfile, line_width
from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.optics.illumination import (
    GaussianProfile,
    LampSpectrum,
    MonochromaticProfile,
    TriangularProfile,
)

PHASES = np.linspace(14.0, 14.6, 97)


@pytest.fixture(scope="module")
def base() -> FringeModel:
    return FringeModel.from_setup("ts8_e2v")


@pytest.mark.parametrize("period_nm", [0.48, 1.3, 30.0])
def test_lorentzian_against_adaptive_quadrature(period_nm: float) -> None:
    place, weight = LorentzianProfile(2.0).nodes(0.1)
    reach = float(place.max()) * (1.0 + 1e-3)
    assert reach == pytest.approx(20.0, rel=5e-3)
    whole = np.arctan(2.0 * 20.0 / 2.0) * 2.0
    fringe = quad(
        lambda x: 1.0 / (1.0 + x**2), -20.0, 20.0, weight="cos", wvar=2.0 * np.pi / period_nm, limit=500
    )[0]
    assert weight @ np.cos(2.0 * np.pi * place / period_nm) == pytest.approx(fringe / whole, abs=2e-6)


def test_a_mixture_is_the_sum_of_its_parts(base: FringeModel) -> None:
    for name, other in (("line_wing", LorentzianProfile(2.0)), ("line_triangle", TriangularProfile(2.0))):
        mixed = base.with_effects({f"{name}.fraction": 0.3}).response(PHASES, [905.0])
        alone = base.with_effects({f"{name}.fraction": 1.0})
        parts = [base.response(PHASES, [905.0]), alone.response(PHASES, [905.0])]
        np.testing.assert_allclose(mixed, 0.7 * parts[0] + 0.3 * parts[1], rtol=1e-12)
        assert alone.system.profile == MixedProfile(GaussianProfile(2.0), other, 1.0)


def test_shapes_follow_the_width_and_come_together(base: FringeModel) -> None:
    """The wing belongs to the line as it is, and a triangle may have wings."""
    model = base.with_effects(
        {"bandwidth.fwhm": 3.0, "line_wing.fraction": 0.1, "line_triangle.fraction": 0.4}
    )
    profile = model.system.profile
    assert line_width(profile, "test") == 3.0
    place, weight = profile.nodes(0.1)
    assert weight.sum() == pytest.approx(1.0, abs=1e-12)
    assert weight @ place == pytest.approx(0.0, abs=1e-12)
    assert np.ptp(model.response(PHASES, [960.0])) < np.ptp(base.response(PHASES, [960.0]))


def test_a_triangle_leaves_fringes_of_the_silicon_that_a_gaussian_washes_out(base: FringeModel) -> None:
    """Transform of the line at a fringe per 1.3 nm: 2e-4 for the Gaussian of 2 nm, 4e-2 for the triangle."""
    scatter = {}
    offsets = np.linspace(0.0, 0.13, 8)
    for share in (0.0, 1.0):
        over = [
            base.with_effects({"line_triangle.fraction": share, "silicon_thickness.offset": offset})
            .response([14.0], [960.0])
            .item()
            for offset in offsets
        ]
        # Thicker silicon absorbs more: a straight line besides the fringe.
        scatter[share] = np.std(over - np.polyval(np.polyfit(offsets, over, 1), offsets))
    assert scatter[1.0] > 20.0 * scatter[0.0]


def test_shapes_without_a_width_are_refused(base: FringeModel) -> None:
    with pytest.raises(InputError, match="Gaussian or triangular"):
        line_width(MonochromaticProfile(), "line_wing")
    with pytest.raises(OutOfRangeError, match="share"):
        MixedProfile(GaussianProfile(1.0), GaussianProfile(2.0), 1.2)


def test_lamp_lines_pull_the_light_towards_them(base: FringeModel) -> None:
    waves = np.array([880.0, 940.0, 980.0, 990.0])
    model = base.with_effects({"lamp_lines.strength": 2.0})
    shift = model.system.flat_fields(waves).mean_wavelength_nm - waves
    assert shift[0] > 0.1  # 882.2 nm
    assert abs(shift[1]) < 0.02  # none near
    assert 0.0 < shift[2] < 0.2  # 980.2 nm
    assert shift[3] > 0.1  # 992.6 nm
    change = model.response(PHASES, waves) - base.response(PHASES, waves)
    assert np.abs(change[1]).max() < 0.05 * np.abs(change[0]).max()


def test_lines_stand_on_the_spectrum_that_is_known(base: FringeModel) -> None:
    """Where it is known, both ends included; without one they stand on even light."""
    (effect,) = (each for each in known_effects() if each.name == "lamp_lines")
    alone = effect.change_system(base.system, {"strength": 2.0}).lamp
    wave = alone.wavelength_nm
    known = LampSpectrum(wave[5:-7], np.linspace(3.0, 1.0, wave.size - 12))
    both = effect.change_system(replace(base.system, lamp=known), {"strength": 2.0}).lamp
    np.testing.assert_array_equal(both.wavelength_nm, known.wavelength_nm)
    on_even, product = alone.at(known.wavelength_nm), both.at(known.wavelength_nm)
    ratio = product / (on_even * known.at(known.wavelength_nm))
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-9)


@pytest.mark.shared
def test_lines_are_those_of_the_test_stand(shared_dir: Path) -> None:
    """Digitised spectrum of the lamp of TS8: it peaks within 2 nm of the strong lines between 870 and 1000 nm."""
    table = Table.read(shared_dir / "data" / "ts8_lamp_xenon_digitised.ecsv", format="ascii.ecsv")
    wavelength, light = np.asarray(table["wavelength"]), np.asarray(table["radiance"])
    strong = [
        nm for nm, intensity in zip(*xenon_lines(), strict=True) if intensity >= 400.0 and 870.0 < nm < 1000.0
    ]
    assert len(strong) == 6
    for line in strong:
        near = np.abs(wavelength - line) < 4.0
        assert abs(wavelength[near][np.argmax(light[near])] - line) < 2.5


def test_a_gap_of_half_a_wavelength_is_no_gap(base: FringeModel) -> None:
    """In monochromatic light; a gap of a quarter is the largest change."""
    narrow = {"bandwidth.fwhm": 0.05}
    plain = base.with_effects(narrow).response(PHASES, [960.0])
    changes = [
        np.abs(
            base.with_effects({**narrow, "air_gap.thickness": gap}).response(PHASES, [960.0]) - plain
        ).max()
        for gap in (480.0, 960.0, 240.0)
    ]
    assert changes[0] < 2e-4
    assert changes[1] < 2e-4
    assert changes[2] > 0.01
