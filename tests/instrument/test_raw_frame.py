import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from raw_frame_maker import (
    PARALLEL,
    PRESCAN,
    SERIAL,
    header_with,
    random_image,
    raw_hdus,
    result_or_refusal,
    small_detector,
    write_raw,
)

from lsst.fringe_sim.errors import FrameFormatError, UnknownNameError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.raw_frame import RawFrame, Section, read_raw_header, read_raw_metadata
from lsst.fringe_sim.resources import read_table

REAL_FRAME = "measured/ts8_raw_201807241028453-RTM-010-S11-det067.fits"


def assembled(frame: RawFrame) -> np.ndarray:
    image = np.zeros(frame.detector_shape, dtype=np.int64)
    for amp in frame.amplifiers:
        image[amp.destination] = amp.oriented(amp.data[amp.imaging])
    return image


# Geometry


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    vendor=st.sampled_from(["e2v", "ITL"]),
    rows=st.integers(1, 12),
    columns=st.integers(1, 6),
    y_from_the_top=st.booleans(),
    seed=st.integers(0, 99),
)
def test_frames_of_any_size_assemble_to_the_image_they_were_made_from(
    tmp_path: Path, vendor: str, rows: int, columns: int, y_from_the_top: bool, seed: int
) -> None:
    detector = small_detector(vendor, (2 * rows, 8 * columns))
    image = random_image(detector, seed)
    hdus = raw_hdus(image, detector)
    if not y_from_the_top:
        for hdu in hdus[1:]:
            hdu.header["DETSEC"] = str(Section.parse(hdu.header["DETSEC"]).mirrored_y(2 * rows))
    path = tmp_path / f"{vendor}_{rows}_{columns}_{y_from_the_top}_{seed}.fits"
    hdus.writeto(path, overwrite=True)
    frame = RawFrame.read(path)
    assert frame.detector_shape == (2 * rows, 8 * columns)
    assert np.array_equal(assembled(frame), image)


def test_overscan_lies_right_and_above_and_prescan_left(tmp_path: Path) -> None:
    frame = RawFrame.read(write_raw(tmp_path / "raw.fits"))
    assert len(frame.amplifiers) == 16
    for amp in frame.amplifiers:
        assert amp.data[amp.serial_prescan].size == 10 * 12
        assert np.all(amp.data[amp.serial_prescan] == PRESCAN)
        assert amp.data[amp.serial_overscan].shape == (12, 54)
        assert np.all(amp.data[amp.serial_overscan] == SERIAL)
        assert amp.data[amp.parallel_overscan].shape == (46, 5)
        assert np.all(amp.data[amp.parallel_overscan] == PARALLEL)
        assert amp.data.dtype == np.int32
        assert amp.data.dtype.isnative


@pytest.mark.parametrize("vendor", ["e2v", "ITL"])
def test_full_size_layout_is_the_one_of_the_table(tmp_path: Path, vendor: str) -> None:
    """The sections as real files spell them, word for word from the table, lead to its positions and flips."""
    rows = [row for row in read_table("instrument", "lsst_raw_amp_layout.ecsv") if row["vendor"] == vendor]
    # A sensor of the vendor: another one would not be taken with this size.
    sensor = {} if vendor == "e2v" else {"LSST_NUM": "ITL-3800C-023", "RAFTNAME": "LCA-11021_RTM-002"}
    about = header_with({"MONOCH-WAVELENG": None, "MONOCH-BANDPASS": None, **sensor})
    primary = fits.PrimaryHDU(header=fits.Header(about))
    hdus = [primary]
    for row in rows:
        hdu = fits.ImageHDU(np.zeros((row["naxis2"], row["naxis1"]), dtype=np.uint8), name=row["extname"])
        for keyword in ("DATASEC", "DETSEC", "DETSIZE"):
            hdu.header[keyword] = row[keyword]
        hdus.append(hdu)
    path = tmp_path / "full.fits"
    fits.HDUList(hdus).writeto(path)
    frame = RawFrame.read(path)
    for row, amp in zip(rows, frame.amplifiers, strict=True):
        assert amp.name == row["amp"]
        assert amp.channel == row["channel"]
        assert (amp.flip_x, amp.flip_y) == (row["flip_x"], row["flip_y"])
        y, x = amp.destination
        assert (y.start, x.start) == (row["ccd_y0"], row["ccd_x0"])
        assert (y.stop - y.start, x.stop - x.start) == (row["data_h"], row["data_w"])
        assert amp.serial_prescan[1].stop == row["prescan_w"]
        assert amp.serial_overscan[1] == slice(row["overscan_x0"], row["overscan_x0"] + row["overscan_w"])
        assert amp.parallel_overscan[0].start == row["par_overscan_y0"]


def test_names_and_size_that_are_missing_are_derived(tmp_path: Path) -> None:
    detector = small_detector()
    image = random_image(detector)
    hdus = raw_hdus(image, detector)
    for hdu in hdus[1:]:
        del hdu.header["EXTNAME"], hdu.header["CHANNEL"], hdu.header["DETSIZE"]
    hdus.writeto(tmp_path / "raw.fits")
    frame = RawFrame.read(tmp_path / "raw.fits")
    assert [amp.name for amp in frame.amplifiers] == [amp.name for amp in detector.amplifiers]
    assert np.array_equal(assembled(frame), image)


def test_compressed_frames_are_read(tmp_path: Path) -> None:
    detector = small_detector()
    image = random_image(detector)
    hdus = raw_hdus(image, detector)
    tiled = fits.HDUList([hdus[0], *(fits.CompImageHDU(h.data, h.header, name=h.name) for h in hdus[1:])])
    tiled.writeto(tmp_path / "raw.fits.fz")
    assert np.array_equal(assembled(RawFrame.read(tmp_path / "raw.fits.fz")), image)
    hdus.writeto(tmp_path / "raw.fits.gz")
    assert np.array_equal(assembled(RawFrame.read(tmp_path / "raw.fits.gz")), image)


def test_unsigned_16_bit_frames_are_read(tmp_path: Path) -> None:
    detector = small_detector()
    image = random_image(detector)
    hdus = raw_hdus(image, detector)
    for hdu in hdus[1:]:
        hdu.data = hdu.data.astype(np.uint16)
    hdus.writeto(tmp_path / "raw.fits")
    assert np.array_equal(assembled(RawFrame.read(tmp_path / "raw.fits")), image)


def test_amplifier_by_name(tmp_path: Path) -> None:
    frame = RawFrame.read(write_raw(tmp_path / "raw.fits"))
    assert frame.amplifier("C07").channel == 9
    with pytest.raises(UnknownNameError, match=r"raw\.fits: amplifier is 'C77'; allowed: .*C17"):
        frame.amplifier("C77")


@pytest.mark.shared
def test_real_frame_is_read_as_it_is(shared_dir: Path) -> None:
    path = shared_dir / REAL_FRAME
    frame = RawFrame.read(path)
    expected = Camera.from_name("lsstCam").detector("E2V-CCD250-179").amplifiers
    assert frame.detector_shape == (4004, 4096)
    for amp, known in zip(frame.amplifiers, expected, strict=True):
        assert amp.name == known.name
        assert amp.destination == known.section
        assert (amp.flip_x, amp.flip_y) == (known.flip_x, known.flip_y)
    with_pixels = [amp.name for amp in frame.amplifiers if np.any(amp.data)]
    assert with_pixels == ["C00"]
    bias = np.median(frame.amplifier("C00").data[frame.amplifier("C00").serial_overscan])
    signal = np.median(frame.amplifier("C00").data[frame.amplifier("C00").imaging])
    assert 20_000 < bias < 40_000
    assert signal > bias + 5_000
    metadata = frame.metadata
    assert metadata == read_raw_metadata(path)
    assert metadata.wavelength_nm == 700.03  # MONOCH-WAVELENG is stale and says 675.004
    assert metadata.temperature_k == pytest.approx(172.625, abs=1e-3)
    assert (metadata.raft, metadata.slot, metadata.detector) == ("RTM-010", "S11", 67)
    assert metadata.exposure_id == 201807241028453
    assert (metadata.observation_type, metadata.test_type) == ("flat", "lambda")
    assert (metadata.exposure_time_s, metadata.run, metadata.seq_num) == (21.913, "6006D", 17)


# What is refused


def spoil(path: Path, change: Callable[[fits.HDUList], Any]) -> Path:
    detector = small_detector()
    hdus = raw_hdus(random_image(detector), detector)
    changed = change(hdus)
    (hdus if changed is None else changed).writeto(path, output_verify="ignore")
    return path


def set_in(number: int, keyword: str, value: Any) -> Callable[[fits.HDUList], None]:
    def change(hdus: fits.HDUList) -> None:
        if value is None:
            del hdus[number].header[keyword]
        else:
            hdus[number].header[keyword] = value

    return change


def swap_detsec(hdus: fits.HDUList) -> None:
    """One amplifier of the lower row where one of the upper row belongs."""
    hdus[1].header["DETSEC"], hdus[16].header["DETSEC"] = hdus[16].header["DETSEC"], hdus[1].header["DETSEC"]


def as_float(hdus: fits.HDUList) -> None:
    hdus[5].data = hdus[5].data.astype(np.float32)


REFUSED: dict[str, tuple[Callable[[fits.HDUList], Any], str]] = {
    "15 amplifiers": (lambda hdus: hdus[:16], r"number of amplifier HDUs is 15; allowed: 16"),
    "no amplifier": (lambda hdus: hdus[:1], r"number of amplifier HDUs is 0; allowed: 16"),
    "17 amplifiers": (
        lambda hdus: fits.HDUList([*hdus, fits.ImageHDU(np.zeros((4, 4), dtype=np.int32))]),
        r"number of amplifier HDUs is 17; allowed: 16",
    ),
    "no DATASEC": (set_in(3, "DATASEC", None), r"C12 DATASEC is None; allowed: \[x1:x2,y1:y2\]"),
    "no DETSEC": (set_in(3, "DETSEC", None), r"C12 DETSEC is None; allowed: \[x1:x2,y1:y2\]"),
    "DATASEC of reals": (set_in(3, "DATASEC", "[11.5:15,1:12]"), r"C12 DATASEC is '\[11\.5:15,1:12\]'"),
    "DATASEC from 0": (set_in(3, "DATASEC", "[0:4,1:12]"), r"C12 DATASEC is '\[0:4,1:12\]'; .*from 1"),
    "DATASEC a number": (set_in(3, "DATASEC", 7), r"C12 DATASEC is 7"),
    "DATASEC backwards": (set_in(3, "DATASEC", "[15:11,1:12]"), r"C12 DATASEC .* increasing"),
    "DATASEC too large": (set_in(3, "DATASEC", "[11:15,1:99]"), r"C12 DATASEC .* within \[1:69,1:58\]"),
    "sections of unequal size": (set_in(3, "DATASEC", "[11:14,1:12]"), r"C12 DETSEC .* size of DATASEC"),
    "DETSEC outside": (set_in(3, "DETSEC", "[45:41,1:12]"), r"C12 DETSEC .* within \[1:40,1:24\]"),
    "DETSEC twice": (set_in(3, "DETSEC", "[10:6,1:12]"), r"DETSEC is 'C11 and C12 overlap'"),
    "DETSIZE differs": (set_in(3, "DETSIZE", "[1:40,1:26]"), r"DETSIZE .* one size"),
    "DETSIZE not from 1": (
        lambda hdus: [set_in(n, "DETSIZE", "[2:41,1:24]")(hdus) for n in range(1, 17)] and None,
        r"DETSIZE .* begins at",
    ),
    "rows exchanged": (swap_detsec, r"DETSEC .* same half"),
    "name twice": (set_in(3, "EXTNAME", "Segment11"), r"C11.*one HDU for each amplifier"),
    "channel of text": (
        set_in(3, "CHANNEL", "three"),
        r"CHANNEL is 'three'; allowed: an integer from 1 to 16",
    ),
    "overscan in the image": (
        set_in(3, "BIASSEC", "[15:20,12:20]"),
        r"C12 BIASSEC is '\[15:20,12:20\]'; allowed: a section without pixels of DATASEC \[11:15,1:12\]",
    ),
    "floating point": (as_float, r"C14 BITPIX is -32; .*integer ADU"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_wrong_with_a_layout_is_said_in_one_message(tmp_path: Path, case: str) -> None:
    change, message = REFUSED[case]
    path = spoil(tmp_path / "raw.fits", change)
    for read in (RawFrame.read, read_raw_metadata):
        with pytest.raises(FrameFormatError, match=message) as caught:
            read(path)
        assert str(caught.value).startswith(str(path))
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("section", ["[16:20,1:12]", "[1:15,13:20]", "[1:10,1:12]"])
def test_overscan_beside_or_above_the_image_is_none_of_it(tmp_path: Path, section: str) -> None:
    detector = small_detector()
    image = random_image(detector)
    hdus = raw_hdus(image, detector)
    set_in(3, "BIASSEC", section)(hdus)
    hdus.writeto(tmp_path / "raw.fits")
    np.testing.assert_array_equal(assembled(RawFrame.read(tmp_path / "raw.fits")), image)


def test_gap_between_amplifiers_is_refused(tmp_path: Path) -> None:
    def widen(hdus: fits.HDUList) -> None:
        for hdu in hdus[1:]:
            hdu.header["DETSIZE"] = "[1:41,1:24]"

    with pytest.raises(FrameFormatError, match=r"960 pixels in all.*41 × 24"):
        RawFrame.read(spoil(tmp_path / "raw.fits", widen))


@pytest.mark.parametrize(
    "content", [b"", b"not a FITS file", b"SIMPLE  =", bytes(5000), b"\x1f\x8b\x08broken"]
)
def test_files_that_are_not_fits_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "raw.fits"
    path.write_bytes(content)
    for read in (RawFrame.read, read_raw_metadata, read_raw_header):
        with pytest.raises(FrameFormatError, match=r"raw\.fits"):
            read(path)


def test_missing_file_and_folder_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "nothere.fits", tmp_path):
        with pytest.raises(FrameFormatError, match="an existing FITS file"):
            RawFrame.read(path)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(kept=st.floats(0, 1, exclude_max=True), zipped=st.booleans())
def test_truncated_files_are_refused(tmp_path: Path, kept: float, zipped: bool) -> None:
    path = tmp_path / "raw.fits"
    if not path.exists():
        write_raw(path)
    content = gzip.compress(path.read_bytes(), mtime=0) if zipped else path.read_bytes()
    cut = tmp_path / "cut.fits"
    cut.write_bytes(content[: int(kept * (len(content) - 2880))])
    with pytest.raises(FrameFormatError, match=r"cut\.fits"):
        RawFrame.read(cut)
    if not zipped:
        with pytest.raises(FrameFormatError, match=r"cut\.fits"):
            read_raw_metadata(cut)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_headers_are_read_right_or_refused(tmp_path: Path, data: st.DataObject) -> None:
    """Whatever bytes stand in the headers: a frame that keeps its promises, or one clear error."""
    path = tmp_path / "raw.fits"
    if not path.exists():
        write_raw(path)
    content = bytearray(path.read_bytes())
    start = data.draw(st.sampled_from([0, 2880, 2880 * 2]), label="start")
    for _ in range(data.draw(st.integers(1, 6), label="changes")):
        at = start + data.draw(st.integers(0, 2879), label="at")
        content[at] = data.draw(st.integers(0, 255), label="byte")
    damaged = tmp_path / "damaged.fits"
    damaged.write_bytes(content)
    frame, refusal = result_or_refusal(lambda: RawFrame.read(damaged))
    if frame is None:
        assert str(damaged) in refusal
        return
    covered = np.zeros(frame.detector_shape, dtype=int)
    for amp in frame.amplifiers:
        covered[amp.destination] += 1
        assert amp.data[amp.imaging].shape == covered[amp.destination].shape
    assert np.all(covered == 1)


SECTION_TEXTS = st.one_of(
    st.text(max_size=20),
    st.from_regex(r"\[[0-9]{1,3}:[0-9]{1,3},[0-9]{1,3}:[0-9]{1,3}\]", fullmatch=True),
    st.integers(),
    st.none(),
)


@given(text=SECTION_TEXTS)
def test_section_is_parsed_or_refused(text: object) -> None:
    section, refusal = result_or_refusal(lambda: Section.parse(text, keyword="DATASEC", source="raw.fits"))
    if section is None:
        assert refusal.startswith("raw.fits: DATASEC is")
        return
    assert Section.parse(str(section)) == section
    rows, columns = section.slices
    assert (rows.stop - rows.start, columns.stop - columns.start) == section.shape
    assert min(rows.start, columns.start) >= 0


@given(bounds=st.tuples(*[st.integers(1, 50)] * 4), n_rows=st.integers(50, 90))
def test_mirroring_twice_is_nothing(bounds: tuple[int, int, int, int], n_rows: int) -> None:
    section = Section(*bounds)
    assert section.mirrored_y(n_rows).mirrored_y(n_rows) == section
    assert section.mirrored_y(n_rows).shape == section.shape
