"""``fringe-sim correct``."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..errors import InputError
from .bad_files import refuse_bad
from .command import DRY_RUN, EXISTING, argument, command, flag, option
from .observed import NO_SKY, Background, TemplateFolder, background_options, images_of, stem_of, target_names
from .output import OutputFolder, origin_of, output_folder
from .progress import progress

if TYPE_CHECKING:
    from ..algorithms.fringe_correction import CorrectionOptions
    from ..algorithms.observed_frames import CorrectedFrame, FrameRecord
    from ..products import ObservedFrame
    from ..products.observed_files import ObservedImage
    from ..report.page import Origin

EXIT_REFUSED = 1

OWN_TEMPLATES = "the templates are made of this frame itself: what is left cannot be judged from it"

OWN_CARD = re.compile(r"FRING(COR|TID|PRB|VER|S[CE]\d+)")
"""Keywords that a correction writes, and its undoing removes."""


@command()
def correct(
    frames: tuple[Path, ...] = argument(kind=EXISTING),
    folder: Path = option(
        "Folder of 'fringe-sim templates', or with fringe_*.fits of a model.",
        kind=EXISTING,
        names="--templates",
        required=True,
    ),
    background: Background = background_options(),
    pixel_scale: float = option(
        "Size of a pixel [arcsec]: fringes are judged on scales up to 20 arcsec.",
        0.2,
        click.FloatRange(0.0, min_open=True),
    ),
    inject: bool = flag(
        "Draw stars and galaxies into a copy of each frame, and tell their fluxes and shapes before and after."
    ),
    undo: bool = flag("Put the fringes back that an earlier run has subtracted."),
    out: OutputFolder = output_folder(
        "Folder for frames, table and report.",
        *("*_corrected.fits", "*_restored.fits", "frames.ecsv", "injected.ecsv", "report.html"),
    ),
    dry_run: bool = DRY_RUN,
) -> None:
    """Subtract fringe templates from observed frames, and prove frame by frame that it helped.

    Files keep their layout: pixels change, and the header says by how much. A frame in which the fringes of the
    templates are not seen is written with its pixels as they are. A frame to which the templates add structure is not
    written; the report shows it, and the exit status is 1.

    \b
    Examples:
      fringe-sim correct night/*.fits --templates templates --out corrected
      fringe-sim correct corrected/*_corrected.fits --templates templates --out restored --undo
    """
    from ..algorithms.fringe_correction import refuse_uncorrected
    from ..products import refuse_corrected

    images, unusable = images_of(frames, refuse_uncorrected if undo else refuse_corrected)
    known = TemplateFolder(folder)
    known.check(images)
    names = target_names(images, *(("_restored", "_corrected") if undo else ("_corrected",)))
    if dry_run:
        click.echo(f"would {'restore' if undo else 'correct'} {len(images)} images")
        refuse_bad(unusable, skip_bad=False, others=False)
        return
    target = out.prepare()
    if undo:
        refused = _restore(images, known, target, names)
        passed = True
    else:
        make = partial(_correct_one, known, background.options, pixel_scale, inject)
        done, refused = _corrected(images, make, background, target, names)
        origin = origin_of(target, [folder, *frames])
        _write_report(target, done, [*map(str, unusable), *refused], origin)
        passed = all(each.proof.passed for each in done)
        for record in done:
            click.echo(_describe(record))
    for line in [*map(str, unusable), *refused]:
        click.echo(line)
    if not undo:
        bare = sum(record.sky_subtracted for record in done)
        if bare:
            click.echo(f"frames without a sky: {bare} of {len(done)} ({NO_SKY})")
        click.echo(str(target / "report.html"))
    if unusable or refused or not passed:
        raise click.exceptions.Exit(EXIT_REFUSED)


def _corrected(
    images: list[ObservedImage],
    make: Callable[[ObservedFrame, str], tuple[CorrectedFrame, FrameRecord]],
    background: Background,
    target: Path,
    names: Mapping[Path, str],
) -> tuple[list[FrameRecord], list[str]]:
    """Frames that could be fitted, of which those that passed are written; and why others could not."""
    from ..products.observed_files import write_images

    done: list[FrameRecord] = []
    refused: list[str] = []
    with progress("correcting frames", len(images)) as advance:
        for path, parts in _by_file(images).items():
            made: dict[int, CorrectedFrame] = {}
            pixels: dict[int, Any] = {}
            for image in parts:
                name = stem_of(path) if len(parts) == 1 else f"{stem_of(path)}[{image.name}]"
                put_back = background.of(image)
                try:
                    each, record = make(image.read(put_back), name)
                except InputError as error:
                    refused.append(f"{name}: not corrected: {error}")
                else:
                    done.append(record)
                    if each.proof.passed:
                        made[image.index] = each
                        pixels[image.index] = each.correction.applied(image.pixels(put_back))
                advance()
            if made:
                cards = {index: _cards(each) for index, each in made.items()}
                flags = {index: each.correction.uncorrected for index, each in made.items()}
                first = {"FRINGTID": next(iter(made.values())).correction.template_id, "FRINGUND": None}
                added = background.folder is not None
                write_images(path, target / names[path], pixels, cards, flags, first, added=added)
    return done, refused


def _correct_one(
    known: TemplateFolder,
    options: CorrectionOptions,
    pixel_scale: float,
    inject: bool,
    frame: ObservedFrame,
    name: str,
) -> tuple[CorrectedFrame, FrameRecord]:
    from ..algorithms.observed_frames import correct_frame, recover_sources

    templates = known.prepared(frame.detector, frame.physical_filter)
    made = correct_frame(frame, templates, options, pixel_arcsec=pixel_scale)
    sources = None
    if inject and made.proof.passed:
        sources = recover_sources(frame, made, templates, options, pixel_arcsec=pixel_scale, name=name)
    return made, made.record(name, sources)


def _by_file(images: list[ObservedImage]) -> dict[Path, list[ObservedImage]]:
    files: dict[Path, list[ObservedImage]] = {}
    for image in images:
        files.setdefault(image.path, []).append(image)
    return files


def _cards(each: CorrectedFrame) -> dict[str, Any]:
    from .. import __version__

    made: dict[str, Any] = {**each.correction.cards, "FRINGPRB": each.proof.probability}
    for keyword, value in made.items():
        scale = re.fullmatch(r"FRINGS([CE])(\d+)", keyword)
        if scale:
            what = "scale" if scale[1] == "C" else "error of the scale"
            made[keyword] = (value, f"[{each.frame.unit or 'counts'}] {what} of template {scale[2]}")
    return {**made, "FRINGVER": __version__}


def _restore(
    images: list[ObservedImage], known: TemplateFolder, target: Path, names: Mapping[Path, str]
) -> list[str]:
    """Put the fringes back; what is returned says why some could not be."""
    from ..algorithms.fringe_correction import undo_correction
    from ..products.observed_files import write_images

    refused = []
    for path, parts in _by_file(images).items():
        pixels, cards, flags = {}, {}, {}
        try:
            for image in parts:
                header, frame = image.header(), image.read()
                templates = known.prepared(frame.detector)
                pixels[image.index] = undo_correction(image.pixels(), templates, header)
                cards[image.index] = dict.fromkeys(key for key in header if OWN_CARD.fullmatch(key))
                flags[image.index] = frame.mask < 0
        except InputError as error:
            refused.append(f"{stem_of(path)}: fringes not put back: {error}")
            continue
        first = {"FRINGTID": None, "FRINGUND": True}
        write_images(path, target / names[path], pixels, cards, flags, first)
        click.echo(f"{stem_of(path)}: fringes put back")
    return refused


def _write_report(target: Path, done: list[FrameRecord], refused: list[str], origin: Origin) -> None:
    from ..algorithms.observed_frames import injected_table, summary_table
    from ..files import table_text, write_whole
    from ..report.correction_page import write_correction_report

    write_whole(target / "frames.ecsv", table_text(summary_table(done)))
    sources = injected_table(done)
    if sources is not None:
        write_whole(target / "injected.ecsv", table_text(sources))
    write_correction_report(target / "report.html", done, refused, origin)


def _describe(record: FrameRecord) -> str:
    proof = record.proof
    if not proof.passed:
        return (
            f"{record.name}: not corrected: the templates add structure ({proof.worst}, probability "
            f"{proof.probability:.1e}); see the report"
        )
    scales = ", ".join(
        f"{scale:.4g} ± {sigma:.2g}" for scale, sigma in zip(record.scale, record.sigma, strict=True)
    )
    scales = f"scales {scales} {record.unit or 'counts'}"
    clearest = max(abs(scale / sigma) for scale, sigma in zip(record.scale, record.sigma, strict=True))
    if not proof.seen:
        return f"{record.name}: left as it is: the fringes of the templates are not seen ({clearest:.1f} σ, {scales})"
    return (
        f"{record.name}: {scales} (fringes at {clearest:.1f} σ); of the fringes "
        f"{_left(proof.part_left, proof.part_left_sigma)} left; structure beyond the noise "
        f"{proof.structure_before:.2f} before, {proof.structure_after:.2f} after"
        + (f"; {OWN_TEMPLATES}" if record.of_own_templates else "")
    )


def _left(part: float, sigma: float) -> str:
    """The part that is left, or its limit where its square, which is measured, is within two errors of 0."""
    from ..report.words import measured_text, number_text

    square, error = part**2, (part + sigma) ** 2 - part**2
    if square < 2.0 * error:
        return f"less than {number_text(100.0 * (square + 2.0 * error) ** 0.5, 2)} % (2 σ)"
    return f"{' ± '.join(measured_text(100.0 * part, 100.0 * sigma))} %"
