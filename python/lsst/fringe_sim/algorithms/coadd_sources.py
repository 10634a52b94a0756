"""What fringes do to the fluxes and shapes of sources in single visits and in the coadd of all of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.table import Table
from scipy.ndimage import affine_transform

from ..array_types import Float32Array, FloatArray
from ..errors import named_units
from ..products import FringeComponents, SkyFringe
from .coadds import Coadds, VisitPlaces, coadds_of_frames, filled_pattern, patterns_left, placed_visits
from .correction.injection import InjectionOptions, Source, bias_columns, free_places, stamp_side
from .pca import fit_pca

SINGLE = 8  # Single visits that are looked at; each has some dozens of sources of a kind and flux

UNTOUCHED, FRINGES, CORRECTED = "untouched", "fringes", "corrected"


@named_units
def sources_in_coadds(
    frames: Sequence[SkyFringe],
    rng: np.random.Generator,
    places: VisitPlaces | None = None,
    options: InjectionOptions | None = None,
    *,
    pixel_arcsec: float = 0.2,
) -> Table | None:
    """Bias of fluxes and shapes in single visits and in their coadd, with fringes and after a correction.

    Single exposures get the photon noise of their sky, a coadd that of its mean. The correction subtracts the one
    pattern that takes most of the frames; a single frame has none. Fringes are interpolated linearly, which
    takes 3 % of those of 10 px and 0.4 % of those of 30 px. One row for each number of visits, kind and flux:
    ``bias`` and ``scatter`` are of the difference from the same source in the same noise without fringes,
    ``magnitude`` is that of the source less that of one square arcsecond of the sky. `None` for frames that are
    too small.
    """
    placed = placed_visits(frames, rng, places)
    chosen = options or InjectionOptions()
    # Places are cells of one and a half images of a source.
    if placed is None or placed[1] < 1.5 * stamp_side(chosen, pixel_arcsec):
        return None
    sources = Source.of_all(chosen, pixel_arcsec)
    noise = float(np.sqrt(np.mean([1.0 / frame.mean_electrons for frame in frames])))
    rows = []
    for count, images in _coadds([filled_pattern(frame) for frame in frames], *placed):
        for source in sources:
            for snr in chosen.signal_to_noise:
                rms = noise / math.sqrt(count)
                flux = source.flux_at(snr, rms)
                departures = _departures(source, flux, rms, images, chosen.number, rng)
                row: dict[str, Any] = {"visits": count, "kind": source.kind, "signal_to_noise": snr}
                row["magnitude"] = -2.5 * math.log10(flux * pixel_arcsec**2)
                rows.append(row | _row(departures))
    return Table(rows)


def _row(departures: dict[str, FloatArray]) -> dict[str, Any]:
    plain = departures.pop(UNTOUCHED)
    known = np.isfinite(sum(departures.values(), plain)).all(axis=0)
    row: dict[str, Any] = {"number": plain.shape[1], "shapes": int(known.sum())}
    row |= bias_columns({name: each - plain for name, each in departures.items()})
    noise = bias_columns({"noise": plain})
    return row | {name: value for name, value in noise.items() if "scatter" in name}


def _departures(
    source: Source,
    flux: float,
    rms: float,
    images: Sequence[dict[str, FloatArray]],
    most: int,
    rng: np.random.Generator,
) -> dict[str, FloatArray]:
    """Of all sources that find a place, in the same noise without fringes, with them, and corrected."""
    found: dict[str, list[FloatArray]] = {name: [] for name in (UNTOUCHED, *images[0])}
    for fringes in images:
        shape = next(iter(fringes.values())).shape
        share = -(-most // len(images))
        for y, x in free_places(np.ones(shape, dtype=bool), source.stamp.shape[0], share, rng):
            place = source.around(y, x)
            plain = flux * source.stamp + rms * rng.standard_normal(source.stamp.shape)
            found[UNTOUCHED].append(source.departure(plain, flux))
            for name, image in fringes.items():
                found[name].append(source.departure(plain + image[place], flux))
    return {name: np.stack(each, axis=1) for name, each in found.items()}


def _coadds(
    patterns: Sequence[Float32Array], places: VisitPlaces, region_px: int
) -> Iterator[tuple[int, list[dict[str, FloatArray]]]]:
    """Number of visits, and fringes in the region before and after the correction: visits, then the coadd of all."""
    mixing = {FRINGES: np.eye(len(patterns))}
    if len(patterns) > 1:
        mixing[CORRECTED] = patterns_left(patterns, 1)
    single: list[dict[str, FloatArray]] = []
    total = {name: np.zeros((region_px, region_px)) for name in mixing}
    for number in range(len(places)):
        made = _pieces(patterns, mixing, places, number, region_px)
        if number < SINGLE:
            single.append(made)
        for name, piece in made.items():
            total[name] += piece / len(places)
    yield 1, single
    yield len(places), [total]


def _pieces(
    patterns: Sequence[Float32Array],
    mixing: dict[str, FloatArray],
    places: VisitPlaces,
    number: int,
    side: int,
) -> dict[str, FloatArray]:
    """The region in one visit, cut from the part of the sensor on which it lies."""
    angle = math.radians(places.rotation_deg[number])
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    centre = np.array([places.y_px[number], places.x_px[number]])
    reach = 0.5 * (side - 1) * np.abs(turn).sum(axis=1)
    first = np.maximum(np.floor(centre - reach).astype(int), 0)
    last = np.ceil(centre + reach).astype(int) + 2
    window = np.s_[first[0] : last[0], first[1] : last[1]]
    start = centre - turn @ np.full(2, 0.5 * (side - 1)) - first
    made = {}
    for name, matrix in mixing.items():
        share = matrix[places.frame[number]]
        parts = (part * each[window] for part, each in zip(share, patterns, strict=True) if part != 0.0)
        cut = sum(parts, np.zeros(1))
        made[name] = affine_transform(cut, turn, start, (side, side), order=1, mode="nearest")
    return made


@dataclass(frozen=True, eq=False)
class NightResults:
    """What frames of a night come to: components, and coadds with the sources in them."""

    components: FringeComponents | None  # of several frames
    coadds: Coadds | None  # of frames without noise that are large enough
    sources: Table | None  # in these coadds
    places_given: bool  # whether the visits of the coadds are at places that were given

    @classmethod
    def of(
        cls,
        frames: Sequence[SkyFringe],
        seed: int,
        places: VisitPlaces | None = None,
        pixel_arcsec: float = 0.2,
    ) -> NightResults:
        """Results of frames.

        ``seed``: of places and angles of the coadds, where ``places`` are not given. ``pixel_arcsec``: size of a
        pixel [arcsec].
        """
        quiet = frames[0].seed is None
        coadds = coadds_of_frames(frames, np.random.default_rng(seed), places) if quiet else None
        sources = None
        if coadds is not None:
            sources = sources_in_coadds(
                frames, np.random.default_rng(seed), places, pixel_arcsec=pixel_arcsec
            )
        return cls(fit_pca(frames) if len(frames) > 1 else None, coadds, sources, places is not None)
