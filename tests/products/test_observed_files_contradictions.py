"""An observed frame whose parts do not belong together is refused, and not read as another one."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from lsst.fringe_sim.errors import FrameFormatError
from lsst.fringe_sim.products.observed_files import observed_images

Change = Callable[[fits.HDUList], object]


def frame(path: Path, change: Change) -> Path:
    about = fits.Header({"DETNAME": "S11", "FILTER": "y", "BUNIT": "electron"})
    image = np.random.default_rng(1).normal(1e3, 30.0, (20, 30)).astype(np.float32)
    hdus = fits.HDUList(
        [
            fits.PrimaryHDU(header=about),
            fits.ImageHDU(image, about, "IMAGE"),
            fits.ImageHDU(np.zeros(image.shape, np.int32), fits.Header({"MP_BAD": 0}), "MASK"),
            fits.ImageHDU(image, name="VARIANCE"),
        ]
    )
    change(hdus)
    hdus.writeto(path)
    return path


def card(number: int, keyword: str, value: str) -> Change:
    return lambda hdus: hdus[number].header.set(keyword, value)


def pixels(number: int, change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda hdus: setattr(hdus[number], "data", change(hdus[number].data))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (card(0, "DETNAME", "S12"), "DETNAME is 'S12 and S11'"),
        (card(0, "FILTER", "z"), "FILTER is 'z and y'"),
        (card(1, "BUNIT", "adu"), "BUNIT is 'electron and adu'"),
        (pixels(2, lambda mask: mask[:10]), "shape of MASK"),
        (pixels(3, lambda variance: variance[:, :10]), "shape of VARIANCE"),
        (pixels(2, lambda mask: mask + np.float32(0.5)), "fractions"),
        (pixels(2, lambda mask: mask + np.float32(np.nan)), "fractions"),
        (lambda hdus: hdus.append(hdus[2].copy()), "MASK, MASK"),
    ],
)
def test_parts_that_do_not_belong_together(tmp_path: Path, change: Change, words: str) -> None:
    path = frame(tmp_path / "a.fits", change)
    with pytest.raises(FrameFormatError, match=rf"a\.fits: .*{words}"):
        observed_images(path)[0].read()


@pytest.mark.parametrize(
    "change",
    [
        lambda hdus: None,
        card(0, "FILTER", "Y"),
        card(0, "FILTER", ""),
        pixels(2, lambda mask: mask.astype(np.float32)),
        lambda hdus: hdus.pop(2),
        # The mask is that of another image of the file.
        lambda hdus: hdus.append(
            fits.ImageHDU(np.eye(9, dtype=np.float32), fits.Header({"DETNAME": "S12"}), "IMAGE", ver=2)
        ),
    ],
)
def test_parts_that_do(tmp_path: Path, change: Change) -> None:
    images = observed_images(frame(tmp_path / "a.fits", change))
    assert [image.read().detector for image in images] == ["S11", "S12"][: len(images)]
