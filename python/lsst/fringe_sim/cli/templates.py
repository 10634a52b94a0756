"""``fringe-sim templates``."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..errors import InputError
from ..files import same_file_key
from .bad_files import refuse_bad
from .command import DRY_RUN, EXISTING, argument, command, flag, option
from .observed import NO_SKY, Background, TemplateFolder, background_options, images_of, latest_date
from .output import OutputFolder, origin_of, output_folder
from .progress import progress

if TYPE_CHECKING:
    from ..algorithms.correction.empirical import TemplateOptions
    from ..products import FringeFrame, FringeTemplates
    from ..products.observed_files import ObservedImage

LEAST_FRAMES = 3


@command()
def templates(
    frames: tuple[Path, ...] = argument(kind=EXISTING),
    background: Background = background_options(),
    components: int | None = option(
        "Templates; by default as many as predict other frames.", kind=click.IntRange(1)
    ),
    least_frames: int = option("Frames that must see a pixel.", LEAST_FRAMES, click.IntRange(1)),
    prior: Path | None = option(
        "Templates of a model, a file or a folder: what the frames do not decide is taken from them.",
        kind=EXISTING,
    ),
    out: OutputFolder = output_folder(
        "Folder for templates, figure and report.", "templates_*.fits", "report.html"
    ),
    skip_bad: bool = flag("Go on without frames that cannot be read."),
    dry_run: bool = DRY_RUN,
) -> None:
    """Make fringe templates of each sensor from observed frames in one filter.

    FRAMES are FITS files after the removal of the instrument's signature, or folders with them: of Rubin, of the
    DECam Community Pipeline, of ZTF, or plain; every image in a file is a sensor of its own. Objects are found and
    left out; the telescope should have moved between the frames.

    \b
    Examples:
      fringe-sim templates night/*.fits --out templates
      fringe-sim templates night --prior model/fringe_0.fits --out templates
    """
    from ..algorithms.correction.empirical import LEARNING_ROUNDS, TemplateOptions
    from ..products import refuse_corrected
    from ..report.correction_page import write_templates_report

    images, unusable = images_of(frames, refuse_corrected)
    refuse_bad(unusable, skip_bad=skip_bad)
    sensors = _by_sensor(images)
    options = TemplateOptions(
        components, least_frames=least_frames, spacing_px=background.spacing_px, amplifiers=background.grid
    )
    expected = None if prior is None else TemplateFolder(prior)
    if dry_run:
        for name, images in sensors.items():
            _check(images, background, expected, name)
            click.echo(f"would make templates of {name} from {len(images)} frames")
        return
    folder = out.prepare()
    steps = LEARNING_ROUNDS * sum(len(images) for images in sensors.values())

    def made(advance: Callable[[], None]) -> Iterator[tuple[str, FringeTemplates]]:
        for name, images in sensors.items():
            known = [] if expected is None else expected.of(name)
            product = _made(images, options, known, background, advance)
            product.write_fits(folder / f"templates_{_file_name(name)}.fits")
            click.echo(_describe(name, product))
            yield name, product

    origin = origin_of(folder, [*frames, *([prior] if prior else [])])
    with progress("finding fringes", steps) as advance:
        page = write_templates_report(folder / "report.html", made(advance), origin)
    click.echo(str(page))


def _by_sensor(images: list[ObservedImage]) -> dict[str, list[ObservedImage]]:
    """Images of each sensor; sensors of which the templates would have one name are refused."""
    from ..products.observed_files import detector_of

    sensors = defaultdict(list)
    for image in images:
        sensors[detector_of(image.header())].append(image)
    files: dict[str, str] = {}
    for name, found in sensors.items():
        if len(found) < LEAST_FRAMES:
            raise InputError(f"frames of sensor {name!r}", len(found), f"{LEAST_FRAMES} or more")
        other = files.setdefault(same_file_key(_file_name(name)), name)
        if other != name:
            allowed = f"names that differ in letters and digits: both become {_file_name(name)}"
            raise InputError("sensors", f"{other} and {name}", allowed)
    return dict(sensors)


def _made(
    images: list[ObservedImage],
    options: TemplateOptions,
    prior: list[FringeFrame],
    background: Background,
    advance: Callable[[], None],
) -> FringeTemplates:
    """Templates of one sensor; each frame is read anew in every round."""
    from ..algorithms.observed_frames import make_templates
    from ..model.provenance import software_cards

    date = latest_date([image.header() for image in images])
    loaders, names = background.loaders(images), _names(images)
    return make_templates(loaders, date, options, prior, software_cards(), advance, names)


def _names(images: list[ObservedImage]) -> list[str]:
    return [f"{image.path}[{image.name}]" for image in images]


def _check(
    images: list[ObservedImage], background: Background, expected: TemplateFolder | None, name: str
) -> None:
    """Refuse what the making of templates of a sensor would refuse before its first fit."""
    from ..algorithms.observed_frames import first_of_alike

    if expected is not None:
        expected.of(name)
    first_of_alike(background.loaders(images), _names(images), "frames for templates")


def _file_name(sensor: str) -> str:
    return "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in sensor) or "sensor"


def _describe(name: str, product: FringeTemplates) -> str:
    good = product.mask == 0
    spread = [float(each[good].std()) for each in product.patterns]
    if product.per_sky:
        rms = ", ".join(f"{100.0 * each:.4f} %" for each in spread)
    else:
        rms = ", ".join(f"{each:.4g}" for each in spread) + f" in the unit of the frames ({NO_SKY})"
    return (
        f"{name or 'sensor'}: {len(product.patterns)} templates from {len(product.scores)} frames, rms {rms}; "
        f"{100.0 * float((~good).mean()):.2f} % of the pixels are seen by too few"
    )
