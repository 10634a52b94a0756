"""Sections of the recomputation with made-up curves and maps in the place of the published ones, as recorded.

The published ones do not belong to the package; whether the numbers of the paper are met, other tests say.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from recorded_numbers import Record

from lsst.fringe_sim.mock.thickness import e2v_321
from lsst.fringe_sim.paper import coadds, laboratory, optics, sky
from lsst.fringe_sim.paper.reproduce import SECTIONS
from lsst.fringe_sim.paper.section import Context
from lsst.fringe_sim.resources import read_table

SERIALS = dict(laboratory.RAFT)
SMALLER = {
    (laboratory, "FIT_SHAPE"): (40, 44),
    (sky, "HSC_SIDE"): 60,
    (sky, "HSC_SCALE"): 8.0,
    (coadds, "REGION_PX"): 64,
    (coadds, "WINDOW_PX"): 160,
    (coadds, "TREECORR_PX"): 24,
    (optics, "PATH_RAYS"): 4,
    (optics, "BINS"): (10, 50),
    (optics, "BEAM_NODES"): 24,
}
"""What takes long, smaller."""


def wave(x: Any, period: float, size: float = 1.0) -> np.ndarray:
    return size * np.sin(2.0 * np.pi * np.asarray(x, dtype=float) / period)


def map_file(path: Path, number: int) -> None:
    """A map of the range of the thickness, as they were read off the figures; one of them jumps by an order."""
    y, x = np.linspace(20.0, 3980.0, 60), np.linspace(50.0, 4040.0, 64)
    fine = 1.0 + 1e-3 * number + wave(y[:, None] + 0.7 * x, 3500.0 + 100 * number) + 1e-4 * x
    if number == 3:
        fine[30:] += 0.3
    parts = {"FINE": fine, "XSRC": x.astype(np.int16), "YSRC": y.astype(np.int16)}
    images = [fits.ImageHDU(values, name=name) for name, values in parts.items()]
    fits.HDUList([fits.PrimaryHDU(), *images]).writeto(path)


@pytest.fixture(scope="module")
def context(tmp_path_factory: pytest.TempPathFactory) -> Context:
    folder = tmp_path_factory.mktemp("shared")
    measured = folder / "measured"
    measured.mkdir()
    (folder / "data").mkdir()
    phase = (np.arange(32) + 0.5) / 32
    step, wide = np.arange(0.0, 3970.0, 50.0), np.arange(820.0, 1000.0, 2.1)
    inset, depth = np.arange(958.0, 970.0, 0.2), np.linspace(600.0, 1060.0, 80)
    diagonal = {"diagonal_pixel": step, "amp_percent": wave(step, 400.0, 0.2)}
    curves = {
        "E2V-321_960nm_phase_folded": {
            "phase": phase, "measured": wave(phase, 1.0, 0.008), "simulated": wave(phase, 1.0, 0.05)
        },
        "MonoCam_sims_diagonal": diagonal,
        "LSST_fringe_sims_center": diagonal,
        "LSST_fringe_sims_edge": diagonal,
        "HSC-data-sim_measured_diagonal": {"diagonal_pixel": step, "amp": wave(step, 700.0)},
        "bandwidth_verify_2nm": {"wavelength": wide, "absorption": 0.8 + wave(wide, 60.0, 0.05)},
        "bandwidth_verify_1nm_inset": {"wavelength": inset, "absorption": 0.6 + wave(inset, 3.0, 0.02)},
        "Si_absorption_depth_pdf_300K": {"wavelength": depth, "depth": np.exp((depth - 700.0) / 55.0)},
        "Si_absorption_depth_pdf_183K": {"wavelength": depth, "depth": np.exp((depth - 690.0) / 54.0)},
    }  # fmt: skip
    for name, columns in curves.items():
        Table(columns).write(measured / f"{name}.ecsv")
    ours = read_table("sky", "oh_lines_palace_yband.ecsv")
    strong = ours[ours["photon_radiance"] > 0.1 * ours["photon_radiance"].max()]
    seen = strong["photon_radiance"] * (1.0 + wave(np.arange(len(strong)), 7.0, 0.3))
    away = 0.02 + 1.0 * (np.arange(len(strong)) % 5 == 0)
    lines = Table({"wavelength": strong["wavelength"] + away, "intensity": seen, "band": strong["band"]})
    lines.write(folder / "data" / "oh_lines_guo2022_fig8.ecsv", format="ascii.ecsv")
    for number, (slot, serial) in enumerate(SERIALS.items()):
        map_file(measured / f"RTM-020_{slot}_{serial}_epoxy_map.fits", number)
    y, x = np.arange(2.0, 4000.0, 67.0), np.arange(3.0, 4090.0, 71.0)
    flat = 1e4 * (1.0 + wave(y[:, None] + x, 600.0, 0.02) + 1e-5 * x)
    images = [fits.ImageHDU(values, name=name) for name, values in (("XSRC", x), ("YSRC", y))]
    fits.HDUList([fits.PrimaryHDU(flat), *images]).writeto(measured / "E2V-321_960nm_flat_measured.fits")
    fits.PrimaryHDU(wave(y[:, None] - x, 900.0, 0.4)).writeto(measured / "HSC-data-sim_measured.fits")
    small = e2v_321((64, 64))
    return Context(small, small, coadds=12, shared=folder)


@pytest.mark.parametrize(
    "compute",
    [
        pytest.param(one, id=one.__name__, marks=[pytest.mark.slow] * (one.__name__ == "hsc"))  # seconds
        for one in SECTIONS
    ],
)
def test_a_section_is_as_recorded(
    compute: Any, context: Context, recorded: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    for (module, name), value in SMALLER.items():
        monkeypatch.setattr(module, name, value)
    recorded(compute(context))


class OneWave:
    """Stands in the place of a response that takes seconds: a wave that depends on all that it is asked for."""

    def __init__(self, model: Any, spectrum: Any, thickness_range_um: tuple[float, float]) -> None:
        self.low, self.high = thickness_range_um
        self.size = 0.01 * spectrum.airmass * len(spectrum.lines.wavelength_nm) ** 0.1

    def sky(self) -> OneWave:
        return self

    def lookup(self, layer_um: np.ndarray) -> tuple[np.ndarray]:
        return (1.0 + wave(np.asarray(layer_um) - self.low, 0.15 * (self.high - self.low), self.size),)


@pytest.mark.parametrize("published", [True, False])
def test_a_section_on_hsc_with_another_response_is_as_recorded(
    published: bool, context: Context, recorded: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    for (module, name), value in SMALLER.items():
        monkeypatch.setattr(module, name, value)
    monkeypatch.setattr(sky, "sky_response", OneWave)
    recorded(sky.hsc(context if published else replace(context, shared=None)))


def one_fit(cube: Any, model: Any, method: str, threads: int) -> Any:
    """Stands in the place of fits that take seconds: a map that depends on all flats, off by orders in places."""
    reach = {"guo2022": 6.0, "global": 4.0}[method] / model.effect_settings["contrast_loss.factor"]
    off = reach * np.tensordot(0.5 ** np.arange(len(cube.image)), cube.image - 1.0, axes=1)
    off[0, :5] = np.nan
    return SimpleNamespace(value=e2v_321((64, 64))[:40, :44] + off)


def test_a_section_on_fits_with_another_fit_is_as_recorded(
    context: Context, recorded: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    for (module, name), value in SMALLER.items():
        monkeypatch.setattr(module, name, value)
    monkeypatch.setattr(laboratory, "fit_thickness", one_fit)
    made = laboratory.thickness_fit(context)
    assert all(0.0 < value < 100.0 for value in made.values.values())
    recorded(made)
