"""What the recomputation of a section of the paper consists of: numbers, and what is drawn."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from ..array_types import FloatArray
from ..errors import InputError
from ..instrument.setup import Setup
from ..mock.thickness import E2V_SHAPE
from ..optics import LayerStack

PAPER_SILICON, COLD_SILICON = "Si_green2008", "Si"
"""Tables of silicon: that of the paper, a law extrapolated to the cold, and what was measured there."""


@dataclass(frozen=True, eq=False)
class Curve:
    """One line of a graph; ``style`` is that of matplotlib, ``-``, ``--``, ``.`` or ``o``."""

    x: NDArray[np.floating]
    y: NDArray[np.floating]
    label: str
    style: str = "-"


@dataclass(frozen=True, eq=False)
class Graph:
    """Curves over one axis; a logarithmic one leaves out what is not positive, and what is below ``lowest``."""

    title: str
    xlabel: str
    ylabel: str
    curves: tuple[Curve, ...]
    logarithmic: bool = False
    lowest: float = 0.0


@dataclass(frozen=True, eq=False)
class Picture:
    """An image ``[y, x]``; diverging colours for values of both signs; ``step_px`` pixels between samples."""

    title: str
    label: str
    values: NDArray[np.floating]
    diverging: bool = False
    step_px: float = 1.0


@dataclass(frozen=True, eq=False)
class PaperSection:
    """A section of the paper, recomputed."""

    # title, text: heading, and what was done
    title: str
    text: str
    # recomputed numbers by item of the table of published numbers; NaN where one could not be computed
    values: Mapping[str, float]
    panels: tuple[Graph | Picture, ...] = ()  # what is drawn, side by side
    caption: str = ""  # caption of the panels


@dataclass(frozen=True, eq=False)
class Context:
    """What a recomputation starts from."""

    # (ny, nx): adhesive of E2V-CCD250-321 over the whole sensor [µm], on any number of pixels
    thickness_um: FloatArray
    detail_um: FloatArray  # (ny, nx): a part of it pixel by pixel [µm]
    coadds: int = 800  # largest number of exposures in a coadd
    seed: int = 1  # seed of noise, random fields and rotations
    # folder with ``measured/`` and ``data/``: curves and maps read off the published figures
    shared: Path | None = None
    # table of silicon; by default the constants of the paper, whatever the set-ups have today
    silicon: str = PAPER_SILICON

    def __post_init__(self) -> None:
        for name in ("thickness_um", "detail_um"):
            if np.ndim(getattr(self, name)) != 2:
                raise InputError(name, np.shape(getattr(self, name)), "two axes (y, x)")
        if self.coadds < 2:
            raise InputError("exposures in a coadd", self.coadds, "2 or more")
        if self.shared is not None and not (self.shared / "measured").is_dir():
            raise InputError("published curves", str(self.shared), "a folder with a folder 'measured' in it")

    def setup(self, name: str) -> Setup:
        """A set-up with this silicon."""
        return Setup.from_name(name).with_silicon(self.silicon)

    @property
    def stack(self) -> LayerStack:
        """The sensor of Table 1 with this silicon."""
        return LayerStack.from_resource("e2v_ccd250").with_silicon(self.silicon)

    @property
    def step_px(self) -> float:
        """Pixels of the sensor between samples of ``thickness_um``."""
        return E2V_SHAPE[0] / len(self.thickness_um)

    def rng(self, section: str) -> np.random.Generator:
        """Generator of one section, so that sections do not depend on each other."""
        return np.random.default_rng([self.seed, *section.encode()])

    def curve(self, name: str) -> Table | None:
        """Curve read off a published figure, or `None` where the curves are not at hand."""
        return self._table(f"measured/{name}.ecsv")

    def lines_of_figure_8(self) -> Table | None:
        """OH lines of Figure 8, or `None` where they are not at hand."""
        return self._table("data/oh_lines_guo2022_fig8.ecsv")

    def map_path(self, name: str) -> Path | None:
        """File of a published map, or `None`."""
        path = None if self.shared is None else self.shared / "measured" / name
        return path if path is not None and path.is_file() else None

    def _table(self, name: str) -> Table | None:
        path = None if self.shared is None else self.shared / name
        return None if path is None or not path.is_file() else Table.read(path, format="ascii.ecsv")


def missing(*items: str) -> dict[str, float]:
    """Items that cannot be computed."""
    return dict.fromkeys(items, math.nan)


def columns(table: Table, *names: str) -> list[FloatArray]:
    """Columns of a table as numbers."""
    return [np.asarray(table[name], dtype=float) for name in names]
