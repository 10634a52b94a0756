"""Gates that overlap in a part of a pixel, against own lines, and what tells them from other layers there."""

import numpy as np
import pytest
import tmm

from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.optics import Illumination

WAVES = np.arange(880.0, 991.0, 10.0)
PART = "gate_structure.part"


def absorbed(model: FringeModel, wave_nm: float, adhesive_um: float, gates_um: float) -> float:
    """Part of light at normal incidence that the detection layer absorbs."""
    stack = model.base_system.stack
    lengths_um = [float(length) for length in stack.thickness_um]
    lengths_um[stack.position("adhesive")] = adhesive_um
    lengths_um[stack.position("gates")] = gates_um
    index = [complex(n) for n in stack.indices(wave_nm, model.base_system.temperature_k)]
    solved = tmm.coh_tmm("s", index, lengths_um, 0.0, 1e-3 * wave_nm)
    return float(tmm.absorp_in_each_layer(solved)[stack.position("detection")])


def test_a_pixel_is_the_mean_of_its_parts() -> None:
    model = FringeModel.from_setup("monocam", {PART: 0.3})
    gates = model.base_system.stack.thickness_um[model.base_system.stack.position("gates")]
    for wave in (935.0, 1002.0):
        light = Illumination(np.array([[wave]]), np.zeros((1, 1)), np.ones((1, 1)))
        for adhesive in (14.3, 16.17):
            own = 0.7 * absorbed(model, wave, adhesive, gates) + 0.3 * absorbed(
                model, wave, adhesive, 2.0 * gates
            )
            reduced = model.system.reduce(light)
            assert reduced.averaged(light.weight, [adhesive])[0, 0] == pytest.approx(own, rel=1e-9)
            derivative = reduced.averaged_derivative_on_grid(light.weight, adhesive, 0.01, 1)[0, 0]
            ahead, behind = (
                0.7 * absorbed(model, wave, adhesive + step, gates)
                + 0.3 * absorbed(model, wave, adhesive + step, 2.0 * gates)
                for step in (1e-4, -1e-4)
            )
            assert derivative == pytest.approx((ahead - behind) / 2e-4, rel=1e-4)


def flats(settings: dict[str, float], adhesive_um: np.ndarray) -> np.ndarray:
    response = FringeModel.from_setup("ts8_e2v", settings).response(adhesive_um, WAVES)
    return np.asarray(response / response.mean(axis=1, keepdims=True))


def left_of(wanted: np.ndarray, others: list[np.ndarray], slope: np.ndarray) -> float:
    """Part of a change of flats ``[wave, pixel]`` that others, and another thickness of every pixel, do not make."""

    def beside_thickness(change: np.ndarray) -> np.ndarray:
        own = (change * slope).sum(axis=0) / (slope**2).sum(axis=0)
        return (change - own * slope).ravel()

    target = beside_thickness(wanted)
    made = np.stack([beside_thickness(each) for each in others], axis=1)
    rest = target - made @ np.linalg.lstsq(made, target, rcond=None)[0]
    return float(np.linalg.norm(rest) / np.linalg.norm(wanted))


def test_what_tells_the_structure_from_other_layers() -> None:
    """Flats at twelve wavelengths: each contrast free, and every layer of the gate side."""
    adhesive = np.linspace(14.0, 18.0, 400)
    plain = flats({}, adhesive)
    slope = (flats({}, adhesive + 1e-3) - flats({}, adhesive - 1e-3)) / 2e-3
    wanted = flats({PART: 0.01}, adhesive) - plain
    contrasts = [np.where(WAVES[:, None] == wave, plain - 1.0, 0.0) for wave in WAVES]
    layers = [
        flats({name: size}, adhesive) - plain
        for name, size in (
            ("gate_oxide.offset", 1e-3),
            ("gate_thickness.offset", 1e-3),
            ("insulation.offset", 1e-3),
            ("epoxy_index.offset", 1e-4),
            ("epoxy_index.cauchy", 1e-5),
            ("epoxy_absorption.k", 1e-6),
            ("roughness.sigma", 5.0),
            ("support_index.offset", 1e-4),
            ("diffuse_gate_side.reflectance", 0.01),
        )
    ]
    assert left_of(wanted, contrasts, slope) == pytest.approx(0.22, abs=0.03)
    assert left_of(wanted, [*layers, *contrasts], slope) == pytest.approx(0.08, abs=0.02)
