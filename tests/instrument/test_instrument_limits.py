"""Limits of light, sensors and what headers say twice: both ends are in, and what lies beyond either is out."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from raw_frame_maker import write_raw
from stated_limits import check_ends

from lsst.fringe_sim.instrument.bandpass import Atmosphere, Bandpass
from lsst.fringe_sim.instrument.beam_field import BeamField
from lsst.fringe_sim.instrument.detector import Amplifier, refuse_misfits
from lsst.fringe_sim.instrument.raw_frame import read_raw_metadata
from lsst.fringe_sim.instrument.ray_bundle import RayBundle, gauss_rule, lagrange_weights, quantiles
from lsst.fringe_sim.instrument.readout import microjansky_to_magnitude
from lsst.fringe_sim.instrument.sky import SkySpectrum
from lsst.fringe_sim.instrument.stated_facts import refuse_contradictions, refuse_other_filter
from lsst.fringe_sim.instrument.telescope import ConeOptics, Telescope, TracedOptics

AIR = Atmosphere(np.array([500.0, 1200.0]), np.array([0.8, 0.9]), 1.2, 0.02, 1.3)
CONE = Telescope("mine", ConeOptics(4.0, 0.3, rings=4, spokes=6), 1.0, 10.0, 0.2, 0.5)
TRACED = Telescope(
    "coarse", TracedOptics("LSST_y.yaml", 1000.0, True, rings=6, spokes=12), 1.0, 10.0, 0.2, 1.5
)


def band(first: float, last: float, below: float = 0.0) -> Bandpass:
    """Light of 1 from first to last, a nanometre apart, and a little of it a nanometre before."""
    wave = np.arange(first - 1.0, last + 1.0)
    return Bandpass("x", wave, np.where(wave < first, below, 1.0), np.zeros(0), AIR)


def pair(x: int = 8, y: int = 0, **changes: Any) -> None:
    """Two amplifiers of eight columns and four rows, the second at a place of its own."""
    one = Amplifier("A1", 1, 0, 0, 4, 8, False, False, 1.0, 5.0, 1e5)
    refuse_misfits([one, dataclasses.replace(one, **{"name": "A2", "x0": x, "y0": y, **changes})])


def stated(*cards: dict[str, Any]) -> None:
    headers = [(f"HDU {number}" if number else "", card) for number, card in enumerate(cards)]
    refuse_contradictions(headers, lambda card, keyword: card.get(keyword), "raw.fits")


@pytest.mark.parametrize(
    ("made", "inside", "outside"),
    [
        (lambda airmass: AIR.total(900.0, airmass), (1.0, 9.999), (0.999, 10.0, math.nan)),
        (lambda airmass: AIR.scattering(900.0, airmass), (1.0, 9.999), (0.999, 10.0, math.nan)),
        (CONE.beam, (0.0, 0.5, -0.5), (0.5001, -0.5001, math.nan)),
        (lambda y: CONE.trace(0.3, y), (0.4, -0.4), (0.4001, -0.4001)),
        (lambda nodes: BeamField.trace(TRACED, nodes), (5,), (4,)),
        (lambda radius: BeamField.trace(TRACED, 5).beam(radius, 0.0, 3), (0.0, 1.5, -1.5), (1.5001, -1.5001)),
        (lambda nodes: gauss_rule([0.0, 1.0, 2.0], np.ones(3), nodes), (1, 2), (0, -1)),
        (lambda first: SkySpectrum.dark().components(band(first, 1100.0)), (880.0, 900.0), (879.0,)),
        (lambda last: SkySpectrum.dark().components(band(900.0, last)), (1110.0,), (1111.0,)),
        (lambda light: SkySpectrum.dark().components(band(880.0, 1100.0, light)), (0.0, 0.22), (0.222,)),
        (lambda x: pair(x), (8,), (7, 9, -8, 0)),
        (lambda y: pair(0, y), (4,), (3, 5, -4)),
        (lambda y: pair(8, y, height=4 - y), (0,), (-1, 1)),
        (lambda columns: pair(width=columns), (1, 20), (0, -1)),
        (lambda rows: pair(height=rows), (4,), (3, 5, 0)),
        (lambda name: pair(name=name), ("A2",), ("A1",)),
        (lambda nm: refuse_other_filter("y_10", nm, "x"), (879.0, 1100.0, None), (878.999, 1100.001)),
        (lambda nm: refuse_other_filter("SDSSz", nm, "x"), (770.0, 1114.0), (769.999, 1114.001)),
        (lambda nm: refuse_other_filter("SDSSi", nm, "x"), (660.0, 841.0), (659.999, 841.001)),
        (lambda nm: refuse_other_filter("960nm", nm, "x"), (935.0, 985.0), (934.999, 985.001)),
        (lambda nm: refuse_other_filter("850CutOn", nm, "x"), (840.0, 1e4), (839.999, 10_001.0)),
        (lambda nm: refuse_other_filter("glass", nm, "x"), (1.0, 1e5), ()),
        (
            lambda c: stated({"CCDTEMP": -95.0, "TEMP_SET": c}),
            (-90.0, -100.0, -200.0, -300.0),
            (-89.9, -100.1, 20),
        ),
        (lambda c: stated({"CCDTEMP": -95.0}, {"SENSTEMP": c}), (-90.0, -250.0), (-89.9,)),
        (lambda nm: stated({"MONOWL": 960.0}, {}, {"MONOWL": nm}), (961.0, 959.0, -1.0), (961.01, 958.99)),
        (lambda s: stated({"EXPTIME": 15.0}, {"EXPTIME": s}), (15.099, 14.901), (15.101, 14.899, "long")),
        (lambda serial: stated({"LSST_NUM": "E2V-1-Dev"}, {"LSST_NUM": serial}), ("E2V-1",), ("E2V-2",)),
        (lambda slot: stated({"SLOTNAME": "S01", "CCDSLOT": slot}), ("S01", "s01", None), ("S02",)),
        (lambda raft: stated({"RAFTBAY": "R11", "RAFTNAME": raft}), ("R11", "RTM-020"), ("R12",)),
    ],
)
def test_ends_are_in(made: Callable[[Any], Any], inside: tuple[Any, ...], outside: tuple[Any, ...]) -> None:
    check_ends(made, inside, outside)


def test_where_a_bandpass_begins_and_ends() -> None:
    """At the last wavelengths on either side that pass less than the part asked for, or at the end of the table."""
    wave = 900.0 + 10.0 * np.arange(8)
    light = np.array([0.0, 0.001, 0.01, 0.5, 0.4, 0.004, 0.0, 0.0])
    made = Bandpass("x", wave, light, np.zeros(0), AIR)
    assert made.support() == (900.0, 960.0)
    assert made.support(0.01) == (910.0, 950.0)
    assert made.support(0.9) == (920.0, 940.0)
    whole = dataclasses.replace(made, optics=np.ones(8))
    assert whole.support() == (900.0, 970.0)
    assert made.transmission([899.9, 935.0, 970.1]).tolist() == pytest.approx([0.0, 0.45, 0.0])


@pytest.mark.parametrize("airmass", [1.0, 1.2, 2.5])
def test_air_of_any_thickness(airmass: float) -> None:
    """Scattering grows with the airmass, absorption more slowly, and clear windows are not absorbed."""
    wave = np.array([500.0, 850.0, 1200.0])
    table, depth = np.array([0.8, 0.85, 0.9]), 0.02 * (wave / 1000.0) ** -1.3
    clear = np.exp(-1.2 * depth)
    expected = (table / clear) ** ((airmass / 1.2) ** 0.6) * np.exp(-airmass * depth)
    np.testing.assert_allclose(AIR.total(wave, airmass), expected, rtol=1e-12)
    np.testing.assert_allclose(AIR.scattering(wave, airmass), np.exp(-airmass * depth), rtol=1e-12)
    bright = dataclasses.replace(AIR, transmission=np.array([0.999, 0.999]))
    np.testing.assert_allclose(bright.total(wave, airmass), 0.999 ** (airmass / 1.2), rtol=1e-12)


def test_rays_and_the_angles_that_stand_for_them() -> None:
    rays = RayBundle(np.array([0.3, 0.0, -0.4]), np.array([0.4, 0.0, 0.3]), 1.0)
    np.testing.assert_allclose(rays.sin_squared, [0.2, 0.0, 0.2])
    np.testing.assert_allclose(rays.theta, np.arctan([0.5, 0.0, 0.5]))
    np.testing.assert_allclose(rays.quantiles(3), [0.0, 0.2, 0.2])
    np.testing.assert_allclose(quantiles(np.array([3.0, 1.0, 2.0]), 2), [4.0 / 3.0, 8.0 / 3.0])
    node, weight = gauss_rule([4.0, 1.0, 2.0], [1.0, 2.0, 1.0], 1)
    np.testing.assert_allclose([node, weight], [[2.0], [4.0]])
    same, all_of_it = gauss_rule([5.0, 5.0], [1.0, 2.0], 4)
    np.testing.assert_allclose([same, all_of_it], [[5.0], [3.0]])
    places = np.array([1.0, 2.0, 4.0])
    where = np.array([[1.0, 3.0], [0.0, 5.0]])
    weights = lagrange_weights(places, where)
    for power in range(3):
        np.testing.assert_allclose(np.tensordot(places**power, weights, axes=1), where**power, atol=1e-12)
    assert np.isnan(microjansky_to_magnitude([0.0, -1.0])).all()
    assert microjansky_to_magnitude(1.0) == pytest.approx(23.9)


@pytest.mark.parametrize(("number", "more"), [(12, False), (13, True)])
def test_keywords_that_are_not_used_are_named_as_far_as_one_reads(
    tmp_path: Path, number: int, more: bool
) -> None:
    path = tmp_path / "raw.fits"
    write_raw(path, {})
    with fits.open(path, mode="update") as hdus:
        for each in range(number):
            hdus[0].header[f"OWN{each:02d}"] = each
    (note,) = read_raw_metadata(path).notes
    assert f"OWN{min(number, 12) - 1:02d}" in note
    assert ("OWN12" in note, "and more" in note) == (False, more)
