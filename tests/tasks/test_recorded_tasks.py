"""What tasks make of small inputs, and the numbers that they report, as recorded."""

import dataclasses
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lsst.pex.config import FieldValidationError
from recorded_numbers import Record, Words

from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.mock.raw_frames import setup_optics
from lsst.fringe_sim.model import Setup
from lsst.fringe_sim.products import FringeFlat, SkyFringe, ThicknessMap
from lsst.fringe_sim.tasks import (
    EpoxyFitConfig,
    EpoxyFitTask,
    FringePcaConfig,
    FringePcaTask,
    MapTemplatesConfig,
    MapTemplatesTask,
    SkyFringeSimConfig,
    SkyFringeSimTask,
)
from lsst.fringe_sim.tasks.fringe_bias import FringeBiasConfig, FringeBiasConnections
from lsst.fringe_sim.tasks.fringe_forecast import (
    FringeForecastConfig,
    FringeForecastConnections,
    FringeForecastTask,
)
from lsst.fringe_sim.tasks.isr_flat_prep import IsrFlatPrepConfig, IsrFlatPrepConnections
from lsst.fringe_sim.tasks.map_templates import MapTemplatesConnections
from lsst.fringe_sim.tasks.sky_fringe_sim import SkyExposure, SkyFringeSimConnections

SENSOR = Camera.from_name("lsstCam").detector("R22_S11")
EXPOSURE = SkyExposure(7026112100660, 20261121, 23.0, 30.0, 1.2, "y_10")
MADE = "2026-11-21T03:43:40"


def reported(caplog: pytest.LogCaptureFixture) -> Words:
    """Numbers in what was reported, whatever the words."""
    said = " ".join(record.getMessage() for record in caplog.records)
    caplog.clear()
    return Words(re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.])", said))


def wedge(rows: int, columns: int, level: float = 14.0, slope: float = 3e-4) -> ThicknessMap:
    y, x = np.mgrid[:rows, :columns]
    zero = np.zeros(x.shape)
    mask = zero.astype(int)
    mask[0, :3], mask[5, 5] = 2, 1
    return ThicknessMap(
        level + slope * x + 0.7 * slope * y, zero + 1e-3, zero + 1.0, zero, mask, "adhesive", detector=SENSOR.name,
        metadata={"STANDSD": 3},
    )  # fmt: skip


def silicon_of(thickness: ThicknessMap) -> ThicknessMap:
    value = np.full(thickness.shape, 100.02)  # one thickness: a series of them takes its time
    mask = np.zeros(thickness.shape, int)
    mask[7, 7] = 2
    return dataclasses.replace(thickness, value=value, mask=mask, layer="detection", metadata={})


@pytest.mark.parametrize(
    "silicon",
    [
        pytest.param(False, id="even silicon", marks=pytest.mark.slow),
        pytest.param(True, id="silicon of a map"),
    ],
)
def test_frames_and_templates_are_as_recorded(
    silicon: bool, recorded: Record, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    thickness = wedge(12, 16, slope=0.02)
    layer = silicon_of(thickness) if silicon else None
    common = {"beams": "centre", "silicon": "map" if silicon else "even", "phase_sigma": 0.2}
    config = SkyFringeSimConfig(**common, night="random", seed=3, noise=True)
    frame = SkyFringeSimTask(config=config).run(thickness, EXPOSURE, SENSOR, layer).sky
    templates = MapTemplatesTask(config=MapTemplatesConfig(**common)).run(
        thickness, SENSOR, "y_10", MADE, layer
    )
    recorded({"frame": frame, "templates": templates.templates, "reported": reported(caplog)})


def test_the_forecast_of_a_sensor_and_a_frame_in_its_beams_are_as_recorded(
    recorded: Record, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    thickness = wedge(560, 572)
    config = FringeForecastConfig(nights=1, cells=2, apertures_arcsec=[1.0, 2.0], templates=1)
    config.validate()
    table = FringeForecastTask(config=config).run(thickness, SENSOR).forecast
    of_the_sky = SkyFringeSimConfig(phase_sigma=0.0, night="steady", noise=False)  # the same beams
    frame = SkyFringeSimTask(config=of_the_sky).run(thickness, EXPOSURE, SENSOR).sky
    stated = {key: value for key, value in table.meta.items() if not key.startswith(("VERSION", "TABLE"))}
    recorded({"table": table, "stated": stated, "frame": frame, "reported": reported(caplog)})


def test_a_map_of_a_part_is_forecast_in_the_place_of_that_part() -> None:
    task = FringeForecastTask(
        config=FringeForecastConfig(nights=1, cells=2, apertures_arcsec=[1.0], templates=1)
    )
    silent = wedge(560, 572)
    whole, part = (
        task.run(dataclasses.replace(silent, metadata={"DETSEC": section}), SENSOR).forecast
        for section in (f"[1:{SENSOR.shape[1]},1:{SENSOR.shape[0]}]", "[573:2,561:2]")
    )
    stated = task.run(silent, SENSOR).forecast  # nothing says that it is less than the sensor
    np.testing.assert_array_equal(stated["rms"], whole["rms"])
    pixel_mm = 1e-3 * SENSOR.pixel_um
    for name, size, centre, step, last in (
        ("x", SENSOR.shape[1], SENSOR.x_mm, 572, np.array([0, 1, 0, 1])),
        ("y", SENSOR.shape[0], SENSOR.y_mm, 560, np.array([0, 0, 1, 1])),
    ):
        for table, first, side in ((whole, 0.5, size), (part, step + 1.5, -step)):
            place = first + side * (0.5 * last + 0.25) - 0.5 - 0.5 * size
            np.testing.assert_allclose(table[name], centre + pixel_mm * place, atol=1e-9)
    # A cell of the part has 286 pixels on a side in the place of 2000: fewer fringes are averaged, others are seen.
    assert part.meta["field_radius"] > whole.meta["field_radius"]


def test_templates_of_a_night_are_as_recorded(recorded: Record, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    y, x = np.mgrid[:20, :30]
    mask = np.zeros(x.shape, int)
    mask[2, 3:9] = 2
    night = []
    for k in range(5):
        pattern = (1.0 + 0.3 * np.sin(k)) * 2e-3 * np.sin(x / 3.0) + 1e-4 * k * np.cos(y / 2.0)
        pattern = pattern + 2e-6 * k**2 * np.sin((x + y) / 2.0)
        metadata = {"SETUP": "lsst_e2v", "INTERR": 1e-6 * (k % 3), "CFGHASH": "a", "ONE": k == 0}
        if k == 1:
            metadata["OTHER"] = 3
        level = 2000.0 + 300.0 * k
        night.append(
            SkyFringe(
                (level * (1.0 + pattern - pattern[mask == 0].mean())).astype(np.float32), mask, "electron", level,
                30.0, 1.2, 20.0 + k, None, 1e-6 * (k % 4), detector="R22_S11", physical_filter="y_10",
                metadata=metadata,
            )
        )  # fmt: skip
    made = {
        name: FringePcaTask(config=FringePcaConfig(**config)).run(night, MADE)
        for name, config in {"usual": {}, "two": {"n_components": 2}, "strong": {"least_rms": 1e-5}}.items()
    }
    shown = {name: {"fringe": one.fringe, "components": one.components} for name, one in made.items()}
    recorded({**shown, "reported": reported(caplog)})


LAB = Camera.from_name("ts8").detector("RTM-020_S01")
CHOICES: dict[str, dict[str, Any]] = {
    "usual": {},
    "held": {"level_zones": "none", "contrast": "fixed", "illumination_degree": 0},
    "halves": {"level_zones": "halves", "contrast": "common", "illumination_degree": 1},
    "walk": {"method": "guo2022", "start_pixel": [9, 11], "range_um": [12.5, 14.5]},
    "wrong": {"level_zones": "sensor"},
    "few": {"range_um": [12.0, 14.5], "slip_limit": 1e-9, "min_wavelengths": 12},
}


@pytest.fixture(scope="module")
def flats() -> list[FringeFlat]:
    """Flats of a small wedge, from the other simulator, with noise."""
    setup, rng = Setup.from_name("ts8_e2v"), np.random.default_rng(5)
    y, x = np.mgrid[:24, :28]
    thickness = 13.0 + 0.02 * x + 0.01 * y + 0.02 * np.sin(x / 4.0)
    wavelengths = [float(nm) for nm in setup.wavelengths_nm if nm != 890.0]
    table = setup_optics("ts8_e2v")[0].table((12.9, 14.2), wavelengths)
    made = []
    for row, wavelength in enumerate(wavelengths):
        light = table.evaluate(row, thickness)
        image = light / light.mean() - 1.0 + 2e-3 * rng.standard_normal(light.shape)
        mask = np.zeros(light.shape, np.int32)
        mask[3, 4] = 2
        image -= image[mask == 0].mean()
        made.append(FringeFlat(
            image.astype(np.float32), np.full(light.shape, 4e-6, np.float32), mask, wavelength, 2.0, 183.15, 8e4,
            detector=LAB.name,
        ))  # fmt: skip
    return made


@pytest.mark.parametrize("name", CHOICES)
def test_fits_are_as_recorded(
    name: str, flats: list[FringeFlat], recorded: Record, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    config = CHOICES[name]
    if name == "wrong":
        flats = [
            *flats[:4],
            dataclasses.replace(flats[4], wavelength_nm=flats[4].wavelength_nm + 1.5),
            *flats[5:],
        ]
    if name == "few":
        flats = [*flats, dataclasses.replace(flats[0], wavelength_nm=flats[0].wavelength_nm + 5.0)]
    found = EpoxyFitTask(config=EpoxyFitConfig(**config)).run(iter(flats), len(flats), LAB)
    assert found.silicon is None
    recorded({"map": found.thickness, "reported": reported(caplog)})


class DataId(dict[str, str]):
    """A band, beside records of a sensor and an exposure."""

    records: dict[str, Any]


class Adjuster:
    """Quanta as a graph offers them, and which of them stay."""

    def __init__(self, *records: dict[str, Any]) -> None:
        self.offered = dict(enumerate(records))

    def iter_data_ids(self) -> list[int]:
        return list(self.offered)

    def expand_quantum_data_id(self, number: int) -> Any:
        given = self.offered[number]

        made = DataId(band=given["band"])
        made.records = {
            "detector": SimpleNamespace(purpose=given["purpose"]),
            "exposure": SimpleNamespace(observation_type=given["kind"]),
        }
        return made

    def remove_quantum(self, number: int) -> None:
        del self.offered[number]


@pytest.mark.parametrize(
    ("connections", "config", "kept"),
    [
        (SkyFringeSimConnections, SkyFringeSimConfig, [0]),
        (MapTemplatesConnections, MapTemplatesConfig, [0, 3]),
        (FringeForecastConnections, FringeForecastConfig, [0, 1, 3]),
    ],
)
def test_graphs_keep_science_sensors_in_the_band(connections: Any, config: Any, kept: list[int]) -> None:
    usual = {"band": "y", "purpose": "SCIENCE", "kind": "science"}
    adjuster = Adjuster(usual, usual | {"band": "i"}, usual | {"purpose": "GUIDER"}, usual | {"kind": "flat"})
    connections(config=config()).adjust_all_quanta(adjuster)
    assert list(adjuster.offered) == kept


def test_inputs_that_may_be_missing_do_not_limit_a_graph() -> None:
    for connections, config, name in (
        (SkyFringeSimConnections, SkyFringeSimConfig, "thickness"),
        (MapTemplatesConnections, MapTemplatesConfig, "thickness"),
        (FringeForecastConnections, FringeForecastConfig, "thickness"),
    ):
        for stand_in in (False, True):
            made = getattr(connections(config=config(stand_in=stand_in)), name)
            assert (made.minimum, made.deferGraphConstraint) == ((0, True) if stand_in else (1, False))
    for silicon in ("even", "map"):
        assert ("silicon" in MapTemplatesConnections(config=MapTemplatesConfig(silicon=silicon)).inputs) == (
            silicon == "map"
        )
    for connections, config, name in (
        (FringeBiasConnections, FringeBiasConfig, "raws"),
        (IsrFlatPrepConnections, IsrFlatPrepConfig, "raw"),
    ):
        for limits in (False, True):
            made = getattr(connections(config=config(raws_limit_graph=limits)), name)
            assert made.deferGraphConstraint is not limits


@pytest.mark.parametrize("change", [{"beams": "centre"}, {"setup": "monocam"}, {"apertures_arcsec": [0.5]}])
def test_a_forecast_needs_the_beams_of_a_traced_telescope_and_whole_apertures(change: dict[str, Any]) -> None:
    with pytest.raises(FieldValidationError):
        FringeForecastConfig(**change).validate()
