"""Nights and coadds: the components of section 5.4 and Figure 16."""

from __future__ import annotations

import numpy as np

from ..algorithms.fringe_amplitudes import fringe_amplitudes
from ..algorithms.image_correlation import LogBins, coadd_correlation
from ..algorithms.pca import fit_pca_from_thickness
from ..instrument.night import NightHistory
from .section import Context, Curve, Graph, Section
from .sky import lines_only

__all__ = ["coadd", "components"]

PERCENT = 100.0
SKY_E = 2717.0
"""Electrons per pixel of the zenith sky in 30 s; decides the noise of an exposure."""

REGION_PX = 240
NULL_SCATTER_BELOW_PX = 10.0
FIRST_HOUR = 19.0


def components(context: Context) -> Section:
    """Principal components of a night."""
    response, night = lines_only(context.setup("lsst_e2v")), NightHistory.guo2022()
    scales = [night.band_scale(time, response.bands) for time in range(len(night))]
    found = fit_pca_from_thickness(context.thickness_um, response, scales)
    ratio = np.zeros(2)
    ratio[: min(2, len(found.explained_variance_ratio))] = found.explained_variance_ratio[:2]
    number = np.arange(1.0, 1.0 + len(found.explained_variance_ratio))
    hours = FIRST_HOUR + np.asarray(night.hours, dtype=float)
    scores = tuple(
        Curve(hours, PERCENT * found.scores[:, k] / np.abs(found.scores).max(), f"component {k + 1}", "o")
        for k in range(min(2, found.scores.shape[1]))
    )
    return Section(
        "Components of a night: section 5.4",
        "Eleven hourly frames with the variation of the OH bands that the paper takes from Noll et al. (2015).",
        {"first_component": PERCENT * ratio[0], "second_component": PERCENT * ratio[1]},
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


def coadd(context: Context) -> Section:
    """Figure 16."""
    frame = lines_only(context.setup("lsst_e2v")).sky().lookup(context.detail_um)[0]
    relative = frame / frame.mean() - 1.0
    counts = tuple(sorted({count for count in (1, 10, 100, context.coadds) if count <= context.coadds}))
    result = coadd_correlation(
        [relative],
        counts,
        1.0 / np.sqrt(SKY_E),
        context.rng("coadd"),
        region_px=REGION_PX,
        bins=LogBins(2.0, 0.5 * REGION_PX, 16),
    )
    close = result.coadd[-1].separation_px < NULL_SCATTER_BELOW_PX
    null = result.null[-1].xi[close]
    excess = float((result.coadd[-1].xi[close].mean() - null.mean()) / null.std(ddof=1))
    curves = [
        Curve(found.separation_px, found.xi, "1 exposure" if count == 1 else f"{count} exposures")
        for count, found in zip(result.counts, result.coadd, strict=True)
    ]
    last = result.null[-1]
    curves.append(Curve(last.separation_px, np.abs(last.xi), f"|noise|, {counts[-1]}", "--"))
    curves.append(
        Curve(last.separation_px, result.model[-1], f"ξ₁/N + (1 − 1/N) ξ_floor, N = {counts[-1]}", ".")
    )
    rms = PERCENT * fringe_amplitudes(frame).rms
    return Section(
        "Coadds: Fig. 16",
        f"Coadds of randomly placed and rotated pieces of one sensor (fringes {rms:.2f} % rms, uncorrected) with "
        "photon noise. The paper takes nine sensors of one raft; the maps of the others are not shipped.",
        {"coadd_800": excess},
        (Graph("correlation of coadds", "separation [px]", "ξ [sky²]", tuple(curves), logarithmic=True),),
        "Correlation of more and more exposures against that of as many exposures of noise; a line ends where the "
        "correlation turns negative.",
    )
