"""Certified templates meet the exposures of the time for which they are valid."""

import datetime

import pytest
from astropy.time import Time
from lsst.daf.butler import Butler, CollectionType, DatasetType, Timespan
from lsst.pipe.base import Pipeline
from lsst.pipe.base.all_dimensions_quantum_graph_builder import AllDimensionsQuantumGraphBuilder
from product_makers import MAKERS

from lsst.fringe_sim.middleware.night import NightPlan, define_night

pytestmark = pytest.mark.middleware

SENSOR = {"instrument": "LSSTCam", "detector": 94}
PIPELINE = "resource://lsst.fringe_sim/pipelines/lsstCam/fringeCorrection.yaml#correction"
FRAMES, TEMPLATES, CALIB = "u/isr", "u/templates", "LSSTCam/calib/fringeTemplates"


@pytest.fixture
def night(butler: Butler) -> dict[int, int]:
    """A frame in each of two years, by year; the templates are valid in the first."""
    days = [datetime.date(year, 1, 15) for year in (2026, 2027)]
    exposures = define_night(butler, "LSSTCam", [NightPlan(day, (23.0,)) for day in days])
    for run in (FRAMES, TEMPLATES):
        butler.collections.register(run)
    types = {
        "ObservedFrame": ("post_isr_image", ("instrument", "exposure", "detector")),
        "FringeTemplates": ("fringeTemplates", ("instrument", "physical_filter", "detector")),
    }
    kinds = {}
    for product, (name, dimensions) in types.items():
        calibration = product == "FringeTemplates"
        kinds[product] = DatasetType(
            name, dimensions, product, universe=butler.dimensions, isCalibration=calibration
        )
        butler.registry.registerDatasetType(kinds[product])
    for record in exposures:
        butler.put(
            MAKERS["ObservedFrame"](), kinds["ObservedFrame"], SENSOR, exposure=record["id"], run=FRAMES
        )
    made = butler.put(
        MAKERS["FringeTemplates"](), kinds["FringeTemplates"], SENSOR, physical_filter="y_10", run=TEMPLATES
    )
    begin, end = (Time(f"{year}-01-01T00:00:00", scale="tai") for year in (2026, 2027))
    butler.registry.registerCollection(CALIB, type=CollectionType.CALIBRATION)
    butler.registry.certify(CALIB, [made], Timespan(begin, end))
    return {day.year: record["id"] for day, record in zip(days, exposures, strict=True)}


def quanta(butler: Butler, exposure: int) -> int:
    pipeline = Pipeline.from_uri(PIPELINE)
    pipeline.addConfigOverride("fringeCorrection", "certified_templates", True)
    builder = AllDimensionsQuantumGraphBuilder(
        pipeline.to_graph(),
        butler,
        where=f"instrument = 'LSSTCam' AND exposure = {exposure}",
        input_collections=[FRAMES, CALIB],
        output_run="u/clean",
    )
    return len(builder.build(attach_datastore_records=False))


@pytest.mark.slow
def test_templates_are_found_by_the_time_of_the_exposure(butler: Butler, night: dict[int, int]) -> None:
    assert quanta(butler, night[2026]) == 1
    with pytest.raises(FileNotFoundError, match="fringeTemplates"):
        quanta(butler, night[2027])
