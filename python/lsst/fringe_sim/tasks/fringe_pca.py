"""From the sky frames of a sensor to the template that removes its fringes."""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Sequence
from typing import Any

import numpy as np

from lsst.pex.config import ChoiceField, Field
from lsst.pipe import base
from lsst.pipe.base.connectionTypes import Input, Output

from ..algorithms.pca import fit_pca, fringe_templates
from ..products import FringeComponents, SkyFringe
from ..products.same_light import refuse_equal_pixels, refuse_mixed_models
from .quantum import (
    SENSOR_EXPOSURE,
    SENSOR_FILTER,
    OrderedConnections,
    by_exposure,
    common_header,
    data_id_of,
    run_datetime,
    sensor_of,
    unusable,
)


class FringePcaConnections(OrderedConnections, dimensions=SENSOR_FILTER):
    """The sky frames of a sensor in a filter in, one template and all components out."""

    frames = Input(
        "skyFringe",
        "SkyFringe",
        "Sky frames of the sensor in this filter.",
        dimensions=SENSOR_EXPOSURE,
        multiple=True,
        minimum=2,  # one alone has no components
    )
    ORDERED = ("frames", by_exposure)
    fringe = Output(
        "fringe",
        "FringeFrame",
        "Zero-mean fractional fringe frame, which instrument signature removal subtracts.",
        dimensions=SENSOR_FILTER,
        isCalibration=True,
    )
    components = Output(
        "fringeComponents",
        "FringeComponents",
        "Mean and principal components of the frames.",
        dimensions=SENSOR_FILTER,
    )

    def __init__(self, *, config: FringePcaConfig | None = None) -> None:
        if config is not None:
            self.fringe = dataclasses.replace(self.fringe, storageClass=config.fringeStorageClass)


class FringePcaConfig(base.PipelineTaskConfig, pipelineConnections=FringePcaConnections):
    """Configuration of `FringePcaTask`."""

    n_components = Field[int](
        optional=True,
        doc="Number of components to keep; by default those above the noise and above least_rms.",
    )
    least_rms = Field[float](
        default=1e-5,
        doc="A component is left out if it adds less than this to a typical frame, as a fraction of the sky. The "
        "photon noise of an LSST y exposure averaged over 20 arcsec is 2e-4.",
        check=lambda value: value >= 0,
    )
    fringeStorageClass = ChoiceField[str](
        default="FringeFrame",
        doc="Storage class of the template; the file is the same.",
        allowed={
            "FringeFrame": "readable with this package alone",
            "ExposureF": "as ip_isr asks for it; for repositories in which 'fringe' is registered so",
        },
    )


class FringePcaTask(base.PipelineTask):
    """Decompose the sky frames of a sensor and make the fringe template."""

    ConfigClass = FringePcaConfig
    config: FringePcaConfig
    _DefaultName = "fringePca"

    def runQuantum(self, butlerQC: base.QuantumContext, inputRefs: Any, outputRefs: Any) -> None:
        """Read the frames, decompose, store."""
        data_id = data_id_of(butlerQC)
        detector = sensor_of(data_id)
        created = run_datetime(outputRefs.fringe.run, _end_of(inputRefs.frames))
        with unusable(f"{detector.name}, {data_id['physical_filter']}"):
            result = self.run(butlerQC.get(inputRefs.frames), created)
        butlerQC.put(result, outputRefs)

    def run(self, frames: Sequence[SkyFringe], creation_datetime: str) -> base.Struct:
        """Decompose the frames of one sensor in one filter.

        Parameters
        ----------
        frames : sequence of `SkyFringe`
            Two frames or more.
        creation_datetime : `str`
            When the calibration is made, ``YYYY-MM-DDThh:mm:ss``.

        Returns
        -------
        result : `~lsst.pipe.base.Struct`
            ``fringe``, the mean pattern as a `FringeFrame`, and ``components``, `FringeComponents`.

        Raises
        ------
        InputError
            Too few frames, frames of different sensors, sizes or models, one frame twice, or all alike.
        """
        first = frames[0]
        refuse_mixed_models([frame.metadata for frame in frames])
        # Without noise, equal hours of two nights are equal.
        refuse_equal_pixels("sky frames", [frame.image for frame in frames if frame.seed is not None])
        shared = _shared_metadata(frames)
        metadata = {**shared, **common_header(self.config), **_numerical_errors(frames)}
        if "CFGHASH" in shared:
            metadata["SKYCFG"] = shared["CFGHASH"]
        components = fit_pca(
            frames,
            n_components=self.config.n_components,
            metadata=metadata,
            detector=first.detector,
            physical_filter=first.physical_filter,
        )
        # The first template is the mean pattern; no component enters it.
        (template,) = fringe_templates(_first(components, 1), creation_datetime, most=1, metadata=metadata)
        if self.config.n_components is None:
            components = _above(components, self.config.least_rms)
        self.log.info(
            "%s in %s: %d frames, components explain %s",
            *(first.detector, first.physical_filter, len(frames)),
            ", ".join(f"{100 * share:.2f} %" for share in components.explained_variance_ratio),
        )
        return base.Struct(fringe=template, components=components)


def _end_of(refs: Sequence[Any]) -> datetime.datetime:
    """End of the last exposure."""
    ends = [ref.dataId.records["exposure"].timespan.end for ref in refs]
    last: datetime.datetime = max(ends).utc.to_datetime()
    return last


def _above(components: FringeComponents, least_rms: float) -> FringeComponents:
    """Components that add at least ``least_rms`` to a typical frame, and the first one in any case."""
    pixels = int(np.count_nonzero(components.mask == 0))
    rms = np.sqrt(components.explained_variance / pixels)
    return _first(components, max(1, int(np.count_nonzero(rms >= least_rms))))


def _first(components: FringeComponents, number: int) -> FringeComponents:
    return dataclasses.replace(
        components,
        components=components.components[:number],
        explained_variance=components.explained_variance[:number],
        explained_variance_ratio=components.explained_variance_ratio[:number],
        scores=components.scores[:, :number],
    )


def _numerical_errors(frames: Sequence[SkyFringe]) -> dict[str, float]:
    """The largest errors of the frames, as fractions of the sky."""
    errors = {"QUADERR": max(frame.quadrature_error for frame in frames)}
    interpolation = [float(frame.metadata["INTERR"]) for frame in frames if "INTERR" in frame.metadata]
    return errors | ({"INTERR": max(interpolation)} if interpolation else {})


def _shared_metadata(frames: Sequence[SkyFringe]) -> dict[str, Any]:
    """What all frames say alike of how they were made: set-up, effects, lines; not whence a file came."""
    first, *others = (frame.metadata.items() for frame in frames)
    return {
        keyword: value
        for keyword, value in first
        if not keyword.startswith("LSST BUTLER") and all((keyword, value) in other for other in others)
    }
