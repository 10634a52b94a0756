"""The sealed truth of the demo: it makes the frames, and is read again for the last page only."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..array_types import Float32Array, FloatArray
from ..challenge.demo_case import DemoCase, draw_demo_case, thickness_of_demo
from ..files import all_or_nothing, write_whole
from ..instrument.setup import Setup
from ..mock.raw_frames import write_mock_flats
from ..mock.visits import VisitConditions, write_mock_visits

LABORATORY, TELESCOPE, SENSOR = "ts8_e2v", "lsst_e2v", "E2V-CCD250-321"
CASE, FRINGES = "truth.json", "fringes.npz"


@dataclass(frozen=True)
class DemoTruth:
    """What is true of the frames of a demo, in a folder that no program which analyses them is given."""

    folder: Path
    seed: int
    shape: tuple[int, int]

    def write_flats(self, raws: Path) -> None:
        """Draw what is hidden, seal it, and write raw frames with it."""
        shutil.rmtree(raws, ignore_errors=True)
        case = draw_demo_case(self.seed, self.shape)
        self.folder.mkdir(exist_ok=True)
        write_whole(self.folder / CASE, case.to_json())
        write_mock_flats(
            raws,
            setup=LABORATORY,
            detector=SENSOR,
            thickness_um=self.thickness_um(),
            wavelengths_nm=Setup.from_name(LABORATORY).wavelengths_nm,
            rng=case.frames_rng,
            effects=case.values,
            size=self._size,
        )

    def write_visits(self, visits: Path, number: int) -> None:
        """Write visits of the same sensor, and seal the fringes in them."""
        shutil.rmtree(visits, ignore_errors=True)
        case = self.case()
        made = list(
            write_mock_visits(
                visits,
                setup=TELESCOPE,
                detector=SENSOR,
                thickness_um=self.thickness_um(),
                rng=case.visits_rng,
                effects=case.on_sky,
                conditions=VisitConditions(number),
            )
        )
        with all_or_nothing(self.folder / FRINGES) as path, path.open("wb") as stream:
            np.savez(
                stream,
                name=np.array([visit.path.stem for visit in made]),
                fringes=np.array([visit.fringes for visit in made]),
                level=np.array([visit.level_e for visit in made]),
            )

    def case(self) -> DemoCase:
        """What is hidden."""
        return DemoCase.from_json((self.folder / CASE).read_text(encoding="utf-8"))

    def thickness_um(self) -> FloatArray:
        """Thickness of the adhesive [µm]."""
        return thickness_of_demo(self.shape)

    def fringes(self) -> list[tuple[str, Float32Array, float]]:
        """Of every visit: name of its file, light of the sky less its mean, and that mean [e⁻]."""
        with np.load(self.folder / FRINGES) as stored:
            return [
                (str(name), fringes, float(level))
                for name, fringes, level in zip(
                    stored["name"], stored["fringes"], stored["level"], strict=True
                )
            ]

    @property
    def _size(self) -> str:
        return f"{self.shape[1]}x{self.shape[0]}"
