"""Measured flats of the real sensor against waves that share no code with the package: contrast and what it lacks."""

import numpy as np
import pytest
from foreign_sky import DATA, ForeignSky
from scipy.optimize import curve_fit

LINE_NM = np.linspace(-2.4, 2.4, 25)  # Offsets within a line of 2 nm; its fringes of silicon are 1.2 nm apart
LINE = np.exp(-4.0 * np.log(2.0) * (LINE_NM / 2.0) ** 2)


def table(name: str) -> dict[str, np.ndarray]:
    """Columns of a shipped table of numbers."""
    text = (DATA / "laboratory" / f"{name}.ecsv").read_text()
    rows = [line.split() for line in text.splitlines() if line[0] != "#"]
    return dict(zip(rows[0], np.array(rows[1:], dtype=float).T, strict=True))


def flat(wave_nm: float, adhesive_um: np.ndarray) -> np.ndarray:
    """Relative light of a flat, normal incidence, plane layers, silicon of 183 K."""
    sensor = ForeignSky(kelvin=183.0)
    seen = [sensor.absorbed(wave_nm + each, np.zeros(1), "s", adhesive_um)[0] for each in LINE_NM]
    light = np.average(seen, axis=0, weights=LINE)
    return np.asarray(light / light.mean())


@pytest.fixture(scope="module")
def adhesive() -> np.ndarray:
    return np.linspace(14.0, 22.0, 801)


def test_twelve_flats_of_one_pixel_have_a_seventh_of_the_contrast(adhesive) -> None:
    """An offset and one factor on the fringes: 0.003 are left, and 0.040 with the contrast of plane layers."""
    pixel = table("e2v_321_pixel_2100_2100")
    fringes = np.array([flat(wave, adhesive) - 1.0 for wave in pixel["wavelength"]]).T
    misfit = []
    for fringe in fringes:
        rows = np.stack([fringe, np.ones(fringe.size)], axis=1)
        found = np.linalg.lstsq(rows, pixel["amplitude"], rcond=None)[0]
        misfit.append((np.sqrt(np.mean((pixel["amplitude"] - rows @ found) ** 2)), found[0]))
    rms, factor = min(misfit)
    plain = (pixel["amplitude"] - fringes).std(axis=1).min()
    assert rms == pytest.approx(0.0031, abs=2e-4)
    assert factor == pytest.approx(0.15, abs=0.01)
    assert plain == pytest.approx(0.040, abs=0.003)


def test_contrast_falls_with_thickness_as_no_plane_layer_does(adhesive) -> None:
    """At 960 nm by 8.3 ± 0.5 per cent per µm, over the blocks of the flat; that of plane layers by 0.8."""
    block = table("e2v_321_contrast_960nm")
    away = block["thickness"] - block["thickness"].mean()
    fit, covariance = curve_fit(
        lambda x, mean, slope: mean * np.exp(slope * x), away, block["contrast"], (0.014, 0.0)
    )
    seen = flat(960.0, adhesive)
    orders = [seen[(adhesive >= low) & (adhesive < low + 0.3)] for low in np.arange(14.0, 21.6, 0.3)]
    own = np.polyfit(np.arange(len(orders)) * 0.3, [np.log(np.ptp(each)) for each in orders], 1)[0]
    assert fit[1] == pytest.approx(-0.083, abs=0.001)
    assert np.sqrt(covariance[1, 1]) == pytest.approx(0.0045, abs=5e-4)
    assert own == pytest.approx(-0.008, abs=0.002)
