"""Loss of fringe contrast without a mechanism."""

from __future__ import annotations

from collections.abc import Mapping

from .base import FloatArray, Parameter, PlainNullEffect, ResponseContext

__all__ = ["ContrastLoss"]


class ContrastLoss(PlainNullEffect):
    """A structured back side returns only a part of the light coherently."""

    name = "contrast_loss"
    title = "constant contrast loss (structured back side)"
    acts_on = "response"
    reference = "needed at the measured pixel of Guo, Walter, Lage & Lupton 2022, Fig. 4 (factor about 0.13)"
    parameters = (
        Parameter(
            "factor",
            "",
            1.0,
            (0.0, 1.5),
            0.3,
            "factor on the departure from the phase mean",
            natural_bounds=(0.0,),
        ),
    )

    def change_response(
        self, response: FloatArray, values: Mapping[str, float], context: ResponseContext
    ) -> FloatArray:
        """Pull the response towards its phase average."""
        mean = context.phase_mean.reshape((-1,) + (1,) * (response.ndim - 1))
        return mean + values["factor"] * (response - mean)
