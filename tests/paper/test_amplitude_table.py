"""Table 2 of the paper: every cell from one function."""

import numpy as np
import pytest
from astropy.table import Table

from lsst.fringe_sim.algorithms.amplitude_table import (
    CASES,
    UNDAMPED,
    WITH_EFFECTS,
    SkyCase,
    amplitude_table,
    compare_amplitudes,
    contradiction,
)
from lsst.fringe_sim.errors import InputError, UnknownNameError
from lsst.fringe_sim.instrument.sky import EmissionLines
from lsst.fringe_sim.mock.thickness import e2v_321

BY_NAME = {case.name: case for case in CASES}
LAB_AND_MONOCAM = (BY_NAME["SLAC-TS8, flat"], BY_NAME["MonoCam"])


@pytest.fixture(scope="module")
def adhesive() -> np.ndarray:
    return e2v_321()[::24, ::24]


@pytest.fixture(scope="module")
def bright() -> SkyCase:
    lines = EmissionLines.oh()
    chosen = np.argsort(lines.photon_radiance)[-60:]
    return SkyCase.of_table(
        "bright",
        Table({"wavelength": lines.wavelength_nm[chosen], "intensity": lines.photon_radiance[chosen]}),
    )


def cell(table: Table, case: str, column: str, light: str | None = None) -> float:
    rows = table[table["case"] == case]
    if light is not None:
        rows = rows[rows["light"] == light]
    return float(rows[column][0])


@pytest.mark.slow
def test_every_cell(adhesive):
    """Numbers of the paper's figures: paper-inventory, section 1; with the lines of PALACE alone."""
    table = amplitude_table(adhesive, [SkyCase.palace()[0]], silicon="Si_green2008")
    assert list(table["case"]) == [case.name for case in CASES]
    assert cell(table, "LSST e2v, centre", "rms") == pytest.approx(0.14, abs=0.02)
    assert cell(table, "LSST e2v, edge", "rms") == pytest.approx(0.04, abs=0.01)
    assert cell(table, "MonoCam", "half_peak_to_peak") == pytest.approx(1.35, abs=0.05)
    assert 0.2 < cell(table, "HSC", "half_peak_to_peak") < 0.6
    assert cell(table, "SLAC-TS8, flat", "half_peak_to_peak") == pytest.approx(13.0, abs=0.5)
    # What an ITL sensor shows is thickness of silicon, not fringes.
    assert cell(table, "LSST ITL, edge", "rms_flat_fielded") < 0.2 * cell(table, "LSST ITL, edge", "rms")
    assert np.all(table["half_range_1_99"] <= table["half_peak_to_peak"])
    assert table["rms"].unit == "%"


@pytest.mark.shared
@pytest.mark.slow
def test_the_lines_of_the_paper(adhesive, shared_dir):
    lines = Table.read(shared_dir / "data" / "oh_lines_guo2022_fig8.ecsv")
    cases = [BY_NAME[name] for name in ("MonoCam", "LSST e2v, centre", "LSST e2v, edge")]
    table = amplitude_table(adhesive, [SkyCase.of_table("paper", lines)], cases=cases, silicon="Si_green2008")
    assert cell(table, "MonoCam", "half_peak_to_peak") == pytest.approx(1.75, abs=0.2)
    assert cell(table, "LSST e2v, centre", "rms") == pytest.approx(0.14, abs=0.02)
    assert cell(table, "LSST e2v, centre", "half_peak_to_peak") == pytest.approx(0.29, abs=0.03)
    assert cell(table, "LSST e2v, edge", "rms") == pytest.approx(0.04, abs=0.01)
    assert cell(table, "LSST e2v, edge", "half_peak_to_peak") == pytest.approx(0.09, abs=0.02)


def test_one_set_of_effects_in_the_laboratory_and_on_the_sky(adhesive, bright):
    """What brings the laboratory to its measured contrast takes the sky's away: the contradiction is stated."""
    plain = amplitude_table(adhesive, [bright], cases=LAB_AND_MONOCAM)
    settings = {"contrast_loss.factor": 0.13, "bandwidth.fwhm": 2.2}
    damped = amplitude_table(adhesive, [bright], settings, cases=LAB_AND_MONOCAM)
    sky = [cell(table, "MonoCam", "rms") for table in (plain, damped)]
    assert sky[1] == pytest.approx(0.13 * sky[0], rel=0.01)  # the lamp's bandwidth does not reach the sky
    lab = [cell(table, "SLAC-TS8, flat", "rms") for table in (plain, damped)]
    assert lab[1] < 0.13 * lab[0]
    for table in (plain, damped):
        assert "no contrast that is common to both" in contradiction(table)
    assert damped.meta["effects"] == settings


def test_damped_and_undamped_stand_in_one_table(adhesive, bright):
    settings = {"contrast_loss.factor": 0.13}
    table = compare_amplitudes(adhesive, [bright], settings, LAB_AND_MONOCAM)
    plain, damped = (table[table["model"] == name] for name in (UNDAMPED, WITH_EFFECTS))
    assert len(plain) == len(damped) == len(LAB_AND_MONOCAM)
    for case in ("SLAC-TS8, flat", "MonoCam"):
        assert cell(damped, case, "rms") == pytest.approx(0.13 * cell(plain, case, "rms"), rel=0.01)
    assert [sentence.partition(":")[0] for sentence in table.meta["contradiction"]] == [
        UNDAMPED,
        WITH_EFFECTS,
    ]
    alone = compare_amplitudes(adhesive, [bright], cases=LAB_AND_MONOCAM[:1])
    assert set(alone["model"]) == {UNDAMPED}
    assert alone.meta["contradiction"] == []


def test_contradiction_is_not_stated_where_there_is_none():
    table = Table(
        {
            "case": ["SLAC-TS8, flat", "MonoCam"],
            "half_range_1_99": [1.6, 1.7],
            "half_peak_to_peak": [1.7, 1.9],
        }
    )
    assert contradiction(table).endswith("Both agree with the measurements.")
    with pytest.raises(InputError, match="rows of the table"):
        contradiction(table[:1])


def test_what_is_refused(bright):
    with pytest.raises(InputError, match="two axes"):
        amplitude_table(np.zeros(3), [bright])
    with pytest.raises(UnknownNameError, match="no_such"):
        amplitude_table(np.zeros((3, 3)), [bright], {"no_such.thing": 1.0})
    with pytest.raises(InputError, match="a column intensity"):
        SkyCase.of_table("x", Table({"wavelength": [1.0]}))
