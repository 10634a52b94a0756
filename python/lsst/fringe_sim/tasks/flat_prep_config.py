"""Choices of the flat preparation as task configuration, shared by the combination of biases."""

from __future__ import annotations

import dataclasses
from typing import Any

from lsst.pex.config import ChoiceField, Config, Field, FieldValidationError

from ..algorithms.flat_prep import FlatPrepOptions
from ..errors import InputError

_DEFAULT = FlatPrepOptions()
_OVERSCAN = ("overscan_method", "overscan_knots", "overscan_skip", "parallel_overscan")


def _choice(default: Any, doc: str) -> Any:
    """Field with the type of its default."""
    return Field(dtype=type(default), default=default, doc=doc)


class FlatPrepConfig(Config):
    """Every choice of `FlatPrepOptions`, by the same name."""

    overscan_method = ChoiceField[str](
        default=_DEFAULT.overscan_method,
        doc="Level of the serial overscan.",
        allowed={"median": "the median of each row", "spline": "a smooth curve through the rows"},
    )
    overscan_knots: Field[int] = _choice(_DEFAULT.overscan_knots, "Intervals of that curve.")
    overscan_skip: Field[int] = _choice(
        _DEFAULT.overscan_skip, "Overscan columns and rows next to the imaging section that are left out."
    )
    parallel_overscan: Field[bool] = _choice(
        _DEFAULT.parallel_overscan, "Whether the parallel overscan is taken off every column."
    )
    clip_sigma: Field[float] = _choice(
        _DEFAULT.clip_sigma, "Rejection in overscan and biases, standard deviations."
    )
    saturation_fraction: Field[float] = _choice(
        _DEFAULT.saturation_fraction, "Part of the saturation level above which a pixel counts as saturated."
    )
    max_saturated: Field[float] = _choice(
        _DEFAULT.max_saturated, "Largest part of saturated pixels with which a flat is still used."
    )
    defect_sigma: Field[float] = _choice(_DEFAULT.defect_sigma, "Departure of a defect, standard deviations.")
    defect_fraction: Field[float] = _choice(
        _DEFAULT.defect_fraction, "Least such departure, relative to the signal."
    )
    column_sigma: Field[float] = _choice(
        _DEFAULT.column_sigma, "Departure of a bad column, standard deviations between columns."
    )
    column_fraction: Field[float] = _choice(
        _DEFAULT.column_fraction, "Least such departure, relative to the signal."
    )
    edge_px: Field[int] = _choice(_DEFAULT.edge_px, "Border of the sensor that is masked, px.")
    midline_px: Field[int] = _choice(
        _DEFAULT.midline_px, "Rows on either side of the middle that are masked, px."
    )
    smoothing_sigma_px: Field[float] = _choice(
        _DEFAULT.smoothing_sigma_px, "Standard deviation of the smoothing kernel, px; 0 for none."
    )

    raws_limit_graph = Field[bool](
        default=True,
        doc="Whether only exposures that have raw frames enter the graph; False where the night to be simulated, "
        "whose exposures have none, is in the same graph.",
    )

    def options(self) -> FlatPrepOptions:
        """These choices as the algorithms take them."""
        names = (item.name for item in dataclasses.fields(FlatPrepOptions))
        return FlatPrepOptions(**{name: getattr(self, name) for name in names})

    def validate(self) -> None:
        """Refuse what the algorithms would refuse."""
        super().validate()
        try:
            self.options()
        except InputError as error:
            raise FieldValidationError(getattr(type(self), error.field), self, str(error)) from error

    @property
    def overscan_choices(self) -> dict[str, object]:
        """Choices that biases and flats must share; for the contracts of pipelines."""
        return {name: getattr(self, name) for name in _OVERSCAN}
