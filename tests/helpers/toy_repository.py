"""A small repository for the tests of the middleware: two sensors, one task."""

from collections.abc import Callable, Iterable
from pathlib import Path

import click.testing
from lsst.daf.butler import Butler, DatasetType
from product_makers import MAKERS
from raw_frame_maker import write_raw

from lsst.fringe_sim.middleware.raw_ingest import ingest_raws

Invoke = Callable[..., click.testing.Result]

PIPELINE = Path(__file__).with_name("toy_pipeline.yaml")
SENSORS = ("E2V-CCD250-319", "E2V-CCD250-321")


def fill(repo: Path, folder: Path) -> None:
    """Ingest one raw frame of each sensor."""
    folder.mkdir()
    for serial in SENSORS:
        write_raw(folder / f"{serial}.fits", {"LSST_NUM": serial})
    with Butler.from_config(str(repo), writeable=True) as butler:
        assert ingest_raws(butler, [str(folder)]).refused == ()


def put_fringe(butler: Butler, run: str, detectors: Iterable[int]) -> None:
    """A fringe frame of each detector of the LSST Camera, in a run of a writeable repository."""
    kind = DatasetType(
        "fringe",
        ("instrument", "physical_filter", "detector"),
        "FringeFrame",
        universe=butler.dimensions,
        isCalibration=True,
    )
    butler.registry.registerDatasetType(kind)
    butler.collections.register(run)
    for detector in detectors:
        frame = MAKERS["FringeFrame"](detector=f"det{detector}")
        butler.put(frame, kind, instrument="LSSTCam", physical_filter="y_10", detector=detector, run=run)
