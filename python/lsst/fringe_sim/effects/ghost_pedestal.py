"""Light that reaches the pixel without interfering."""

from __future__ import annotations

from collections.abc import Mapping

from .base import FloatArray, Parameter, PlainNullEffect, ResponseContext

__all__ = ["GhostPedestal"]


class GhostPedestal(PlainNullEffect):
    """A uniform level is added to every exposure, in proportion to its mean."""

    name = "ghost_pedestal"
    title = "scattered light or ghost pedestal"
    acts_on = "response"
    laboratory_only = True
    reference = "uniform ghost of a flat-field illumination"
    parameters = (Parameter("fraction", "", 0.0, (0.0, 20.0), 0.05, "pedestal over mean signal"),)

    def change_response(
        self, response: FloatArray, values: Mapping[str, float], context: ResponseContext
    ) -> FloatArray:
        """Add a multiple of the phase-averaged response."""
        mean = context.phase_mean.reshape((-1,) + (1,) * (response.ndim - 1))
        return response + values["fraction"] * mean
