"""Fit the smooth model of the adhesive of E2V-CCD250-321 that the package ships.

Reads the published thickness map (`measured/RTM-020_S01_E2V-321_epoxy_map.fits`, derived by Guo et al. 2022 from
laboratory flats), checks it for whole rows that sit on another fringe order and puts them back, fits a bicubic
tensor-product spline by least squares and writes the coefficients to
`data/laboratory/thickness_e2v_321.ecsv`.

    python scripts/fit_e2v_321_thickness.py [SHARED_DIR]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table
from numpy.typing import NDArray
from scipy.interpolate import BSpline

CHECKOUT = Path(__file__).resolve().parents[1]
OUTPUT = CHECKOUT / "python/lsst/fringe_sim/data/laboratory/thickness_e2v_321.ecsv"
MAP = "measured/RTM-020_S01_E2V-321_epoxy_map.fits"

SENSOR_SHAPE = (4004, 4096)
COEFFICIENTS = 24  # per axis; more do not lower the cross-validated misfit by more than 1 %
DEGREE = 3
SMOOTHING = 1e-3  # second-difference penalty; decides only the outermost strip, which the map does not cover
ORDER_UM = 0.300  # one fringe order of an adhesive of index 1.6 at 960 nm


def repair_row_orders(thickness: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
    """Undo jumps of whole fringe orders between successive rows.

    The published fit walked from row to row, so an order slip shifts everything above it by n × 0.300 µm.

    Parameters
    ----------
    thickness : `numpy.ndarray`, (rows, columns)
        Thickness [µm].

    Returns
    -------
    repaired : `numpy.ndarray`, (rows, columns)
        Thickness with continuous rows [µm].
    jumps : `int`
        Number of jumps that were removed.
    """
    steps = np.median(np.diff(thickness, axis=0), axis=1)
    # The sensor itself changes slowly, so a jump is a step unlike the steps around it.
    padded = np.pad(steps, 3, mode="edge")
    local = np.median(np.lib.stride_tricks.sliding_window_view(padded, 7), axis=1)
    orders = np.rint((steps - local) / ORDER_UM)
    shift = np.concatenate([[0.0], np.cumsum(orders)]) * ORDER_UM
    return thickness - shift[:, np.newaxis], int(np.count_nonzero(orders))


def knots(size: int) -> NDArray[np.float64]:
    """Knots of a clamped cubic spline over the pixel centres 0 … size - 1."""
    inner = np.linspace(0.0, size - 1.0, COEFFICIENTS - DEGREE + 1)
    return np.concatenate([[0.0] * DEGREE, inner, [size - 1.0] * DEGREE])


def fit_operator(position: NDArray[np.float64], size: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Basis at the positions, and the matrix that turns data there into coefficients."""
    basis = BSpline.design_matrix(position, knots(size), DEGREE).toarray()
    bend = np.diff(np.eye(COEFFICIENTS), 2, axis=0)
    return basis, np.linalg.solve(basis.T @ basis + SMOOTHING * bend.T @ bend, basis.T)


def main(shared: Path) -> None:
    """Fit and write the table."""
    with fits.open(shared / MAP) as hdus:
        measured = hdus["FINE"].data.astype(float) + float(hdus[0].header["ABSMIN"])
        columns = hdus["XSRC"].data.astype(float)
        rows = hdus["YSRC"].data.astype(float)
    repaired, jumps = repair_row_orders(measured)
    basis_y, solve_y = fit_operator(rows, SENSOR_SHAPE[0])
    basis_x, solve_x = fit_operator(columns, SENSOR_SHAPE[1])
    coefficients = np.round(solve_y @ repaired @ solve_x.T, 5)
    residual = repaired - basis_y @ coefficients @ basis_x.T

    iy, ix = np.indices(coefficients.shape)
    table = Table(
        {"iy": iy.ravel(), "ix": ix.ravel(), "coefficient": coefficients.ravel()},
        descriptions={
            "iy": "index of the spline basis function along y",
            "ix": "index of the spline basis function along x",
            "coefficient": "coefficient of the tensor-product spline",
        },
        units={"coefficient": "um"},
    )
    table.meta = {
        "description": "Smooth model of the adhesive thickness of E2V-CCD250-321 (LSSTCam R11_S01)",
        "model": "sum over iy, ix of coefficient * B_iy(y) * B_ix(x); clamped uniform B-splines",
        "degree": DEGREE,
        "coefficients_per_axis": COEFFICIENTS,
        "sensor_shape": list(SENSOR_SHAPE),
        "coordinates": "0-based pixel centres of the full sensor, lower-left origin; knots span 0 to size - 1",
        "source": (
            "Guo, Walter, Lage & Lupton 2022, PASP 135, 034503 (figures 5 and 7: sensor S01 of RTM-020); "
            "spline fitted here to 242 x 240 cells of that map"
        ),
        "doi": "10.1088/1538-3873/acbe67",
        "licence": "facts, cited (coefficients of a fit to published values)",
        "row_jumps_removed": jumps,
        "residual_rms_um": round(float(residual.std()), 5),
        "residual_max_um": round(float(np.abs(residual).max()), 5),
        "residual_note": "the map itself is quantised to 9 nm rms and its fitted phases cluster by as much",
        "extrapolated": "outside rows 23-3980 and columns 56-4039 the spline continues with its curvature",
        "made_by": "scripts/fit_e2v_321_thickness.py",
    }
    table.write(OUTPUT, format="ascii.ecsv", overwrite=True)
    print(f"{OUTPUT}: {jumps} row jumps removed, rms difference to the map {1e3 * residual.std():.2f} nm")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else CHECKOUT.parent / "shared")
