"""From a raw monochromatic flat to the fringe pattern of its sensor."""

from __future__ import annotations

import dataclasses
import re
from typing import Any, ClassVar

from lsst.pex.config import DictField, Field, FieldValidationError
from lsst.pipe import base
from lsst.pipe.base.connectionTypes import Input, Output

from ..algorithms.flat_prep import prepare_flat
from ..errors import InputError
from ..instrument.detector import Detector
from ..instrument.raw_frame import RawFrame
from ..model import Setup
from ..model.provenance import table_cards
from ..products import CombinedBias, describe_mask
from .camera_config import CameraConfig
from .flat_prep_config import FlatPrepConfig
from .model_config import by_raft
from .quantum import SENSOR, SENSOR_EXPOSURE, common_header, data_id_of, sensor_of, unusable

_WAVELENGTH = re.compile(r"\s*([\d.]+) nm\s*")


class IsrFlatPrepConnections(base.PipelineTaskConnections, dimensions=SENSOR_EXPOSURE):
    """One raw flat and the bias of its sensor in, one fringe pattern out."""

    config: IsrFlatPrepConfig

    raw = Input("raw", "RawFrame", "Raw monochromatic flat.", dimensions=SENSOR_EXPOSURE)
    bias = Input("fringeBias", "CombinedBias", "Mean bias of the sensor.", dimensions=SENSOR)
    flat = Output(
        "fringeFlat", "FringeFlat", "Fringe pattern, counts / mean - 1.", dimensions=SENSOR_EXPOSURE
    )

    def __init__(self, *, config: IsrFlatPrepConfig | None = None) -> None:
        if config is not None and not config.raws_limit_graph:
            self.raw = dataclasses.replace(self.raw, deferGraphConstraint=True)

    def adjust_all_quanta(self, adjuster: base.QuantaAdjuster) -> None:
        """Keep the monochromatic flats in the wavelength range: biases and nights have exposures too."""
        for data_id in list(adjuster.iter_data_ids()):
            exposure: Any = adjuster.expand_quantum_data_id(data_id).records["exposure"]
            if exposure.observation_type != "flat" or not self._is_wanted(exposure.target_name):
                adjuster.remove_quantum(data_id)

    def _is_wanted(self, target: str | None) -> bool:
        match = _WAVELENGTH.fullmatch(target or "")
        if match is None:
            return False  # white light
        return bool(self.config.min_wavelength_nm <= float(match[1]) <= self.config.max_wavelength_nm)


class IsrFlatPrepConfig(
    CameraConfig, FlatPrepConfig, base.PipelineTaskConfig, pipelineConnections=IsrFlatPrepConnections
):
    """Configuration of `IsrFlatPrepTask`."""

    task_name: ClassVar[str] = "isrFlatPrep"

    setup = Field[str](
        default="ts8_e2v",
        doc="Set-up in which the flats were taken: width of the line and beam, where headers tell none.",
    )
    raft_setups: DictField[str, str] = DictField(
        keytype=str, itemtype=str, default={}, doc="Set-up of single rafts, by raft."
    )
    min_wavelength_nm = Field[float](
        default=800.0, doc="Flats of shorter wavelength are left aside; e2v sensors are opaque there."
    )
    max_wavelength_nm = Field[float](default=1100.0, doc="Flats of longer wavelength are left aside.")

    def validate(self) -> None:
        """Refuse rafts and set-ups that do not exist, and set-ups that have no monochromator."""
        super().validate()
        self.check_rafts(type(self).raft_setups, self.raft_setups)
        for field, name in (
            (type(self).setup, self.setup),
            *((type(self).raft_setups, name) for name in self.raft_setups.values()),
        ):
            try:
                kind = Setup.from_name(name).kind
            except InputError as error:
                raise FieldValidationError(field, self, str(error)) from error
            if kind != "monochromator":
                raise FieldValidationError(field, self, f"set-up {name} has no monochromator")

    def setup_of(self, raft: str) -> Setup:
        """Set-up of a raft."""
        return Setup.from_name(self.raft_setups.get(raft, self.setup))

    @property
    def setup_by_raft(self) -> dict[str, str]:
        """Set-up of the task under ``""``, and those of rafts that differ; for the contracts of pipelines."""
        return by_raft({"": self.setup, **self.raft_setups})


class IsrFlatPrepTask(base.PipelineTask):
    """Overscan, bias, gain, masks, smoothing and division by the mean of one flat."""

    ConfigClass = IsrFlatPrepConfig
    config: IsrFlatPrepConfig
    _DefaultName = "isrFlatPrep"

    def runQuantum(self, butlerQC: base.QuantumContext, inputRefs: Any, outputRefs: Any) -> None:
        """Read, prepare, store."""
        data_id = data_id_of(butlerQC)
        detector = sensor_of(data_id)
        with unusable(f"{detector.name}, exposure {data_id['exposure']}"):
            result = self.run(butlerQC.get(inputRefs.raw), butlerQC.get(inputRefs.bias), detector)
        butlerQC.put(result, outputRefs)

    def run(self, raw: RawFrame, bias: CombinedBias, detector: Detector) -> base.Struct:
        """Prepare one flat.

        Parameters
        ----------
        raw : `RawFrame`
            The flat.
        bias : `CombinedBias`
            Mean bias of the same sensor.
        detector : `Detector`
            The sensor, with its gains.

        Returns
        -------
        result : `~lsst.pipe.base.Struct`
            ``flat``, a `FringeFlat`.

        Raises
        ------
        InputError
            The frame cannot be used; it says why.
        """
        for note in raw.metadata.notes:
            self.log.warning("%s: %s", detector.name, note)
        setup = self.config.setup_of(detector.raft)
        flat = prepare_flat(
            raw,
            bias,
            detector,
            bandwidth_fwhm_nm=setup.bandwidth_fwhm_nm,
            f_number=setup.f_number,
            options=self.config.options(),
        )
        if flat.metadata["BADAMPS"] != "none":
            self.log.warning(
                "%s: masked whole, dead, hot or saturated: %s", detector.name, flat.metadata["BADAMPS"]
            )
        self.log.info(
            "%s at %g nm: level %.0f e, masked %s",
            detector.name,
            flat.wavelength_nm,
            flat.level_e,
            describe_mask(flat.mask),
        )
        shipped = () if setup.files else (("setups", f"{setup.name}.yaml"),)
        tables = table_cards((*shipped, ("instrument", "lsstcam_amps.ecsv")), setup.files)
        metadata = {**common_header(self.config), "SETUP": setup.name, **tables, **flat.metadata}
        return base.Struct(flat=dataclasses.replace(flat, detector=detector.name, metadata=metadata))
