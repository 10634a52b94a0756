"""Exposures of the package ``lsst.images``, written and read back by that package itself (Python 3.12 or later)."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy import units
from astropy.io import fits
from astropy.time import Time
from observed_night import observed_night

from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.errors import FrameFormatError
from lsst.fringe_sim.products import describe_mask
from lsst.fringe_sim.products.observed_files import observed_images

images = pytest.importorskip("lsst.images", reason="lsst-images is not installed (Python 3.12 or later)")

SIDE = 96
BEGIN = (10, 20)
WHOLE = {"y": (0, 4000), "x": (0, 4072)}


def box(begin: tuple[int, int] = BEGIN, side: int = SIDE) -> Any:
    return images.Box.factory[begin[0] : begin[0] + side, begin[1] : begin[1] + side]


def sensor() -> Any:
    """A detector in a camera of which only the frames are told."""
    from lsst.images import cameras
    from lsst.images._transforms import _ast
    from starlink import Ast

    frames = _ast.FrameSet(_ast.Frame(2, "Ident=FOCAL_PLANE,Unit(1)=mm,Unit(2)=mm"))
    frames._impl.addframe(1, Ast.UnitMap(2), Ast.Frame(2, "Ident=FIELD_ANGLE"))
    frames._impl.addframe(1, Ast.ZoomMap(2, 100.0), Ast.Frame(2, "Ident=DETECTOR_94"))
    orientation = cameras.Orientation(focal_plane_x=0.0, focal_plane_y=0.0, focal_plane_z=0.0)
    told = {"name": "R22_S11", "id": 94, "type": "SCIENCE", "serial": "E2V", "physical_type": "E2V"}
    bounds = images.Box.factory[0 : WHOLE["y"][1], 0 : WHOLE["x"][1]]
    attributes = cameras.DetectorAttributes(**told, bbox=bounds, orientation=orientation, pixel_size=0.01)
    return cameras.Detector(attributes, [], cameras.CameraFrameSet("LSSTCam", frames))


def background(rng: np.random.Generator) -> Any:
    """Akima splines over 5 x 6 bins of which one has no value."""
    from lsst.images.fields import SplineField

    values = rng.normal(2000.0, 30.0, (5, 6))
    values[1, 2] = np.nan
    y, x = np.linspace(12.0, 104.0, 5), np.linspace(22.0, 114.0, 6)
    return SplineField(box(), values, y=y, x=x, unit=units.electron)


def exposure(pixels: np.ndarray, subtracted: Any = None, planes: int = 0) -> Any:
    """An exposure with all that one has to have; ``planes``: so many more planes of its mask."""
    from astro_metadata_translator import ObservationInfo
    from lsst.images.psfs import GaussianPointSpreadFunction
    from lsst.images.tests import make_random_sky_projection

    rng, bounds = np.random.default_rng(3), box()
    frame = images.DetectorFrame(instrument="LSSTCam", visit=7, detector=94, bbox=box((0, 0), 4000))
    more = [images.MaskPlane(f"OTHER{number}", "") for number in range(planes)]
    names = ("BAD", "SATURATED", "COSMIC_RAY", "DETECTED", "NOT_DEBLENDED")
    schema = images.MaskSchema([*(images.MaskPlane(name, "") for name in names), *more])
    backgrounds = images.BackgroundMap()
    if subtracted is not None:
        backgrounds.add("standard", subtracted, is_subtracted=True)
    projection = make_random_sky_projection(rng, frame, bounds)
    return images.VisitImage(
        images.Image(pixels, bbox=bounds, unit=units.electron, sky_projection=projection),
        mask=images.Mask(0, bbox=bounds, schema=schema),
        variance=images.Image(np.full_like(pixels, 2000.0), bbox=bounds, unit=units.electron**2),
        obs_info=ObservationInfo(
            instrument="LSSTCam",
            physical_filter="y_10",
            datetime_begin=Time("2026-01-02T03:04:05", scale="tai"),
        ),
        psf=GaussianPointSpreadFunction(1.5, bounds, 11),
        detector=sensor(),
        backgrounds=backgrounds,
        band="y",
    )


def read(path: Path) -> Any:
    from lsst.images.serialization import read_archive

    return read_archive(str(path))


def test_an_exposure_is_a_frame(tmp_path: Path) -> None:
    """Planes of two images of the mask are known by name; what the exposure holds beside its image is no frame."""
    pixels = np.random.default_rng(1).normal(0.0, 40.0, (SIDE, SIDE)).astype(np.float32)
    made = exposure(pixels, background(np.random.default_rng(2)), planes=30)
    one = np.zeros(pixels.shape, dtype=bool)
    for number, name in enumerate(("SATURATED", "COSMIC_RAY", "DETECTED", "NOT_DEBLENDED", "OTHER29")):
        made.mask.set(name, np.roll(one | (np.arange(SIDE) == 0), number, axis=1))
    path = tmp_path / "visit.fits"
    made.write(str(path))
    (image,) = observed_images(path)
    frame = image.read()
    assert (frame.detector, frame.physical_filter, frame.unit) == ("R22_S11", "y_10", "electron")
    assert image.header()["DATE-OBS"].startswith("2026-01-02T03:04:05")
    np.testing.assert_array_equal(frame.image, pixels)
    np.testing.assert_array_equal(frame.variance, 2000.0)
    assert describe_mask(frame.mask) == {"BAD": SIDE, "SAT": SIDE, "CR": SIDE, "DETECTED": SIDE}


def test_its_background_is_put_back(tmp_path: Path) -> None:
    """From the exposure itself, or from a file of backgrounds; one that was not subtracted is refused."""
    pixels = np.zeros((SIDE, SIDE), dtype=np.float32)
    pixels[0, 0] = 1.0
    sky = background(np.random.default_rng(2))
    exposure(pixels, sky).write(str(tmp_path / "visit.fits"))
    exposure(pixels).write(str(tmp_path / "with_sky.fits"))
    images.fits.write(sky, str(tmp_path / "sky.fits"))
    (image,) = observed_images(tmp_path / "visit.fits")
    expected = pixels + sky.render(box()).array
    for name in ("visit.fits", "sky.fits"):
        np.testing.assert_allclose(image.read(tmp_path / name).image, expected, rtol=1e-6)
    with pytest.raises(FrameFormatError, match=r"with_sky\.fits: subtracted background is 'none'"):
        image.read(tmp_path / "with_sky.fits")


def test_from_a_night_to_corrected_exposures(tmp_path: Path) -> None:
    """The package reads what was corrected, all of it; fringes put back are those that were there."""
    rng = np.random.default_rng(44)
    night, sky = observed_night(rng, 5, side=SIDE, stars=4), background(rng)
    (tmp_path / "night").mkdir()
    subtracted = sky.render(box(), dtype=np.float64).array
    for number, pixels in enumerate(night.images):
        made = exposure((pixels - subtracted).astype(np.float32), sky)
        made.write(str(tmp_path / "night" / f"visit_{number}.fits"))
    frames, out = str(tmp_path / "night"), tmp_path / "corrected"
    words = [frames, "--background", frames]
    assert run(["templates", *words, "--components", "1", "--out", str(tmp_path / "templates")]) == 0
    assert run(["correct", *words, "--templates", str(tmp_path / "templates"), "--out", str(out)]) == 0
    before, after = read(tmp_path / "night" / "visit_1.fits"), read(out / "visit_1_corrected.fits")
    assert after.backgrounds.subtracted is None
    assert (after.mask, after.variance) == (before.mask, before.variance)
    assert (after.detector, after.psf) == (before.detector, before.psf)
    taken = night.images[1] - after.image.array
    assert np.corrcoef(taken.ravel(), night.fringes[1].ravel())[0, 1] > 0.9
    with fits.open(out / "visit_1_corrected.fits", checksum=True) as hdus:
        assert [hdu.data is None for hdu in hdus].count(True) == 1
    restored = tmp_path / "restored"
    words = [str(out), "--templates", str(tmp_path / "templates"), "--undo", "--out", str(restored)]
    assert run(["correct", *words]) == 0
    np.testing.assert_allclose(
        read(restored / "visit_1_restored.fits").image.array, night.images[1], rtol=1e-5
    )
