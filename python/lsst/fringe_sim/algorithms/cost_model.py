"""What the frames and forecasts of a focal plane cost: quanta, processor time, memory, disk."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["FocalPlaneCost"]

PIXELS = 4004 * 4096
"""Pixels of an e2v sensor."""

RESPONSE_S = 9.0
"""Response of one sensor to the sky with the beam of every pixel [s of processor time]."""

FRAME_S = 0.7
"""One frame of 16.4 Mpix with the beam of every pixel, in float32 and written as FITS [s]."""

COMPONENT_S = 0.35
"""Principal components, per frame that enters them [s]."""

FORECAST_S = 6.0
"""Forecast of one sensor beside its response [s]."""

SAMPLED_S = 0.9
"""The same with one sampled pixel per arcsecond, beside a response that all sensors share [s]."""

PEAK_BYTES = 1.9e9
"""Most memory of the process of one sensor-night."""


@dataclass(frozen=True)
class FocalPlaneCost:
    """Cost of a forecast; the times were measured on the machine of doc/performance.md.

    Attributes
    ----------
    sensors, exposures : `int`
        Sensors, and exposures of the night.
    """

    sensors: int
    exposures: int

    @property
    def quanta(self) -> int:
        """Quanta of pipelines/lsstCam/focalPlane.yaml: frames, components and forecasts, and their summary."""
        return self.sensors * (self.exposures + 2) + 1

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
                f"(cluster them by sensor), {self.pipeline_s / 3600.0:.1f} h of processor time, "
                f"{self.sensor_night_s:.0f} s per sensor-night, {PEAK_BYTES / 2**30:.1f} GiB of memory per process, "
                f"{self.disk_bytes / 2**30:.0f} GiB on disk",
            )
        )
