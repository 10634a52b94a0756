"""Night-sky frames: Table 2, Figures 12 to 15, sections 5.1 to 5.4."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.io import fits
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter

from ..algorithms.fringe_amplitudes import fringe_amplitudes
from ..algorithms.sky_frame import SkyResponse, sky_response, throughput_electrons
from ..array_types import FloatArray
from ..instrument.bandpass import Bandpass
from ..instrument.readout import (
    electrons_to_microjansky,
    magnitude_to_microjansky,
    microjansky_to_magnitude,
    zero_point,
)
from ..instrument.sky import EmissionLines, SkySpectrum
from ..model import FringeModel, Setup
from ..optics import Illumination
from .section import Context, Curve, Graph, PaperSection, Picture, columns, missing

PERCENT = 100.0
AIRMASS = 1.2
RANGE_UM = (13.9, 22.6)
EDGE_DEG = 1.44
READ_NOISE_E = 9.0
SMOOTHING_PX = 4.0  # Gaussian kernel "of 16 by 16 pixels": σ of 4 px cut at 2 σ

PUBLISHED_MAP = "RTM-020_S01_E2V-321_epoxy_map.fits"
PUBLISHED_LOWEST_UM = 14.022  # Lower end of the colour bar of Figure 5

DIAGONAL_PX = 3970

HSC_RELIEF_UM = 1.74
HSC_SIDE = 500
HSC_SCALE = 60.0


@functools.lru_cache(maxsize=8)
def lines_only(
    setup: Setup,
    field_deg: float = 0.0,
    silicon_offset_um: float = 0.0,
    range_um: tuple[float, float] = RANGE_UM,
) -> SkyResponse:
    """Response to the OH lines alone, as in the paper."""
    effects = {"silicon_thickness.offset": silicon_offset_um} if silicon_offset_um else None
    model = FringeModel.from_setup(setup, effects, field_x_deg=field_deg)
    return sky_response(model, SkySpectrum(EmissionLines.oh(), airmass=AIRMASS), thickness_range_um=range_um)


def monocam(context: Context) -> PaperSection:
    """Section 5.1, Figure 12."""
    frame = lines_only(context.setup("monocam")).sky().lookup(context.thickness_um)[0]
    values = {
        "monocam": PERCENT * fringe_amplitudes(frame).half_peak_to_peak,
        **missing("monocam_curve", "monocam_shape"),
    }
    curves = [Curve(_places(frame), _diagonal(frame), "OH lines of PALACE")]
    theirs = _AsPublished.of(context, "monocam", curve="MonoCam_sims_diagonal")
    if theirs is not None:
        values["monocam_curve"], values["monocam_shape"] = theirs.half_peak_to_peak, theirs.correlation
        curves = theirs.curves
    return PaperSection(
        "MonoCam: section 5.1, Fig. 12",
        "OH lines through the LSST y band at f/4 and −120 °C, with the adhesive of E2V-CCD250-321.",
        values,
        (
            Picture("MonoCam sky", *_relative(frame), True, context.step_px),
            Graph(
                "diagonal", "position along the diagonal [its length]", "sky / mean − 1 [%]", tuple(curves)
            ),
        ),
        "Simulated, noiseless sky frame and its diagonal.",
    )


def hsc(context: Context) -> PaperSection:
    """Section 5.2, Figure 13."""
    rng = context.rng("HSC")
    relief = gaussian_filter(rng.standard_normal((HSC_SIDE, HSC_SIDE)), HSC_SCALE, mode="wrap")
    layer = 200.0 + HSC_RELIEF_UM * ((relief - relief.min()) / np.ptp(relief) - 0.5)
    sky = SkySpectrum(EmissionLines.oh(), airmass=AIRMASS)
    response = sky_response(
        FringeModel.from_setup(context.setup("hsc")), sky, thickness_range_um=(199.0, 201.0)
    )
    frame = response.sky().lookup(layer)[0]
    half = PERCENT * fringe_amplitudes(frame).half_peak_to_peak
    curves = [Curve(_places(frame), _diagonal(frame), "this package, random relief")]
    measured = _measured_hsc(context)
    pictures = (
        ()
        if measured is None
        else (Picture("HSC sky, measured", "sky / mean − 1 [%]", measured, True, 3.28),)
    )
    published = context.curve("HSC-data-sim_measured_diagonal")
    if published is not None:
        place, amplitude = columns(published, "diagonal_pixel", "amp")
        curves.append(Curve(place / place.max(), amplitude, "measured frame of Fig. 13", "--"))
    return PaperSection(
        "Hyper Suprime-Cam: section 5.2, Fig. 13",
        "A random relief of 1.74 µm in 200 µm of silicon, HSC optics and filter. Only amplitudes can be compared: "
        "the rms of the whole frame, with the continuum of a dark sky in it, with that of the measured one.",
        {"hsc": half, "hsc_observed": half, "hsc_frame": _hsc_frame(context, layer, measured)},
        (
            Picture("HSC sky", *_relative(frame), True),
            *pictures,
            Graph(
                "diagonal", "position along the diagonal [its length]", "sky / mean − 1 [%]", tuple(curves)
            ),
        ),
        "Simulated fringes of a piece of an HSC sensor, and the diagonal of a measured one.",
    )


def _measured_hsc(context: Context) -> FloatArray | None:
    """Measured frame of Figure 13 [%]."""
    path = context.map_path("HSC-data-sim_measured.fits")
    if path is None:
        return None
    with fits.open(path) as hdus:
        return np.asarray(hdus[0].data, dtype=float)


def _hsc_frame(context: Context, layer: FloatArray, measured: FloatArray | None) -> float:
    """Rms of a simulated frame of a whole sky over that of the measured one."""
    if measured is None:
        return math.nan
    model = FringeModel.from_setup(context.setup("hsc"))
    whole = sky_response(model, SkySpectrum.dark(airmass=AIRMASS), thickness_range_um=(199.0, 201.0))
    return PERCENT * fringe_amplitudes(whole.sky().lookup(layer)[0]).rms / float(np.nanstd(measured))


def lsst(context: Context) -> PaperSection:
    """Section 5.3, Figure 14."""
    centre, edge = (
        lines_only(context.setup("lsst_e2v"), field).sky().lookup(context.thickness_um)[0]
        for field in (0.0, EDGE_DEG)
    )
    thicker = lines_only(context.setup("lsst_e2v"), 0.0, 0.1).sky().lookup(context.thickness_um)[0]
    values = {
        "lsst_centre": PERCENT * fringe_amplitudes(centre).rms,
        "lsst_edge": PERCENT * fringe_amplitudes(edge).rms,
        "silicon_change": float(np.corrcoef(centre.ravel(), thicker.ravel())[0, 1]),
        **missing("lsst_centre_half", "lsst_edge_half", "lsst_shape"),
    }
    curves = [
        Curve(_places(centre), _diagonal(centre), "centre, OH lines of PALACE"),
        Curve(_places(edge), _diagonal(edge), f"{EDGE_DEG}° off axis"),
    ]
    theirs = _AsPublished.of(context, "lsst_e2v", curve="LSST_fringe_sims_center")
    at_edge = _AsPublished.of(context, "lsst_e2v", EDGE_DEG)
    if theirs is not None and at_edge is not None:
        values["lsst_centre_half"], values["lsst_shape"] = theirs.half_peak_to_peak, theirs.correlation
        values["lsst_edge_half"] = at_edge.half_peak_to_peak
        curves = theirs.curves
    pictures = tuple(
        Picture(name, *_relative(frame), True, context.step_px)
        for name, frame in (("field centre", centre), (f"{EDGE_DEG}° off axis", edge))
    )
    return PaperSection(
        "LSST: section 5.3, Fig. 14, Table 2",
        "The same sensor behind the LSST optics. The paper does not say which amplitude it means; its 0.2 % and "
        "0.04 % are compared with the rms, and half peak to peak with what its figure shows.",
        values,
        (
            *pictures,
            Graph(
                "diagonal", "position along the diagonal [its length]", "sky / mean − 1 [%]", tuple(curves)
            ),
        ),
        "Simulated, noiseless sky frames and their diagonals.",
    )


def surface_brightness(context: Context) -> PaperSection:
    """Figure 15, section 5.4."""
    model = FringeModel.from_setup(context.setup("lsst_e2v"))
    setup, band = model.setup, Bandpass.from_name(model.setup.bandpass)
    zero = zero_point(band, setup.effective_area_m2)

    def brightness(electrons: float) -> float:
        return float(electrons_to_microjansky(electrons, zero, setup.exposure_s, setup.pixel_scale_arcsec))

    sky_e = throughput_electrons(SkySpectrum.dark(), band, model)
    sky = brightness(sky_e)
    frame = lines_only(context.setup("lsst_e2v")).sky().lookup(context.detail_um)[0]
    # Continua do not fringe; their share of the light dilutes the fringe of the lines.
    photons = {item.name: float(item.photons.sum()) for item in SkySpectrum.dark().components(band)}
    lines = sum(value for name, value in photons.items() if name[0].isdigit()) / sum(photons.values())
    relative = lines * (frame / frame.mean() - 1.0)
    rng = context.rng("surface brightness")
    noise = np.sqrt(sky_e + READ_NOISE_E**2) * rng.standard_normal(relative.shape)
    smooth = gaussian_filter(brightness(1.0) * noise, SMOOTHING_PX, truncate=2.0)
    limit = 0.1 * float(magnitude_to_microjansky(26.0))
    whole = lines_only(context.setup("lsst_e2v")).sky().lookup(context.thickness_um)[0]
    fringe = sky * lines * 2.0 * fringe_amplitudes(whole).half_peak_to_peak
    smooth_fringe = gaussian_filter(sky * relative, SMOOTHING_PX, truncate=2.0)
    return PaperSection(
        "Surface brightness: Fig. 15, section 5.4",
        f"A dark zenith sky of {sky_e:.0f} electrons per pixel in {setup.exposure_s:g} s, {sky:.1f} µJy arcsec⁻². "
        "Fringes and noise are kept apart, both smoothed like the figure.",
        {
            "sky_brightness": float(microjansky_to_magnitude(sky)),
            "fringe_brightness": fringe,
            "noise_brightness": 3.0 * float(smooth.std()),
            "limit_26": limit,
            "limit_30": 0.1 * float(magnitude_to_microjansky(30.0)),
            "over_limit": fringe / limit,
        },
        (
            Picture("fringes alone", "µJy arcsec⁻²", smooth_fringe, True),
            Picture("noise alone", "µJy arcsec⁻²", smooth, True),
            Picture("both, as in the figure", "µJy arcsec⁻²", smooth_fringe + smooth, True),
        ),
        "What the smoothed image of the paper consists of, for a part of the sensor.",
    )


def _relative(frame: FloatArray) -> tuple[str, FloatArray]:
    """Label and values of a frame over its mean."""
    return "sky / mean − 1 [%]", PERCENT * (frame / frame.mean() - 1.0)


def _places(frame: FloatArray) -> FloatArray:
    return np.linspace(0.0, 1.0, min(frame.shape))


def _diagonal(frame: FloatArray) -> FloatArray:
    """Diagonal of a frame over its mean, less 1, per cent."""
    count = min(frame.shape)
    rows, columns = (np.linspace(0, side - 1, count).round().astype(int) for side in frame.shape)
    values = frame[rows, columns]
    return np.asarray(PERCENT * (values / values.mean() - 1.0))


@dataclass(frozen=True, eq=False)
class _AsPublished:
    """A frame with the lines of Figure 8 on the published map of the adhesive, and its published diagonal."""

    half_peak_to_peak: float
    diagonal: FloatArray
    published: FloatArray | None

    @classmethod
    def of(
        cls, context: Context, setup: str, field_deg: float = 0.0, curve: str | None = None
    ) -> _AsPublished | None:
        """Compute it, or `None` where lines, map or diagonal are not at hand."""
        lines, path = context.lines_of_figure_8(), context.map_path(PUBLISHED_MAP)
        table = None if curve is None else context.curve(curve)
        if lines is None or path is None or (curve is not None and table is None):
            return None
        band = Bandpass.from_name("lsst_y")
        wavelength = np.asarray(lines["wavelength"], dtype=float)
        weight = np.asarray(lines["intensity"], dtype=float) * band.transmission(wavelength)
        weight *= band.air.total(wavelength, AIRMASS)
        model = FringeModel.from_setup(context.setup(setup), field_x_deg=field_deg)
        light = Illumination.spectrum(wavelength, weight, model.system.beam)
        response = model.table_of(light, RANGE_UM, tolerance=1e-6)
        layer, diagonal = _published_map(path)
        published = None
        if table is not None:
            step = np.arange(len(diagonal), dtype=float)
            published = np.interp(step, table["diagonal_pixel"], table["amp_percent"])
        along = response.lookup(diagonal)[0]
        return cls(
            PERCENT * fringe_amplitudes(response.lookup(layer)[0]).half_peak_to_peak,
            np.asarray(PERCENT * (along / along.mean() - 1.0)),
            published,
        )

    @property
    def correlation(self) -> float:
        """Correlation of the two diagonals."""
        return math.nan if self.published is None else float(np.corrcoef(self.diagonal, self.published)[0, 1])

    @property
    def curves(self) -> list[Curve]:
        """Both diagonals."""
        place = np.linspace(0.0, 1.0, len(self.diagonal))
        found = [Curve(place, self.diagonal, "published map and lines")]
        if self.published is not None:
            found.append(Curve(place, self.published, "published diagonal", "--"))
        return found


def _published_map(path: Path) -> tuple[FloatArray, FloatArray]:
    """Published map of the adhesive [µm], and its values on the diagonal that the figures show."""
    with fits.open(path) as hdus:
        layer = hdus["FINE"].data.astype(float) + PUBLISHED_LOWEST_UM
        places = hdus["YSRC"].data.astype(float), hdus["XSRC"].data.astype(float)
    interpolate = RegularGridInterpolator(places, layer, bounds_error=False, fill_value=None)
    step = np.arange(DIAGONAL_PX)
    # The figures show the frame trimmed by 15 rows and 48 columns on either side.
    return layer, np.asarray(interpolate(np.stack([step + 15, step + 48], axis=1)))
