"""Fringes on the sky of images that GalSim draws from a configuration.

``modules: [lsst.fringe_sim.algorithms.galsim_config]`` adds the image type ``FringedSky``: a ``Scattered`` image
whose sky, whatever it is made of, is multiplied by the fringes of one sensor before noise is drawn. The
page of the guide on other programs has an example.
"""

from __future__ import annotations

import functools
from typing import Any

import galsim
import numpy as np
from galsim.config.image_scattered import ScatteredImageBuilder
from numpy.typing import NDArray

from ..array_types import FloatArray
from ..errors import InputError
from ..instrument.detector import Detector
from ..instrument.sky import SkySpectrum
from ..model import FringeModel, Setup
from ..products import SensorSection, ThicknessMap
from ..products.thickness_map import thickness_span_um
from .field_response import sensor_response
from .sensor_placement import SensorPlacement
from .sky_frame import simulate_sky_frame
from .sky_response import Response
from .thickness_stand_in import stand_in_thickness

__all__ = ["FringedSkyBuilder"]

FRINGES = "fringes"  # Field of the image that holds what is said of them
REQUIRED = {"detector": str}
OPTIONAL = {"setup": str, "thickness": str, "airmass": float}


class FringedSkyBuilder(ScatteredImageBuilder):
    """Image type ``FringedSky``: as ``Scattered``, with a field ``fringes``.

    ``fringes`` has ``detector`` (name of the sensor, which decides its beams), and may have ``setup`` (``lsst_e2v``),
    ``thickness`` (file with a map of the sensor or of the part that its header states, of the size of the image; a
    random field with the statistics of measured sensors without it), ``airmass`` (that of the set-up), ``bands``
    (factors on OH bands and continua by name) and ``effects`` (as ``{roughness.sigma: 25.0}``).
    """

    def setup(
        self,
        config: dict[str, Any],
        base: dict[str, Any],
        image_num: int,
        obj_num: int,
        ignore: list[str],
        logger: Any,
    ) -> tuple[int, int]:
        """Size of the image."""
        if FRINGES not in config:
            raise InputError("image.fringes", "missing", "a mapping with the name of a detector")
        size: tuple[int, int] = super().setup(config, base, image_num, obj_num, [*ignore, FRINGES], logger)
        return size

    def addNoise(  # noqa: N802 - the name that GalSim calls
        self,
        image: galsim.Image,
        config: dict[str, Any],
        base: dict[str, Any],
        image_num: int,
        obj_num: int,
        current_var: float,
        logger: Any,
    ) -> None:
        """Add the sky with its fringes, and the noise of both."""
        sky = galsim.ImageD(image.bounds, wcs=image.wcs, init_value=0.0)
        galsim.config.AddSky(base, sky)
        fringes = sky.array * _pattern(config, base, image.array.shape)
        image += galsim.Image(fringes.astype(image.dtype), bounds=image.bounds)
        super().addNoise(image, config, base, image_num, obj_num, current_var, logger)


def _pattern(config: dict[str, Any], base: dict[str, Any], shape: tuple[int, int]) -> NDArray[np.floating]:
    """Sky over mean sky, minus one, of the sensor that the configuration names."""
    given = config[FRINGES]
    mappings = {name: dict(given.get(name, {})) for name in ("bands", "effects")}
    values, _ = galsim.config.GetAllParams(given, base, REQUIRED, OPTIONAL, ignore=list(mappings))
    layer, model, response = _sensor(
        values["detector"],
        values.get("setup", "lsst_e2v"),
        values.get("thickness", ""),
        values.get("airmass"),
        tuple(sorted(mappings["effects"].items())),
    )
    if layer.shape != shape:
        raise InputError("shape of the image", shape, f"{layer.shape}, that of the thickness map")
    return simulate_sky_frame(layer, model, response=response, scale=mappings["bands"] or None).fraction()


@functools.lru_cache(maxsize=4)
def _sensor(
    detector: str, setup: str, thickness: str, airmass: float | None, effects: tuple[tuple[str, float], ...]
) -> tuple[FloatArray, FringeModel, Response]:
    """Thickness [µm], model and response of a sensor; kept for its next exposure."""
    chosen = Setup.from_name(setup)
    sensor = chosen.sensor(detector)
    layer, header = _layer(thickness, chosen, sensor)
    section = SensorSection.of_image(sensor, layer.shape, header)
    placement = SensorPlacement.of(sensor, chosen.pixel_scale_arcsec, section)
    model = FringeModel.from_setup(
        chosen, dict(effects), field_x_deg=placement.field_x_deg, field_y_deg=placement.field_y_deg
    ).at_laboratory_temperature(header)
    sky = SkySpectrum.dark(airmass=chosen.airmass if airmass is None else airmass)
    return layer, model, sensor_response(model, sky, placement, thickness_span_um(layer))


def _layer(path: str, setup: Setup, sensor: Detector) -> tuple[FloatArray, dict[str, Any]]:
    """Thickness of the varying layer [µm], NaN where it is not known, and what its header says."""
    found = (
        ThicknessMap.read_any(path, setup.varying).of_setup(setup, path)
        if path
        else stand_in_thickness(setup, sensor)
    )
    return found.known_um().astype(float), dict(found.metadata)


galsim.config.RegisterImageType("FringedSky", FringedSkyBuilder())
