"""Products on disk: the same bit for bit, whole or absent, in the published layout, and never read when spoilt."""

import dataclasses
import struct
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from hypothesis import given
from hypothesis import strategies as st
from product_makers import MAKERS, METADATA, NAMES, SHAPES, cube, flat, frame, thickness
from recorded_numbers import Record

from lsst.fringe_sim.errors import FrameFormatError, InputError, UnknownNameError
from lsst.fringe_sim.products import FringeCube, ThicknessMap, mask_bits
from lsst.fringe_sim.products.thickness_map import THICKNESS_LIMITS_UM, UNKNOWN_SIGMA_UM

KINDS = st.sampled_from(sorted(MAKERS))
BLOCK = 2880


def assert_identical(left: Any, right: Any) -> None:
    assert type(left) is type(right)
    for item in dataclasses.fields(left):
        first, second = getattr(left, item.name), getattr(right, item.name)
        if dataclasses.is_dataclass(first):
            assert_identical(first, second)
        elif isinstance(first, np.ndarray):
            native = second.astype(second.dtype.newbyteorder("="))
            assert (first.shape, first.dtype) == (second.shape, native.dtype)
            assert first.tobytes() == native.tobytes()
        elif isinstance(first, Mapping):
            pairs = [{k: (type(v), v) for k, v in each.items()} for each in (first, second)]
            assert pairs[0] == pairs[1]
        else:
            assert (type(first), first) == (type(second), second)


@given(KINDS, SHAPES, st.integers(0, 2**31), METADATA, NAMES)
def test_bit_for_bit(
    kind: str, shape: tuple[int, int], seed: int, metadata: dict[str, Any], detector: str
) -> None:
    product = MAKERS[kind](shape, seed, metadata=metadata, detector=detector)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "product.fits"
        product.write_fits(path)
        assert_identical(product, type(product).read_fits(path))


@pytest.mark.parametrize("kind", sorted(MAKERS))
class TestEveryProduct:
    def test_a_file_is_as_recorded(self, kind: str, tmp_path: Path, recorded: Record) -> None:
        """A record of layout and header, for edits that are not meant to change them."""
        MAKERS[kind](metadata={"NOTE": "x"}).write_fits(tmp_path / "a.fits")
        recorded(tmp_path / "a.fits")

    def test_two_writes_agree_to_the_byte(self, kind: str, tmp_path: Path, monkeypatch: Any) -> None:
        product = MAKERS[kind](metadata={"NOTE": "x"})
        product.write_fits(tmp_path / "a.fits")
        # The clock that astropy stamps checksums with moves on.
        monkeypatch.setattr(fits.hdu.base._ValidHDU, "_get_timestamp", lambda self: "2099-01-01T00:00:00")
        product.write_fits(tmp_path / "b.fits")
        assert (tmp_path / "a.fits").read_bytes() == (tmp_path / "b.fits").read_bytes()

    def test_what_is_on_disk_is_plain_fits_with_right_checksums(self, kind: str, tmp_path: Path) -> None:
        path = tmp_path / "product.fits"
        MAKERS[kind]().write_fits(path, {"QFLOAT": -1.2345678901234567e-101})
        with fits.open(path, checksum=True) as hdus:  # warnings are errors here
            hdus.verify("exception")
            assert all("CHECKSUM" in hdu.header and "DATASUM" in hdu.header for hdu in hdus)
            assert hdus[0].header["QFLOAT"] == -1.2345678901234567e-101

    def test_metadata_of_the_write_win_and_are_read_back(self, kind: str, tmp_path: Path) -> None:
        product = MAKERS[kind](metadata={"NOTE": "first", "KEPT": 1})
        product.write_fits(tmp_path / "product.fits", {"note": "second", "LSST BUTLER ID": "x" * 70})
        back = dict(type(product).read_fits(tmp_path / "product.fits").metadata)
        assert back == {"NOTE": "second", "KEPT": 1, "LSST BUTLER ID": "x" * 70}

    def test_it_cannot_be_changed(self, kind: str) -> None:
        product = MAKERS[kind]()
        for item in dataclasses.fields(product):
            value = getattr(product, item.name)
            with pytest.raises(dataclasses.FrozenInstanceError):
                setattr(product, item.name, value)
            if isinstance(value, np.ndarray):
                with pytest.raises(ValueError, match="read-only"):
                    value[...] = 0
        with pytest.raises(TypeError):
            product.metadata["NEW"] = 1

    @pytest.mark.parametrize("scale", [{"BZERO": 3.4e38}, {"BSCALE": 1e308}, {"BZERO": 1e30}], ids=str)
    def test_scales_beyond_the_numbers_are_refused(
        self, kind: str, scale: dict[str, float], tmp_path: Path
    ) -> None:
        """A file without checksums, whose images overflow where astropy scales them."""
        product, path = MAKERS[kind](), tmp_path / "product.fits"
        product.write_fits(path)
        with fits.open(path, mode="update", do_not_scale_image_data=True) as hdus:
            for hdu in hdus:
                hdu.header.update(scale if hdu.is_image and hdu.data is not None else {})
                for card in ("CHECKSUM", "DATASUM"):
                    hdu.header.remove(card)
        with pytest.raises(InputError, match=r"product\.fits"):
            type(product).read_fits(path)


@given(KINDS, st.integers(0, 10**6), st.integers(1, 255), st.booleans())
def test_a_damaged_or_truncated_file_never_passes(kind: str, at: int, change: int, cut: bool) -> None:
    product = MAKERS[kind]()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "product.fits"
        product.write_fits(path)
        content = bytearray(path.read_bytes())
        place = at % len(content)
        content[place] ^= change
        path.write_bytes(content[:place] if cut else content)
        try:
            back = type(product).read_fits(path)
        except InputError as error:
            told = str(error)
        else:  # a blank behind the END of a header
            assert not cut
            assert_identical(product, back)
            told = str(path)
    assert str(path) in told


def test_a_missing_file_a_wrong_product_and_a_missing_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="an existing FITS file"):
        FringeCube.read_fits(tmp_path / "none.fits")
    flat().write_fits(tmp_path / "flat.fits")
    with pytest.raises(InputError, match="PRODUCT is 'FringeFlat'; allowed: FringeCube"):
        FringeCube.read_fits(tmp_path / "flat.fits")
    with pytest.raises(InputError, match="an existing folder"):
        flat().write_fits(tmp_path / "nowhere" / "flat.fits")


def test_a_failed_write_leaves_the_old_file_and_no_rubbish(tmp_path: Path, monkeypatch: Any) -> None:
    path = tmp_path / "flat.fits"
    flat(wavelength_nm=900.0).write_fits(path)
    before = path.read_bytes()

    def full_disk(*args: Any, **kwargs: Any) -> None:
        args[1].write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(fits.HDUList, "writeto", full_disk)
    with pytest.raises(OSError, match="No space"):
        flat(wavelength_nm=910.0).write_fits(path)
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["flat.fits"]


def test_writing_leaves_the_callers_array_as_it_was(tmp_path: Path) -> None:
    image = np.arange(12, dtype=np.float32).reshape(3, 4) / 100
    before = image.copy()
    flat(image=image, mask=np.zeros((3, 4), int), variance=image).write_fits(tmp_path / "flat.fits")
    assert image.flags.writeable
    np.testing.assert_array_equal(image, before)


def test_a_memory_mapped_cube_holds_the_same_numbers(tmp_path: Path) -> None:
    product = cube()
    product.write_fits(tmp_path / "cube.fits")
    mapped = FringeCube.read_fits(tmp_path / "cube.fits", memmap=True)
    base: Any = mapped.image
    while isinstance(base, np.ndarray) and not isinstance(base, np.memmap):
        base = base.base
    assert isinstance(base, np.memmap) or type(base).__name__ == "mmap"
    assert_identical(product, mapped)


def test_checksums_hold_for_any_order_of_bytes_and_columns(tmp_path: Path) -> None:
    """They are made from the numbers of the machine, without turning bytes round; astropy makes them its own way."""
    rng = np.random.default_rng(5)
    shape, positive = (301, 7), np.abs(rng.normal(size=(301, 14))).astype(np.float32)
    product = thickness(
        shape,
        value=positive[:, ::2] + 1,
        sigma=positive[:, :7].astype(">f4"),
        n_wavelengths=rng.integers(0, 2**31, shape),
    )
    product.write_fits(tmp_path / "map.fits")
    with fits.open(tmp_path / "map.fits", checksum=True) as hdus:  # warnings are errors here
        np.testing.assert_array_equal(hdus["VALUE"].data, positive[:, ::2] + 1)
        np.testing.assert_array_equal(hdus["SIGMA"].data, positive[:, :7])


# The layout that afw expects of an exposure, on the bytes of the file, without any FITS library.


def read_headers(content: bytes) -> list[tuple[dict[str, str], int]]:
    """Cards of each HDU as text, and where its data start; every value as it stands before the comment."""
    found = []
    at = 0
    while at < len(content):
        cards: dict[str, str] = {}
        while (card := content[at : at + 80].decode("ascii")).rstrip() != "END":
            at += 80
            key, _, rest = card.partition("=")
            key = key.removeprefix("HIERARCH").strip()
            assert key not in cards
            cards[key] = rest.split(" / ")[0].strip()
        at = -(-(at + 80) // BLOCK) * BLOCK
        found.append((cards, at))
        axes = [int(cards[f"NAXIS{axis + 1}"]) for axis in range(int(cards["NAXIS"]))]
        if axes:
            at += -(-int(np.prod(axes)) * abs(int(cards["BITPIX"])) // 8 // BLOCK) * BLOCK
    return found


def test_a_template_is_an_exposure_of_afw(tmp_path: Path) -> None:
    path, expected = tmp_path / "fringe.fits", frame(metadata={"DATE-AVG": "2022-03-04T05:06:07"})
    expected.write_fits(path)
    content = path.read_bytes()
    assert len(content) % BLOCK == 0
    (primary, _), *extensions = read_headers(content)
    for keyword, value in {
        "SIMPLE": "T",
        "NAXIS": "0",
        "EXPINFO_V": "1",
        "FILTER": "'y_10    '",
        "OBSTYPE": "'fringe  '",
        "CALIB_CREATION_DATE": "'2022-03-04'",
        "CALIB_CREATION_TIME": "'05:06:07'",
        "CALIB_CREATION_DATETIME": "'2022-03-04T05:06:07'",
        "TIMESYS": "'TAI     '",
    }.items():
        assert primary[keyword] == value
    assert "AR_HDU" not in primary
    assert [(cards["EXTTYPE"].strip("' "), cards["BITPIX"]) for cards, _ in extensions] == [
        ("IMAGE", "-32"), ("MASK", "32"), ("VARIANCE", "-32"),
    ]  # fmt: skip
    images = (expected.image, expected.mask, expected.variance)
    for (cards, at), data, code in zip(extensions, images, "fif", strict=True):
        assert (cards["XTENSION"], cards["INHERIT"]) == ("'IMAGE   '", "T")
        assert (cards["NAXIS1"], cards["NAXIS2"]) == ("4", "3")
        assert not {"BZERO", "BSCALE"} & set(cards)
        assert [float(cards[key]) for key in ("CRPIX1A", "CRPIX2A", "CRVAL1A", "CRVAL2A")] == [1, 1, 5, 7]
        planes = {key: value for key, value in cards.items() if key.startswith("MP_")}
        assert (planes.get("MP_BAD"), planes.get("MP_NO_DATA")) == (
            ("0", "8") if code == "i" else (None, None)
        )
        stored = np.array(struct.unpack(f">12{code}", content[at : at + 48])).reshape(3, 4)
        np.testing.assert_array_equal(stored, data)  # big-endian rows from the bottom


def test_no_time_scale_is_claimed_without_a_time(tmp_path: Path) -> None:
    frame().write_fits(tmp_path / "fringe.fits")
    assert "TIMESYS" not in fits.getheader(tmp_path / "fringe.fits")


# Files of other programs, to the published layout only.


def foreign_cube(number: int = 2, shape: tuple[int, int] = (3, 4), unit: str = "electron") -> dict[str, Any]:
    image = np.random.default_rng(5).normal(20000, 100, (number, *shape))
    table = Table(
        {
            "wavelength": np.linspace(990, 880, number),
            "bandwidth_fwhm": np.full(number, 2.0),
            "temperature": np.full(number, 183.0),
            "f_number": np.full(number, np.inf),
        }
    )
    image_hdu = fits.ImageHDU(image.astype(np.float32), name="IMAGE")
    image_hdu.header["BUNIT"] = unit
    return {
        "PRIMARY": fits.PrimaryHDU(),
        "IMAGE": image_hdu,
        "VARIANCE": fits.ImageHDU(image, name="VARIANCE"),  # float64
        "MASK": fits.ImageHDU(np.zeros((number, *shape), np.uint8), name="MASK"),
        "EXPOSURES": fits.BinTableHDU(table, name="EXPOSURES"),
    }


def write(path: Path, parts: dict[str, Any], **options: Any) -> Path:
    fits.HDUList(list(parts.values())).writeto(path, **options)
    return path


def test_a_minimal_cube_is_read(tmp_path: Path) -> None:
    parts = foreign_cube()
    found = FringeCube.read_fits(write(tmp_path / "cube.fits", parts))
    np.testing.assert_array_equal(found.image, parts["IMAGE"].data)
    np.testing.assert_array_equal(found.wavelength_nm, [990, 880])
    assert np.isinf(found.exposures.f_number).all()
    assert found.variance.dtype == np.float32
    assert not found.exposures.level_e.any()
    assert not found.exposures.dark_time_s.any()
    assert FringeCube.read_fits(write(tmp_path / "pixel.fits", foreign_cube(12, (1, 1)))).shape == (12, 1, 1)


def test_units_of_a_cube_are_converted(tmp_path: Path) -> None:
    parts = foreign_cube(1)
    parts["THICKNESS"] = fits.ImageHDU(np.full((3, 4), 14000.0), name="THICKNESS")
    parts["THICKNESS"].header.update({"LAYER": "epoxy", "BUNIT": "nm"})
    parts["EXPOSURES"].columns["wavelength"].unit = "um"
    parts["EXPOSURES"].data["wavelength"] = 0.99
    found = FringeCube.read_fits(write(tmp_path / "cube.fits", parts))
    assert found.layer == "epoxy"
    np.testing.assert_allclose(found.thickness, 14.0)
    np.testing.assert_allclose(found.wavelength_nm, 990.0)
    parts["THICKNESS"].header["BUNIT"] = "K"
    with pytest.raises(FrameFormatError, match="unit of THICKNESS is 'K'"):
        FringeCube.read_fits(write(tmp_path / "kelvin.fits", parts))


def test_one_mask_for_all_wavelengths(tmp_path: Path) -> None:
    parts = foreign_cube()
    parts["MASK"] = fits.ImageHDU(np.eye(3, 4, dtype=np.int16), name="MASK")
    found = FringeCube.read_fits(write(tmp_path / "cube.fits", parts))
    np.testing.assert_array_equal(found.mask, np.broadcast_to(np.eye(3, 4), (2, 3, 4)))


@pytest.mark.parametrize("memmap", [False, True])
def test_pixels_without_a_number_become_no_data(tmp_path: Path, memmap: bool) -> None:
    parts = foreign_cube()
    parts["IMAGE"].data[1, 2, 3] = np.nan
    parts["VARIANCE"].data[0, 0, 0] = np.inf
    found = FringeCube.read_fits(write(tmp_path / "cube.fits", parts), memmap=memmap)
    expected = np.zeros((2, 3, 4), int)
    expected[1, 2, 3] = expected[0, 0, 0] = mask_bits("NO_DATA")
    np.testing.assert_array_equal(found.mask, expected)


def without_column(name: str) -> Callable[[dict[str, Any]], None]:
    def spoil(parts: dict[str, Any]) -> None:
        table = Table(parts["EXPOSURES"].data)
        table.remove_column(name)
        parts["EXPOSURES"] = fits.BinTableHDU(table, name="EXPOSURES")

    return spoil


SPOILT: list[tuple[Callable[[dict[str, Any]], Any], type[InputError], str]] = [
    *((lambda p, n=n: p.pop(n), FrameFormatError, f"no {n}") for n in ("IMAGE", "VARIANCE", "MASK", "EXPOSURES")),
    *((without_column(n), FrameFormatError, f"no column {n}")
      for n in ("wavelength", "bandwidth_fwhm", "temperature")),
    (lambda p: p["IMAGE"].header.set("BUNIT", "adu"), UnknownNameError, "BUNIT is 'adu'"),
    (lambda p: p["IMAGE"].header.remove("BUNIT"), FrameFormatError, "BUNIT is 'missing'"),
    (lambda p: p.update(VARIANCE=fits.ImageHDU(np.ones((2, 3, 5)), name="VARIANCE")),
     FrameFormatError, "VARIANCE is 'shape"),
]  # fmt: skip


@pytest.mark.parametrize(("spoil", "error", "message"), SPOILT)
def test_what_a_cube_lacks_is_named_with_its_file(
    spoil: Callable[[dict[str, Any]], Any], error: type[InputError], message: str, tmp_path: Path
) -> None:
    parts = foreign_cube()
    spoil(parts)
    path = write(tmp_path / "cube.fits", parts)
    with pytest.raises(error, match=message) as caught:
        FringeCube.read_fits(path)
    assert caught.value.source == str(path)


def test_a_checksum_of_another_program_is_verified(tmp_path: Path) -> None:
    path = write(tmp_path / "cube.fits", foreign_cube(), checksum=True)
    FringeCube.read_fits(path)
    content = bytearray(path.read_bytes())
    content[-2000] ^= 1
    path.write_bytes(content)
    with pytest.raises(FrameFormatError, match="verification failed"):
        FringeCube.read_fits(path)


# Thickness maps of anybody.


def foreign_map(path: Path, factor: float = 1.0, **cards: str) -> Path:
    value = np.linspace(13.0, 15.0, 35).reshape(5, 7)
    value[0, 0] = np.nan
    hdu = fits.PrimaryHDU(value * factor)
    hdu.header.update(cards)
    hdu.writeto(path)
    return path


@pytest.mark.parametrize(
    ("unit", "factor"),
    [("nm", 1e3), ("mm", 1e-3), ("m", 1e-6), ("um", 1.0), ("micron", 1.0), ("Angstrom", 1e4), (None, 1.0)],
)
def test_a_map_is_in_the_unit_that_it_states(unit: str | None, factor: float, tmp_path: Path) -> None:
    path = foreign_map(tmp_path / "map.fits", factor, **({"BUNIT": unit} if unit else {}))
    found = ThicknessMap.read_any(path, "adhesive")
    expected = np.linspace(13.0, 15.0, 35).reshape(5, 7)
    expected[0, 0] = np.nan
    np.testing.assert_allclose(found.known_um(), expected, rtol=3e-7)
    assert found.layer == "adhesive"


@pytest.mark.parametrize(
    ("factor", "cards", "message"),
    [
        (1.0, {"BUNIT": "electron"}, "unit of thickness map is 'electron'"),
        (1.0, {"BUNIT": "furlong"}, "unit of thickness map is 'furlong'"),
        (1e3, {}, "state the unit in BUNIT"),
        (1e-3, {}, "state the unit in BUNIT"),
        (1.0, {"LAYER": "detection"}, "layer of the thickness map is 'detection'; allowed: adhesive"),
        (1.0, {"PRODUCT": "FringeFlat"}, "PRODUCT is 'FringeFlat'"),
    ],
)
def test_what_is_no_map_of_the_layer_is_refused(
    factor: float, cards: dict[str, str], message: str, tmp_path: Path
) -> None:
    path = foreign_map(tmp_path / "map.fits", factor, **cards)
    with pytest.raises(InputError, match=message) as caught:
        ThicknessMap.read_any(path, "adhesive")
    assert caught.value.source == str(path)


def test_a_map_of_ours_keeps_what_its_mask_only_doubts(tmp_path: Path) -> None:
    mask = np.zeros((3, 4), int)
    mask[0, 0], mask[1, 1] = mask_bits("NO_DATA"), mask_bits("SLIP")
    product = thickness(mask=mask)
    product.write_fits(tmp_path / "map.fits")
    found = ThicknessMap.read_any(tmp_path / "map.fits")
    assert_identical(product, found)
    known = found.known_um()
    assert np.isnan(known[0, 0])
    assert known[1, 1] == product.value[1, 1]


def foreign_parts(value: np.ndarray, **others: np.ndarray) -> fits.HDUList:
    named = [fits.ImageHDU(array, name=name) for name, array in others.items()]
    return fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(value, name="MAP"), *named])


def test_pixels_of_a_map_from_elsewhere_that_mean_nothing_are_no_data(tmp_path: Path) -> None:
    """No positive number, marked by its mask, or no uncertainty; one that is sure of itself is good."""
    value, sigma, mask = np.full((5, 7), 14.0), np.full((5, 7), 2.0), np.zeros((5, 7), np.int32)
    value[0, :4] = np.nan, 0.0, -3.0, np.inf
    sigma[1, :4] = np.nan, -1.0, np.inf, 0.0
    mask[4, 2:4] = 1, 4
    hdus = foreign_parts(value, SIGMA=sigma, MASK=mask)
    hdus["SIGMA"].header["BUNIT"] = "nm"
    hdus.writeto(tmp_path / "map.fits")
    found = ThicknessMap.read_any(tmp_path / "map.fits")
    expected = np.zeros((5, 7), int)
    expected[0, :4] = expected[1, :3] = expected[4, 2:4] = mask_bits("NO_DATA")
    np.testing.assert_array_equal(found.mask, expected)
    np.testing.assert_allclose(found.sigma[expected == 0], np.where(sigma == 0.0, 0.0, 2e-3)[expected == 0])
    assert found.layer == "unknown"
    foreign_parts(value, MASK=mask).writeto(tmp_path / "plain.fits")
    plain = ThicknessMap.read_any(tmp_path / "plain.fits")
    expected[1] = 0
    np.testing.assert_array_equal(plain.mask, expected)
    np.testing.assert_allclose(plain.sigma, UNKNOWN_SIGMA_UM)
    assert not plain.chi2.any()
    assert not plain.slip_probability.any()


LOW_UM, HIGH_UM = THICKNESS_LIMITS_UM
SOME = np.full((3, 4), 14.0)


@pytest.mark.parametrize(
    ("hdus", "message"),
    [
        (foreign_parts(SOME * LOW_UM / 14.0), ""),
        (foreign_parts(SOME * HIGH_UM / 14.0), ""),
        (foreign_parts(0.99 * SOME * LOW_UM / 14.0), "median of the thickness map"),
        (foreign_parts(1.01 * SOME * HIGH_UM / 14.0), "median of the thickness map"),
        (foreign_parts(SOME, SIGMA=0.34 * SOME / 14.0), ""),
        (foreign_parts(SOME, SIGMA=0.36 * SOME / 14.0), "median of SIGMA"),
        (foreign_parts(SOME, SIGMA=np.ones((4, 3))), "shape of SIGMA"),
        (foreign_parts(SOME, MASK=np.ones((4, 3), np.int16)), "shape of MASK"),
        (foreign_parts(SOME, MASK=np.ones((3, 4), np.int16)), "no finite pixel"),
        (foreign_parts(SOME, SIGMA=np.full((3, 4), -1.0)), "good pixels of the thickness map is 0"),
        (foreign_parts(np.ones((2, 3, 4))), "two-dimensional"),
        (fits.HDUList([fits.PrimaryHDU()]), "no image"),
    ],
)
def test_a_map_from_elsewhere_is_a_thickness_or_is_refused(hdus: Any, message: str, tmp_path: Path) -> None:
    path = tmp_path / "map.fits"
    hdus.writeto(path)
    if not message:
        assert ThicknessMap.read_any(path).shape == (3, 4)
        return
    with pytest.raises(FrameFormatError, match=message) as caught:
        ThicknessMap.read_any(path)
    assert caught.value.source == str(path)
