import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lsst.fringe_sim.errors import InputError, UnknownNameError
from lsst.fringe_sim.instrument.camera import Camera, Detector
from lsst.fringe_sim.instrument.setup import Setup, setup_names
from lsst.fringe_sim.resources import read_table

CAMERAS = ("lsstCam", "ts8", "monocam", "hsc")
ALL_DETECTORS = [(name, d.id) for name in CAMERAS for d in Camera.from_name(name).detectors]


def coverage(detector: Detector) -> np.ndarray:
    """How many amplifiers each pixel of the assembled CCD belongs to."""
    count = np.zeros(detector.shape, dtype=int)
    for amp in detector.amplifiers:
        count[amp.section] += 1
    return count


def test_focal_plane_is_complete() -> None:
    camera = Camera.from_name("lsstCam")
    assert len(camera.science) == 189
    assert [detector.id for detector in camera.science] == list(range(189))
    assert {d.vendor for d in camera.science} == {"e2v", "ITL"}
    assert sum(d.vendor == "e2v" for d in camera.science) == 117  # 13 rafts of e2v, 8 of ITL
    assert {d.kind for d in camera.detectors} == {"science", "guider", "wavefront"}


@pytest.mark.parametrize("key", [37, "37", "R11_S01", "E2V-CCD250-321", "E2V-CCD250-321-Dev", " R11_S01 "])
def test_the_sensor_of_the_paper_by_every_name(key: int | str) -> None:
    detector = Camera.from_name("lsstCam").detector(key)
    assert (detector.id, detector.name, detector.serial) == (37, "R11_S01", "E2V-CCD250-321")
    assert detector.shape == (4004, 4096)
    assert detector.vendor == "e2v"


@pytest.mark.parametrize("name", ["R11", "RTM-020", "LCA-11021_RTM-020"])
def test_raft_by_bay_and_by_module(name: str) -> None:
    raft = Camera.from_name("lsstCam").raft(name)
    assert [d.id for d in raft] == list(range(36, 45))
    assert [d.slot for d in raft] == [f"S{row}{column}" for row in range(3) for column in range(3)]


def test_test_stand_knows_where_its_sensors_are_today() -> None:
    stand, camera = Camera.from_name("ts8"), Camera.from_name("lsstCam")
    assert stand.detector("R11_S01").name == "RTM-020_S01"
    assert [d.serial for d in stand.raft("R11")] == [d.serial for d in camera.raft("R11")]
    assert stand.detector("R11_S01").amplifiers == camera.detector("R11_S01").amplifiers


@pytest.mark.parametrize(
    ("camera", "key", "offered"),
    [
        ("lsstCam", "R11_S0", "did you mean R11_S"),
        ("lsstCam", 999, "R00_SG0"),
        ("lsstCam", -1, "R00_SG0"),
        ("lsstCam", "", "R00_SG0"),
        ("lsstCam", "E2V-CCD250-1290", "E2V-CCD250-129"),
        ("ts8", "RTM-020_S33", "RTM-020_S"),
        ("monocam", "R11_S01", "R00_S00"),
    ],
)
def test_unknown_detector_is_refused_with_near_misses(camera: str, key: int | str, offered: str) -> None:
    with pytest.raises(UnknownNameError, match="detector is") as caught:
        Camera.from_name(camera).detector(key)
    assert offered in str(caught.value)


def test_unknown_raft_camera_and_amplifier_are_refused() -> None:
    camera = Camera.from_name("lsstCam")
    with pytest.raises(UnknownNameError, match="R11"):
        camera.raft("R111")
    with pytest.raises(UnknownNameError, match="did you mean lsstCam"):
        Camera.from_name("lsstcam")
    with pytest.raises(UnknownNameError, match="C17"):
        camera.detector(37).amplifier("C18")


@pytest.mark.parametrize("name", CAMERAS)
def test_names_are_unique_within_a_camera(name: str) -> None:
    detectors = Camera.from_name(name).detectors
    assert len({d.id for d in detectors}) == len(detectors)
    assert len({d.name for d in detectors}) == len(detectors)
    assert all(d.name == f"{d.raft}_{d.slot}" for d in detectors)


@pytest.mark.parametrize(("camera", "key"), [("lsstCam", 37), ("lsstCam", 0), ("lsstCam", 191), ("hsc", 0)])
def test_amplifiers_cover_the_sensor_once(camera: str, key: int) -> None:
    assert np.all(coverage(Camera.from_name(camera).detector(key)) == 1)


def test_every_readout_is_physical() -> None:
    for name, key in ALL_DETECTORS:
        for amp in Camera.from_name(name).detector(key).amplifiers:
            assert 0.5 < amp.gain < 5
            assert 2 < amp.read_noise < 200
            assert amp.saturation > 10_000


def test_means_over_amplifiers_are_those_of_the_detector_table() -> None:
    table = read_table("instrument", "lsstcam_detectors.ecsv")
    camera = Camera.from_name("lsstCam")
    for row in table:
        detector = camera.detector(int(row["detector"]))
        assert detector.gain == pytest.approx(row["gain"], abs=6e-5)
        assert detector.read_noise == pytest.approx(row["read_noise"], abs=6e-4)


def test_field_angles_follow_the_plate_scale() -> None:
    for detector in Camera.from_name("lsstCam").detectors:
        r_mm = math.hypot(detector.x_mm, detector.y_mm)
        field = 20.005867576692737 / 3600 * (r_mm - 8.33713991e-9 * r_mm**3 - 1.41389858e-15 * r_mm**5)
        assert detector.field_radius_deg == pytest.approx(field, abs=2e-5)


def test_test_stand_has_no_field_angle() -> None:
    assert all(math.isnan(d.field_x_deg) for d in Camera.from_name("ts8").detectors)


def test_cameras_of_one_sensor() -> None:
    monocam, hsc = (Camera.from_name(name).detectors for name in ("monocam", "hsc"))
    assert [d.shape for d in monocam] == [(4004, 4096)]
    assert [d.shape for d in hsc] == [(4096, 2048)]
    assert monocam[0].vendor == "e2v"
    assert hsc[0].pixel_um == 15.0
    assert all(amp.raw is None for amp in hsc[0].amplifiers)


CAMERA = """
title: a test stand of one sensor
source: a test
vendor: ITL
pixel_um: 10.0
layout: ITL
readout: median of LSSTCam
detectors:
  - {id: 3, name: R00_S11, raft: R00, slot: S11, serial: "A-1", raft_serial: "", x_mm: 0.0, y_mm: 0.0,
     field_x_deg: 0.0, field_y_deg: 0.0}
"""


def test_a_further_camera_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "stand.yaml").write_text(CAMERA)
    camera = Camera.from_file(tmp_path / "stand.yaml")
    assert camera.name == "stand"
    assert camera.detector("A-1").shape == (4000, 4072)
    assert camera.detector(3).readout_source == "median of the ITL science sensors of LSSTCam"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("vendor: ITL", "vendor: Fairchild", "vendor is 'Fairchild'; allowed: .*ITL"),
        ("layout: ITL", "layout: itl", "vendor is 'itl'; allowed: .*ITL"),
        ("pixel_um: 10.0", "pixel_um: 0", "pixel_um is 0; allowed: a positive number"),
        ("pixel_um: 10.0", "pixel_um: small", "the description of a camera"),
        ("pixel_um: 10.0", "", "entry is 'pixel_um'; allowed: every entry"),
        ("title: a", "titel: a", "entry is 'title'"),
        ("id: 3", "id: three", "the description of a camera"),
        ("detectors:\n", "detectors: 3\nothers:\n", "the description of a camera"),
        ("title", "[", "allowed: YAML"),
        (CAMERA, "a list", "content is 'str'; allowed: a mapping"),
        (CAMERA, CAMERA + CAMERA[CAMERA.index("  - {") :], "id of a detector is 3"),
    ],
)
def test_camera_that_is_not_described_well_is_refused(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    assert old in CAMERA
    path = tmp_path / "stand.yaml"
    path.write_text(CAMERA.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as caught:
        Camera.from_file(path)
    assert str(caught.value).startswith(str(path))


def test_camera_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="an existing file"):
        Camera.from_file(tmp_path / "nothing.yaml")


@given(rows=st.integers(1, 60), columns=st.integers(1, 20), vendor=st.sampled_from([37, 0, 191]))
def test_cut_down_sensor_keeps_its_layout(rows: int, columns: int, vendor: int) -> None:
    whole = Camera.from_name("lsstCam").detector(vendor)
    n_rows = 1 if vendor == 191 else 2
    small = whole.cut_down((n_rows * rows, 8 * columns))
    assert small.shape == (n_rows * rows, 8 * columns)
    assert np.all(coverage(small) == 1)
    for before, after in zip(whole.amplifiers, small.amplifiers, strict=True):
        assert (before.name, before.gain, before.flip_x, before.flip_y) == (
            after.name,
            after.gain,
            after.flip_x,
            after.flip_y,
        )
        assert before.raw is not None
        assert after.raw is not None
        assert before.raw.shape[0] - before.height == after.raw.shape[0] - after.height
        assert before.raw.shape[1] - before.width == after.raw.shape[1] - after.width
    assert small.cut_down(whole.shape) == whole


@pytest.mark.parametrize("shape", [(24, 41), (23, 40), (0, 40), (-2, 8)])
def test_sizes_that_amplifiers_cannot_share_are_refused(shape: tuple[int, int]) -> None:
    with pytest.raises(InputError, match="positive multiples of 2 rows and 8 columns"):
        Camera.from_name("lsstCam").detector(37).cut_down(shape)


@pytest.mark.parametrize("name", setup_names())
def test_the_sensor_of_a_setup_is_of_the_vendor_of_its_films(name: str) -> None:
    setup = Setup.from_name(name)
    own = Camera.from_name(setup.camera).detector(setup.detector)
    assert own.vendor.lower() in setup.stack.name.lower()
    setup.refuse_other_vendor(own)


def test_a_sensor_of_another_vendor_has_setups_of_its_own() -> None:
    sensor = Camera.from_name("ts8").detector("RTM-014_S11")
    with pytest.raises(InputError, match=r"of ITL.*ts8_itl"):
        Setup.from_name("ts8_e2v").refuse_other_vendor(sensor)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("x0: 512,", "x0: 500,", "shared by A1 and A2"),
        ("x0: 512,", "x0: 520,", "pixels without an amplifier is 8192"),
        ("name: A2", "name: A1", "name of an amplifier is 'A1'"),
        ("width: 500", "width: 0", "width, height of A2"),
    ],
)
def test_amplifiers_that_do_not_fit_the_pixels_are_refused(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    path, rest = tmp_path / "two.yaml", "height: 1024, gain: 1.5, read_noise: 6.0, saturation: 100000}"
    text = f"""
title: two outputs of different widths
source: test
vendor: any
pixel_um: 10.0
amplifiers:
  - {{name: A1, x0: 0, y0: 0, width: 512, {rest}
  - {{name: A2, x0: 512, y0: 0, width: 500, {rest}
detectors:
  - {{id: 0, name: S00}}
"""
    path.write_text(text, encoding="utf-8")
    sensor = Camera.from_file(path).detector("S00")
    assert (coverage(sensor) == 1).all()
    assert (coverage(sensor.cut_down((32, 64))) == 1).all()  # though one is narrower than its place tells
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError, match=message):
        Camera.from_file(path)


def test_amplifiers_are_counted_from_one_in_the_order_of_their_file() -> None:
    (sensor,) = Camera.from_name("hsc").detectors
    assert [(amp.name, amp.channel) for amp in sensor.amplifiers] == [
        ("A1", 1), ("A2", 2), ("A3", 3), ("A4", 4),
    ]  # fmt: skip
