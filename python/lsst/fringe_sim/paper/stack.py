"""The sensor: Table 1, Eqs. 1 and 3, Figures 1 and 3, section 2.3."""

from __future__ import annotations

import numpy as np
from astropy.table import Table
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from ..array_types import FloatArray
from ..model import FringeModel
from ..optics import Beam, LayerStack, Medium, get_medium
from ..optics.illumination import SIGMA_PER_FWHM, GaussianProfile
from ..optics.system import OpticalSystem
from .section import Context, Curve, Graph, PaperSection, columns, missing

PERCENT = 100.0
LAB_K = 183.0
SHARP_NM = 0.1  # Bandwidth [nm] that leaves 97 % of the fringes of the silicon, with which those of 1 nm are compared
NINETY_NINE = float(np.log(100.0))  # Optical depths that absorb 99 %


def layers(context: Context) -> PaperSection:
    """Table 1, Eqs. 1 and 3."""
    stack = context.stack
    adhesive = stack.position("adhesive")
    fixed = np.delete(stack.thickness_um, adhesive)
    wavelength = 960.0
    index = float(stack.layers[adhesive].medium.index(wavelength, LAB_K).real)
    silicon = float(get_medium(context.silicon).index(1000.0, LAB_K).real)
    thickness = np.linspace(5.0, 30.0, 200)
    spacing = wavelength**2 / (2e3 * index * thickness + wavelength)
    return PaperSection(
        "Sensor: Table 1, Eqs. 1 and 3",
        "The stack as shipped, the fringe spacing in wavelength and the thickness of one fringe order.",
        {
            "layers": float(len(stack.layers)),
            "solid_layers": float(fixed[np.isfinite(fixed)].sum()),
            "spacing_adhesive": wavelength**2 / (2e3 * index * 14.0 + wavelength),
            "spacing_silicon": wavelength**2 / (2e3 * 3.6 * 100.0 + wavelength),
            "order_adhesive": 0.5 * wavelength / index,
            "order_silicon": 0.5 * 1000.0 / silicon,
        },
        (
            Graph(
                "Eq. 1 at 960 nm",
                "adhesive [µm]",
                "fringe spacing [nm]",
                (
                    Curve(thickness, spacing, "λ² / (2nd + λ)"),
                    Curve(thickness, np.full(thickness.shape, 20.0), "twice the step of the flats", "--"),
                ),
            ),
        ),
        "Below the dashed line flats every 10 nm do not resolve the fringe.",
    )


def _absorption(
    stack: LayerStack, wavelength_nm: ArrayLike, fwhm_nm: float, extinction_scale: float = 1.0
) -> FloatArray:
    """1 − R − T of the stack of Table 1 with 14 µm of adhesive, as Figure 1 shows it."""
    if extinction_scale != 1.0:
        silicon = stack.layers[stack.position("detection")].medium.modified(extinction_scale=extinction_scale)
        for layer in ("detection", "gates", "support"):
            stack = stack.with_medium(layer, silicon)
    system = OpticalSystem(stack, LAB_K, GaussianProfile(fwhm_nm), Beam.collimated(), observable="total")
    light = system.flat_fields(wavelength_nm, 0.1)
    return system.reduce(light).averaged(light.weight, 14.0)


def _ripple(wavelength_nm: FloatArray, values: FloatArray) -> FloatArray:
    """What is left when the slow fringe of the adhesive is taken out."""
    place = wavelength_nm - wavelength_nm.mean()
    return values - np.polyval(np.polyfit(place, values, 7), place)


def _spacing(wavelength_nm: FloatArray, ripple: FloatArray) -> float:
    """Mean distance of upward zero crossings [nm]."""
    up = np.flatnonzero((ripple[:-1] < 0.0) & (ripple[1:] >= 0.0))
    crossing = wavelength_nm[up] - ripple[up] * (wavelength_nm[up + 1] - wavelength_nm[up]) / (
        ripple[up + 1] - ripple[up]
    )
    return float((crossing[-1] - crossing[0]) / (len(crossing) - 1))


def _coherence(stack: LayerStack, wavelength_nm: FloatArray) -> float:
    """What 1 nm of bandwidth leaves of the fringes of the silicon, over the law of a Gaussian line."""
    sharp, blurred = (
        _ripple(wavelength_nm, _absorption(stack, wavelength_nm, fwhm)) for fwhm in (SHARP_NM, 1.0)
    )
    place = _spacing(wavelength_nm, blurred)
    law = np.exp(-2.0 * (np.pi * SIGMA_PER_FWHM / place) ** 2 * (1.0 - SHARP_NM**2))
    return float(
        _fundamental(wavelength_nm, blurred, place) / _fundamental(wavelength_nm, sharp, place) / law
    )


def _fundamental(wavelength_nm: FloatArray, ripple: FloatArray, spacing_nm: float) -> float:
    """Amplitude of the part of a ripple that has a spacing."""
    wave = np.exp(2j * np.pi * wavelength_nm / spacing_nm)
    return float(np.abs((ripple * wave).sum()))


def bandwidth(context: Context) -> PaperSection:
    """Figure 1."""
    wide, close = np.arange(820.0, 1000.0, 0.5), np.arange(958.0, 970.0, 0.1)
    stack = context.stack
    narrow = _ripple(close, _absorption(stack, close, 1.0))
    values = {
        "spacing_silicon_seen": _spacing(close, narrow),
        "bnl_coherence": _coherence(stack, close),
        "ripple_narrow": PERCENT * 0.5 * float(np.ptp(narrow)),
        "ripple_wide": PERCENT * 0.5 * float(np.ptp(_ripple(close, _absorption(stack, close, 2.0)))),
        **missing("absorption_level", "absorption_level_less", "absorption_fringe"),
    }
    curves = [Curve(wide, _absorption(stack, wide, 2.0), "this package, 2 nm")]
    inset = [Curve(close, _absorption(stack, close, 1.0), "this package, 1 nm")]
    published = context.curve("bandwidth_verify_2nm")
    if published is not None:
        place, theirs = columns(published, "wavelength", "absorption")
        departure = _absorption(stack, place, 2.0) - theirs
        x = place - place.mean()
        residual = departure - np.polyval(np.polyfit(x, departure, 3), x)
        less = _absorption(stack, place, 2.0, 0.955) - theirs
        values["absorption_level"] = PERCENT * float(np.abs(departure).max())
        values["absorption_level_less"] = PERCENT * float(np.abs(less).max())
        values["absorption_fringe"] = PERCENT * float(residual.std())
        curves.append(Curve(place, theirs, "Fig. 1", "--"))
    narrow_curve = context.curve("bandwidth_verify_1nm_inset")
    if narrow_curve is not None:
        place, theirs = columns(narrow_curve, "wavelength", "absorption")
        inset.append(Curve(place, theirs, "Fig. 1, inset", "--"))
    label = "absorbed in the stack, 1 − R − T"
    return PaperSection(
        "Bandwidth: Fig. 1",
        "Absorption of the whole stack with 14 µm of adhesive at 183 K. A line of 2 nm washes the fringes of the "
        "silicon out, one of 1 nm does not.",
        values,
        (
            Graph("2 nm", "wavelength [nm]", label, tuple(curves)),
            Graph("1 nm", "wavelength [nm]", label, tuple(inset)),
        ),
        "Fringes of the adhesive (left) and, on top of them, of the silicon (right).",
    )


def _depth_um(silicon: Medium, wavelength_nm: ArrayLike, temperature_k: float) -> FloatArray:
    """Depth at which 99 % are absorbed [µm]."""
    wavelength = np.asarray(wavelength_nm, dtype=float)
    extinction = silicon.index(wavelength, temperature_k).imag
    return NINETY_NINE * 1e-3 * wavelength / (4.0 * np.pi * extinction)


def absorption_depth(context: Context) -> PaperSection:
    """Figure 3."""
    wavelength = np.arange(650.0, 1051.0, 2.0)
    silicon = get_medium(context.silicon)
    values = {
        "depth_wavelength": float(brentq(lambda w: _depth_um(silicon, w, LAB_K) - 100.0, 700.0, 950.0)),
        **missing("depth_temperature", "depth_warm"),
    }
    curves = [
        Curve(wavelength, _depth_um(silicon, wavelength, 300.0), "300 K"),
        Curve(wavelength, _depth_um(silicon, wavelength, LAB_K), "183 K"),
    ]
    warm, cold = (context.curve(f"Si_absorption_depth_pdf_{k}K") for k in (300, 183))
    if warm is not None and cold is not None:

        def inside(table: Table) -> tuple[FloatArray, FloatArray]:
            place = np.asarray(table["wavelength"], dtype=np.float64)
            chosen = (place > 650.0) & (place < 1050.0)
            return place[chosen], np.asarray(table["depth"], dtype=np.float64)[chosen]

        place, depth = inside(warm)
        values["depth_warm"] = PERCENT * float(np.abs(depth / _depth_um(silicon, place, 300.0) - 1.0).max())
        cold_place, cold_depth = inside(cold)
        # The ratio of the two curves depends on the temperature law alone, not on the table of the extinction.
        ratio = np.log(cold_depth / np.interp(cold_place, place, depth))
        warm_depth = _depth_um(silicon, cold_place, 300.0)
        trial = np.arange(160.0, 200.0, 0.1)
        misfit = [
            np.mean((ratio - np.log(_depth_um(silicon, cold_place, t) / warm_depth)) ** 2) for t in trial
        ]
        values["depth_temperature"] = float(trial[int(np.argmin(misfit))])
        place, depth = cold_place, cold_depth
        curves.append(Curve(place, depth, "Fig. 3, labelled 183 K", "--"))
    return PaperSection(
        "Absorption depth: Fig. 3",
        "Depth of silicon that absorbs 99 % of the light; the paper takes the temperature law of Green (2008).",
        values,
        (Graph("99 % depth", "wavelength [nm]", "depth [µm]", tuple(curves), logarithmic=True),),
        "Where a curve exceeds 100 µm, light reaches the adhesive.",
    )


def other_vendor(context: Context) -> PaperSection:
    """Section 2.3."""
    thickness = np.linspace(99.5, 100.5, 400)

    def fringe(aperture: float) -> FloatArray:
        effects = {"bandwidth.fwhm": 1.0, "converging_beam.numerical_aperture": aperture}
        response = FringeModel.from_setup(context.setup("ts8_itl"), effects).response(thickness, [960.0])[0]
        # Thicker silicon absorbs more: a trend that is no fringe.
        trend = np.polyval(np.polyfit(thickness, response, 1), thickness)
        return np.asarray(response / trend - 1.0)

    parallel, fast = fringe(0.0), fringe(1.0 / 2.4)
    return PaperSection(
        "ITL sensors: section 2.3",
        "With a black coating over the adhesive only the silicon fringes. A converging beam of f/1.2 averages that "
        "away even at a bandwidth of 1 nm.",
        {"itl_fast_beam": float(np.ptp(fast) / np.ptp(parallel))},
        (
            Graph(
                "960 nm, 1 nm bandwidth",
                "silicon [µm]",
                "response / trend − 1 [%]",
                (
                    Curve(thickness, PERCENT * parallel, "parallel light"),
                    Curve(thickness, PERCENT * fast, "f/1.2", "--"),
                ),
            ),
        ),
        "Fringes of an ITL sensor.",
    )
