"""What the commands say and do around frames of the sky, raw frames and plans of flats, with the work left out."""

from __future__ import annotations

import math
import uuid
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import numpy as np
import pytest
from astropy.io import fits
from small_pages import verdict

from lsst.fringe_sim.algorithms import discovery, sky_frame
from lsst.fringe_sim.algorithms.correction import AMPLIFIERS_UNKNOWN, AmplifierGrid
from lsst.fringe_sim.algorithms.fringe_correction import CorrectionOptions
from lsst.fringe_sim.cli import (
    discover,
    lab_frames,
    observed,
    output,
    plan_flats,
    provenance,
    sky,
    sky_frames,
)
from lsst.fringe_sim.cli.inputs import read_settings
from lsst.fringe_sim.cli.lab_frames import LabSeries
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.cli.parameters import LABORATORY, SKY
from lsst.fringe_sim.errors import FringeSimError, InputError
from lsst.fringe_sim.instrument.bandpass import Bandpass
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.setup import setup_names
from lsst.fringe_sim.model import FringeModel, Setup
from lsst.fringe_sim.products import SensorSection
from lsst.fringe_sim.products.observed_files import ObservedImage

SENSOR = Camera.from_name("lsstCam").detector("R22_S11")


def test_both_forecasts_of_a_frame() -> None:
    """Of the first frame: what is lost in the laboratory only, and what is lost on the sky as well."""
    frames = [SimpleNamespace(metadata={"FRINGRMS": value}) for value in (0.02, 0.05)]
    line = sky._both_forecasts(frames[0], 0.25, 0.04)
    assert line.startswith(
        "the laboratory flats have 0.25 ± 0.04 of the model's contrast: fringes of rms 2.0000 % if it is lost in the "
        "laboratory only, 0.5000 % if it is lost on the sky as well; the frames hold the first."
    )


def test_lines_of_a_night(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sky, "_describe", lambda frame: frame.name)
    monkeypatch.setattr(sky, "_open_phase", lambda frame, model: f"phase of {frame.name}")
    monkeypatch.setattr(sky, "_both_forecasts", lambda frame, *numbers: f"{frame.name}: {numbers}")
    frames: Any = [
        SimpleNamespace(name="a", metadata={"PHASERMS": 1.0}),
        SimpleNamespace(name="b", metadata={}),
    ]
    model: Any = None
    assert list(sky._said(frames, model, (0.5, 0.1))) == ["a", "b", "phase of a", "a: (0.5, 0.1)"]
    assert list(sky._said(frames[::-1], model, None)) == ["b", "a"]


def test_cards_of_all_frames(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("x")
    section = SensorSection.of_image(SENSOR, (5, 20), {"DETSEC": "[11:30,1:5]"})
    model = FringeModel.from_setup("lsst_e2v", {"silicon_absorption.scale": 1.5})
    found = sky._cards(model, [tmp_path / "a"], (0.25, 0.04), section)
    assert (found["SETUP"], found["BEAMS"]) == ("lsst_e2v", "pixel")
    assert (found["LABCONTR"], found["LABCONSG"], found["DETSEC"]) == (0.25, 0.04, "[11:30,1:5]")
    assert not {"LABCONTR", "LABCONSG", "DETSEC"} & set(sky._cards(model, [], None, None))


@pytest.mark.parametrize(("measured", "table"), [(True, False), (True, True), (False, True)])
def test_the_level_of_a_frame(measured: bool, table: bool, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """What the stack detects, where no quantum efficiency was measured."""
    band = SimpleNamespace(detector=np.ones(3 if table else 0))
    monkeypatch.setattr(Bandpass, "from_name", lambda name: band)
    monkeypatch.setattr(sky_frame, "throughput_electrons", lambda spectrum, *rest: 123.0)
    monkeypatch.setattr(sky_frame, "simulate_sky_frame", lambda *parts, **more: more)
    layers = sky.Layers(np.full((2, 3), 14.0), None, None, 0.5)
    exposure = sky.Exposure(15.0, 1.2, None, measured, None)
    response: Any = SimpleNamespace(bands=("8-4", "7-3"))
    made: Any = sky._frames(layers, FringeModel.from_setup("lsst_e2v"), response, exposure, {"seed": 3})
    frames, scales = made
    assert scales == [{"8-4": 1.0, "7-3": 1.0}]
    assert [frame["mean_electrons"] for frame in frames] == [123.0 if measured and table else None]
    assert (frames[0]["exposure_s"], frames[0]["phase_sigma"], frames[0]["seed"]) == (15.0, 0.5, 3)
    out, err = capsys.readouterr()
    assert (out, bool(err)) == ("", measured and not table)


def test_the_layer_that_is_built_in_is_of_a_whole_sensor() -> None:
    setup = Setup.from_name("lsst_e2v")
    layer, section = sky._layer("e2v_321", SENSOR, setup)
    assert section == SensorSection.of_image(SENSOR, SENSOR.shape, {})
    assert layer.shape == SENSOR.shape


def test_a_path_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"there is no such file or folder: '.*/none'") as raised:
        sky_frames._files([str(tmp_path / "none")])
    assert raised.value.filename == str(tmp_path / "none")
    with pytest.raises(InputError, match="FITS files, or folders with them"):
        sky_frames._files([str(tmp_path)])


# Raw frames


def one(kind: str, source: str, **changes: Any) -> Any:
    about = {
        "raft": "R22",
        "slot": "S11",
        "serial": "",
        "notes": (),
        "camera": "lsstCam",
        "detector": "R22_S11",
    }
    about |= {"observation_type": kind, "source": source, "exposure_id": 1}
    return SimpleNamespace(**(about | changes), require_wavelength_nm=lambda: 950.0)


def test_a_sensor_of_no_table_has_gains_of_the_set_up(capsys) -> None:
    """The vendor is that of its serial number, and of the set-up where that tells nothing."""
    setup = Setup.from_name("ts8_e2v")
    of_setup = Camera.from_name(setup.camera).detector(setup.detector)
    for serial, gains in (("E2V-CCD250-999", True), ("HAL-9000", True), (of_setup.serial, False)):
        place = "nowhere" if gains else of_setup.name
        series = LabSeries(serial, (), (one("flat", "a", serial=serial, camera="ts8", detector=place),))
        series.check(setup)
        out, err = capsys.readouterr()
        assert out == ""
        assert err == (f"{serial} is in no table: gains are those of {setup.detector}\n" if gains else "")
        sensor = series._sensor(setup)
        assert (sensor.vendor, sensor.name) == (of_setup.vendor, serial if gains else of_setup.name)
    with pytest.raises(FringeSimError, match="ITL"):
        LabSeries("ITL-3800C-999", (), (one("flat", "a", serial="ITL-3800C-999", camera="ts8"),)).check(setup)


def test_plain_images_that_are_neither(capsys) -> None:
    images: Any = [
        SimpleNamespace(source=name, kind=kind, detector=detector, shape=(3, 4), wavelength_nm=950.0)
        for name, kind, detector in (
            ("a", "flat", ""), ("b", "bias", "X"), ("c", "dark", "X"), ("d", "flat", "X"), ("e", "sky", ""),
        )
    ]  # fmt: skip
    series = lab_frames._plain_series(images)
    assert [each.source for each in (*series.biases, *series.flats)] == ["b", "a", "d"]
    assert series.serial == "X"
    assert capsys.readouterr() == ("", "neither flats nor bias images, left out: c, e\nplain flats\n")
    lab_frames._plain_series(images[:1])
    assert capsys.readouterr().err == "plain flats, taken as bias-subtracted: there are no bias images\n"


@pytest.mark.parametrize(("kinds", "said"), [(["dark", "bias", "dark"], "bias, dark"), ([], "no frame")])
def test_no_flat_among_raw_frames(kinds: list[str], said: str) -> None:
    with pytest.raises(InputError, match=f"^x y: flats is '{said}'; allowed: one flat or more"):
        lab_frames._raw_series([one(kind, str(number)) for number, kind in enumerate(kinds)], ["x", "y"])


# Plans


def test_a_plan_that_reaches_its_goal_and_one_that_does_not(capsys) -> None:
    flats = tuple(SimpleNamespace(wavelength_nm=nm, bandwidth_fwhm_nm=None) for nm in (880.0, 890.0))
    thick = np.linspace(9.0, 10.0, 20)
    now: Any = SimpleNamespace(
        flats=flats, thickness_um=thick, rival_um=thick + 0.3, order_um=0.3, separation=40.0 - thick,
        sigma_um=np.full(20, 4e-3), pixel_slip=np.full(20, 0.01), region_slip=np.full(20, 1e-9), region_px=64,
        safe=lambda limit: limit > 1e-9,
    )  # fmt: skip
    short: Any = SimpleNamespace(**vars(now) | {"sigma_um": np.where(np.arange(20) < 10, 3e-3, 4e-3)})
    plan_flats._print(now, (), short, 1e-5, 2.0)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "2 flats: 880, 890 nm (2 nm wide)"
    assert [line.split() for line in lines[2:12]] == [
        [f"{thick[i]:.2f}–{thick[i + 1]:.2f}", "4.00", f"{thick[i + 1] + 0.3:.3f}", "+1.00",
         f"{40.0 - thick[i + 1]:.2f}", "1.0e-02", "1.0e-09"]
        for i in range(0, 20, 2)
    ]  # fmt: skip
    assert lines[-1] == "2 flats would do (σ 3.54 nm): 880, 890 nm (2 nm wide)"
    assert any(line.startswith("no order is ambiguous: regions of 64 pixels") for line in lines)
    plan_flats._print(now, (), short, 1e-12, 2.0)
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("orders are AMBIGUOUS: regions of 64 pixels") for line in lines)
    assert lines[-1] == (
        "the candidates do not reach the goal; the best 2 of them: 880, 890 nm (2 nm wide), slip of a region 1.0e-09"
    )


# Searches


def test_a_search_on_the_sky_reports_beside_its_result(tmp_path: Path, monkeypatch, capsys) -> None:
    def search(*parts: Any, report: Any, **more: Any) -> Any:
        report("half of it is done")
        return verdict()

    monkeypatch.setattr(discovery, "discover_sky", search)
    data: Any = SimpleNamespace(sky=SimpleNamespace(frames=(), thickness_um=None, thickness_sigma_um=None))
    folder: Any = SimpleNamespace(prepare=lambda: tmp_path)
    model, options = FringeModel.from_setup("lsst_e2v"), SimpleNamespace()
    discover._search_sky(data, model, None, folder, 1, options, [])
    out, err = capsys.readouterr()
    assert "half of it is done\n" in err
    assert "half of it is done" not in out


def test_flats_of_a_repository_are_searched(tmp_path: Path, monkeypatch, capsys) -> None:
    asked: list[Any] = []
    cube = SimpleNamespace(metadata={}, detector="", shape=(8, 24, 32))
    monkeypatch.setattr(discover, "_from_repository", lambda *words: asked.append(words) or cube)
    (tmp_path / "butler.yaml").write_text("")
    setup = Setup.from_name("ts8_e2v")
    path = str(tmp_path)
    assert discover._read((path,), setup, "u/a", "94", False, True) is None
    assert capsys.readouterr().out == "would search 8 flats of 24 x 32 pixels\n"
    assert discover._read((path,), setup, "u/a", "94", False, False) is cube
    assert asked == [(path, "u/a", "94")] * 2
    cube.detector = "ITL-3800C-034"
    with pytest.raises(InputError, match=f"^{path}: "):
        discover._read((path,), setup, "u/a", "94", False, False)


# Files


def test_a_lock_that_was_taken_away_is_another_file(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    path.write_text("")
    with path.open() as stream:
        assert output._is_same(path, stream.fileno())
        path.unlink()
        assert not output._is_same(path, stream.fileno())
        path.write_text("")
        assert not output._is_same(path, stream.fileno())


def test_inputs_of_a_dataset_are_told_by_their_data_id() -> None:
    known = uuid.uuid4()
    ref = SimpleNamespace(dataId=SimpleNamespace(required={"instrument": "HSC", "detector": 3}))
    butler = SimpleNamespace(get_dataset=lambda each: ref if each == known else None)
    assert provenance._data_id(butler, str(known)) == "{'instrument': 'HSC', 'detector': 3}"
    assert provenance._data_id(butler, str(uuid.uuid4())) == "not in this repository"
    assert provenance._data_id(butler, "no number") == "not in this repository"


def test_what_is_fitted_beside_the_fringes(tmp_path: Path) -> None:
    """Amplifiers are given as columns x rows; backgrounds are named as their frames."""
    (tmp_path / "a.fits").write_text("")
    beside = observed.Background(tmp_path, 100.0, (8, 2))
    assert (beside.grid.rows, beside.grid.columns) == (2, 8)
    assert beside.options == CorrectionOptions(100.0, AmplifierGrid(2, 8))
    assert observed.Background(None, 100.0, None).grid is AMPLIFIERS_UNKNOWN
    image = ObservedImage(Path("night") / "a.fits", 0, "a")
    assert beside.of(image) == tmp_path / "a.fits"
    assert observed.Background(None, 100.0, None).of(image) is None
    with pytest.raises(InputError, match=r"a file named as the frame night/b\.fits"):
        beside.of(replace(image, path=Path("night") / "b.fits"))


HELD: Any = None


@pytest.mark.parametrize(
    ("cards", "found"),
    [
        ({"CONTRAST": 0.5, "CONTRSIG": 0.1}, (0.5, 0.1)),
        ({"CONTRAST": 0.0, "CONTRSIG": 0.0}, (0.0, 0.0)),
        ({"CONTRAST": 1.0, "CONTRSIG": 0.1}, (1.0, 0.1)),
        ({"CONTRAST": 0.5, "CONTRSIG": 0.0}, (0.5, 0.0)),
        ({"CONTRAST": 1.0, "CONTRSIG": 0.0}, HELD),
        ({"CONTRAST": 1.0}, HELD),
        ({"CONTRSIG": 1.0}, HELD),
        ({"CONTRAST": -0.1, "CONTRSIG": 0.1}, "refused"),
        ({"CONTRAST": 0.1, "CONTRSIG": -0.1}, "refused"),
        ({"CONTRAST": math.inf, "CONTRSIG": 0.1}, "refused"),
        ({"CONTRAST": 0.1, "CONTRSIG": math.inf}, "refused"),
        ({"CONTRAST": math.nan, "CONTRSIG": 0.1}, "refused"),
    ],
)
def test_the_contrast_that_a_map_states(cards: dict[str, float], found: Any) -> None:
    if found == "refused":
        with pytest.raises(InputError, match=r"^a map: CONTRAST"):
            sky.laboratory_contrast(cards, "a map")
    else:
        assert sky.laboratory_contrast(cards, "a map") == found


@pytest.mark.parametrize("overwrite", [True, False])
def test_a_file_that_is_to_be_written(overwrite: bool, tmp_path: Path) -> None:
    there, new = tmp_path / "there", tmp_path / "new"
    there.write_text("")
    output.refuse_used_file("--ecsv", new, overwrite)
    if overwrite:
        output.refuse_used_file("--ecsv", there, overwrite)
    else:
        with pytest.raises(InputError, match="a new file; --overwrite replaces it"):
            output.refuse_used_file("--ecsv", there, overwrite)
    with pytest.raises(InputError, match="not something else" if overwrite else "a new file"):
        output.refuse_used_file("--ecsv", tmp_path, overwrite)
    with pytest.raises(InputError, match="a folder that is there"):
        output.refuse_used_file("--ecsv", tmp_path / "nowhere" / "new", overwrite)


def test_names_of_set_ups_are_completed() -> None:
    """Those of the kind of the command; files where there is none of that beginning."""
    asked = click.Context(click.Command("x")), click.Option(["--setup"])
    for kind, wanted in (("monochromator", LABORATORY), ("sky", SKY)):
        names = [name for name in setup_names() if Setup.from_name(name).kind == kind]
        assert 0 < len(names) < len(setup_names())
        assert [item.value for item in wanted.shell_complete(*asked, "")] == names
        first = [name for name in names if name.startswith(names[0][:2])]
        assert [item.value for item in wanted.shell_complete(*asked, names[0][:2])] == first
        (item,) = wanted.shell_complete(*asked, "no_such")
        assert (item.value, item.type) == ("no_such", "file")


@pytest.mark.parametrize(
    ("limits", "top", "said"),
    [
        (
            [14.0, 14.04],
            30.0,
            "steps are below the Nyquist rate for layers thicker than 14.0 µm, by wavelength",
        ),
        ([14.0, 14.06], 14.01, "steps are below the Nyquist rate for layers thicker than 14.0 to 14.1 µm"),
        ([15.0, 14.0, 14.5], 14.0, "steps are above the Nyquist rate up to 14.0 to 15.0 µm"),
        ([], 30.0, ""),
    ],
)
def test_where_steps_are_too_wide(limits: list[float], top: float, said: str, capsys) -> None:
    plan_flats._print_nyquist(np.array(limits), (5.0, top))
    assert capsys.readouterr().out.startswith(said)


def test_a_key_that_is_stated_twice_is_named() -> None:
    assert provenance._each_key_once([("a", 1), ("b", 2)]) == {"a": 1, "b": 2}
    with pytest.raises(InputError, match="key is 'b'; allowed: a key once"):
        provenance._each_key_once([("a", 1), ("b", 2), ("c", 2), ("b", 3)])


@pytest.mark.parametrize(("text", "found"), [("", "empty"), ("[1]", "list"), ("word", "str")])
def test_settings_that_are_no_mapping(text: str, found: str, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(InputError, match=rf"a\.yaml: settings file is '{found}'"):
        read_settings(tmp_path / "a.yaml")


@pytest.mark.parametrize(
    ("words", "exposed", "level", "templates"),
    [
        (["--noiseless", "--templates"], (None, None), (0.0, None), True),
        (
            ["--exptime", "7s", "--seed", "5", "--flat-spectrum", "white", "--level", "model"],
            (7.0, None),
            None,
            False,
        ),
        (["--airmass", "1.5", "--night"], (None, 1.5), None, False),
    ],
)
def test_what_is_asked_of_a_simulation_of_the_sky(
    words: list[str], exposed: Any, level: Any, templates: bool, tmp_path: Path, monkeypatch, capsys
) -> None:
    """The simulation itself and the page are left out."""
    asked: dict[str, Any] = {}

    def keep(name: str, result: Any) -> Any:
        return lambda *parts, **more: asked.setdefault(name, (*parts, more)) and result

    monkeypatch.setattr(sky, "_response", keep("response", "response"))
    monkeypatch.setattr(sky, "_frames", keep("frames", (["frame"], [{}])))
    monkeypatch.setattr(sky, "_written", keep("written", ["frame"]))
    monkeypatch.setattr(sky, "_write_templates", keep("templates", None))
    monkeypatch.setattr(sky, "_said", lambda *parts: ["said"])
    monkeypatch.setattr("lsst.fringe_sim.algorithms.coadd_sources.NightResults.of", lambda *parts: None)
    monkeypatch.setattr("lsst.fringe_sim.report.sky_page.write_sky_report", keep("page", "page"))
    thickness = tmp_path / "map.fits"
    part = fits.Header({"DETSEC": "[101:124,201:220]"})
    fits.writeto(thickness, np.linspace(14.0, 15.0, 20 * 24).reshape(20, 24), part)
    setup = Setup.from_name("monocam")
    sensor = setup.sensor()
    command = ["sky", "--setup", "monocam", "--thickness", str(thickness), *words]
    number = 11 if "--night" in words else 1
    assert run([*command, "--out", str(tmp_path / "dry"), "--dry-run"]) == 0
    said = f"would simulate {number} frames of {sensor.name}, 24 x 20 pixels"
    assert capsys.readouterr().out.splitlines() == [said]
    out = tmp_path / "out"
    assert run([*command, "--out", str(out)]) == 0
    assert capsys.readouterr().out.splitlines() == ["said", str(out), "page"]
    exposure, common = asked["frames"][3:5]
    assert (exposure.exptime_s, exposure.airmass) == (exposed[0], exposed[1] or setup.airmass)
    assert (exposure.night is None, exposure.measured) == ("--night" not in words, "model" not in words)
    assert (common["read_noise_e"], common["seed"]) == (
        level or (sensor.read_noise, 5 if "--seed" in words else 1)
    )
    assert (common["detector"], common["physical_filter"]) == (sensor.name, setup.filter_name)
    stem, cards = asked["written"][2:4]
    assert stem == out / f"sky_{sensor.name}"
    assert cards["INPUT0"].startswith("map.fits ")
    assert cards["DETSEC"] == part["DETSEC"]
    assert cards.get("FLATSPEC") == ("white" if "white" in words else None)
    assert ("templates" in asked) is templates
    if templates:
        assert asked["templates"][3] == out / f"fringe_{sensor.name}"
    assert asked["page"][0] == out / "report.html"
    assert asked["page"][-1]["picture"] == out / "sky.png"
