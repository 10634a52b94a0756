"""From the flats of a sensor to the thickness of the layer that makes its fringes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from typing import Any, ClassVar

import numpy as np

from lsst.pex.config import ChoiceField, Field, ListField, RangeField
from lsst.pipe import base
from lsst.pipe.base.connectionTypes import Output

from ..algorithms import fit_thickness
from ..algorithms.flat_conditions import model_of_flats
from ..algorithms.template_errors import template_errors
from ..algorithms.thickness_fit import SILICON_FIELDS, Nuisances, SiliconSearch, remarks, silicon_map
from ..array_types import FloatArray
from ..errors import InputError
from ..instrument.detector import Detector
from ..model import LABORATORY_TEMPERATURE, Setup
from ..products import FringeCube, FringeFlat, ThicknessMap, describe_mask
from .model_config import FringeModelConfig
from .quantum import SENSOR, OrderedConnections, common_header, data_id_of, flats_input, sensor_of, unusable


def _by_wavelength(ref: Any) -> tuple[str, int]:
    # The ingest writes the wavelength with a fixed number of digits, so the texts sort like the numbers.
    exposure = ref.dataId.records["exposure"]
    return exposure.target_name or "", exposure.id


class EpoxyFitConnections(OrderedConnections, dimensions=SENSOR):
    """The flats of a sensor in, its thickness map out."""

    flats = flats_input()
    thickness = Output(
        "epoxyThickness",
        "ThicknessMap",
        "Thickness of the varying layer, with its uncertainty.",
        dimensions=SENSOR,
    )

    silicon = Output(
        "siliconThickness",
        "ThicknessMap",
        "Thickness of the silicon in front of it, where the flats tell it; only if it is fitted.",
        dimensions=SENSOR,
    )

    ORDERED = ("flats", _by_wavelength)

    def __init__(self, *, config: EpoxyFitConfig | None = None) -> None:
        if config is not None and config.silicon == "fixed":
            del self.silicon


class EpoxyFitConfig(FringeModelConfig, base.PipelineTaskConfig, pipelineConnections=EpoxyFitConnections):
    """Configuration of `EpoxyFitTask`."""

    task_name: ClassVar[str] = "epoxyFit"

    method = ChoiceField[str](
        default="global",
        doc="How the thickness is found.",
        allowed={
            "global": "fringe order solved for the whole sensor at once",
            "guo2022": "walk from pixel to pixel, steps 1 to 4 of Guo, Walter, Lage & Lupton 2022",
        },
    )
    observable = ChoiceField[str](
        default="detection",
        doc="What a pixel responds to.",
        allowed={
            "detection": "light absorbed in the detection layer",
            "total": "light absorbed in the whole stack, as the published fit had it",
        },
    )
    min_wavelengths = Field[int](
        default=4, doc="Least number of different wavelengths with which a sensor is fitted."
    )
    range_um = ListField[float](
        optional=True, length=2, doc="Thicknesses that are searched, µm; by default the set-up's."
    )
    start_pixel = ListField[int](
        optional=True, length=2, doc="Row and column at which the walk of 'guo2022' begins."
    )
    silicon = ChoiceField[str](
        default="fixed",
        doc="Thickness of the silicon in front of the varying layer.",
        allowed={
            "fixed": "as in the model",
            "sensor": "one for the sensor, fitted where flats with a narrow line tell it",
            "plane": "a plane over the sensor, fitted likewise",
            "paraboloid": "a polynomial of second degree over the sensor, fitted likewise",
        },
    )
    level_zones = ChoiceField[str](
        default="known",
        doc="Parts of the sensor whose level is free at each wavelength.",
        allowed={
            "known": "amplifiers, as well as their gains are known",
            "none": "levels and wavelengths are as they are",
            "sensor": "one level for the sensor",
            "halves": "one for the upper and one for the lower half",
            "amplifiers": "one for each amplifier",
        },
    )
    illumination_degree: Any = RangeField(
        dtype=int,
        default=2,
        min=0,
        max=8,
        inclusiveMax=True,
        doc="Degree of a slow illumination that is free at each wavelength; 0 for none.",
    )
    contrast = ChoiceField[str](
        default="wavelength",
        doc="Contrast of the fringes.",
        allowed={
            "wavelength": "times a free factor at each wavelength",
            "common": "times one free factor",
            "fixed": "that of the model",
        },
    )
    slip_limit = Field[float](
        default=0.01, doc="Pixels whose fringe order is wrong with a larger probability are masked."
    )
    threads = Field[int](
        optional=True,
        doc="Number of threads, without influence on the result; by default as many as there are processors.",
    )


class EpoxyFitTask(base.PipelineTask):
    """Fit the thickness of the varying layer at every pixel of a sensor."""

    ConfigClass = EpoxyFitConfig
    config: EpoxyFitConfig
    _DefaultName = "epoxyFit"

    def runQuantum(self, butlerQC: base.QuantumContext, inputRefs: Any, outputRefs: Any) -> None:
        """Read the flats one by one into a cube, fit, store."""
        detector = sensor_of(data_id_of(butlerQC))
        flats = (butlerQC.get(ref).get() for ref in inputRefs.flats)
        with unusable(detector.name):
            result = self.run(flats, len(inputRefs.flats), detector)
        butlerQC.put(result.thickness, outputRefs.thickness)
        if result.silicon is not None:
            butlerQC.put(result.silicon, outputRefs.silicon)

    def run(self, flats: Iterable[FringeFlat], number: int, detector: Detector) -> base.Struct:
        """Fit one sensor.

        Parameters
        ----------
        flats : iterable of `FringeFlat`
            Flats of the sensor; they need not all be in memory at once.
        number : `int`
            How many they are.
        detector : `Detector`
            The sensor.

        Returns
        -------
        result : `~lsst.pipe.base.Struct`
            ``thickness``, a `ThicknessMap`, and ``silicon``, one of the silicon; `None` if it is not fitted, or if
            the flats do not decide.

        Raises
        ------
        InputError
            Too few wavelengths, or flats that do not belong together.
        """
        choice = self.config.choice_of(detector)
        cube = FringeCube.from_flats(flats, number=number)
        setup = Setup.from_name(choice.setup)
        missing = self._check_wavelengths(cube.wavelength_nm, setup, detector)
        model, options = choice.model(), self._options(setup)
        fitted = fit_thickness(cube, model, self.config.method, **options)
        errors = template_errors(model, cube.wavelength_nm, options["range_um"], self.config.observable)
        metadata = {
            **common_header(self.config),
            **choice.header(),
            **fitted.metadata,
            "QUADERR": errors[0],
            "INTERR": errors[1],
            "NFLATS": number,
            "MISSING": missing,
            LABORATORY_TEMPERATURE: model_of_flats(model, cube.exposures).system.temperature_k,
        }
        self._report(fitted, detector)
        silicon = silicon_map(fitted, model)
        if silicon is not None:
            silicon = dataclasses.replace(
                silicon, detector=detector.name, metadata={**metadata, **silicon.metadata}
            )
        thickness = dataclasses.replace(fitted, detector=detector.name, metadata=metadata)
        return base.Struct(thickness=thickness, silicon=silicon)

    def _options(self, setup: Setup) -> dict[str, Any]:
        config = self.config
        return {
            "observable": config.observable,
            "range_um": None if config.range_um is None else tuple(config.range_um),
            "start_pixel": None if config.start_pixel is None else tuple(config.start_pixel),
            "slip_limit": config.slip_limit,
            "nuisances": self._nuisances(setup),
            "silicon": None if config.silicon == "fixed" else SiliconSearch(SILICON_FIELDS[config.silicon]),
            "threads": config.threads,
        }

    def _nuisances(self, setup: Setup) -> Nuisances | None:
        """What is free; `None`, which is the choice of the fit, for the walk and for two layers."""
        config = self.config
        if config.method != "global" or config.silicon != "fixed":
            return None
        if config.level_zones == "none":
            return Nuisances(contrast=config.contrast, illumination_degree=config.illumination_degree)
        free = Nuisances.automatic(config.contrast, setup.wavelength_accuracy_nm)
        if config.level_zones != "known":
            free = dataclasses.replace(free, zones=config.level_zones, gain_accuracy=math.inf)
        return dataclasses.replace(free, illumination_degree=config.illumination_degree)

    def _check_wavelengths(self, found_nm: FloatArray, setup: Setup, detector: Detector) -> str:
        """Refuse too few wavelengths; return, and report, the usual ones that are missing."""
        distinct = len(set(np.round(found_nm, 3)))
        if distinct < self.config.min_wavelengths:
            raise InputError(
                "number of wavelengths",
                distinct,
                f"{self.config.min_wavelengths} or more",
                source=detector.name,
            )
        missing = [f"{usual:g}" for usual in setup.missing_nm(found_nm)]
        if missing:
            self.log.warning(
                "%s: no flats at %s nm; the fit is less certain without them",
                detector.name,
                ", ".join(missing),
            )
        return ",".join(missing)

    def _report(self, fitted: ThicknessMap, detector: Detector) -> None:
        good = fitted.mask == 0
        said = "; ".join(remarks(fitted.metadata, fitted.flats))
        if not good.any():
            wanted = f"at least one. {said}".strip()
            raise InputError("good pixels of the thickness map", 0, wanted, source=detector.name)
        if said:
            self.log.info("%s: %s", detector.name, said)
        self.log.info(
            "%s: %s %.3f to %.3f um (1 to 99 %%), median sigma %.1f nm, %.4f %% of the pixels masked: %s",
            detector.name,
            fitted.layer,
            *np.percentile(fitted.value[good], [1, 99]),
            1e3 * float(np.median(fitted.sigma[good])),
            100.0 * float(1.0 - good.mean()),
            describe_mask(fitted.mask),
        )
