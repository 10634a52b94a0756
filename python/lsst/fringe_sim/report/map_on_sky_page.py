"""Page of a thickness map that was held against frames of the sky."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from ..algorithms.map_on_sky import MapOnSky
from ..products import ThicknessMap
from ..style import figure, show_image
from .page import Report

__all__ = ["write_map_on_sky_report"]

NM = 1000.0


def write_map_on_sky_report(path: Path, found: MapOnSky, layer: ThicknessMap, said: Sequence[str]) -> Path:
    """Write the page; ``said`` is what the command says."""
    report = Report(
        f"Map of {layer.detector or 'one sensor'} on the sky",
        f"Layer {layer.layer}, cells of {found.cell_px} px.",
    )
    report.section(
        "What the frames say of the map", ". ".join(line[0].upper() + line[1:] for line in said) + "."
    )
    report.figure(
        _figure(found),
        "What is added to the map, and the uncertainty of that, averaged over all that compete.",
    )
    return report.write(path)


def _figure(found: MapOnSky) -> Figure:
    with figure(9.0, 3.9) as made:
        left, right = made.subplots(1, 2)
        step = float(found.cell_px)
        show_image(
            left, NM * found.shift.shift_um, label="shift [nm]", title="shift", diverging=True, step_px=step
        )
        show_image(
            right, NM * found.shift.sigma_um, label="σ [nm]", title="uncertainty of the shift", step_px=step
        )
        return made
