"""Response of the detection layer: the paper's table, the sky table, single evaluations."""

from __future__ import annotations

import math
import time

import numba
import numpy as np
import tmm

from lsst.fringe_sim.optics import Beam, Illumination, LayerStack, layer_absorption
from lsst.fringe_sim.optics.closed_form import on_grid
from lsst.fringe_sim.optics.illumination import GaussianProfile, MonochromaticProfile
from lsst.fringe_sim.optics.system import OpticalSystem

from ._table import Row, median_time

TEMPERATURE_K = 183.0
WAVELENGTHS_NM = np.arange(880.0, 991.0, 10.0)
THICKNESSES = 30_000
SAMPLES = 81


def run() -> list[Row]:
    return [*paper_table(), *sky_table(), *single_evaluations()]


def paper_light() -> tuple[OpticalSystem, Illumination]:
    """12 wavelengths with 81 samples of a 2 nm Gaussian, normal incidence."""
    system = OpticalSystem(
        LayerStack.from_resource("e2v_ccd250"), TEMPERATURE_K, GaussianProfile(2.0), Beam.collimated()
    )
    offset = np.linspace(-3.0, 3.0, SAMPLES)
    weight = np.exp(-0.5 * (offset / (2.0 / 2.3548)) ** 2)
    wave = WAVELENGTHS_NM[:, None] + offset
    shares = np.broadcast_to(weight / weight.sum(), wave.shape)
    return system, Illumination(wave, np.zeros(wave.shape), shares)


def paper_table() -> list[Row]:
    system, light = paper_light()
    start, step = 5.0, 25.0 / THICKNESSES
    evaluations = float(THICKNESSES * light.weight.size)
    work = f"paper's table: {THICKNESSES} thicknesses × 12 wavelengths × {SAMPLES} samples"

    def ours() -> np.ndarray:
        return system.reduce(light).averaged_on_grid(light.weight, start, step, THICKNESSES)

    ours_s = median_time(ours, 7)
    closed = system.reduce(light)
    arrays, weights, _ = closed._grouped(light.weight)
    direct_s = median_time(lambda: on_grid(arrays, weights, start, step, THICKNESSES), 3)

    index = system.stack.indices(light.wavelength_nm, TEMPERATURE_K)
    wave_um = 1e-3 * light.wavelength_nm
    few = start + 25.0 * np.linspace(0.0, 1.0, 40)
    matrices_s = median_time(
        lambda: matrix_loop(index, system.stack.thickness_um, wave_um, light.weight, few, 7), 3
    )
    matrix_each = matrices_s / (few.size * light.weight.size)

    rng = np.random.default_rng(1)
    cases = [
        (rng.integers(12), rng.integers(SAMPLES), start + step * rng.integers(THICKNESSES))
        for _ in range(400)
    ]
    began = time.perf_counter()
    expected = [
        tmm_detection(index[:, i, j], system.stack.thickness_um, d, wave_um[i, j]) for i, j, d in cases
    ]
    tmm_each = (time.perf_counter() - began) / len(cases)
    wrong = max(
        abs(closed.evaluate(d)[i, j] - value) for (i, j, d), value in zip(cases, expected, strict=True)
    )
    gap = np.abs(ours() - on_grid(arrays, weights, start, step, THICKNESSES)).max()
    return [
        Row(work, "tmm 0.2 (400 of them)", tmm_each * evaluations, evaluations),
        Row(
            work,
            "2×2 matrices, compiled, all cores (40 thicknesses)",
            matrix_each * evaluations,
            evaluations,
            tmm_each,
            "the paper's algorithm, R and T only",
        ),
        Row(work, "closed form at every node", direct_s, evaluations, tmm_each),
        Row(
            work,
            "harmonic series (this package)",
            ours_s,
            evaluations,
            tmm_each,
            f"largest difference from tmm {wrong:.1e}, from the closed form {gap:.1e}; "
            f"{matrix_each / (ours_s / evaluations):,.0f}× the matrices",
        ),
    ]


def tmm_detection(index: np.ndarray, thickness_um: np.ndarray, adhesive_um: float, wave_um: float) -> float:
    d = thickness_um.copy()
    d[7] = adhesive_um
    return float(tmm.absorp_in_each_layer(tmm.coh_tmm("s", index, d, 0.0, wave_um))[3])


@numba.njit(cache=True, parallel=True)
def matrix_loop(
    index: np.ndarray,
    d: np.ndarray,
    wave: np.ndarray,
    weight: np.ndarray,
    thickness: np.ndarray,
    varying: int,
) -> np.ndarray:
    """1 - R - T by a product of 2×2 matrices for every thickness, wavelength and sample (section 2.1)."""
    layers, rows, samples = index.shape
    out = np.zeros((rows, thickness.size))
    for i in numba.prange(thickness.size):
        for w in range(rows):
            for s in range(samples):
                m00, m01, m10, m11 = 1.0 + 0j, 0j, 0j, 1.0 + 0j
                for layer in range(layers - 1):
                    n1, n2 = index[layer, w, s], index[layer + 1, w, s]
                    r, t = (n1 - n2) / (n1 + n2), 2.0 * n1 / (n1 + n2)
                    if layer > 0:
                        depth = thickness[i] if layer == varying else d[layer]
                        delta = 2.0 * math.pi * n1 * depth / wave[w, s]
                        back, forth = np.exp(-1j * delta), np.exp(1j * delta)
                    else:
                        back, forth = 1.0 + 0j, 1.0 + 0j
                    a00, a01, a10, a11 = back / t, back * r / t, forth * r / t, forth / t
                    m00, m01, m10, m11 = (
                        m00 * a00 + m01 * a10,
                        m00 * a01 + m01 * a11,
                        m10 * a00 + m11 * a10,
                        m10 * a01 + m11 * a11,
                    )
                reflected = abs(m10 / m00) ** 2
                through = abs(1.0 / m00) ** 2 * index[layers - 1, w, s].real / index[0, w, s].real
                out[w, i] += weight[w, s] * (1.0 - reflected - through)
    return out


def sky_table() -> list[Row]:
    beam = Beam.cone(1.234, 0.61, 64)
    lines = np.linspace(920.0, 1060.0, 146)
    system = OpticalSystem(LayerStack.from_resource("e2v_ccd250"), 173.0, MonochromaticProfile(), beam)
    light = Illumination.spectrum(lines, np.ones(146), beam)
    grid = (14.0, 0.002, 4000)
    evaluations = float(light.weight.size * 2 * grid[2])
    work = "sky table: 146 lines × 64 angles × 2 polarisations × 4000 thicknesses"

    def ours() -> np.ndarray:
        return system.reduce(light).averaged_on_grid(light.weight, *grid)

    arrays, weights, _ = system.reduce(light)._grouped(light.weight)

    def direct() -> np.ndarray:
        return on_grid(arrays, weights, *grid)

    exact = direct()
    error = np.abs(ours() - exact).max() / np.ptp(exact)
    direct_s, ours_s = median_time(direct, 5), median_time(ours, 7)
    cpu_s = median_time(ours, 7, cpu=True)
    return [
        Row(work, "direct sum of the closed form", direct_s, evaluations),
        Row(
            work,
            "harmonic series (this package)",
            ours_s,
            evaluations,
            direct_s / evaluations,
            f"{cpu_s:.2f} s of processor time; {error:.0e} of peak-to-peak from the direct sum",
        ),
    ]


def single_evaluations() -> list[Row]:
    rng = np.random.default_rng(2)
    count = 20_000
    n = rng.uniform(1.0, 4.0, (10, count)) + 1j * rng.uniform(0.0, 0.1, (10, count))
    n[0] = 1.0
    d = rng.uniform(0.0, 2.0, (10, count))
    d[[0, -1]] = np.inf
    wave, theta = rng.uniform(0.4, 1.1, count), rng.uniform(0.0, 1.2, count)
    began = time.perf_counter()
    expected = [
        tmm.absorp_in_each_layer(tmm.coh_tmm("p", n[:, i], d[:, i], theta[i], wave[i])) for i in range(400)
    ]
    tmm_each = (time.perf_counter() - began) / 400
    wrong = np.abs(layer_absorption(n, d, wave, theta, "p")[:, :400] - np.array(expected).T).max()
    ours = median_time(lambda: layer_absorption(n, d, wave, theta, "p"), 5)
    work = f"absorption in every layer of {count} random stacks of 10 layers, p"
    return [
        Row(work, "tmm 0.2 (400 of them)", tmm_each * count, count),
        Row(work, "layer_absorption", ours, count, tmm_each, f"largest difference {wrong:.1e}"),
    ]
