"""Diffuse return at the gate side against photons followed one by one, and against the measured efficiency."""

from dataclasses import replace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.sky_frame import sky_response
from lsst.fringe_sim.effects import EFFECTS, activate_effects, apply_to_system
from lsst.fringe_sim.instrument.setup import Setup
from lsst.fringe_sim.instrument.sky import EmissionLines, SkySpectrum
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.optics import Layer
from lsst.fringe_sim.optics.diffuse import DiffuseReturn
from lsst.fringe_sim.resources import read_table

WAVES = np.array([880.0, 900.0, 920.0, 940.0, 960.0, 980.0, 1000.0, 1020.0, 1040.0, 1060.0])


def film_reflectance(
    index: list[float], thickness_um: list[float], wave_um: float, sine: np.ndarray
) -> np.ndarray:
    """Mean over both polarisations; sines of the angle in the first medium. Airy's recursion from the far side."""
    total = np.zeros(sine.size)
    for p_wave in (False, True):
        cosines = [np.sqrt(1.0 - (index[0] / each * sine) ** 2 + 0j) for each in index]
        waves = [n / c if p_wave else n * c for n, c in zip(index, cosines, strict=True)]
        reflection = np.zeros(sine.size, complex)
        for layer in reversed(range(len(index) - 1)):
            face = (waves[layer] - waves[layer + 1]) / (waves[layer] + waves[layer + 1])
            reflection = (face + reflection) / (1.0 + face * reflection)
            if layer > 0:
                turns = 4.0 * np.pi * index[layer] * cosines[layer] * thickness_um[layer] / wave_um
                reflection = reflection * np.exp(1j * turns)
        total += 0.5 * np.abs(reflection) ** 2
    return total


def follow(rng, wave_nm: float, reflectance: float, total_reflection: float) -> tuple[float, float]:
    """Parts of photons that are absorbed in 100 µm of silicon and that leave through its coated front."""
    stack = Setup.from_name("ts8_e2v").stack
    n = stack.indices(wave_nm, 183.15)
    silicon, alpha = n[3].real, 4.0 * np.pi * n[3].imag / (1e-3 * wave_nm)
    media, films = [silicon, n[2].real, n[1].real, 1.0], [0.0, 0.0441, 0.1221, 0.0]
    cosine = np.sqrt(rng.uniform(size=60_000))
    count = cosine.size
    absorbed = escaped = 0
    while cosine.size:
        live = rng.exponential(1.0 / alpha, cosine.size) > 100.0 / cosine
        absorbed, cosine = absorbed + np.count_nonzero(~live), cosine[live]
        back = rng.uniform(size=cosine.size) < film_reflectance(
            media, films, 1e-3 * wave_nm, np.sqrt(1 - cosine**2)
        )
        escaped, cosine = escaped + np.count_nonzero(~back), cosine[back]
        live = rng.exponential(1.0 / alpha, cosine.size) > 100.0 / cosine
        absorbed, cosine = absorbed + np.count_nonzero(~live), cosine[live]
        # At the gate side: returned, or reflected totally where it is flat and not blocked on the way up, or lost.
        draw = rng.uniform(size=(3, cosine.size))
        returned = draw[0] < reflectance
        totally = np.sqrt(1 - cosine**2) > n[4].real / silicon
        up = ~returned & totally & (draw[1] < total_reflection) & (draw[2] >= reflectance)
        cosine = np.where(returned, np.sqrt(rng.uniform(size=cosine.size)), cosine)[returned | up]
    return absorbed / count, escaped / count


@pytest.mark.rng("diffuse photons")
@pytest.mark.parametrize(
    ("wave_nm", "reflectance", "total_reflection"),
    [(900.0, 0.35, 0.0), (960.0, 0.35, 0.0), (1040.0, 0.35, 0.0), (1000.0, 0.2, 1.0), (1060.0, 0.6, 0.5)],
)
def test_photons_one_by_one(wave_nm, reflectance, total_reflection, rng) -> None:
    system = Setup.from_name("ts8_e2v").optical_system()
    changed = apply_to_system(
        activate_effects({"diffuse_gate_side.reflectance": reflectance}, EFFECTS), system
    )
    gate_side = replace(changed.diffuse, total_reflection=total_reflection)
    found = gate_side.fate(changed.stack, "detection", [wave_nm], 183.15)
    own = follow(rng, wave_nm, reflectance, total_reflection)
    # Three standard deviations of so many photons.
    assert found[0].item() == pytest.approx(own[0], abs=0.0062)
    assert found[1].item() == pytest.approx(own[1], abs=0.0062)


def test_energy_is_conserved() -> None:
    """Where all that is not scattered is reflected totally and silicon is deep, nothing but the two ends is left."""
    stack = Setup.from_name("ts8_e2v").stack
    medium = stack.layers[stack.position("detection")].medium
    deep = stack.replace_layer("detection", thickness_um=1e5)
    for name in ("upper", "lower"):
        deep = deep.with_inserted(Layer(name, medium, 0.0), before="gate_oxide")
    taken, left = DiffuseReturn("upper", "lower", 0.5).fate(deep, "detection", WAVES, 183.15)
    np.testing.assert_allclose(taken[WAVES < 1000.0], 1.0, atol=1e-9)
    assert np.all((left >= 0.0) & (taken + left <= 1.0 + 1e-12))
    # All is scattered again and again: what is not absorbed can only leave through the front.
    taken, left = DiffuseReturn("upper", "lower", 1.0 - 1e-12).fate(
        deep.replace_layer("detection", thickness_um=100.0), "detection", WAVES, 183.15
    )
    np.testing.assert_allclose(taken + left, 1.0, atol=1e-9)


def test_plane_wave_gives_what_is_scattered() -> None:
    """Where nearly all is returned, the silicon has one passage of the plane wave, and the diffuse light."""
    model = FringeModel.from_setup("ts8_e2v", {"diffuse_gate_side.reflectance": 0.95, "bandwidth.fwhm": 6.0})
    bare = FringeModel.from_setup("ts8_e2v")
    wave, thickness = 960.0, np.linspace(14.0, 14.3, 31)
    n = bare.system.stack.indices(wave, 183.15)
    media, films = [1.0, n[1].real, n[2].real, n[3].real], [0.0, 0.1221, 0.0441, 0.0]
    entering = 1.0 - film_reflectance(media, films, 1e-3 * wave, np.zeros(1))[0]
    once = np.exp(-4.0 * np.pi * n[3].imag * 100.0 / (1e-3 * wave))
    absorbed = model.system.diffuse.fate(model.system.stack, "detection", [wave], 183.15)[0].item()
    expected = entering * (1.0 - once + 0.95 * once * absorbed)
    assert model.response(thickness, [wave]).mean() == pytest.approx(expected, rel=5e-3)


def test_fringes_fade_with_every_passage() -> None:
    """The wave that comes back from the adhesive has passed the gate side twice, and has (1 - R)² of its power."""
    thickness = np.linspace(14.0, 14.3, 61)

    def swing(reflectance: float) -> float:
        response = FringeModel.from_setup("ts8_e2v", {"diffuse_gate_side.reflectance": reflectance})
        return float(np.ptp(response.response(thickness, [960.0])[0]))

    ratio = swing(0.35) / swing(0.0)
    assert ratio == pytest.approx((1.0 - 0.35) ** 2, rel=0.1)


def test_it_reproduces_the_measured_efficiency() -> None:
    """Of e2v sensors between 880 and 1060 nm, where that of the plane layers falls to a third of the measured one."""
    table = read_table("sky", "qe_lsst_detectors.ecsv")
    measured = np.interp(WAVES, table["wavelength"], table["e2v_QE"])
    thickness = np.linspace(14.0, 14.9, 61)
    spread = {}
    for reflectance in (0.0, 0.3, 0.35, 0.4):
        settings = {
            "diffuse_gate_side.reflectance": reflectance,
            "bandwidth.fwhm": 6.0,
            "temperature.kelvin": 173.15,
        }
        seen = FringeModel.from_setup("ts8_e2v", settings).response(thickness, WAVES).mean(axis=1)
        spread[reflectance] = float(np.std(np.log(seen / measured)))
        if reflectance == 0.35:
            np.testing.assert_allclose(seen[WAVES <= 1000.0], measured[WAVES <= 1000.0], rtol=0.08)
    assert spread[0.0] > 0.38
    assert spread[0.3] < 0.17
    assert spread[0.4] < 0.11


@pytest.mark.slow
def test_level_and_fringes_of_the_sky_come_from_the_same_model() -> None:
    sky = SkySpectrum(EmissionLines.oh())
    plain, diffuse = (
        sky_response(FringeModel.from_setup("lsst_e2v", settings), sky, thickness_range_um=(14.0, 22.0))
        for settings in ({}, {"diffuse_gate_side.reflectance": 0.35})
    )
    # The measured efficiency gives 2893 electrons where that of plane layers gives 2057.
    assert diffuse.level / plain.level == pytest.approx(2893 / 2057, abs=0.05)
    fringe = [np.std(each.sky().values[0]) / np.mean(each.sky().values[0]) for each in (plain, diffuse)]
    assert fringe[1] < 0.5 * fringe[0]
