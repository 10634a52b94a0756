"""Nights and coadds: the components of section 5.4 and Figure 16."""

from __future__ import annotations

import math

import numpy as np
from astropy.io import fits
from scipy.interpolate import RectBivariateSpline

from ..algorithms.image_correlation import LogBins, coadd_correlation, correlation_function
from ..algorithms.pca import fit_pca_from_thickness
from ..array_types import FloatArray
from ..instrument.night import NightHistory
from .laboratory import MAP_RANGE_UM, RAFT
from .section import Context, Curve, Graph, PaperSection
from .sky import RANGE_UM, lines_only

PERCENT = 100.0
SKY_E = 2717.0  # Electrons per pixel of the zenith sky in 30 s; decides the noise of an exposure

REGION_PX = 240
NULL_SCATTER_BELOW_PX = 10.0
FIRST_HOUR = 19.0
CORNER_PX, WINDOW_PX = 1500.0, 1000  # Part of every sensor from which pieces are cut
RAFT_UM = (13.8, 28.5)  # Adhesive of all nine sensors, if the thinnest place of each has 14 µm

TREECORR_PX = 64


def components(context: Context) -> PaperSection:
    """Principal components of a night."""
    response, night = lines_only(context.setup("lsst_e2v")), NightHistory.guo2022()
    scales = [night.band_scale(time, response.bands) for time in range(len(night))]
    found = fit_pca_from_thickness(context.thickness_um, response, scales)
    ratio = np.zeros(2)
    ratio[: min(2, len(found.explained_variance_ratio))] = found.explained_variance_ratio[:2]
    left = PERCENT * max(0.0, 1.0 - float(np.sum(found.explained_variance_ratio[:2])))
    number = np.arange(1.0, 1.0 + len(found.explained_variance_ratio))
    hours = FIRST_HOUR + np.asarray(night.hours, dtype=float)
    scores = tuple(
        Curve(hours, PERCENT * found.scores[:, k] / np.abs(found.scores).max(), f"component {k + 1}", "o")
        for k in range(min(2, found.scores.shape[1]))
    )
    return PaperSection(
        "Components of a night: section 5.4",
        "Eleven hourly frames with the variation of the OH bands that the paper takes from Noll et al. (2015).",
        {"first_component": PERCENT * ratio[0], "second_component": PERCENT * ratio[1], "corrected": left},
        (
            Graph(
                "scree",
                "component",
                "share of the variance",
                (Curve(number, np.asarray(found.explained_variance_ratio), "night of the paper", "o"),),
                logarithmic=True,
            ),
            Graph("through the night", "local time [h]", "score [% of the largest]", scores),
        ),
        "Variance by component, and how strongly each is present.",
    )


def coadd(context: Context) -> PaperSection:
    """Figure 16."""
    maps = _raft_maps(context)
    table = lines_only(context.setup("lsst_e2v"), range_um=RAFT_UM if maps else RANGE_UM).sky()
    layers = maps or [context.detail_um]
    patterns = [frame / frame.mean() - 1.0 for frame in (table.lookup(layer)[0] for layer in layers)]
    counts = tuple(sorted({count for count in (1, 10, 100, context.coadds) if count <= context.coadds}))
    result = coadd_correlation(
        patterns,
        counts,
        1.0 / np.sqrt(SKY_E),
        context.rng("coadd"),
        region_px=REGION_PX,
        bins=LogBins(2.0, 0.5 * REGION_PX, 16),
    )
    close = result.coadd[-1].separation_px < NULL_SCATTER_BELOW_PX
    null = result.null[-1].xi[close]
    excess = float((result.coadd[-1].xi[close].mean() - null.mean()) / null.std(ddof=1))
    last, deepest = result.coadd[-1], counts[-1]
    separation = last.separation_px
    curves = [
        Curve(separation, model, "1 exposure" if count == 1 else f"{count} exposures")
        for count, model in zip(counts, result.model, strict=True)
    ]
    curves.append(Curve(separation, last.xi, f"{deepest}, with noise", "."))
    # Of white noise the products of n pairs have this standard deviation.
    scatter = 1.0 / (SKY_E * deepest * np.sqrt(last.weight))
    curves.append(Curve(separation, scatter, f"σ of noise, {deepest}", "--"))
    rms = PERCENT * float(np.sqrt(np.mean([pattern.var() for pattern in patterns])))
    one = "one sensor, where the paper has nine (their maps are not at hand)"
    sensors = "the nine sensors of the raft" if maps else one
    return PaperSection(
        "Coadds: Fig. 16",
        f"Coadds of randomly placed and rotated pieces of {sensors} (fringes {rms:.2f} % rms, uncorrected) with "
        "photon noise.",
        {"coadd_800": excess, "coadd_treecorr": _against_treecorr(patterns[0])},
        (Graph("correlation of coadds", "separation [px]", "ξ [sky²]", tuple(curves), logarithmic=True),),
        "Correlation of fringes in more and more exposures, and that of the deepest coadd with its noise; a line "
        "ends where the correlation turns negative.",
    )


def _raft_maps(context: Context) -> list[FloatArray]:
    """Pixel by pixel, a part of the published map of every sensor; none where one is missing or out of range."""
    layers = []
    for slot, serial in RAFT:
        path = context.map_path(f"RTM-020_{slot}_{serial}_epoxy_map.fits")
        if path is None:
            return []
        with fits.open(path) as hdus:
            relative = hdus["FINE"].data.astype(float)
            places = hdus["YSRC"].data.astype(float), hdus["XSRC"].data.astype(float)
        # Only the range of each map is published, not its zero.
        layer = MAP_RANGE_UM[0] + relative - np.nanmin(relative)
        at = CORNER_PX + np.arange(WINDOW_PX, dtype=float)
        layers.append(np.clip(RectBivariateSpline(*places, layer)(at, at), *RAFT_UM))
    return layers


def _against_treecorr(pattern: FloatArray) -> float:
    """Largest departure of the correlation of a piece of a pattern from TreeCorr's, over its variance [%]."""
    try:
        import treecorr
    except ImportError:
        return math.nan
    image = pattern[:TREECORR_PX, :TREECORR_PX]
    image = image - image.mean()
    bins = LogBins(1.0, 0.5 * TREECORR_PX, 12)
    y, x = np.indices(image.shape, dtype=float)
    catalogue = treecorr.Catalog(x=x.ravel(), y=y.ravel(), k=image.ravel())
    theirs = treecorr.KKCorrelation(
        min_sep=bins.smallest_px, max_sep=bins.largest_px, nbins=bins.count, bin_slop=0.0, brute=True
    )
    theirs.process(catalogue)
    return PERCENT * float(
        np.nanmax(np.abs(correlation_function(image, bins=bins).xi - theirs.xi)) / image.var()
    )
