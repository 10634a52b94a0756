"""World coordinates of sensor images, read back by astropy's own WCS."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from product_makers import thickness

from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.products import SensorSection, ThicknessMap

CAMERA = Camera.from_name("lsstCam")
MM_PER_DEG = 180.2
"""Effective focal length of 10.31 m; distortion and refraction change it by half a percent over the field."""


@pytest.mark.parametrize("name", ["R22_S11", "R11_S01", "R43_S21"])
def test_pixels_and_millimetres(name: str) -> None:
    detector = CAMERA.detector(name)
    cards = SensorSection.whole(detector).cards(detector.shape)
    ny, nx = detector.shape
    assert WCS(cards, key="D").pixel_to_world_values(0, 0) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert WCS(cards, key="D").pixel_to_world_values(nx - 1, 5) == pytest.approx((nx - 1.0, 5.0))
    place = WCS(cards, key="F")
    assert place.pixel_to_world_values((nx - 1) / 2, (ny - 1) / 2) == pytest.approx(
        (detector.x_mm, detector.y_mm), abs=1e-6
    )
    first, second = (np.array(place.pixel_to_world_values(x, 0)) for x in (0, 1))
    assert np.hypot(*(second - first)) == pytest.approx(1e-3 * detector.pixel_um, rel=1e-9)
    assert list(place.wcs.cunit) == ["mm", "mm"]


def test_neighbours_do_not_overlap() -> None:
    """The right edge of a sensor lies left of the left edge of the next, by the gap between them."""
    left, right = CAMERA.detector("R22_S10"), CAMERA.detector("R22_S11")
    edge = WCS(SensorSection.whole(left).cards(left.shape), key="F").pixel_to_world_values(
        left.shape[1] - 0.5, 0
    )[0]
    begin = WCS(SensorSection.whole(right).cards(right.shape), key="F").pixel_to_world_values(-0.5, 0)[0]
    assert 0.0 < begin - edge < 3.0


def test_millimetres_follow_the_field_angle() -> None:
    for name in ("R22_S11", "R02_S01", "R20_S10", "R43_S21"):
        detector = CAMERA.detector(name)
        assert detector.x_mm == pytest.approx(MM_PER_DEG * detector.field_x_deg, rel=0.02, abs=1.0)


def test_a_thinned_image_covers_the_same_sensor() -> None:
    detector = CAMERA.detector("R11_S01")
    full, thin = detector.shape, (detector.shape[0] // 4, detector.shape[1] // 4)
    for key in "DF":
        spans = []
        for shape in (full, thin):
            wcs = WCS(SensorSection.whole(detector).cards(shape), key=key)
            edges = [
                wcs.pixel_to_world_values(-0.5, -0.5),
                wcs.pixel_to_world_values(shape[1] - 0.5, shape[0] - 0.5),
            ]
            spans.append(np.array(edges))
        assert np.allclose(*spans, atol=1e-9)


def test_a_rotated_sensor_is_rotated() -> None:
    turned = [d for d in CAMERA.detectors if d.yaw_deg == 270.0]
    detector = turned[0]
    wcs = WCS(SensorSection.whole(detector).cards(detector.shape), key="F")
    step = np.subtract(wcs.pixel_to_world_values(1, 0), wcs.pixel_to_world_values(0, 0))
    assert abs(step[0]) < 1e-12
    assert step[1] == pytest.approx(-1e-3 * detector.pixel_um, rel=1e-9)


def test_a_product_keeps_its_numbers_and_its_checksums(tmp_path) -> None:
    made, path = thickness((6, 8)), tmp_path / "thickness.fits"
    made.write_fits(path, section=SensorSection.whole(CAMERA.detector("R22_S11")))
    again = ThicknessMap.read_fits(path)
    assert np.array_equal(again.value, made.value, equal_nan=True)
    assert np.array_equal(again.mask, made.mask)
    with fits.open(path, checksum=True) as hdus:
        images = [hdu for hdu in hdus if hdu.is_image and hdu.data is not None]
        assert images
        assert all(WCS(hdu.header, key="F").wcs.name == "FOCAL PLANE" for hdu in images)
        assert all("updated" not in hdu.header.comments["CHECKSUM"] for hdu in hdus), "no time of day"
    assert list(tmp_path.iterdir()) == [path]
