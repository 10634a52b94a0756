"""Files of observed frames as pipelines lay them out, and the same files with other pixels."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
from astropy.io import fits

from lsst.fringe_sim.errors import FrameFormatError, InputError, MissingPackageError
from lsst.fringe_sim.products import MASK_PLANES, describe_mask
from lsst.fringe_sim.products.image_archive import archive_planes
from lsst.fringe_sim.products.observed_files import detector_of, observed_images, write_images

SHAPE = (12, 20)
IMAGE = np.arange(240, dtype=np.float32).reshape(SHAPE)


def write(path, *hdus, **cards):
    primary = fits.PrimaryHDU()
    primary.header.update(cards)
    fits.HDUList([primary, *hdus]).writeto(path)
    return path


def bit(name):
    return 1 << MASK_PLANES[name]


def test_plain_image(tmp_path):
    path = tmp_path / "plain.fits"
    header = fits.Header({"BUNIT": "adu/s", "DETNAME": "S11", "FILTER": "y"})
    gap = IMAGE.copy()
    gap[3, 4] = np.nan
    fits.PrimaryHDU(gap, header).writeto(path)
    (image,) = observed_images(path)
    frame = image.read()
    assert (frame.unit, frame.detector, frame.physical_filter, frame.variance) == ("adu/s", "S11", "y", None)
    assert describe_mask(frame.mask) == {"NO_DATA": 1}


def test_rubin_exposure(tmp_path):
    """Planes are known by name, wherever their bits are; those that say nothing of the sky are passed over."""
    mask = np.zeros(SHAPE, dtype=np.int32)
    mask[0, :4] = [1 << 3, 1 << 9, 1 << 14, 1 << 15]
    hdu = fits.ImageHDU(mask, name="MASK")
    for name, place in {"SAT": 3, "DETECTED": 9, "CROSSTALK": 14, "INJECTED": 15}.items():
        hdu.header[f"HIERARCH MP_{name}"] = place
    path = write(
        tmp_path / "visit.fits",
        fits.ImageHDU(IMAGE, name="IMAGE"),
        hdu,
        fits.ImageHDU(IMAGE + 2, name="VARIANCE"),
        DETECTOR="R22_S11",
    )
    (image,) = observed_images(path)
    frame = image.read()
    assert frame.detector == "R22_S11"
    assert list(frame.mask[0, :4]) == [bit("SAT"), bit("DETECTED"), bit("BAD"), 0]
    np.testing.assert_array_equal(frame.variance, IMAGE + 2)


@pytest.mark.parametrize(
    ("version", "stored", "planes"),
    [
        ("V5.5", [1, 2, 3, 5], ["BAD", "NO_DATA", "SAT", "CR"]),
        ("V3.2.1", [1, 2, 16, 64], ["BAD", "SAT", "CR", "SAT"]),
    ],
    ids=["codes", "bits"],
)
def test_decam_community_pipeline(tmp_path, version, stored, planes):
    """An empty primary HDU, a sensor per extension, weights that are inverse variances, masks of codes or of bits."""
    quality = np.zeros(SHAPE, dtype=np.int16)
    quality[0, :4] = stored
    weight = np.full(SHAPE, 0.25, dtype=np.float32)
    weight[5, 5] = 0.0
    for kind, data in (("ooi", IMAGE), ("ood", quality), ("oow", weight)):
        hdus = [
            fits.CompImageHDU(data + number, name=name)
            for number, name in enumerate(("N4", "S7"))
            if not number
        ]
        hdus.append(fits.CompImageHDU(data, name="S7"))
        write(tmp_path / f"c4d_150101_010101_{kind}_z_v1.fits.fz", *hdus, PLVER=version, FILTER="z")
    images = observed_images(tmp_path / "c4d_150101_010101_ooi_z_v1.fits.fz")
    assert [image.name for image in images] == ["N4", "S7"]
    frame = images[1].read()
    assert (frame.detector, frame.physical_filter) == ("S7", "z")
    assert list(frame.mask[0, :4]) == [bit(name) for name in planes]
    assert frame.variance[1, 1] == 4.0
    assert not np.isfinite(frame.variance[5, 5])


def test_ztf(tmp_path):
    stored = np.zeros(SHAPE, dtype=np.int16)
    stored[0, :3] = [2, 256, 4]
    fits.PrimaryHDU(IMAGE).writeto(tmp_path / "ztf_1_zi_c01_o_q1_sciimg.fits")
    fits.PrimaryHDU(stored).writeto(tmp_path / "ztf_1_zi_c01_o_q1_mskimg.fits")
    (image,) = observed_images(tmp_path / "ztf_1_zi_c01_o_q1_sciimg.fits")
    assert list(image.read().mask[0, :3]) == [bit("DETECTED"), bit("SAT"), bit("BAD")]


@pytest.mark.parametrize(
    ("name", "cards", "stored"),
    [
        ("UNCERT", {"UTYPE": "StdDevUncertainty"}, 2.0),
        ("UNCERT", {"UTYPE": "InverseVariance"}, 0.25),
        ("ERR", {}, 2.0),
        ("WEIGHT", {}, 0.25),
    ],
)
def test_variances_by_other_names(tmp_path, name, cards, stored):
    errors = fits.ImageHDU(np.full(SHAPE, stored, dtype=np.float32), fits.Header(cards), name=name)
    path = write(tmp_path / "ccd.fits", fits.ImageHDU(IMAGE, name="SCI"), errors)
    assert observed_images(path)[0].read().variance[0, 0] == pytest.approx(4.0)


def test_a_background_is_put_back(tmp_path):
    path, other = tmp_path / "frame.fits", tmp_path / "background.fits"
    fits.PrimaryHDU(IMAGE).writeto(path)
    fits.PrimaryHDU(np.full(SHAPE, 100.0)).writeto(other)
    np.testing.assert_array_equal(observed_images(path)[0].read(other).image, IMAGE + 100.0)
    fits.PrimaryHDU(np.ones((3, 3))).writeto(other, overwrite=True)
    with pytest.raises(FrameFormatError, match=r"background.fits: image is \(3, 3\)"):
        observed_images(path)[0].read(other)


def test_a_background_is_the_first_image_where_none_has_the_name_and_the_number(tmp_path):
    """Tables and images without pixels are passed over; a file with nothing else is refused."""
    table = fits.BinTableHDU.from_columns([fits.Column("x", "D", array=np.arange(3.0))])
    path = write(tmp_path / "frame.fits", fits.ImageHDU(IMAGE, name="SCI"))
    other = write(
        tmp_path / "sky.fits", fits.ImageHDU(), table, fits.ImageHDU(IMAGE + 5.0), fits.ImageHDU(IMAGE)
    )
    (image,) = observed_images(path)
    np.testing.assert_array_equal(image.read(other).image, 2.0 * IMAGE + 5.0)
    for hdus in ([], [fits.ImageHDU()]):
        (tmp_path / "nothing.fits").unlink(missing_ok=True)
        with pytest.raises(FrameFormatError, match="image is None"):
            image.read(write(tmp_path / "nothing.fits", *hdus))


def test_exposure_of_lsst_images_without_that_package(tmp_path, monkeypatch):
    """Its tree names sensor and filter; only a background that it holds has to be drawn by the package."""
    tree = {"detector": {"attributes": {"name": "R22_S11"}}, "obs_info": {"physical_filter": "y_10"}}
    stored = np.frombuffer(json.dumps(tree | {"image": {"yx0": [0, 0]}}).encode(), dtype=np.uint8)
    table = fits.BinTableHDU.from_columns([fits.Column("JSON", "PB", array=[stored])], name="JSON")
    mask = fits.ImageHDU(
        (IMAGE == 7).astype(np.int32) << 4, fits.Header({"MSKN0004": "SATURATED"}), name="MASK"
    )
    mask.header["MSKM0004"] = 16
    other = fits.ImageHDU(np.ones((9, 9)), name="BACKGROUNDS/FIELDS/STANDARD/DATA")
    path = write(
        tmp_path / "visit.fits",
        fits.ImageHDU(IMAGE, name="IMAGE"),
        mask,
        other,
        table,
        DATAMODL="visit_image",
    )
    (image,) = observed_images(path)
    frame = image.read()
    assert (frame.detector, frame.physical_filter) == ("R22_S11", "y_10")
    assert describe_mask(frame.mask) == {"SAT": 1}
    monkeypatch.setitem(sys.modules, "lsst.images", None)
    with pytest.raises(MissingPackageError, match=r"lsst-fringe-sim\[lsst-images\]"):
        image.read(path)
    with fits.open(path, mode="update") as hdus:
        hdus["MASK"].header["MSKM0004"] = 17
    with pytest.raises(FrameFormatError, match="MSKM0004 is 17"):
        image.read()


def test_a_file_is_written_again_with_all_that_is_in_it(tmp_path):
    table = fits.BinTableHDU.from_columns([fits.Column("x", "D", array=np.arange(3.0))], name="CATALOGUE")
    compressed = fits.CompImageHDU(IMAGE, name="N4")
    compressed.header["CRVAL1"] = 12.5
    path = write(
        tmp_path / "night.fits.fz", compressed, fits.ImageHDU(IMAGE, name="S7"), table, ORIGIN="NOAO"
    )
    flags = np.zeros(SHAPE, dtype=bool)
    flags[2, 2] = True
    target = tmp_path / "new.fits"
    write_images(path, target, {1: IMAGE + 1}, {1: {"FRINGCOR": 2}}, {1: flags}, {"FRINGTID": "abc"})
    with fits.open(target) as hdus:
        assert [hdu.name for hdu in hdus] == ["PRIMARY", "N4", "S7", "CATALOGUE", "N4_UNCORRECTED"]
        np.testing.assert_array_equal(hdus["N4"].data, IMAGE + 1)
        np.testing.assert_array_equal(hdus["S7"].data, IMAGE)
        np.testing.assert_array_equal(hdus["N4_UNCORRECTED"].data, flags)
        assert (hdus["N4"].header["CRVAL1"], hdus["N4"].header["FRINGCOR"]) == (12.5, 2)
        assert (hdus[0].header["ORIGIN"], hdus[0].header["FRINGTID"]) == ("NOAO", "abc")
    assert [image.name for image in observed_images(target)] == ["N4", "S7"]


def test_what_is_no_frame_is_named(tmp_path):
    with pytest.raises(InputError, match="images is 0"):
        observed_images(write(tmp_path / "empty.fits"))
    (tmp_path / "text.fits").write_text("no FITS at all")
    with pytest.raises(InputError, match=r"text\.fits"):
        observed_images(tmp_path / "text.fits")
    path = write(
        tmp_path / "odd.fits", fits.ImageHDU(IMAGE, name="SCI"), fits.ImageHDU(IMAGE[:3], name="MASK")
    )
    with pytest.raises(InputError, match="shape of MASK"):
        observed_images(path)[0].read()


def test_the_sensor_is_named_by_the_most_telling_keyword():
    assert detector_of({"EXTNAME": "IMAGE", "CCDNUM": 7}) == "7"
    assert detector_of({"EXTNAME": "N4", "CCDNUM": 7}) == "N4"
    assert detector_of({"DETNAME": "R22_S11", "EXTNAME": "N4"}) == "R22_S11"
    assert detector_of({}) == ""


def test_sensors_of_cameras_that_name_them_in_other_ways_are_not_one():
    # Two quadrants of one CCD of ZTF, two sensors of HSC, and two of the LSST Camera.
    assert [detector_of({"CCDID": 7, "QID": n + 1, "RCID": 24 + n}) for n in (0, 1)] == ["24", "25"]
    assert [detector_of({"EXTNAME": "IMAGE", "DET-ID": n}) for n in (0, 50)] == ["0", "50"]
    slots = [{"RAFTBAY": "R22", "CCDSLOT": slot} for slot in ("S11", "S12")]
    assert list(map(detector_of, slots)) == ["R22_S11", "R22_S12"]


def test_the_filter_of_hsc_is_read(tmp_path):
    path = write(tmp_path / "CORR.fits", fits.ImageHDU(IMAGE, fits.Header({"FILTER01": "HSC-Y"})))
    assert observed_images(path)[0].read().physical_filter == "HSC-Y"


@pytest.mark.parametrize(
    ("stated", "place"), [(1, 0), (2, 1), (1 << 30, 30), (0, None), (-2, None), (6, None)]
)
def test_planes_of_an_archive_are_powers_of_two(stated, place):
    hdu = fits.ImageHDU(np.zeros(SHAPE, dtype=np.int32), name="MASK")
    hdu.header["MSKN0007"], hdu.header["MSKM0007"] = "SATURATED", stated
    hdus = fits.HDUList([fits.PrimaryHDU(), hdu, fits.ImageHDU(IMAGE, name="VARIANCE")])
    if place is None:
        with pytest.raises(FrameFormatError, match="MSKM0007"):
            archive_planes(hdus)
    else:
        ((stored, bits),) = archive_planes(hdus)
        assert (stored.shape, bits) == (SHAPE, {"SAT": place})


def test_a_card_of_nothing_is_taken_out_if_it_is_there(tmp_path):
    source = write(
        tmp_path / "in.fits", fits.ImageHDU(IMAGE, fits.Header({"GONE": 1, "STAYS": 2}), name="SCI")
    )
    write_images(
        source, tmp_path / "out.fits", {1: IMAGE + 1.0}, {1: {"GONE": None, "NEVER": None, "NEW": 3}},
        {1: np.zeros(SHAPE, bool)}, {},
    )  # fmt: skip
    with fits.open(tmp_path / "out.fits") as hdus:
        assert len(hdus) == 2
        assert ("GONE" in hdus[1].header, hdus[1].header["STAYS"], hdus[1].header["NEW"]) == (False, 2, 3)
        np.testing.assert_array_equal(hdus[1].data, IMAGE + 1.0)
