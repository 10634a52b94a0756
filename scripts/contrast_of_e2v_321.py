"""Fit the fringes of the published 960 nm flat of E2V-CCD250-321 block by block.

Reads the flat of Figure 2 (`measured/E2V-321_960nm_flat_measured.fits`), takes the adhesive from the map that the
package ships, and fits every block of the sensor with a quadratic illumination, a step at the midline, and the first
two harmonics of the fringe phase. Writes `data/laboratory/e2v_321_contrast_960nm.ecsv`.

    python scripts/contrast_of_e2v_321.py [SHARED_DIR]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table
from numpy.typing import NDArray

from lsst.fringe_sim.instrument.measured_thickness import e2v_321

CHECKOUT = Path(__file__).resolve().parents[1]
OUTPUT = CHECKOUT / "python/lsst/fringe_sim/data/laboratory/e2v_321_contrast_960nm.ecsv"
FLAT = "measured/E2V-321_960nm_flat_measured.fits"

FloatArray = NDArray[np.float64]

BLOCKS = 16  # per axis
ORDER_UM = 0.300  # of an adhesive of index 1.6 at 960 nm
LEAST_ORDERS = 1.5  # in a block: with less, fringe and illumination are not told apart
OUTLIER_SIGMA = 4.0
MIDLINE_ROW = 2002


def design(thickness_um: FloatArray, above: FloatArray) -> FloatArray:
    """Columns of the fit of one block, fringes last."""
    y, x = np.meshgrid(*(np.linspace(-1.0, 1.0, side) for side in thickness_um.shape), indexing="ij")
    columns = [np.ones_like(y), y, x, y * x, y**2, x**2]
    if 0.0 < above.mean() < 1.0:
        columns.append(above)
    phase = 2.0 * np.pi * thickness_um / ORDER_UM
    columns += [np.cos(phase), np.sin(phase), np.cos(2.0 * phase), np.sin(2.0 * phase)]
    return np.stack([column.ravel() for column in columns], axis=1)


def fit_block(image: FloatArray, columns: FloatArray) -> tuple[complex, complex, float]:
    """First and second harmonic, and the standard error of either component of both."""
    values = image.ravel()
    keep = np.isfinite(values)
    for _ in range(2):
        found, *_ = np.linalg.lstsq(columns[keep], values[keep], rcond=None)
        left = values - columns @ found
        spread = 1.4826 * np.median(np.abs(left[keep]))
        keep = np.isfinite(values) & (np.abs(left) < OUTLIER_SIGMA * spread)
    covariance = np.linalg.inv(columns[keep].T @ columns[keep]) * left[keep].var()
    first, second = complex(found[-4], -found[-3]), complex(found[-2], -found[-1])
    return first, second, float(np.sqrt(covariance[-4, -4]))


def main() -> None:
    """Fit all blocks and write the table."""
    shared = Path(sys.argv[1]) if len(sys.argv) > 1 else CHECKOUT.parent / "shared"
    with fits.open(shared / FLAT) as hdus:
        image = hdus[0].data.astype(float)
        rows, columns = (hdus[name].data.astype(int) for name in ("YSRC", "XSRC"))
    amplitude = image / np.nanmean(image) - 1.0
    thickness = e2v_321()[np.ix_(rows, columns)]
    above = np.repeat((rows >= MIDLINE_ROW).astype(float)[:, None], len(columns), axis=1)
    lines = []
    for y in np.array_split(np.arange(len(rows)), BLOCKS):
        for x in np.array_split(np.arange(len(columns)), BLOCKS):
            part = np.ix_(y, x)
            if np.ptp(thickness[part]) < LEAST_ORDERS * ORDER_UM:
                continue
            first, second, error = fit_block(amplitude[part], design(thickness[part], above[part]))
            # The second harmonic in the frame of the first: a cosine at its maximum.
            shape = second / abs(first) * np.exp(-2j * np.angle(first))
            lines.append(
                (
                    rows[y].mean(), columns[x].mean(), thickness[part].mean(), abs(first), error,
                    np.angle(first), shape.real, shape.imag,
                )
            )  # fmt: skip
    names = ("y", "x", "thickness", "contrast", "contrast_error", "phase", "second_cos", "second_sin")
    table = Table(rows=lines, names=names)
    for name, unit, decimals in zip(
        names, ("pix", "pix", "um", "", "", "rad", "", ""), (1, 1, 4, 6, 6, 4, 4, 4), strict=True
    ):
        table[name] = np.round(table[name], decimals)
        table[name].unit = unit or None
    descriptions = {
        "y": "row of the middle of the block, full sensor",
        "x": "column of the middle of the block",
        "thickness": "mean adhesive of the shipped map",
        "contrast": "amplitude of the first harmonic over the mean of the flat",
        "contrast_error": "standard error from the scatter of the pixels",
        "phase": "z in contrast * cos(2 pi thickness / 0.300 um + z)",
        "second_cos": "second harmonic over the first, in phase with its maxima",
        "second_sin": "the same, a quarter of a period of the second harmonic away",
    }
    for name, text in descriptions.items():
        table[name].description = text
    table.meta.update(
        description="Fringes of the 960 nm flat of E2V-CCD250-321, 16 x 16 blocks with 1.5 fringe orders or more",
        source="Guo, Walter, Lage & Lupton 2022, PASP 135, 034503, Figure 2 (flat of SLAC Test Stand 8), fitted here",
        doi="10.1088/1538-3873/acbe67",
        licence="facts, cited (coefficients of a fit to published values)",
        wavelength_nm=960.0,
        order_um=ORDER_UM,
        made_by="scripts/contrast_of_e2v_321.py",
    )
    table.write(OUTPUT, format="ascii.ecsv", overwrite=True)
    print(OUTPUT, len(table))


if __name__ == "__main__":
    main()
