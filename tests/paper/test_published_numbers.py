"""The table of published numbers, and how a recomputed one is judged."""

import math

import numpy as np
import pytest
from recorded_numbers import Record

from lsst.fringe_sim.errors import InputError, ResourceError, UnknownNameError
from lsst.fringe_sim.mock.thickness import e2v_321
from lsst.fringe_sim.paper import published_numbers, reproduce
from lsst.fringe_sim.paper import stack as of_the_stack
from lsst.fringe_sim.paper.laboratory import row_jumps
from lsst.fringe_sim.paper.published import PublishedNumber, published_number
from lsst.fringe_sim.paper.reproduce import SECTIONS
from lsst.fringe_sim.paper.section import Context

ENTRY = {"item": "x", "place": "Eq. 1", "quantity": "a length", "unit": "nm", "tolerance": 1}


def number(**changes) -> PublishedNumber:
    return PublishedNumber.from_mapping({**ENTRY, "published": 30, **changes})


@pytest.fixture(scope="module")
def without_curves() -> Context:
    small = e2v_321((64, 64))
    return Context(small, small, coadds=2)


@pytest.mark.parametrize(
    ("value", "status"),
    [
        (30.0, "agrees"),
        (31.0, "agrees"),
        (29.0, "agrees"),
        (300.5, "erratum"),
        (40.0, "differs"),
        (math.nan, "skipped"),
    ],
)
def test_a_number_is_judged_against_the_paper_then_against_its_correction(value, status) -> None:
    assert number(corrected=300, note="ten times").compare(value).status == status


def test_ranges_hold_their_ends() -> None:
    observed = number(published=[0.2, 0.6], tolerance=0)
    assert [observed.compare(v).status for v in (0.19, 0.2, 0.6, 0.61)] == [
        "differs",
        "agrees",
        "agrees",
        "differs",
    ]
    assert observed.stated == "0.2–0.6"
    assert number(published=[3, math.inf]).stated == "> 3"


@pytest.mark.parametrize("microjansky", [0.4, 0.449, 0.451, 0.6, 0.733, 0.749, 0.752, 0.9])
def test_one_number_in_two_units_has_one_verdict(microjansky) -> None:
    """The fringes of the abstract, and how far they are over 10 % of 26 AB mag arcsec⁻²."""
    brightness, over = published_number("fringe_brightness"), published_number("over_limit")
    assert brightness.compare(microjansky).status == over.compare(microjansky / 0.014454).status


def test_where_the_paper_gives_no_number_only_the_correction_counts() -> None:
    silent = number(published=None, corrected=2.0, note="why")
    assert silent.compare(2.0).status == "erratum"
    assert silent.compare(9.0).status == "differs"
    assert silent.stated == "–"


@pytest.mark.parametrize(
    "changes",
    [{"published": None}, {"published": [2, 1]}, {"corrected": 3}, {"tolerance": -1}],
    ids=["no number at all", "upside down", "correction without a reason", "negative tolerance"],
)
def test_bad_entries_are_refused(changes) -> None:
    with pytest.raises(ResourceError, match=r"published\.yaml"):
        number(**changes)


def test_table_is_whole() -> None:
    numbers = published_numbers()
    assert len(numbers) > 50
    places = " ".join(entry.place for entry in numbers.values())
    for place in (
        "Table 1",
        "Table 2",
        "Eq. 1",
        "Eq. 3",
        "Eq. 4",
        "Eq. 5",
        *(f"Fig. {k}" for k in (1, 3, 4, 5)),
    ):
        assert place in places
    for place in ("Fig. 7", "Fig. 8", "Fig. 10", "Fig. 11", "Fig. 12", "Fig. 14", "Fig. 15", "Fig. 16"):
        assert place in places
    with pytest.raises(UnknownNameError, match="order_adhesive"):
        published_number("order_adhesiv")


def test_sections_without_published_curves_skip_and_say_so(without_curves) -> None:
    made = reproduce(without_curves, (of_the_stack.layers, of_the_stack.absorption_depth))
    found = {finding.number.item: finding for finding in made.all_findings}
    assert found["order_adhesive"].status == "erratum"
    assert found["layers"].status == "agrees"
    assert found["depth_wavelength"].status == "agrees"
    assert found["depth_warm"].status == "skipped"
    assert "figures" in found["depth_warm"].reason
    table = made.table()
    assert len(table) == len(found)
    assert np.isnan(table["recomputed"][list(table["item"]).index("depth_warm")])
    assert "2 were skipped" in made.summary()


@pytest.mark.shared
def test_the_curve_labelled_183_k_is_that_of_173_k(shared_dir) -> None:
    small = e2v_321((64, 64))
    made = reproduce(Context(small, small, shared=shared_dir), (of_the_stack.absorption_depth,))
    assert {finding.number.item: finding.status for finding in made.all_findings} == {
        "depth_wavelength": "agrees",
        "depth_temperature": "erratum",
        "depth_warm": "agrees",
    }


def test_row_jumps_are_counted() -> None:
    smooth = e2v_321((120, 60))
    assert row_jumps(smooth, 0.3) == 0
    broken = smooth.copy()
    broken[50:] += 0.3
    broken[80:] -= 0.6
    assert row_jumps(broken, 0.3) == 2


def test_bad_contexts_are_named(tmp_path) -> None:
    small = e2v_321((64, 64))
    with pytest.raises(InputError, match="thickness_um"):
        Context(small[0], small)
    with pytest.raises(InputError, match="exposures in a coadd"):
        Context(small, small, coadds=1)
    with pytest.raises(InputError, match="published curves"):
        Context(small, small, shared=tmp_path)


OF_CURVES = ("one_pixel", "flat_contrast", "row_3000", "raft", "bandwidth", "absorption_depth", "oh_lines")
"""What else there is without the published curves; others are recorded with made-up ones."""


@pytest.mark.parametrize(
    "compute", [pytest.param(one, id=one.__name__) for one in SECTIONS if one.__name__ in OF_CURVES]
)
def test_a_section_of_a_small_sensor_is_as_recorded(
    compute, without_curves: Context, recorded: Record
) -> None:
    """A record of numbers and curves; the published numbers need the whole sensor and are judged by slow tests."""
    recorded(compute(without_curves))
