"""Images of a whole sensor, and of a part of it: the same pixel has the same coordinates in both."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from hypothesis import given
from hypothesis import strategies as st
from product_makers import MAKERS, cube, thickness

from lsst.fringe_sim.errors import FrameFormatError, InputError, OutOfRangeError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.products import SensorSection, ThicknessMap
from lsst.fringe_sim.products import __all__ as names

CAMERA = Camera.from_name("lsstCam")
SENSOR = CAMERA.detector("R11_S01")
TURNED = next(d for d in CAMERA.detectors if d.yaw_deg == 270.0)
NY, NX = SENSOR.shape


def place(section: SensorSection, shape: tuple[int, ...], key: str, x: float, y: float) -> np.ndarray:
    return np.array(WCS(section.cards(shape), key=key).pixel_to_world_values(x, y))


@pytest.mark.parametrize("detector", [SENSOR, TURNED], ids=["upright", "turned"])
@given(st.data())
def test_a_part_agrees_with_the_whole(detector, data) -> None:
    """A pixel of a window has the coordinates that it has in an image of the whole sensor, reversed or not."""
    ny, nx = detector.shape
    x = tuple(data.draw(st.lists(st.integers(0, nx - 1), min_size=2, max_size=2)))
    y = tuple(data.draw(st.lists(st.integers(0, ny - 1), min_size=2, max_size=2)))
    part, whole = SensorSection(detector, x, y), SensorSection.whole(detector)
    shape = (abs(y[1] - y[0]) + 1, abs(x[1] - x[0]) + 1)
    for key in "DF":
        for column, row, there in ((0, 0, (x[0], y[0])), (shape[1] - 1, shape[0] - 1, (x[1], y[1]))):
            found = place(part, shape, key, column, row)
            assert np.allclose(found, place(whole, (ny, nx), key, *there), atol=1e-8)


def test_larger_pixels_of_a_part_have_its_edges() -> None:
    part = SensorSection(SENSOR, (100, 299), (40, 79))
    for key in "DF":
        for x, y in ((-0.5, -0.5), (1.0, 1.0)):
            edge = np.array([x, y])
            fine = place(part, (40, 200), key, *(edge if x < 0 else (199.5, 39.5)))
            coarse = place(part, (10, 20), key, *(edge if x < 0 else (19.5, 9.5)))
            assert np.allclose(fine, coarse, atol=1e-9)


def test_planes_of_a_cube_are_counted() -> None:
    wcs = WCS(SensorSection.whole(SENSOR).cards((12, NY, NX)), key="F")
    assert wcs.wcs.naxis == 3
    x_mm, y_mm, plane = wcs.pixel_to_world_values((NX - 1) / 2, (NY - 1) / 2, 7)
    assert (x_mm, y_mm, plane) == pytest.approx((SENSOR.x_mm, SENSOR.y_mm, 7.0))


def test_keyword_comes_back() -> None:
    for section in (SensorSection.whole(SENSOR), SensorSection(SENSOR, (9, 3), (0, 500))):
        header = {"DETSEC": section.keyword}
        assert SensorSection.of_image(SENSOR, (7, 7), header) == section
    assert SensorSection(SENSOR, (9, 3), (0, 500)).keyword == "[10:4,1:501]"


def test_an_image_of_unknown_place_has_none() -> None:
    assert SensorSection.of_image(SENSOR, (NY, NX), {}) == SensorSection.whole(SENSOR)
    assert SensorSection.of_image(SENSOR, (NY, NX - 1), {}) is None
    assert SensorSection.of_image(SENSOR, (50, 50), {"CCDSEC": "[1:50,1:50]"}) is not None


@pytest.mark.parametrize("text", ["[1:5]", "1:5,1:5", "[a:b,c:d]", "[1.5:2,1:2]", "[1:2,1:2] "])
def test_a_malformed_section_is_refused(text: str) -> None:
    if text.endswith(" "):
        assert SensorSection.of_image(SENSOR, (2, 2), {"DETSEC": text}) is not None
        return
    with pytest.raises(FrameFormatError, match="DETSEC"):
        SensorSection.of_image(SENSOR, (5, 5), {"DETSEC": text})


@pytest.mark.parametrize("text", ["[0:5,1:5]", f"[1:{NX + 1},1:5]", f"[1:5,1:{NY + 1}]"])
def test_pixels_that_the_sensor_does_not_have_are_refused(text: str) -> None:
    with pytest.raises(OutOfRangeError, match="of the section"):
        SensorSection.of_image(SENSOR, (5, 5), {"DETSEC": text})


def test_shapes_that_are_no_image_are_refused() -> None:
    for shape in ((5,), (0, 4), ()):
        with pytest.raises(InputError, match="shape of the image"):
            SensorSection.whole(SENSOR).cards(shape)


@pytest.mark.parametrize("name", sorted(set(names) & set(MAKERS)))
def test_every_product_writes_them(name: str, tmp_path) -> None:
    product, path = MAKERS[name](), tmp_path / "product.fits"
    shape = product.mask.shape[-2:]
    section = SensorSection(SENSOR, (10, 9 + shape[1]), (20, 19 + shape[0]))
    product.write_fits(path, section=section)
    again = type(product).read_fits(path)
    assert again.metadata["DETSEC"] == section.keyword
    with fits.open(path, checksum=True) as hdus:
        shown = [hdu for hdu in hdus[1:] if hdu.is_image and hdu.shape[-2:] == shape]
        assert len(shown) >= 2
        for hdu in shown:
            first = WCS(hdu.header, key="D").pixel_to_world_values(*[0] * len(hdu.shape))
            assert first[:2] == pytest.approx((10.0, 20.0))
        others = [hdu for hdu in hdus[1:] if hdu not in shown]
        assert all("WCSNAMED" not in hdu.header for hdu in others)
    product.write_fits(path)
    assert "DETSEC" not in fits.getheader(path)


def test_numbers_are_those_without_a_section(tmp_path) -> None:
    made = thickness((6, 8))
    made.write_fits(tmp_path / "with.fits", section=SensorSection(SENSOR, (0, 7), (0, 5)))
    made.write_fits(tmp_path / "without.fits")
    left, right = (ThicknessMap.read_fits(tmp_path / name) for name in ("with.fits", "without.fits"))
    assert np.array_equal(left.value, right.value, equal_nan=True)
    assert np.array_equal(left.sigma, right.sigma, equal_nan=True)
    assert {key: value for key, value in left.metadata.items() if key != "DETSEC"} == right.metadata


def test_a_cube_remembers_its_place(tmp_path) -> None:
    """So that a thickness map fitted to it has the same."""
    from lsst.fringe_sim.cli.fit import section_of_cube
    from lsst.fringe_sim.model import Setup
    from lsst.fringe_sim.products import FringeCube

    setup = Setup.from_name("ts8_e2v")
    made, path = cube((5, 6), 4), tmp_path / "cube.fits"
    assert section_of_cube(made, setup) is None
    sensor = Camera.from_name(setup.camera).detector(setup.detector)
    section = SensorSection(sensor, (100, 105), (7, 11))
    made.write_fits(path, {"SERIAL": sensor.serial}, section=section)
    assert section_of_cube(FringeCube.read_fits(path), setup) == section
