"""What the frames and forecasts of a focal plane cost: quanta, processor time, memory, disk."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

PIXELS = 4004 * 4096  # Pixels of an e2v sensor
RESPONSE_S = 9.0  # Response of one sensor to the sky with the beam of every pixel [s of processor time]
FRAME_S = 0.7  # One frame of 16.4 Mpix with the beam of every pixel, in float32 and written as FITS [s]
COMPONENT_S = 0.35  # Principal components, per frame that enters them [s]
FORECAST_S = 6.0  # Forecast of one sensor beside its response [s]
SAMPLED_S = 0.9  # The same with one sampled pixel per arcsecond, beside a response that all sensors share [s]

MIB = 2.0**20


@dataclass(frozen=True)
class QuantumCost:
    """What one quantum of a full e2v sensor costs."""

    # Processor time of all threads, that of the most expensive quantum; the start of the process is not
    # in it
    processor_s: float
    peak_bytes: float  # most memory of the process


QUANTUM_COSTS: Mapping[str, QuantumCost] = MappingProxyType(
    {
        "fringeBias": QuantumCost(2.5, 883 * MIB),
        "isrFlatPrep": QuantumCost(2.5, 1031 * MIB),
        "epoxyFit": QuantumCost(20.6, 2878 * MIB),
        "effectDiscovery": QuantumCost(168.3, 3855 * MIB),
        "skyEffectDiscovery": QuantumCost(740.0, 6144 * MIB),
        "skyFringeSim": QuantumCost(16.3, 1262 * MIB),
        "fringePca": QuantumCost(10.7, 3428 * MIB),
        "mapTemplates": QuantumCost(16.8, 1529 * MIB),
        "observedFringe": QuantumCost(570.0, 4096 * MIB),
        "fringeCorrection": QuantumCost(62.0, 2500 * MIB),
        "fringeForecast": QuantumCost(21.4, 1255 * MIB),
        "focalPlaneSummary": QuantumCost(0.1, 339 * MIB),
    }
)
"""By task, as ``python scripts/measure_quanta.py`` has measured them: twelve flats, three biases, eleven hours.

The search for effects found none; with effects it takes longer. That on the sky has not been measured on a full
sensor: its time is that of a small one with an effect, its memory that of eleven frames, counted. Neither have the
two tasks of observed frames: their times are sixteen times those of 1024 x 1024 pixels, of eleven frames for
templates, and their memory is that of the images they hold, counted. ``mapTemplates`` was measured without a
repository.
"""


@dataclass(frozen=True)
class FocalPlaneCost:
    """Cost of a forecast; the times were measured on the machine of doc/performance.md."""

    # exposures: those of the night
    sensors: int
    exposures: int

    @property
    def quanta(self) -> int:
        """Quanta of pipelines/lsstCam/focalPlane.yaml: frames, components and forecasts, and their summary."""
        return self.sensors * (self.exposures + 2) + 1

    @property
    def jobs(self) -> int:
        """Jobs of bps: the frames of one sensor, the forecast of one sensor, and the summary."""
        return 2 * self.sensors + 1

    @property
    def peak_bytes(self) -> float:
        """Most memory of a job."""
        return max(
            QUANTUM_COSTS[label].peak_bytes for label in ("skyFringeSim", "fringePca", "fringeForecast")
        )

    @property
    def frame_bytes(self) -> int:
        """Bytes of one sky frame: float32 image and int32 mask."""
        return PIXELS * 8

    @property
    def disk_bytes(self) -> int:
        """Bytes of all frames, of templates (image, mask, variance) and of the mean and two components."""
        return self.sensors * (self.exposures * self.frame_bytes + PIXELS * 12 + PIXELS * 16)

    @property
    def sensor_night_s(self) -> float:
        """Processor time of the frames of one sensor in one process [s]."""
        return RESPONSE_S + self.exposures * FRAME_S

    @property
    def pipeline_s(self) -> float:
        """Processor time of the whole pipeline, clustered by sensor [s]."""
        night = self.sensor_night_s + self.exposures * COMPONENT_S
        return self.sensors * (night + RESPONSE_S + FORECAST_S)

    @property
    def sampled_s(self) -> float:
        """Processor time of ``fringe-sim focal-plane``, which writes no frames [s]."""
        return 2 * RESPONSE_S + self.sensors * SAMPLED_S

    def describe(self) -> str:
        """Text for people."""
        return "\n".join(
            (
                f"{self.sensors} sensors; forecast from one pixel per arcsecond, no frames: "
                f"{self.sampled_s / 60.0:.1f} min of processor time",
                f"the same as a pipeline with the frames of {self.exposures} exposures: {self.quanta} quanta "
                f"in {self.jobs} jobs of bps, {self.pipeline_s / 3600.0:.1f} h of processor time, "
                f"{self.sensor_night_s:.0f} s per sensor-night, {self.peak_bytes / 2**30:.1f} GiB of memory per job, "
                f"{self.disk_bytes / 2**30:.0f} GiB on disk",
                f"on 32 cores: {self.pipeline_s / 32.0 / 60.0:.0f} min, and the time to start {self.jobs} processes",
            )
        )
