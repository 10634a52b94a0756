"""Set-ups: all shipped ones load, and a bad description is refused by the key at fault."""

import copy

import numpy as np
import pytest
import yaml

from lsst.fringe_sim.errors import FringeSimError, InputError, UnknownNameError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.model import Setup, setup_names
from lsst.fringe_sim.resources import read_yaml

CONTRACT = {"ts8_e2v", "bnl_ts8_e2v", "ts8_itl", "monocam", "hsc", "lsst_e2v", "lsst_itl"}


def test_the_set_ups_of_the_paper_are_there() -> None:
    assert set(setup_names()) >= CONTRACT


@pytest.mark.parametrize("name", setup_names())
def test_every_set_up_loads(name) -> None:
    setup = Setup.from_name(name)
    assert setup.name == name
    assert setup.source
    assert setup.varying in setup.stack.names
    offset, weight = setup.profile.nodes()
    assert weight.sum() == pytest.approx(1.0)
    assert offset @ weight == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("name", setup_names())
def test_every_set_up_names_a_detector_that_exists(name) -> None:
    setup = Setup.from_name(name)
    assert Camera.from_name(setup.camera).detector(setup.detector).name == setup.detector


def test_temperatures_are_those_of_the_instruments() -> None:
    kelvin = {name: Setup.from_name(name).temperature_k for name in CONTRACT}
    assert kelvin["ts8_e2v"] == pytest.approx(273.15 - 90.0)
    assert kelvin["monocam"] == pytest.approx(273.15 - 120.0)
    assert kelvin["hsc"] == kelvin["lsst_e2v"] == pytest.approx(273.15 - 100.0)


def test_near_miss_is_offered() -> None:
    with pytest.raises(UnknownNameError, match="did you mean ts8_e2v"):
        Setup.from_name("ts8-e2v")


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("temperature_k",), "cold", "temperature_k"),
        (("temperature_k",), 20.0, "100 to 400"),
        (("temperature_k",), True, "temperature_k"),
        (("stack",), "e2v", "did you mean e2v_ccd250"),
        (("varying",), "epoxy", "adhesive"),
        (("thickness_range_um",), [30.0, 5.0], "increasing"),
        (("thickness_range_um",), [5.0], "2 numbers"),
        (("illumination", "kind"), "lamp", "monochromator"),
        (("illumination", "bandwidth_fwhm_nm"), -2.0, "bandwidth_fwhm_nm"),
        (("illumination", "wavelengths_nm"), [], "wavelengths_nm"),
        (("illumination", "beam", "kind"), "colimated", "did you mean collimated"),
        (("illumination", "beam"), None, "illumination.beam"),
        (("title",), None, "title"),
    ],
)
def test_bad_descriptions_are_refused_by_key(path, value, words) -> None:
    content = copy.deepcopy(read_yaml("setups", "ts8_e2v.yaml"))
    target = content
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    with pytest.raises(FringeSimError, match=words):
        Setup.from_mapping("mine", content)


def test_missing_key_is_named() -> None:
    content = copy.deepcopy(read_yaml("setups", "lsst_e2v.yaml"))
    del content["illumination"]["airmass"]
    with pytest.raises(InputError, match=r"illumination\.airmass"):
        Setup.from_mapping("mine", content)


def test_users_may_bring_their_own_file(tmp_path) -> None:
    content = copy.deepcopy(read_yaml("setups", "ts8_e2v.yaml"))
    content["illumination"]["bandwidth_fwhm_nm"] = 0.5
    path = tmp_path / "narrow.yaml"
    path.write_text(yaml.safe_dump(content))
    setup = Setup.from_file(path)
    assert setup.name == "narrow"
    assert setup.bandwidth_fwhm_nm == 0.5


@pytest.mark.parametrize("text", ["[1, 2", "- a list", "", "!!python/object/apply:os.system ['true']"])
def test_other_files_are_refused_with_their_name(tmp_path, text) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"bad\.yaml"):
        Setup.from_file(path)


def test_cone_follows_the_sine_condition() -> None:
    beam = Setup.from_name("monocam").beam()
    assert beam.theta.max() < np.arcsin(1.0 / 8.0)
    assert beam.theta.max() > 0.99 * np.arcsin(1.0 / 8.0)
