"""Fringe correction: after flat-fielding, before background subtraction."""

from __future__ import annotations

import dataclasses
from typing import Any

from lsst.pex.config import ChoiceField, Field
from lsst.pipe import base
from lsst.pipe.base.connectionTypes import Input, Output, PrerequisiteInput

from ..algorithms.fringe_correction import CorrectionOptions
from ..algorithms.observed_frames import correct_frame, summary_table
from ..errors import InputError
from ..middleware.afw import observed_from_exposure, put_into_exposure
from ..products import FringeTemplates, ObservedFrame
from .observed_fringe import BackgroundConfig
from .quantum import SENSOR_EXPOSURE, SENSOR_FILTER, common_header, data_id_of, sensor_of, unusable


class FringeCorrectionConnections(base.PipelineTaskConnections, dimensions=SENSOR_EXPOSURE):
    """A frame and templates in, the corrected frame and its row of the table out."""

    config: FringeCorrectionConfig

    frame = Input(
        "post_isr_image",
        "ObservedFrame",
        "Frame after the removal of the instrument's signature, with its fringes.",
        dimensions=SENSOR_EXPOSURE,
    )
    templates = Input(
        "fringeTemplates",
        "FringeTemplates",
        "Fringe templates of the sensor in the filter of the frame.",
        dimensions=SENSOR_FILTER,
        isCalibration=True,
    )
    corrected = Output(
        "fringeCorrected", "ObservedFrame", "The frame without fringes.", dimensions=SENSOR_EXPOSURE
    )
    summary = Output(
        "fringeCorrectionSummary",
        "AstropyTable",
        "Scales, structure before and after, and whether the templates may be trusted; one row.",
        dimensions=SENSOR_EXPOSURE,
    )

    def __init__(self, *, config: FringeCorrectionConfig | None = None) -> None:
        if config is None:
            return
        self.frame, self.corrected = (
            dataclasses.replace(each, storageClass=config.frame_storage_class)
            for each in (self.frame, self.corrected)
        )
        if config.certified_templates:
            fields = ("doc", "name", "storageClass", "dimensions", "isCalibration")
            same = {name: getattr(self.templates, name) for name in fields}
            self.templates = PrerequisiteInput(**same)


class FringeCorrectionConfig(
    BackgroundConfig, base.PipelineTaskConfig, pipelineConnections=FringeCorrectionConnections
):
    """Configuration of `FringeCorrectionTask`."""

    certified_templates = Field[bool](
        default=False,
        doc="Whether the templates come from a calibration collection, by the time of the exposure; otherwise "
        "from the run in which they are made.",
    )
    frame_storage_class = ChoiceField[str](
        default="ObservedFrame",
        doc="Storage class of the frame, before and after.",
        allowed={
            "ObservedFrame": "readable with this package alone",
            "Exposure": "as the next task of Rubin's pipelines wants it; needs lsst.afw",
        },
    )
    pixel_arcsec = Field[float](
        default=0.2,
        doc="Size of a pixel [arcsec]: fringes are judged on scales up to 20 arcsec.",
        check=lambda value: value > 0.0,
    )


class FringeCorrectionTask(base.PipelineTask):
    """Subtract fringe templates from a frame, if their fringes are seen; refuse those that add structure."""

    ConfigClass = FringeCorrectionConfig
    config: FringeCorrectionConfig
    _DefaultName = "fringeCorrection"

    def runQuantum(self, butlerQC: base.QuantumContext, inputRefs: Any, outputRefs: Any) -> None:
        """Read, correct, store."""
        data_id = data_id_of(butlerQC)
        name = f"{sensor_of(data_id).name}, exposure {data_id['exposure']}"
        with unusable(name):
            result = self.run(butlerQC.get(inputRefs.frame), butlerQC.get(inputRefs.templates), name)
        butlerQC.put(result, outputRefs)

    def run(self, frame: Any, templates: FringeTemplates, name: str = "") -> base.Struct:
        """Correct one frame.

        Parameters
        ----------
        frame : `ObservedFrame` or ``lsst.afw.image.Exposure``
            Frame with its fringes. An exposure is changed in place.
        templates : `FringeTemplates`
            Templates of its sensor.
        name : `str`, optional
            Name of the frame in the table.

        Returns
        -------
        result : `~lsst.pipe.base.Struct`
            ``corrected``, of the type of ``frame``, and ``summary``, an `astropy.table.Table` with one row.

        Raises
        ------
        InputError
            A frame that was corrected already, or to which the templates add structure.
        UndeterminedError
            Its pixels do not decide the scales.
        """
        options = CorrectionOptions(self.config.background_px, self.config.grid)
        observed = frame if isinstance(frame, ObservedFrame) else observed_from_exposure(frame)
        made = correct_frame(observed, templates.frames(), options, pixel_arcsec=self.config.pixel_arcsec)
        if not made.proof.passed:
            allowed = f"what a good template gives (worst: {made.proof.worst})"
            raise InputError("probability of the correction", float(f"{made.proof.probability:.4g}"), allowed)
        if not made.proof.seen:
            self.log.warning("%s: left as it is: the fringes of the templates are not seen", name)
        if made.correction.of_own_templates:
            self.log.warning(
                "%s: the templates are made of this frame itself: its summary does not judge them", name
            )
        self.log.info(
            "%s: structure beyond the noise %.2f before, %.2f after",
            *(name, made.proof.structure_before, made.proof.structure_after),
        )
        metadata = {**made.frame.metadata, **common_header(self.config)}
        corrected = dataclasses.replace(made.frame, metadata=metadata)
        return base.Struct(
            corrected=corrected if observed is frame else put_into_exposure(frame, corrected),
            summary=summary_table([made.record(name)]),
        )
