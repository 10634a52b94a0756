"""Table 2 of Guo, Walter, Lage & Lupton 2022, cell by cell, with every definition of "amplitude".

One model, with one set of effects, computes the laboratory flat and the skies, so that an effect that has been named
from laboratory data shows at once what it does to the sky. The paper's own numbers stand beside.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.table import Column, Table, vstack
from numpy.typing import ArrayLike

from ..array_types import FloatArray
from ..effects import activate_effects, known_effects
from ..effects.active import settings_of
from ..errors import InputError
from ..instrument.bandpass import Bandpass
from ..instrument.camera import Camera
from ..instrument.sky import EmissionLines, SkySpectrum
from ..instrument.telescope import reduce_beam
from ..model import FringeModel, ResponseTable, Setup
from ..optics import Illumination
from ..products.thickness_map import thickness_span_um
from .fringe_amplitudes import FringeAmplitudes, fringe_amplitudes
from .sky_frame import SkyQuadrature
from .sky_response import tabulate_components, white_light
from .thickness_stand_in import stand_in_thickness

EDGE_DEG = 1.44  # Field radius that the paper calls the edge of the focal plane [deg]

_FLAT_ANGLES = 32

_QUADRATURE = SkyQuadrature(table_tolerance=3e-6)  # Amplitudes are given to 1e-6 of the sky


@dataclass(frozen=True)
class AmplitudeCase:
    """One row of the table: a set-up, and what the paper says of it."""

    # name, setup: of the row, and of the set-up
    name: str
    setup: str
    field_deg: float
    wavelength_nm: float  # wavelength of a laboratory flat; NaN on the sky
    # observed, simulated: amplitudes in Table 2 of the paper; empty where it has none
    observed: str
    simulated: str
    recomputed: str  # what the data of the paper's figures give, with the definition of amplitude
    # Whether the adhesive of E2V-CCD250-321 is the layer that varies; a random field if not
    own_map: bool = True

    @property
    def on_sky(self) -> bool:
        """Whether the row is one of the night sky."""
        return math.isnan(self.wavelength_nm)


CASES: tuple[AmplitudeCase, ...] = (
    AmplitudeCase("SLAC-TS8, flat", "ts8_e2v", 0.0, 960.0, "~2", "2", "fundamental 1.50 (measured)"),
    AmplitudeCase(
        "MonoCam", "monocam", 0.0, math.nan, "~2", "1.5", "half p-p 1.75 ± 0.2; rms of a diagonal 0.89"
    ),
    AmplitudeCase("HSC", "hsc", 0.0, math.nan, "0.2 to 0.6", "0.3", "half p-p 0.2 to 0.6", own_map=False),
    AmplitudeCase("LSST e2v, centre", "lsst_e2v", 0.0, math.nan, "", "0.2", "rms 0.14 ± 0.02; half p-p 0.29"),
    AmplitudeCase(
        "LSST e2v, edge", "lsst_e2v", EDGE_DEG, math.nan, "", "0.04", "rms 0.04 ± 0.01; half p-p 0.09"
    ),
    AmplitudeCase(
        "LSST ITL, edge", "lsst_itl", EDGE_DEG, math.nan, "", "", "black coating: none", own_map=False
    ),
)
"""Rows of Table 2; LSST at both ends of its range, and the ITL sensors, which have none according to the paper."""


@dataclass(frozen=True)
class SkyCase:
    """A spectrum of the night sky."""

    name: str  # name for the column ``sky``
    lines: EmissionLines
    continuum: bool  # whether the airglow continuum and zodiacal light are added

    @classmethod
    def palace(cls) -> tuple[SkyCase, SkyCase]:
        """PALACE lines alone, and with the continua."""
        return cls("PALACE lines", EmissionLines.oh(), False), cls(
            "PALACE and continuum", EmissionLines.oh(), True
        )

    @classmethod
    def of_table(cls, name: str, table: Table) -> SkyCase:
        """A line list with columns ``wavelength`` [nm, vacuum] and ``intensity`` (photons, any unit).

        As in Eq. 4 of the paper, the air of the LSST throughput lies between the lines and the sensor.
        """
        for column in ("wavelength", "intensity"):
            if column not in table.colnames:
                raise InputError(
                    "columns of the line list", table.colnames, f"a column {column}", source=name
                )
        order = np.argsort(np.asarray(table["wavelength"], dtype=float), kind="stable")
        wavelength = np.asarray(table["wavelength"], dtype=float)[order]
        intensity = np.asarray(table["intensity"], dtype=float)[order]
        air = Bandpass.from_name("lsst_y").air
        absorption = np.minimum(air.total(wavelength) / air.scattering(wavelength), 1.0)
        lines = EmissionLines(wavelength, intensity, absorption, np.full(wavelength.size, "0-0"))
        return cls(name, lines, False)

    def spectrum(self, airmass: float) -> SkySpectrum:
        """Sky at an airmass."""
        if self.continuum:
            return SkySpectrum.dark(self.lines, airmass)
        return SkySpectrum(self.lines, (), airmass)


UNDAMPED = "undamped"  # Rows of the model without effects, which is that of the paper
WITH_EFFECTS = "with effects"  # Rows of the model with the effects that were given


def amplitude_table(
    adhesive_um: ArrayLike,
    skies: Sequence[SkyCase] | None = None,
    effects: Mapping[str, Any] | None = None,
    cases: Sequence[AmplitudeCase] | None = None,
    *,
    silicon: str | None = None,
) -> Table:
    """Amplitudes of the fringes of every set-up.

    ``adhesive_um`` (ny, nx): thickness of the adhesive of E2V-CCD250-321; every 16th pixel will do. ``skies``:
    spectra of the night sky; PALACE with and without continua by default. ``effects``: effects that the set-ups
    lack, by ``name.parameter``; those of the laboratory are left out on the sky. Without any, this is the undamped
    model of the paper. ``cases``: `CASES` by default. ``silicon``: another table of silicon than that of the
    set-ups, as the ``Si_green2008`` of the paper. Returns one row per case and sky. Amplitudes in per cent of the
    mean: of the frame itself (``rms``, ``half_peak_to_peak``, ``half_range_1_99``), and ``rms_flat_fielded`` after
    division by a flat field of white light, which takes out how absorption changes with the thickness of silicon.
    """
    adhesive = np.asarray(adhesive_um, dtype=float)
    if adhesive.ndim != 2:
        raise InputError("shape of the thickness map", adhesive.shape, "two axes (y, x)")
    settings = dict(effects or {})
    activate_effects(settings, known_effects())
    chosen = SkyCase.palace() if skies is None else tuple(skies)
    rows = []
    for case in CASES if cases is None else cases:
        model = _model(case, settings, silicon)
        thickness = adhesive if case.own_map else _stand_in(case.setup)
        for sky in chosen if case.on_sky else (None,):
            found, flat_fielded = _amplitudes(case, model, thickness, sky)
            rows.append(_row(case, model, sky, found, flat_fielded))
    table = Table(rows=rows)
    for name in ("rms", "half_peak_to_peak", "half_range_1_99", "rms_flat_fielded"):
        table[name].unit = "%"
        table[name].format = ".4f"
    table.meta.update(
        effects={str(name): float(value) for name, value in settings.items()},
        paper="Guo, Walter, Lage & Lupton 2022, Table 2; what is recomputed from its figures in column recomputed",
    )
    return table


def compare_amplitudes(
    adhesive_um: ArrayLike,
    skies: Sequence[SkyCase] | None = None,
    effects: Mapping[str, Any] | None = None,
    cases: Sequence[AmplitudeCase] | None = None,
) -> Table:
    """`amplitude_table` without effects and, if there are any, with them, in one table.

    Returns the table of `amplitude_table`, with a column ``model`` of `UNDAMPED` and `WITH_EFFECTS`;
    ``meta["contradiction"]`` has a sentence for each model where the rows that it needs are there.
    """
    settings = dict(effects or {})
    parts = [amplitude_table(adhesive_um, skies, {}, cases)]
    if settings:
        parts.append(amplitude_table(adhesive_um, skies, settings, cases))
    said = []
    for part, name in zip(parts, (UNDAMPED, WITH_EFFECTS), strict=False):
        if {"SLAC-TS8, flat", "MonoCam"} <= set(part["case"]):
            said.append(f"{name}: {contradiction(part)}")
        part.add_column(Column([name] * len(part), name="model"), index=1)
    table = vstack(parts, metadata_conflicts="silent")
    table.meta = {**parts[-1].meta, "contradiction": said}
    return table


def contradiction(table: Table) -> str:
    """What laboratory and sky say of the contrast together, in words.

    The detection-layer model is several times too strong in the laboratory, and about right on the sky with MonoCam:
    an effect that damps one damps the other.
    """
    lab = table[table["case"] == "SLAC-TS8, flat"]
    sky = table[table["case"] == "MonoCam"]
    if not len(lab) or not len(sky):
        raise InputError("rows of the table", sorted(set(table["case"])), "SLAC-TS8, flat and MonoCam")
    flat, night = float(lab["half_range_1_99"][0]), float(np.max(sky["half_peak_to_peak"]))
    ratio_lab, ratio_sky = flat / _MEASURED_FLAT, night / _MEASURED_MONOCAM
    agrees = 0.7 < ratio_lab < 1.4 and 0.7 < ratio_sky < 1.4
    return (
        f"Laboratory flat at 960 nm: {flat:.2f} %, measured {_MEASURED_FLAT:g} % ({ratio_lab:.1f} times). "
        f"MonoCam: {night:.2f} %, measured about {_MEASURED_MONOCAM:g} % ({ratio_sky:.2f} times). "
        + (
            "Both agree with the measurements."
            if agrees
            else f"The two ratios differ by a factor {ratio_lab / ratio_sky:.1f}: no contrast that is common to both "
            "can bring them together; what damps the laboratory's fringes must spare those of the sky."
        )
    )


_MEASURED_FLAT = 1.5  # Half range of E2V-CCD250-321 at 960 nm: the measured fundamental [%]
_MEASURED_MONOCAM = 2.0  # Amplitude of MonoCam's fringes in Table 2 [%]


def _model(case: AmplitudeCase, settings: Mapping[str, Any], silicon: str | None) -> FringeModel:
    """Model with those effects that the stack and the light of a case can have."""
    setup = Setup.from_name(case.setup)
    setup = setup if silicon is None else setup.with_silicon(silicon)
    bare = FringeModel.from_setup(setup, field_x_deg=case.field_deg)
    given = settings_of(activate_effects(settings, known_effects()), on_sky=case.on_sky)
    return bare.with_effects({key: value for key, value in given.items() if _applies(bare, {key: value})})


def _applies(model: FringeModel, setting: Mapping[str, Any]) -> bool:
    try:
        model.with_effects(setting)
    except InputError:
        return False
    return True


@functools.lru_cache(maxsize=4)
def _stand_in(setup_name: str) -> FloatArray:
    setup = FringeModel.from_setup(setup_name).setup
    detector = Camera.from_name(setup.camera).detector(setup.detector)
    shape = (detector.shape[0] // 8, detector.shape[1] // 8)
    return stand_in_thickness(setup, detector, shape=shape).value.astype(float)


def _amplitudes(
    case: AmplitudeCase, model: FringeModel, thickness: FloatArray, sky: SkyCase | None
) -> tuple[FringeAmplitudes, FringeAmplitudes]:
    """Amplitudes of the frame, and of the frame over a flat field of white light."""
    span = thickness_span_um(thickness)
    if sky is None:
        found = fringe_amplitudes(model.table(span, [case.wavelength_nm]).lookup(thickness)[0])
        return found, found
    spectrum = sky.spectrum(model.setup.airmass)
    band = Bandpass.from_name(model.setup.bandpass)
    table, _, _ = tabulate_components(model, spectrum, band, span, _QUADRATURE)
    frame = table.lookup(thickness).sum(axis=0)
    flat = _white_table(model, span).lookup(thickness)[0]
    return fringe_amplitudes(frame), fringe_amplitudes(frame / flat)


def _white_table(model: FringeModel, span: tuple[float, float]) -> ResponseTable:
    white = white_light(Bandpass.from_name(model.setup.bandpass), 0.2)
    beam = reduce_beam(model.system.beam, _FLAT_ANGLES)
    light = Illumination.spectrum(white.wavelength_nm, white.photons, beam)
    return model.table_of(light, span, tolerance=1e-6)


def _row(
    case: AmplitudeCase,
    model: FringeModel,
    sky: SkyCase | None,
    found: FringeAmplitudes,
    flat_fielded: FringeAmplitudes,
) -> dict[str, Any]:
    return {
        "case": case.name,
        "setup": case.setup,
        "temperature": model.system.temperature_k,
        "layer": model.setup.varying,
        "light": "960 nm, 2 nm wide" if sky is None else sky.name,
        "rms": 100.0 * found.rms,
        "half_peak_to_peak": 100.0 * found.half_peak_to_peak,
        "half_range_1_99": 100.0 * found.half_range_1_99,
        "rms_flat_fielded": 100.0 * flat_fielded.rms,
        "paper_observed": case.observed,
        "paper_simulated": case.simulated,
        "recomputed": case.recomputed,
    }
