"""Frames of 16.4 Mpix from tables, beside numpy."""

from __future__ import annotations

import numpy as np

from lsst.fringe_sim.model import ResponseTable, response_table
from lsst.fringe_sim.optics import Beam, Illumination, LayerStack
from lsst.fringe_sim.optics.illumination import MonochromaticProfile
from lsst.fringe_sim.optics.system import OpticalSystem

from ._table import Row, median_time

SHAPE = (4096, 4004)


def thickness_map() -> np.ndarray:
    """A smooth map with the grain of a measurement."""
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    rng = np.random.default_rng(3)
    adhesive = 18.0 + 3.0 * np.sin(x / 900.0) * np.cos(y / 1100.0)
    adhesive += 0.01 * rng.standard_normal(SHAPE, dtype=np.float32)
    return adhesive.astype(np.float32)


def run() -> list[Row]:
    beam = Beam.cone(1.234, 0.61, 16)
    system = OpticalSystem(LayerStack.from_resource("e2v_ccd250"), 173.0, MonochromaticProfile(), beam)
    light = Illumination.spectrum(np.linspace(930.0, 1050.0, 20), np.ones(20), beam)
    table = response_table(system, light, (14.0, 22.0))
    adhesive = thickness_map()
    out = np.empty(SHAPE, dtype=np.float32)
    copy_s = median_time(lambda: np.copyto(out, adhesive), 7)
    pixels = float(out.size)
    return [
        Row("16.4 Mpix, memory", "copy of a float32 image", copy_s, pixels),
        *one_layer(table, adhesive, out, pixels, copy_s),
    ]


def one_layer(
    table: ResponseTable, adhesive: np.ndarray, out: np.ndarray, pixels: float, copy_s: float
) -> list[Row]:
    grid, values = table.thickness_um, table.values[0]
    numpy_s = median_time(lambda: np.interp(adhesive, grid, values), 3)
    ours_s = median_time(lambda: table.frame(adhesive, 0, out), 7)
    error = np.abs(out[:64] - table.lookup(adhesive[:64])[0]).max()
    work = f"16.4 Mpix from a table of {grid.size} thicknesses"
    return [
        Row(work, "np.interp (linear)", numpy_s, pixels),
        Row(
            work,
            "ResponseTable.frame (cubic)",
            ours_s,
            pixels,
            numpy_s / pixels,
            f"{ours_s / copy_s:.1f} copies; float32 rounding {error:.0e}",
        ),
    ]
