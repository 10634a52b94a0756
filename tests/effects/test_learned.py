"""Corrections that were learned: what they do, where they go, and that nobody looks for them."""

from pathlib import Path

import numpy as np
import pytest

from lsst.fringe_sim.effects import (
    AMPLIFIERS,
    EFFECTS,
    LEARNED,
    ImageGeometry,
    activate_effects,
    apply_to_image,
    known_effects,
)
from lsst.fringe_sim.effects.active import settings_of
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.model.effects_override import effects_override, read_effects_override

WAVELENGTHS = np.array([905.0, 960.0])
THICKNESS = np.linspace(14.0, 14.6, 400)


def on_image(settings: dict[str, float], geometry: ImageGeometry) -> np.ndarray:
    """What effects make of even light."""
    system = FringeModel.from_setup("ts8_e2v").base_system
    image = np.ones((len(geometry.wavelength_nm), *geometry.sample_shape))
    return apply_to_image(activate_effects(settings, LEARNED), system, image, geometry)


def test_nobody_looks_for_them() -> None:
    assert {effect.name for effect in LEARNED}.isdisjoint(effect.name for effect in EFFECTS)
    assert set(LEARNED) < set(known_effects())
    assert all(effect.learned and "not physics" in effect.title for effect in LEARNED)
    for effect in LEARNED:
        with pytest.raises(InputError, match="physical"):
            effect.check_search(ImageGeometry.of_pixels((8, 8), WAVELENGTHS))


@pytest.mark.parametrize("setup", ["ts8_e2v", "ts8_itl"])
def test_a_wave_form_is_added_to_one_wavelength(setup: str) -> None:
    """At a single wavelength the change is that of the cosine, a part of the mean over all phases."""
    bare = FringeModel.from_setup(setup)
    learned = FringeModel.from_setup(
        setup, {"learned_response.cos2_960": 0.01, "learned_response.sin1_960": -0.02}
    )
    light = bare.system.flat_fields(WAVELENGTHS, 0.5)
    nodes = bare.system.reduce(light)
    thickness = THICKNESS if setup == "ts8_e2v" else np.linspace(100.0, 100.5, 400)
    each = thickness[:, np.newaxis, np.newaxis]
    change = learned.system.reduce(light).evaluate(each) - nodes.evaluate(each)
    # Nodes are 10 nm apart: the line at 905 nm has no part in that at 960 nm.
    assert np.abs(change[:, 0]).max() < 1e-12
    share = np.maximum(1.0 - np.abs(light.wavelength_nm[1] - 960.0) / 10.0, 0.0)
    turn = np.exp(1j * nodes.kappa[0, 1] * thickness[:, np.newaxis])
    wave = 0.01 * (turn**2).real - 0.02 * turn.imag
    # Fixed by the change at the first thickness: the mean over phases.
    scale = change[:, 1] / (share * wave)
    assert np.ptp(scale, axis=0).max() < 1e-7 * scale.min()
    assert 0.2 < scale.min() < scale.max() < 1.0
    span = np.linspace(0.0, 1.0, 64, endpoint=False) * 2.0 * np.pi
    if not nodes.kappa.imag.any():
        phases = span[:, np.newaxis] / nodes.kappa[0, 1].real
        mean = np.stack([nodes.evaluate(np.broadcast_to(p, nodes.node_shape))[1] for p in phases]).mean(
            axis=0
        )
        assert scale[0] == pytest.approx(mean, rel=1e-9)


def test_flats_frames_and_tables_have_it_alike() -> None:
    model = FringeModel.from_setup("ts8_e2v", {"learned_response.cos1_960": 0.01})
    bare = FringeModel.from_setup("ts8_e2v")
    change = model.response(THICKNESS, WAVELENGTHS) - bare.response(THICKNESS, WAVELENGTHS)
    assert np.abs(change[1]).max() > 1e-3
    table = model.table((13.9, 14.7), WAVELENGTHS).lookup(THICKNESS)
    assert table == pytest.approx(model.response(THICKNESS, WAVELENGTHS), abs=2e-7)


def test_patterns_are_cosines_over_the_sensor() -> None:
    geometry = ImageGeometry.of_pixels((20, 30), WAVELENGTHS)
    image = on_image({"learned_map.y1x2": 0.02, "learned_light.at_960_y0x1": 0.01}, geometry)
    y, x = (np.linspace(0.0, np.pi, size) for size in (20, 30))
    grey = 1.0 + 0.02 * np.cos(y)[:, np.newaxis] * np.cos(2.0 * x)
    assert image[0] == pytest.approx(grey, abs=1e-12)
    assert image[1] == pytest.approx(grey * (1.0 + 0.01 * np.cos(x)), abs=1e-12)


def test_amplifiers_keep_the_mean() -> None:
    geometry = ImageGeometry.of_pixels((16, 32), np.array([885.0, 985.0]))
    image = on_image({"learned_amplifiers.C00": 0.016, "learned_amplifiers.C10_colour": 0.016}, geometry)
    assert image.mean(axis=(1, 2)) == pytest.approx(1.0)
    step = [
        image[:, geometry.amplifier == AMPLIFIERS.index(name)].mean(axis=1) for name in ("C00", "C10", "C05")
    ]
    assert step[0] - step[2] == pytest.approx(0.016)
    assert step[1] - step[2] == pytest.approx([-0.016, 0.016])


def test_an_override_takes_them_everywhere_and_the_sky_leaves_light_out(tmp_path: Path) -> None:
    settings = {
        "learned_response.cos1_960": 0.01, "learned_amplifiers.C00": 0.001, "learned_map.y1x2": 0.02,
        "learned_light.at_960_y0x1": 0.01,
    }  # fmt: skip
    read = read_effects_override(effects_override(settings, "ts8_e2v", "unexplained"))
    assert read == settings
    on_sky = settings_of(activate_effects(read, known_effects()), on_sky=True)
    assert set(on_sky) == {"learned_response.cos1_960", "learned_amplifiers.C00"}
