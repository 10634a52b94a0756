import shutil
from pathlib import Path

import numpy as np
import pytest
from lsst.pex.config import FieldValidationError

from lsst.fringe_sim.effects import EFFECTS, Effect
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.model.effects_override import effects_override
from lsst.fringe_sim.tasks import (
    EpoxyFitConfig,
    FringeModelConfig,
    IsrFlatPrepConfig,
    RaftConfig,
    SensorConfig,
)
from lsst.fringe_sim.tasks.model_config import ModelChoice

OWN = Path(__file__).resolve().parents[2] / "doc" / "tutorials" / "own_sensor"


def config(setup: str = "ts8_e2v", **effects: float) -> FringeModelConfig:
    made = FringeModelConfig(setup=setup)
    for name, value in effects.items():
        made.effects[name.replace("__", ".")] = value
    return made


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_an_effect_of_the_laboratory_stays_there(effect: Effect) -> None:
    parameter = effect.parameters[0]
    settings = {f"{effect.name}.{parameter.name}": parameter.bounds[1]}
    assert ModelChoice("ts8_e2v", settings).applied_effects == settings
    assert ModelChoice("lsst_e2v", settings).applied_effects == ({} if effect.laboratory_only else settings)


def test_the_laboratory_gets_every_effect_the_sky_those_of_the_sensor() -> None:
    effects = {
        "bandwidth.fwhm": 2.4,
        "temperature.kelvin": 186.0,
        "epoxy_absorption.k": 1e-4,
        "contrast_loss.factor": 0.5,
    }
    in_laboratory, on_sky = ModelChoice("ts8_e2v", effects), ModelChoice("lsst_e2v", effects)
    assert in_laboratory.applied_effects == effects
    assert in_laboratory.left_out == ()
    assert on_sky.applied_effects == {"epoxy_absorption.k": 1e-4, "contrast_loss.factor": 0.5}
    assert on_sky.left_out == ("bandwidth.fwhm", "temperature.kelvin")


def test_the_model_is_that_of_set_up_and_effects() -> None:
    choice = ModelChoice("ts8_e2v", {"bandwidth.fwhm": 3.0})
    expected = FringeModel.from_setup("ts8_e2v", {"bandwidth": {"fwhm": 3.0}})
    thickness = np.linspace(10, 11, 7)
    np.testing.assert_array_equal(
        choice.model().response(thickness, [960.0]), expected.response(thickness, [960.0])
    )


def test_a_raft_adds_to_and_wins_over_the_task() -> None:
    made = config(bandwidth__fwhm=2.4, epoxy_index__offset=0.0)
    made.rafts["R11"] = RaftConfig(setup="bnl_ts8_e2v")
    made.rafts["R11"].effects["bandwidth.fwhm"] = 0.7
    assert made.choice("R01") == ModelChoice("ts8_e2v", {"bandwidth.fwhm": 2.4, "epoxy_index.offset": 0.0})
    assert made.choice("R11") == ModelChoice(
        "bnl_ts8_e2v", {"bandwidth.fwhm": 0.7, "epoxy_index.offset": 0.0}
    )


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda c: setattr(c, "setup", "ts8_e2w"), "did you mean ts8_e2v"),
        (lambda c: c.effects.update({"bandwith.fwhm": 2.0}), "did you mean bandwidth"),
        (lambda c: c.effects.update({"bandwidth.fwmh": 2.0}), "did you mean fwhm"),
        (lambda c: c.effects.update({"bandwidth.fwhm": -2.0}), "bandwidth.fwhm"),
        (lambda c: c.effects.update({"bandwidth": 2.0}), "name.parameter"),
        (lambda c: c.rafts.update({"R11": RaftConfig(setup="nowhere")}), "raft R11"),
        (lambda c: c.rafts.update({"R1": RaftConfig()}), "raft is 'R1'; allowed: did you mean R"),
        (lambda c: c.rafts.update({"RTM-20": RaftConfig()}), "did you mean RTM-020"),
        (
            lambda c: c.sensors.update({"R11_S1": SensorConfig()}),
            "detector is 'R11_S1'; allowed: did you mean",
        ),
        (
            lambda c: c.sensors.update({"R11_S01": SensorConfig(effects={"tilt": 1})}),
            "sensor R11_S01: .*tilt",
        ),
        (lambda c: setattr(c, "camera", "lsstcam"), "did you mean lsstCam"),
    ],
)
def test_a_wrong_name_or_value_is_found_before_anything_runs(spoil, message: str) -> None:  # type: ignore[no-untyped-def]
    made = config()
    spoil(made)
    with pytest.raises(FieldValidationError, match=message):
        made.validate()


def test_names_are_those_of_the_camera_of_the_pipeline() -> None:
    for camera, raft, other in (("lsstCam", "R11", "RTM-020"), ("ts8", "RTM-020", "R11")):
        for kind, field in ((EpoxyFitConfig, "rafts"), (IsrFlatPrepConfig, "raft_setups")):
            made = kind(camera=camera)
            getattr(made, field)[raft] = RaftConfig() if field == "rafts" else "ts8_e2v"
            made.validate()
            getattr(made, field)[other] = RaftConfig() if field == "rafts" else "ts8_e2v"
            with pytest.raises(
                FieldValidationError, match=f"{camera}: raft is '{other}'; allowed: {raft}, its name"
            ):
                made.validate()


def test_a_sensor_wins_over_its_raft_and_the_raft_over_the_task() -> None:
    made = config(bandwidth__fwhm=2.4)
    made.rafts["R11"] = RaftConfig(setup="bnl_ts8_e2v", effects={"bandwidth.fwhm": 0.7, "tilt.deg": 1.0})
    made.sensors["R11_S01"] = SensorConfig(effects={"bandwidth.fwhm": 0.9})
    camera = Camera.from_name("lsstCam")
    assert made.choice_of(camera.detector("R11_S01")) == ModelChoice(
        "bnl_ts8_e2v", {"bandwidth.fwhm": 0.9, "tilt.deg": 1.0}
    )
    assert made.choice_of(camera.detector("R11_S02")) == made.choice("R11")
    assert made.choice_of(camera.detector("R22_S01")) == made.choice()


def test_agreements_look_at_every_sensor() -> None:
    lab, sky = config("ts8_e2v", bandwidth__fwhm=2.4), config("lsst_e2v", bandwidth__fwhm=2.4)
    lab.sensors["R11_S01"] = SensorConfig(effects={"bandwidth.fwhm": 2.4})
    assert lab.effects_by_raft == sky.effects_by_raft
    lab.rafts["R11"] = RaftConfig(effects={"bandwidth.fwhm": 2.5})
    sky.rafts["R11"] = RaftConfig(effects={"bandwidth.fwhm": 2.5})
    assert lab.effects_by_raft != sky.effects_by_raft
    sky.sensors["R11_S01"] = SensorConfig(effects={"bandwidth.fwhm": 2.4})
    assert lab.effects_by_raft == sky.effects_by_raft


def test_header_says_what_was_modelled() -> None:
    made = config(bandwidth__fwhm=2.4)
    header = made.choice().header()
    tables = [value for key, value in header.items() if key.startswith("TABLE")]
    rest = {key: value for key, value in header.items() if not key.startswith("TABLE")}
    assert rest == {"SETUP": "ts8_e2v", "EFFECT0": "bandwidth.fwhm", "EFFVAL0": 2.4}
    assert [table.split()[0] for table in tables[:2]] == ["setups/ts8_e2v.yaml", "stacks/e2v_ccd250.yaml"]


def test_agreements_look_at_every_raft() -> None:
    lab, sky = config("ts8_e2v", bandwidth__fwhm=2.4), config("lsst_e2v", bandwidth__fwhm=2.4)
    assert lab.effects_by_raft == sky.effects_by_raft
    assert lab.sensor_by_raft == sky.sensor_by_raft
    sky.rafts["R01"] = RaftConfig(setup="lsst_itl")
    assert lab.effects_by_raft == sky.effects_by_raft
    assert lab.sensor_by_raft != sky.sensor_by_raft
    lab.rafts["R01"] = RaftConfig(setup="ts8_itl")
    assert lab.sensor_by_raft == sky.sensor_by_raft
    lab.rafts["R11"] = RaftConfig()
    lab.rafts["R11"].effects["bandwidth.fwhm"] = 2.5
    assert lab.effects_by_raft != sky.effects_by_raft


def test_flats_are_prepared_in_the_set_up_in_which_they_are_fitted() -> None:
    fit, flats = EpoxyFitConfig(), IsrFlatPrepConfig()
    assert fit.setup_by_raft == flats.setup_by_raft
    fit.rafts["R01"] = RaftConfig(setup="ts8_itl")
    assert fit.setup_by_raft != flats.setup_by_raft
    flats.raft_setups["R01"] = "ts8_itl"
    flats.raft_setups["R02"] = "ts8_e2v"
    assert fit.setup_by_raft == flats.setup_by_raft


def test_flats_need_a_monochromator() -> None:
    made = IsrFlatPrepConfig(setup="lsst_e2v")
    with pytest.raises(FieldValidationError, match="no monochromator"):
        made.validate()
    made = IsrFlatPrepConfig()
    made.raft_setups["R01"] = "tsb8_itl"
    with pytest.raises(FieldValidationError, match="did you mean"):
        made.validate()


def test_choices_of_the_preparation_are_checked_with_the_field_named() -> None:
    made = IsrFlatPrepConfig(clip_sigma=0.5)
    with pytest.raises(FieldValidationError, match=r"clip_sigma is 0\.5"):
        made.validate()


@pytest.mark.parametrize(("field", "name"), [("rafts", "RTM-020"), ("sensors", "R11_S01")])
def test_an_entry_that_is_not_there_is_said(field: str, name: str) -> None:
    made = config()
    with pytest.raises(InputError, match=f"{name}.*none yet.*Config"):
        getattr(made, field)[name]
    assert name not in getattr(made, field)
    assert getattr(made, field).get(name) is None


FOUND = {"bandwidth.fwhm": 2.4, "roughness.sigma": 25.0, "contrast_loss.factor": 0.5}


def apply_override(tmp_path: Path, text: str) -> FringeModelConfig:
    """As ``pipetask -C`` does: the file is executed, then the configuration is validated."""
    path = tmp_path / "effects.py"
    path.write_text(text)
    made = FringeModelConfig()
    made.load(str(path))
    made.validate()
    return made


def test_an_override_of_a_search_is_taken_whole(tmp_path: Path) -> None:
    text = effects_override(FOUND, "ts8_e2v", "named", known={"temperature.kelvin": 175.0})
    made = apply_override(tmp_path, text)
    assert dict(made.effects) == {"temperature.kelvin": 175.0, **FOUND}
    made.effects["epoxy_index.offset"] = 0.01
    made.validate()
    made.effects["roughness.sigma"] = 30.0
    with pytest.raises(FieldValidationError, match="written_effects"):
        made.validate()
    made.written_effects = ""
    made.validate()


@pytest.mark.slow
def test_an_override_that_was_cut_short_is_refused(tmp_path: Path) -> None:
    """At every byte. One that ends before the first statement does says nothing at all, and cannot be told."""
    text = effects_override(FOUND, "ts8_e2v", "named", known={"temperature.kelvin": 175.0})
    statement = text.index(" = ")
    accepted = []
    for length in range(len(text.rstrip().rpartition("\n")[0])):
        try:
            made = apply_override(tmp_path, text[:length])
        except (FieldValidationError, SyntaxError, NameError, LookupError, AttributeError):
            continue
        if dict(made.effects) != {"temperature.kelvin": 175.0, **FOUND}:
            accepted.append(length)
    assert accepted == [0, len("config"), statement, statement + 1]


@pytest.mark.parametrize(
    "change", [("2.4", "2.5"), ("roughness.sigma'] =", "roughness.kind'] ="), ("25.0", "2")]
)
def test_an_override_that_was_changed_is_refused(tmp_path: Path, change: tuple[str, str]) -> None:
    text = effects_override(FOUND, "ts8_e2v", "named")
    assert change[0] in text
    with pytest.raises(FieldValidationError, match="written_effects"):
        apply_override(tmp_path, text.replace(*change))


def test_a_set_up_may_be_a_file(tmp_path: Path) -> None:
    shutil.copytree(OWN / "ccd290", tmp_path / "own")
    config = EpoxyFitConfig()
    config.setup = str(tmp_path / "own" / "flats.yaml")
    config.validate()
    assert config.choice().model().setup.sensor().serial == "CCD290-01"
    config.setup = str(tmp_path / "own" / "nothing.yaml")
    with pytest.raises(FieldValidationError, match=r"nothing\.yaml"):
        config.validate()
