"""What a task makes of one quantum: what it takes from the record of the exposure, and which maps it asks for."""

from __future__ import annotations

import hashlib
import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lsst.pipe import base

from lsst.fringe_sim.errors import OutOfRangeError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.night import NightHistory
from lsst.fringe_sim.model import Setup
from lsst.fringe_sim.tasks import (
    EpoxyFitConfig,
    EpoxyFitTask,
    SkyFringeSimConfig,
    SkyFringeSimTask,
    epoxy_fit,
    sky_fringe_sim,
)
from lsst.fringe_sim.tasks.epoxy_fit import EpoxyFitConnections
from lsst.fringe_sim.tasks.fringe_bias import FringeBiasConfig, FringeBiasConnections
from lsst.fringe_sim.tasks.isr_flat_prep import IsrFlatPrepConfig, IsrFlatPrepConnections
from lsst.fringe_sim.tasks.quantum import config_digest, data_id_of, flats_input

DETECTOR = Camera.from_name("lsstCam").detector("R22_S11")
SETUP = Setup.from_name("lsst_e2v")


class DataId(dict[str, Any]):
    records: dict[str, Any]


@pytest.mark.parametrize(("zenith_angle", "airmass"), [(None, SETUP.airmass), (60.0, 2.0), (0.0, 1.0)])
def test_an_exposure_has_the_airmass_of_its_record(
    zenith_angle: float | None, airmass: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(sky_fringe_sim, "sensor_of", lambda data_id: DETECTOR)
    monkeypatch.setattr(sky_fringe_sim, "hour_of_night", lambda record: 23.5)
    monkeypatch.setattr(SkyFringeSimTask, "run", lambda self, *given: asked.append(given) or "result")
    data_id = DataId(physical_filter="y_10")
    record = SimpleNamespace(id=7, day_obs=20261121, exposure_time=15.0, zenith_angle=zenith_angle)
    data_id.records = {"exposure": record}
    put: list[Any] = []
    context: Any = SimpleNamespace(
        quantum=SimpleNamespace(dataId=data_id),
        get=lambda ref: f"map of {ref}",
        put=lambda *each: put.append(each),
    )
    task = SkyFringeSimTask(config=SkyFringeSimConfig())
    task.runQuantum(context, SimpleNamespace(thickness="ref"), "references")
    ((thickness, exposure, detector, silicon),) = asked
    assert (thickness, silicon, detector) == ("map of ref", None, DETECTOR)
    assert exposure.airmass == pytest.approx(airmass)
    assert (exposure.exposure_id, exposure.day_obs, exposure.hour) == (7, 20261121, 23.5)
    assert (exposure.exposure_s, exposure.physical_filter) == (15.0, "y_10")
    assert put == [("result", "references")]


def test_a_stand_in_has_the_shape_that_is_asked_for() -> None:
    config = SkyFringeSimConfig(stand_in=True, stand_in_shape=[20, 24])
    made = config.map_of(None, DETECTOR)
    assert made.value.shape == (20, 24)
    again = SkyFringeSimConfig(stand_in=True, stand_in_shape=[20, 24]).map_of(None, DETECTOR)
    np.testing.assert_array_equal(again.value, made.value)
    other = SkyFringeSimConfig(stand_in=True, stand_in_shape=[20, 24], stand_in_seed=9).map_of(None, DETECTOR)
    assert np.any(other.value != made.value)


def test_flats_of_a_monochromator_in_the_range_stay_in_a_graph() -> None:
    """White light, other exposures, and wavelengths beyond either end are left out; the ends are in."""
    targets = [
        "0960.030 nm",
        "950.0 nm",
        "949.99 nm",
        " 970.0 nm ",
        "970.01 nm",
        "white",
        "",
        None,
        "0960 um",
    ]
    offered = dict(enumerate([*(("flat", target) for target in targets), ("bias", "0960.030 nm")]))

    class Adjuster:
        def iter_data_ids(self) -> list[int]:
            return list(offered)

        def expand_quantum_data_id(self, number: int) -> Any:
            kind, target = offered[number]
            record = SimpleNamespace(observation_type=kind, target_name=target)
            return SimpleNamespace(records={"exposure": record})

        def remove_quantum(self, number: int) -> None:
            del offered[number]

    config = IsrFlatPrepConfig(min_wavelength_nm=950.0, max_wavelength_nm=970.0)
    adjuster: Any = Adjuster()
    IsrFlatPrepConnections(config=config).adjust_all_quanta(adjuster)
    assert list(offered) == [0, 1, 3]


def test_a_configuration_is_known_by_its_values() -> None:
    config = SkyFringeSimConfig(seed=3)
    text = json.dumps(config.toDict(), sort_keys=True, default=str)
    assert config_digest(config) == hashlib.sha256(text.encode()).hexdigest()[:16]
    assert config_digest(config) != config_digest(SkyFringeSimConfig(seed=4))


@pytest.mark.parametrize(("hour", "row"), [(0.0, 0), (-9e-7, 0), (5.0, 5), (10.0, 10), (10.0 + 9e-7, 10)])
def test_both_ends_of_a_night_are_in_it(hour: float, row: int) -> None:
    """The middle of an exposure is known to rounding only."""
    night = NightHistory.guo2022()
    (levels,) = sky_fringe_sim._at_hour(night, hour).intensity
    np.testing.assert_allclose(levels, night.intensity[row], rtol=1e-5)
    with pytest.raises(OutOfRangeError):
        sky_fringe_sim._at_hour(night, -1.1e-6)
    with pytest.raises(OutOfRangeError):
        sky_fringe_sim._at_hour(night, 10.0 + 1.1e-6)


class Exposed(dict[str, int]):
    """Data id of an exposure with its record."""

    def __init__(self, number: int, kind: str, target: str | None = None) -> None:
        super().__init__(exposure=number)
        record = SimpleNamespace(id=number, observation_type=kind, target_name=target)
        self.records = {"exposure": record}


def refs(*data_ids: Exposed) -> list[Any]:
    return [SimpleNamespace(dataId=data_id) for data_id in data_ids]


@pytest.fixture
def only_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the parent class of all connections checks needs real datasets."""
    monkeypatch.setattr(base.PipelineTaskConnections, "adjustQuantum", lambda self, *given: ({}, {}))


@pytest.mark.usefixtures("only_own")
def test_a_bias_is_made_of_the_biases_in_their_order() -> None:
    connections = FringeBiasConnections(config=FringeBiasConfig())
    offered = refs(Exposed(3, "bias"), Exposed(1, "flat"), Exposed(2, "bias"))
    inputs: dict[str, Any] = {"raws": ("connection", offered)}
    changed, outputs = connections.adjustQuantum(inputs, {}, "bias", None)
    assert changed == inputs == {"raws": ("connection", [offered[2], offered[0]])}
    assert outputs == {}
    for none in (offered[1:2], []):
        with pytest.raises(base.NoWorkFound):
            connections.adjustQuantum({"raws": (connections.raws, none)}, {}, "bias", None)


@pytest.mark.usefixtures("only_own")
def test_a_fit_has_its_flats_in_the_order_of_their_wavelengths() -> None:
    """Those without one come first, and those of one wavelength by their number."""
    connections = EpoxyFitConnections(config=EpoxyFitConfig())
    targets = ["0990.000 nm", "0880.000 nm", None, "0880.000 nm"]
    offered = refs(*(Exposed(9 - number, "flat", target) for number, target in enumerate(targets)))
    inputs: dict[str, Any] = {"flats": ("connection", offered)}
    changed, _ = connections.adjustQuantum(inputs, {}, "fit", None)
    assert changed == inputs == {"flats": ("connection", [offered[number] for number in (2, 3, 1, 0)])}


@pytest.mark.parametrize("silicon", ["fixed", "sensor"])
def test_silicon_is_stored_where_it_is_fitted(silicon: str) -> None:
    assert ("silicon" in EpoxyFitConnections(config=EpoxyFitConfig(silicon=silicon)).outputs) == (
        silicon == "sensor"
    )


@pytest.mark.parametrize("both", [True, False])
def test_a_fit_stores_the_silicon_if_there_is_one(both: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Flats are read when the fit asks for them."""
    read: list[Any] = []
    monkeypatch.setattr(epoxy_fit, "sensor_of", lambda data_id: DETECTOR)

    def run(self: Any, flats: Any, number: int, detector: Any) -> Any:
        assert (number, read) == (2, [])
        assert list(flats) == ["flat of a", "flat of b"]
        return SimpleNamespace(thickness="thickness", silicon="silicon" if both else None)

    monkeypatch.setattr(EpoxyFitTask, "run", run)

    def get(ref: str) -> Any:
        return SimpleNamespace(get=lambda: read.append(ref) or f"flat of {ref}")

    put: list[Any] = []
    context: Any = SimpleNamespace(
        quantum=SimpleNamespace(dataId="id"), get=get, put=lambda *each: put.append(each)
    )
    outputs = SimpleNamespace(thickness="t", silicon="s")
    EpoxyFitTask(config=EpoxyFitConfig()).runQuantum(context, SimpleNamespace(flats=["a", "b"]), outputs)
    assert put == [("thickness", "t"), *([("silicon", "s")] if both else [])]
    assert read == ["a", "b"]


def test_flats_are_many_and_read_one_by_one() -> None:
    made = flats_input()
    assert (made.multiple, made.deferLoad) == (True, True)
    assert data_id_of(SimpleNamespace(quantum=SimpleNamespace(dataId="id"))) == "id"
    with pytest.raises(AssertionError, match="data id"):
        data_id_of(SimpleNamespace(quantum=SimpleNamespace(dataId=None)))
