"""Truth beside verdict, and what came of it: numbers of the demo, and the first part of its page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.table import Table
from numpy.typing import NDArray

from ..algorithms.discovery import Verdict
from ..algorithms.night_levels import background_terms
from ..array_types import Float32Array, FloatArray
from ..challenge.demo_case import DemoCase, found_words, of_the_layers
from ..effects import EFFECTS
from ..products import SkyFringe, ThicknessMap
from ..report.discovery_figures import candidates_figure, gap_figure, where_figure
from ..report.page import Report
from ..report.words import measured_text
from ..style import figure, finite_range, show_image
from .demo_truth import DemoTruth

PERCENT, NM_PER_UM = 100.0, 1000.0

JUDGEMENTS = {
    "right": "right: both effects are named, and nothing else is as likely",
    "right class": "right class: each hidden effect is named, or is one of a class that these data cannot tell apart",
    "wrong": "wrong: what is named is not what was hidden",
    "no name": "no name: the search did not commit itself",
}


@dataclass(frozen=True, eq=False)
class VisitFringes:
    """True fringes of a visit before and after its correction, over the light of its sky."""

    name: str
    before: FloatArray
    after: FloatArray
    corrected: bool  # whether its fringes were seen, and something subtracted
    strength: tuple[
        float, float
    ]  # fitted scale of the template over the light of the sky, and its uncertainty

    @property
    def rms(self) -> tuple[float, float]:
        """Before and after."""
        return float(self.before.std()), float(self.after.std())


@dataclass(frozen=True, eq=False)
class Outcome:
    """What was hidden, what was found, and what is left of the fringes."""

    case: DemoCase
    verdict: Verdict
    map_errors_nm: tuple[
        float, float
    ]  # median absolute errors of the unchanged model, and with what was found
    forecast: tuple[SkyFringe, SkyFringe]  # the same
    visits: tuple[VisitFringes, ...]

    @classmethod
    def read(cls, folder: Path, truth: DemoTruth, maps: tuple[ThicknessMap, ThicknessMap]) -> Outcome:
        """Open what was sealed, and compare."""
        true_um = truth.thickness_um()
        without, found = (
            SkyFringe.read_fits(next((folder / name).glob("sky_*.fits")))
            for name in ("sky_without", "sky_with")
        )
        scales = {row["name"]: row for row in Table.read(folder / "corrected" / "frames.ecsv")}
        visits = tuple(_left(folder, *each, scales.get(each[0])) for each in truth.fringes())
        errors = (_error_nm(maps[0], true_um), _error_nm(maps[1], true_um))
        return cls(truth.case(), read_verdict(folder), errors, (without, found), visits)

    @property
    def rms_of_fringes(self) -> tuple[float, float]:
        """Of all visits, before and after."""
        squares = np.square([visit.rms for visit in self.visits]).mean(axis=0)
        return float(np.sqrt(squares[0])), float(np.sqrt(squares[1]))

    @property
    def measured(self) -> tuple[float, float]:
        """Mean strength of the template in the visits, 1 where they have what was found; and its uncertainty."""
        strength, sigma = np.array([visit.strength for visit in self.visits]).T
        weight = sigma**-2.0
        return float((strength * weight).sum() / weight.sum()), float(weight.sum() ** -0.5)

    def lines(self) -> list[tuple[str, str]]:
        """The story in a few lines, each a subject and what is to be said of it."""
        gap, (before, after) = self.verdict.gap, self.rms_of_fringes
        seen, expected = sum(visit.corrected for visit in self.visits), _rms_percent(self.forecast[1])
        strength, sigma = self.measured
        return [
            ("judgement", JUDGEMENTS[found_words(self.case, self.verdict)]),
            ("hidden", _told(self.case.values)),
            ("found", self._found()),
            (
                "data minus model",
                f"{_over(gap.before, gap.noise_floor)} times the noise before, "
                f"{_over(gap.after, gap.noise_floor)} times after",
            ),
            (
                "error of the thickness map",
                f"{self.map_errors_nm[0]:.2g} nm with the unchanged model, {self.map_errors_nm[1]:.2g} nm with what "
                "was found (median, against the true map)",
            ),
            (
                "forecast of the sky",
                f"fringes of {_rms_percent(self.forecast[0]):.2g} % rms with the unchanged model, "
                f"{_rms_percent(self.forecast[1]):.2g} % with what was found; {PERCENT * before:.2g} % in the visits",
            ),
            (
                "fringes in the visits",
                f"{PERCENT * before:.2g} % of the sky (rms) before the correction, {PERCENT * after:.2g} % after; "
                f"seen and subtracted in {seen} of {len(self.visits)} visits, which together measure "
                f"{strength * expected:.2g} ± {sigma * expected:.1g} %",
            ),
            ("seed", str(self.case.seed)),
        ]

    def _found(self) -> str:
        if not self.verdict.effects:
            return self.verdict.verdict
        words = []
        for effect in self.verdict.effects:
            values, sigmas = (
                {f"{effect.name}.{name}": getattr(each, what) for name, each in effect.parameters.items()}
                for what in ("value", "sigma")
            )
            rivals = f", or {', '.join(effect.ambiguous_with)}" if effect.ambiguous_with else ""
            words.append(f"{_told(values, sigmas)}{rivals}")
        return "; ".join(words)

    def tell(self, report: Report, add: Any) -> None:
        """The first sections of the page."""
        report.summary(self.lines())
        self._truth_and_verdict(report, add)
        self._sky(report, add)
        self._visits(report, add)

    def _truth_and_verdict(self, report: Report, add: Any) -> None:
        report.section(
            "Truth beside verdict",
            "The search was given the raw frames and the name of the set-up. The truth lay in sealed/, and was read "
            "for this page only.",
        )
        report.link("discovery/report.html", "discovery/report.html", ".", "The whole evidence is in ")
        report.table(_comparison(self.case, self.verdict), "demo_truth_and_verdict")
        if self.verdict.where.channels:
            add(
                "discovery_where",
                where_figure(self.verdict),
                "Where the flats and the unchanged model disagree.",
            )
        if self.verdict.candidates:
            add("discovery_candidates", candidates_figure(self.verdict), "What could explain it.")
        if math.isfinite(self.verdict.gap.before):
            add(
                "discovery_gap",
                gap_figure(self.verdict),
                "The gap before and after what was found is in the model.",
            )

    def _sky(self, report: Report, add: Any) -> None:
        left = sorted(
            {key.partition(".")[0] for key in self.verdict.settings} - set(_names_on_sky(self.verdict))
        )
        out = (
            f" Not taken to the sky, as flat fields or the laboratory keep it: {', '.join(left)}."
            if left
            else ""
        )
        report.section(
            "The sky with and without it",
            f"What a dark y-band sky will show on this sensor, by the model before the search and after it.{out}",
        )
        add("forecast", _forecast_figure(self.forecast), "Forecasts on one scale.")

    def _visits(self, report: Report, add: Any) -> None:
        report.section(
            "Visits with stars",
            "Simulated visits of the same sensor, corrected with the certified template. Their true fringes are "
            "known; what was subtracted is taken from them. A visit in which no fringes are seen is left as it is. "
            "The proof, which does not know the truth, is in corrected/report.html.",
        )
        report.table(_visit_table(self.visits), "demo_visits")
        add(
            "visit",
            _visit_figure(self.visits[0]),
            f"True fringes of {self.visits[0].name}, less a surface of second degree as in all numbers of fringes.",
        )


def read_verdict(folder: Path) -> Verdict:
    """What the search of a demo said."""
    return Verdict.from_json((folder / "discovery" / "discovery.json").read_text(encoding="utf-8"))


def _names_on_sky(verdict: Verdict) -> list[str]:
    kept = {key.partition(".")[0] for key in of_the_layers(verdict.settings)}
    return [effect.name for effect in EFFECTS if effect.name in kept and not effect.laboratory_only]


MANY = 6  # Parameters from which on an effect is told by the rms of their values


def _told(values: Mapping[str, float], sigmas: Mapping[str, float] | None = None) -> str:
    """Effects with their sizes, and uncertainties if there are any."""
    units, words = _units(), []
    for name in dict.fromkeys(key.partition(".")[0] for key in values):
        own = {key: value for key, value in values.items() if key.partition(".")[0] == name}
        if len(own) > MANY:
            sizes = [f"rms {np.std(list(own.values())):.2g} {units[next(iter(own))]}".rstrip()]
        else:
            sizes = [
                f"{key.partition('.')[2]} = {value:.3g}"
                + (f" ± {sigmas[key]:.1g}" if sigmas else "")
                + (f" {units[key]}" if units[key] else "")
                for key, value in own.items()
            ]
        words.append(f"{name} ({', '.join(sizes)})")
    return "; ".join(words)


def _comparison(case: DemoCase, verdict: Verdict) -> Table:
    """Hidden and found size of every parameter that is in either."""
    found = {
        f"{effect.name}.{name}": each
        for effect in verdict.effects
        for name, each in effect.parameters.items()
    }
    rows, units = [], _units()
    for key in dict.fromkeys([*case.values, *found]):
        true, each = case.values.get(key), found.get(key)
        rows.append(
            (
                key,
                "–" if true is None else f"{true:.4g}",
                "–" if each is None else " ± ".join(measured_text(each.value, each.sigma)),
                units[key] or "1",
            )
        )
    return Table(rows=rows, names=("parameter", "hidden", "found", "unit"))


def _units() -> dict[str, str]:
    return {f"{effect.name}.{each.name}": each.unit for effect in EFFECTS for each in effect.parameters}


def _over(size: float, noise: float) -> str:
    return f"{size / noise:.3g}"


def _rms_percent(frame: SkyFringe) -> float:
    return PERCENT * float(np.nanstd(_fringes(frame)))


def _fringes(frame: SkyFringe) -> FloatArray:
    return _without_background(np.where(frame.mask == 0, frame.fraction(), np.nan))


def _without_background(image: NDArray[np.floating]) -> FloatArray:
    """An image less a surface of second degree, as the removal of a background takes it; NaN stays."""
    terms = np.moveaxis(background_terms(image.shape), 0, -1)
    known = np.isfinite(image)
    found, *_ = np.linalg.lstsq(terms[known], image[known].astype(float), rcond=None)
    return np.asarray(image - terms @ found)


def _error_nm(found: ThicknessMap, true_um: FloatArray) -> float:
    return NM_PER_UM * float(np.median(np.abs(found.value - true_um)[found.mask == 0]))


def _left(folder: Path, name: str, true_e: Float32Array, level_e: float, row: Any | None) -> VisitFringes:
    """Fringes of a visit, and what is left of them; all of them where it was not corrected."""
    before = _without_background(true_e / level_e)
    path = folder / "corrected" / f"{name}_corrected.fits"
    fitted = (0.0, math.inf) if row is None else (row["scale 0"] / level_e, row["sigma 0"] / level_e)
    if not path.is_file():
        return VisitFringes(name, before, before, False, fitted)
    image, corrected = (
        np.asarray(fits.getdata(each, "IMAGE"), dtype=np.float64)
        for each in (folder / "visits" / f"{name}.fits", path)
    )
    taken = np.where(np.isfinite(image - corrected), image - corrected, 0.0)
    after = _without_background((true_e - taken) / level_e)
    return VisitFringes(name, before, after, bool(taken.any()), fitted)


def _visit_table(visits: tuple[VisitFringes, ...]) -> Table:
    rows = [
        (visit.name, PERCENT * visit.rms[0], PERCENT * visit.rms[1], "yes" if visit.corrected else "no")
        for visit in visits
    ]
    table = Table(rows=rows, names=("visit", "fringes before", "fringes after", "corrected"))
    for name in ("fringes before", "fringes after"):
        table[name].unit = "percent"
        table[name].info.format = ".2g"
    return table


def _forecast_figure(frames: tuple[SkyFringe, SkyFringe]) -> Any:
    images = [PERCENT * _fringes(frame) for frame in frames]
    return _beside(images, ("unchanged model", "with what was found"), "fringes / sky [%]")


def _visit_figure(visit: VisitFringes) -> Any:
    images = [PERCENT * image for image in (visit.before, visit.after)]
    return _beside(images, ("fringes before", "fringes after"), "fringes / sky [%]")


def _beside(images: list[FloatArray], titles: tuple[str, str], label: str) -> Any:
    limits = finite_range(images[0], symmetric=True)
    with figure(9.5, 4.2) as made:
        for axes, image, title in zip(made.subplots(1, 2), images, titles, strict=True):
            show_image(axes, image, label=label, title=title, diverging=True, limits=limits)
        return made
