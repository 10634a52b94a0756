"""Sky: principal components, correlation functions, noise, beams, each beside the package that one would take."""

from __future__ import annotations

import gc
import tempfile
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import galsim
import numpy as np
import treecorr
from sklearn.decomposition import PCA, IncrementalPCA

from lsst.fringe_sim.algorithms.field_response import SensorPlacement, sensor_response
from lsst.fringe_sim.algorithms.image_correlation import LogBins, correlation_function
from lsst.fringe_sim.algorithms.image_noise import add_exposure_noise
from lsst.fringe_sim.algorithms.pca import decompose_thickness, fit_pca, fit_pca_from_thickness
from lsst.fringe_sim.algorithms.sky_frame import simulate_night, sky_response
from lsst.fringe_sim.algorithms.thickness_stand_in import stand_in_thickness
from lsst.fringe_sim.instrument.beam_field import TRACED_RADII, BeamField
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.night import NightHistory
from lsst.fringe_sim.instrument.sky import SkySpectrum
from lsst.fringe_sim.instrument.telescope import Telescope
from lsst.fringe_sim.mock.thickness import e2v_321
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FringeComponents

from ._table import Row, best_of, memory_now, memory_watch, timed

SENSOR = (4004, 4096)
READ_NOISE_E = 9.0
SKY_E = 2717.0
TRACED_SENSORS = 6
INCREMENTAL_SHARE = 4
"""The incremental decomposition is timed on this part of the pixels; its time is proportional to them."""

DIRECT_SIDE = 96
"""Images up to this side are summed pair by pair too; the time grows with the fourth power."""


def run() -> list[Row]:
    """All tables of the sky."""
    rows: list[Row] = []
    for work in (
        components_of_a_night,
        components_of_a_quarter,
        components_of_many_frames,
        components_of_model_frames,
        sensor_night,
        correlations,
        noise,
        beams,
    ):
        rows += work()
        gc.collect()
    return rows


def frames_like_a_night(count: int, shape: tuple[int, int], noise_e: float = 1e-3) -> np.ndarray:
    """Two patterns that vary, and noise, in units of the sky."""
    rng = np.random.default_rng(3)
    thickness = e2v_321(shape)
    patterns = np.stack([np.cos(40.0 * thickness), np.cos(38.0 * thickness + 0.4)]).astype(np.float32)
    frames = np.empty((count, *shape), np.float32)
    for frame, scale in zip(frames, rng.normal(2e-3, 4e-4, (count, 2)), strict=True):
        frame[:] = np.tensordot(scale.astype(np.float32), patterns, axes=1)
        frame += np.float32(noise_e) * rng.standard_normal(shape, dtype=np.float32)
    return frames


def components_of_a_night(shape: tuple[int, int] = SENSOR) -> list[Row]:
    """11 frames of a whole sensor beside the full decomposition, in the precision of the frames and in double."""
    frames = frames_like_a_night(11, shape)
    work = f"principal components of 11 frames of {1e-6 * frames[0].size:.3g} Mpix"
    flat = frames.reshape(len(frames), -1)
    exact = _exact_ratio(flat)
    fit_pca([frame[:64, :64] for frame in frames], n_components=1)  # compiles

    def off(ratio: np.ndarray) -> str:
        return f"variance fractions off by {np.abs(ratio - exact[: len(ratio)]).max():.0e}"

    rows = []
    with memory_watch() as memory:
        before = memory_now()
        expected, wall, cpu = timed(lambda: PCA(n_components=10, svd_solver="full").fit(flat))
    note = f"{memory[0] - before:.2f} GiB beyond the frames; {off(expected.explained_variance_ratio_)}"
    rows.append(Row(work, "scikit-learn, full, single precision", wall, note=note, cpu=cpu))
    del expected
    gc.collect()
    quick, wall, quick_cpu = timed(lambda: PCA(n_components=2, svd_solver="auto", random_state=1).fit(flat))
    note = f"takes the randomized solver; {off(quick.explained_variance_ratio_)}"
    rows.append(
        Row(work, "scikit-learn, default for 2 components", wall, beside=cpu, note=note, cpu=quick_cpu)
    )
    del quick
    gc.collect()
    for number in (2, 10):
        with memory_watch() as memory:
            before = memory_now()
            found, wall, own = timed(lambda: fit_pca(list(frames), n_components=number))  # noqa: B023
            products = (found.mean.nbytes + found.components.nbytes + found.mask.nbytes) / 2**30
        note = (
            f"{memory[0] - before - products:.2f} GiB beyond frames and result ({products:.2f}); "
            f"{off(found.explained_variance_ratio)}"
        )
        rows.append(Row(work, f"fit_pca, {number} components", wall, beside=cpu, note=note, cpu=own))
        del found
        gc.collect()
    return rows


def components_of_a_quarter(shape: tuple[int, int] = (1001, 4096)) -> list[Row]:
    """The same on a quarter of a sensor with scikit-learn in double precision, too large for a whole one."""
    frames = frames_like_a_night(11, shape)
    work = f"principal components of 11 frames of {1e-6 * frames[0].size:.3g} Mpix"
    double = frames.reshape(len(frames), -1).astype(np.float64)
    _, wall, cpu = timed(lambda: PCA(n_components=10, svd_solver="full").fit(double))
    rows = [Row(work, "scikit-learn, full, double precision", wall, cpu=cpu)]
    for number in (2, 10):
        _, wall, own = timed(lambda: fit_pca(list(frames), n_components=number))  # noqa: B023
        rows.append(Row(work, f"fit_pca, {number} components", wall, beside=cpu, cpu=own))
    return rows


def _exact_ratio(flat: np.ndarray) -> np.ndarray:
    """Variance fractions from the products of all frames in double precision, without tiles."""
    count = len(flat)
    mean = flat.mean(axis=0, dtype=np.float64)
    gram = np.array([[np.vdot(a - mean, b - mean) for b in flat] for a in flat])
    values = np.linalg.eigvalsh(gram)[::-1]
    return values[: count - 1] / values.sum()


def components_of_many_frames(shape: tuple[int, int] = (1000, 1000)) -> list[Row]:
    """400 frames of a megapixel, in half and in whole, beside what scikit-learn has for many frames."""
    frames = frames_like_a_night(400, shape)
    flat = frames.reshape(len(frames), -1)
    work = f"5 principal components of 400 frames of {1e-6 * frames[0].size:.3g} Mpix"
    fit_pca(list(frames[:70, :64, :64]), n_components=1)  # compiles
    gc.collect()
    beyond = []
    for count in (200, 400):
        with memory_watch() as memory:
            before = memory_now()
            found, own_wall, own = timed(lambda: fit_pca(list(frames[:count]), n_components=5))  # noqa: B023
        beyond.append(1024 * (memory[0] - before))
    expected, wall, randomized = timed(
        lambda: PCA(n_components=5, svd_solver="randomized", random_state=1).fit(flat)
    )
    rows = [Row(work, "scikit-learn, randomized", wall, cpu=randomized)]
    change = np.abs(found.explained_variance_ratio[:2] - expected.explained_variance_ratio_[:2]).max()
    note = (
        f"{beyond[0]:.0f} and {beyond[1]:.0f} MiB beyond 200 and 400 frames, with their results; "
        f"variance fractions of the two patterns {change:.0e} from the randomized"
    )
    rows.append(Row(work, "fit_pca", own_wall, beside=randomized, note=note, cpu=own))
    quarter = np.ascontiguousarray(flat[:, : flat.shape[1] // INCREMENTAL_SHARE])
    _, wall, incremental = timed(lambda: IncrementalPCA(n_components=5, batch_size=50).fit(quarter))
    part = frames[:, : shape[0] // INCREMENTAL_SHARE]
    _, own_wall, own = timed(lambda: fit_pca(list(part), n_components=5))
    work = f"the same of {1e-6 * quarter.shape[1]:.2g} Mpix"
    rows.append(Row(work, "scikit-learn, incremental, batches of 50", wall, cpu=incremental))
    rows.append(Row(work, "fit_pca", own_wall, beside=incremental, cpu=own))
    return rows


def components_of_model_frames() -> list[Row]:
    """Noiseless frames of a night: from the frames, and from the histogram of thickness."""
    model = FringeModel.from_setup("lsst_e2v")
    thickness = e2v_321().astype(np.float32)
    span = (float(thickness.min()) - 0.05, float(thickness.max()) + 0.05)
    response = sky_response(model, SkySpectrum.dark(), thickness_range_um=span)
    night = NightHistory.guo2022()
    work = f"principal components of {len(night)} noiseless frames of 16.4 Mpix"

    def by_frames() -> FringeComponents:
        return fit_pca(list(simulate_night(thickness, model, response, night)), n_components=2)

    expected, wall, frames_cpu = timed(by_frames)
    rows = [Row(work, "frames, then fit_pca", wall, cpu=frames_cpu)]
    scales = [night.band_scale(each, response.bands) for each in range(len(night))]

    def own() -> object:
        return fit_pca_from_thickness(thickness, response, scales, n_components=2)

    wall, alone = best_of(lambda: decompose_thickness(thickness, response, scales, n_components=2))
    rows.append(Row(work, "decompose_thickness (no images)", wall, beside=frames_cpu, cpu=alone))
    found = fit_pca_from_thickness(thickness, response, scales, n_components=2)
    wall, own_cpu = best_of(own)
    change = np.abs(found.explained_variance_ratio - expected.explained_variance_ratio).max()
    note = f"variance fractions within {change:.0e} of those of the frames"
    rows.append(
        Row(work, "fit_pca_from_thickness (three images)", wall, beside=frames_cpu, note=note, cpu=own_cpu)
    )
    return rows


def sensor_night() -> list[Row]:
    """One sensor of the focal plane: eleven exposures of a night with the beam of every pixel, written as FITS."""
    detector = Camera.from_name("lsstCam").detector("R22_S11")
    model = FringeModel.from_setup("lsst_e2v")
    night, sky = NightHistory.guo2022(), SkySpectrum.dark(airmass=1.2)
    thickness = stand_in_thickness(model.setup, detector, 0, SENSOR).value
    span = (float(thickness.min()) - 1e-3, float(thickness.max()) + 1e-3)
    placement = SensorPlacement.of(detector, model.setup.pixel_scale_arcsec)
    work = f"{len(night)} frames of 16.4 Mpix of {detector.name} with the beam of every pixel"
    response, wall, cpu = timed(lambda: sensor_response(model, sky, placement, span))
    rows = [Row(work, "response to the sky", wall, cpu=cpu)]
    with tempfile.TemporaryDirectory() as folder, memory_watch() as memory:
        before = memory_now()

        def frames() -> None:
            # As the command: a frame is written while the next one is made.
            write: Future[None] | None = None
            with ThreadPoolExecutor(1) as thread:
                for number, frame in enumerate(simulate_night(thickness, model, response, night)):
                    if write is not None:
                        write.result()
                    write = thread.submit(frame.write_fits, Path(folder) / f"{number}.fits")

        _, frames_wall, frames_cpu = timed(frames)
        size = sum(path.stat().st_size for path in Path(folder).iterdir()) / 2**30
    note = f"{size:.2f} GiB of FITS; {memory[0] - before:.2f} GiB of memory beyond map and response"
    rows.append(Row(work, "frames and FITS files", frames_wall, note=note, cpu=frames_cpu))
    rows.append(Row(work, "together", wall + frames_wall, cpu=cpu + frames_cpu))
    return rows


def correlations() -> list[Row]:
    """Correlation function of images of growing size, beside TreeCorr with and without its approximation."""
    rng = np.random.default_rng(7)
    rows = [row for side in (96, 512) for row in _correlation(rng.standard_normal((side, side)))]
    image = rng.standard_normal(SENSOR)
    wall, cpu = best_of(lambda: correlation_function(image, bins=LogBins(1.0, 1000.0, 20)))
    rows.append(Row("correlation function of a full sensor", "correlation_function", wall, cpu=cpu))
    return rows


def _correlation(image: np.ndarray) -> list[Row]:
    """One image by all methods; every pair one by one only where that is not hopeless."""
    side = len(image)
    bins = LogBins(1.0, 0.25 * side, 20)
    y, x = (axis.ravel().astype(float) for axis in np.indices(image.shape))
    catalogue = treecorr.Catalog(x=x, y=y, k=image.ravel())
    work = f"correlation function of {side} × {side} px"

    def tree(**options: object) -> treecorr.KKCorrelation:
        limits = {"min_sep": bins.smallest_px, "max_sep": bins.largest_px, "nbins": bins.count}
        found = treecorr.KKCorrelation(**limits, **options)
        found.process(catalogue)
        return found

    wall, own = best_of(lambda: correlation_function(image, bins=bins))
    found = correlation_function(image, bins=bins)
    default, wall_tree, cpu_tree = timed(tree)
    rows = [Row(work, "TreeCorr, default", wall_tree, cpu=cpu_tree)]
    note = f"TreeCorr's approximation is off by {_off(default.xi, found.xi, image):.0e} of the variance"
    if side <= DIRECT_SIDE:
        exact, wall_exact, cpu_exact = timed(lambda: tree(bin_slop=0, brute=True))
        rows.append(
            Row(work, "TreeCorr, every pair (`bin_slop=0`)", wall_exact, beside=cpu_tree, cpu=cpu_exact)
        )
        note += (
            f"; from every pair within {_off(exact.xi, found.xi, image):.0e}, {cpu_exact / own:.0f}× faster"
        )
    rows.append(Row(work, "correlation_function", wall, beside=cpu_tree, note=note, cpu=own))
    return rows


def _off(one: np.ndarray, other: np.ndarray, image: np.ndarray) -> float:
    return float(np.nanmax(np.abs(one - other)) / image.var())


def noise() -> list[Row]:
    """Photon and read noise of an exposure of the sky."""
    electrons = (SKY_E * (1.0 + 2e-3 * np.cos(40.0 * e2v_321()))).astype(np.float32)
    work = "photon and read noise, 16.4 Mpix at 2717 e⁻"

    def by_galsim() -> None:
        image = galsim.Image(electrons.copy())
        deviate = galsim.BaseDeviate(5)
        image.addNoise(galsim.PoissonNoise(deviate))
        image.addNoise(galsim.GaussianNoise(deviate, sigma=READ_NOISE_E))

    _, wall, cpu = timed(by_galsim)
    rows = [Row(work, "GalSim", wall, float(electrons.size), cpu=cpu)]
    wall, own = best_of(lambda: add_exposure_noise(electrons, np.random.default_rng(5), READ_NOISE_E))
    rows.append(Row(work, "add_exposure_noise", wall, float(electrons.size), cpu / electrons.size, "", own))
    return rows


def beams() -> list[Row]:
    """Angles of incidence on the sensors of the focal plane: every one traced, or interpolated between radii."""
    telescope = Telescope.from_name("lsst")
    fields = [
        (detector.field_x_deg, detector.field_y_deg) for detector in Camera.from_name("lsstCam").science
    ]
    work = f"angles of incidence on {len(fields)} sensors"
    sample = fields[:: len(fields) // TRACED_SENSORS][:TRACED_SENSORS]
    _, wall, cpu = timed(lambda: [telescope.trace(*place).beam() for place in sample])
    share = len(fields) / len(sample)
    rows = [Row(work, f"traced with batoid ({len(sample)} of them)", wall * share, cpu=cpu * share)]

    def interpolated() -> list[object]:
        field = BeamField.trace(telescope)
        return [field.beam(*place) for place in fields]

    _, wall, own = timed(interpolated)
    method = f"BeamField: {TRACED_RADII} radii traced, rays interpolated"
    rows.append(Row(work, method, wall, beside=cpu * share, cpu=own))
    return rows
