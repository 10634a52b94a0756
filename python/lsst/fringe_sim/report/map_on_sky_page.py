"""Page of a thickness map that was held against frames of the sky."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ..algorithms.map_on_sky import MapOnSky
from ..algorithms.sky_shift import SkyShift
from ..products import SensorSection, ThicknessMap
from ..style import show_image
from .figures import map_row
from .page import Origin, Report
from .words import NM, masked_text, of_sensor, sigma_text

EVEN = 0.5  # Chance that a map is right from which on no shift is shown
LEAST_SIGMAS = 3.0  # Least reach of the colours of a shift, in its median uncertainty


def write_map_on_sky_report(
    path: Path,
    found: MapOnSky,
    layer: ThicknessMap,
    said: Sequence[str],
    *,
    frames: int,
    section: SensorSection | None = None,
    origin: Origin | None = None,
) -> Path:
    """Write the page.

    ``said``: what the command says. ``frames``: how many there were. ``section``: pixels of the sensor that the map
    shows, where that is known. ``origin``: command, and pages of what it was given.
    """
    report = Report(
        f"Map of {layer.detector or 'one sensor'} on the sky",
        f"Layer {layer.layer}, cells of {found.cell_px} px.",
        origin or Origin(),
    )
    shift = found.shift
    report.summary(
        [
            ("result", f"The map is right as it is with a probability of {shift.chance_unmoved:.2g}"),
            ("mean shift", f"{NM * float(shift.shift_um.mean()):+.3g} nm"),
            ("rms about the mean", f"{NM * float(shift.shift_um.std()):.2g} nm"),
            ("median σ of the shift", sigma_text(shift.sigma_um)),
            ("chance of another fringe order", f"{shift.chance_other_order:.2g}"),
            ("fringes over those of the dark sky", _strength(shift)),
            ("masked", masked_text(found.moved.mask)),
            ("part that was compared", of_sensor(layer.shape, section)),
            ("frames", f"{frames}"),
        ]
    )
    report.section(
        "What the frames say of the map", ". ".join(line[0].upper() + line[1:] for line in said) + "."
    )
    caption = "What is added to the map, and the uncertainty of that, averaged over all that compete."
    if shift.chance_unmoved > EVEN:
        caption = "Uncertainty of the map. No shift is seen."
    report.figure(_figure(found), caption)
    report.map(path.with_name("thickness.png"), found.moved.value, mask=found.moved.mask, unit="µm")
    return report.write(path)


def _strength(shift: SkyShift) -> str:
    sigma = shift.strength_sigma
    return f"{shift.strength:.3g}" + (f" ± {sigma:.1g}" if math.isfinite(sigma) else "")


def _figure(found: MapOnSky) -> Figure:
    """Shift, if one is likely, in colours that show nothing which its uncertainty allows for, and that."""
    shift, step = found.shift, float(found.cell_px)
    reach = NM * max(float(np.abs(shift.shift_um).max()), LEAST_SIGMAS * float(np.median(shift.sigma_um)))
    with map_row(1 if shift.chance_unmoved > EVEN else 2) as (made, (*others, right)):
        for left in others:
            show_image(
                left,
                NM * shift.shift_um,
                label="shift [nm]",
                title="shift of the map",
                diverging=True,
                limits=(-reach, reach),
                step_px=step,
            )
        show_image(right, NM * shift.sigma_um, label="σ [nm]", title="uncertainty of the shift", step_px=step)
        return made
