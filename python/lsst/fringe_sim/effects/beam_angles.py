"""Beams of many angles that are tilted, or that come from a source with an extent."""

from __future__ import annotations

import math

import numpy as np

from ..optics.illumination import Beam

__all__ = ["tilted", "widened"]

AZIMUTHS = 8
"""Directions of a tilt relative to a ray, over half a turn; the mean over them converges exponentially."""


def tilted(beam: Beam, angle: float) -> Beam:
    """Rotationally symmetric beam seen by a sensor that is tilted by ``angle`` [rad]; `AZIMUTHS` times the nodes.

    A ray at ``θ`` to the axis, at azimuth ``φ``, falls on the sensor at ``cos θ' = cos θ cos α + sin θ sin α cos φ``.
    """
    azimuth = (np.arange(AZIMUTHS) + 0.5) * math.pi / AZIMUTHS
    cosine = np.cos(beam.theta)[:, None] * math.cos(angle)
    cosine = cosine + np.sin(beam.theta)[:, None] * math.sin(angle) * np.cos(azimuth)
    return Beam(np.arccos(np.clip(cosine, -1.0, 1.0)).ravel(), np.repeat(beam.weight, AZIMUTHS) / AZIMUTHS)


def widened(beam: Beam, source: Beam, nodes: int) -> Beam:
    """Beam in which every ray is a cone ``source``, as a Gauss rule of ``nodes`` angles in ``sin²θ``."""
    # Needs a ray tracer to import; most effects do without.
    from ..instrument.telescope import reduce_beam

    parts = [tilted(beam, angle) for angle in source.theta]
    theta = np.concatenate([part.theta for part in parts])
    weight = np.concatenate([w * part.weight for w, part in zip(source.weight, parts, strict=True)])
    return reduce_beam(Beam(theta, weight / weight.sum()), nodes)
