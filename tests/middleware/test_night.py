import datetime
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lsst.daf.butler import Butler, Timespan
from recorded_numbers import Record
from toy_repository import Invoke

from lsst.fringe_sim.errors import InputError, OutOfRangeError, UnknownNameError
from lsst.fringe_sim.middleware.night import NightPlan, airmass_of, define_night, hour_of_night, parse_hours

pytestmark = pytest.mark.middleware

DATE = datetime.date(2026, 11, 21)


def test_night_of_the_paper(butler: Butler, recorded: Record) -> None:
    define_night(butler, "LSSTCam", [NightPlan(DATE, parse_hours("19:29"))])
    records = sorted(
        butler.query_dimension_records(
            "exposure", where="instrument='LSSTCam' AND exposure.observation_type='science'"
        ),
        key=lambda record: record.id,
    )
    assert len(records) == 11
    assert [hour_of_night(r) for r in records] == pytest.approx(list(range(19, 30)), abs=1e-6)
    assert {r.day_obs for r in records} == {20261121}
    assert {r.physical_filter for r in records} == {"y_10"}
    assert {r.exposure_time for r in records} == {30.0}
    assert all(r.has_simulated and r.can_see_sky for r in records)
    assert [airmass_of(r) for r in records] == pytest.approx([1.2] * 11)
    assert len({r.id for r in records}) == 11
    recorded([record.toDict() for record in records])


@pytest.mark.parametrize(
    ("instrument", "physical_filter"), [("LSSTCam", "y_10"), ("MonoCam", "y"), ("HSC", "HSC-Y")]
)
def test_local_time_comes_back_on_every_site(butler: Butler, instrument: str, physical_filter: str) -> None:
    hours = (12.0, 19.25, 24.0, 29.5, 35.0)
    define_night(butler, instrument, [NightPlan(DATE, hours, exposure_time_s=60.0)])
    records = sorted(butler.query_dimension_records("exposure", instrument=instrument), key=lambda r: r.id)
    assert [hour_of_night(r) for r in records] == pytest.approx(list(hours), abs=1e-6)
    assert {r.physical_filter for r in records} == {physical_filter}


def test_registering_again_changes_nothing_and_other_properties_are_refused(butler: Butler) -> None:
    plan = NightPlan(DATE, (19.0, 20.0))
    define_night(butler, "LSSTCam", [plan])
    define_night(butler, "LSSTCam", [plan, NightPlan(DATE, (20.0, 21.0))])
    assert len(list(butler.query_dimension_records("exposure", instrument="LSSTCam"))) == 3
    longer = NightPlan(DATE, (22.0, 20.0), exposure_time_s=15.0)
    with pytest.raises(InputError, match="exposure is 7026112100480"):
        define_night(butler, "LSSTCam", [longer])
    assert len(list(butler.query_dimension_records("exposure", instrument="LSSTCam"))) == 3


def test_what_has_no_night_is_refused(butler: Butler) -> None:
    plan = NightPlan(DATE, (19.0,))
    with pytest.raises(InputError, match="instrument is 'LSST-TS8'; allowed: one on a telescope: LSSTCam"):
        define_night(butler, "LSST-TS8", [plan])
    with pytest.raises(UnknownNameError, match="did you mean LSSTCam"):
        define_night(butler, "LSSTcam", [plan])
    with pytest.raises(UnknownNameError, match="physical filter is 'none'; allowed: y_10"):
        define_night(butler, "LSSTCam", [NightPlan(DATE, (19.0,), physical_filter="none")])


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"hours": ()}, OutOfRangeError),
        ({"hours": (11.9,)}, OutOfRangeError),
        ({"hours": (36.0,)}, OutOfRangeError),
        ({"hours": (float("nan"),)}, OutOfRangeError),
        ({"hours": (19.0, 19.001)}, InputError),
        ({"exposure_time_s": 0.0}, OutOfRangeError),
        ({"exposure_time_s": float("inf")}, OutOfRangeError),
        ({"airmass": 0.9}, OutOfRangeError),
        ({"airmass": 40.1}, OutOfRangeError),
        ({"airmass": float("nan")}, OutOfRangeError),
    ],
)
def test_plans_that_make_no_sense_are_refused(changes: dict[str, object], error: type[Exception]) -> None:
    values: dict[str, object] = {"date": DATE, "hours": (19.0,), **changes}
    with pytest.raises(error):
        NightPlan(**values)  # type: ignore[arg-type]


def test_plans_at_the_edge_of_sense_are_taken() -> None:
    for airmass in (1.0, 40.0):
        assert NightPlan(DATE, (12.0, 35.99), exposure_time_s=0.01, airmass=airmass).airmass == airmass


@given(first=st.integers(12, 30), count=st.integers(1, 50), step=st.sampled_from([0.1, 0.25, 0.5, 1.0, 2.0]))
def test_hours_include_the_last_one(first: int, count: int, step: float) -> None:
    last = first + (count - 1) * step
    hours = parse_hours(f"{first}:{last}:{step}")
    assert hours == pytest.approx([first + i * step for i in range(count)])


def test_hours_as_in_the_help() -> None:
    assert parse_hours("19:29") == tuple(float(h) for h in range(19, 30))
    assert parse_hours("22:23:0.5") == (22.0, 22.5, 23.0)
    assert parse_hours("22:22") == (22.0,)


@pytest.mark.parametrize(
    "text", ["", "19", "19-29", "29:19", "19:29:0", "19:29:-1", "a:b", "1:2:3:4", "19:nan"]
)
def test_hours_that_cannot_be_read_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="FIRST:LAST"):
        parse_hours(text)


def test_exposure_without_time_or_night_is_refused(butler: Butler) -> None:
    define_night(butler, "LSSTCam", [NightPlan(DATE, (19.0,))])
    (record,) = butler.query_dimension_records("exposure", instrument="LSSTCam")
    moment = record.timespan.begin
    for span in (None, Timespan(None, moment), Timespan(moment, None)):
        without = butler.dimensions["exposure"].RecordClass(**{**record.toDict(), "timespan": span})
        with pytest.raises(InputError, match=r"timespan is .*; allowed: a begin and an end"):
            hour_of_night(without)
    other = butler.dimensions["exposure"].RecordClass(**{**record.toDict(), "instrument": "LSST-TS8"})
    with pytest.raises(InputError, match="one on a telescope"):
        hour_of_night(other)


def test_command(repo: Path, invoke: Invoke) -> None:
    arguments = ("define-fringe-night", repo, "LSSTCam", "--date", "20261121", "--date", "2026-11-22")
    rehearsal = invoke(*arguments, "--hours", "22:24", "--dry-run")
    assert rehearsal.exit_code == 0, rehearsal.output
    assert "6 exposures would be registered" in rehearsal.output
    with Butler.from_config(str(repo)) as butler:
        assert list(butler.query_dimension_records("exposure", explain=False)) == []
    result = invoke(*arguments, "--hours", "22:24")
    assert result.exit_code == 0, result.output
    assert "exposure 7026112100600  night sky 22.00 h  y_10  30 s" in result.output
    assert "6 exposures registered" in result.output
    wrong = invoke("define-fringe-night", repo, "LSST-TS8", "--date", "20261121")
    assert wrong.exit_code == 1
    assert wrong.output.strip().startswith("Error: instrument is 'LSST-TS8'")
    assert invoke(*arguments, "--hours", "nonsense").exit_code == 1
    assert invoke("define-fringe-night", repo, "LSSTCam", "--date", "someday").exit_code == 2
