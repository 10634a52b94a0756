"""Tables of a challenge from results made by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table

from lsst.fringe_sim.challenge.result import CaseResult, ChallengeResult
from lsst.fringe_sim.errors import InputError

RIGHT = CaseResult(
    0, "one", ("roughness",), {"roughness.sigma": 40.0}, "named", ("roughness",), ((),), True, True, 50.0, 50.0,
    0.99, 0.98, {"roughness.sigma": 1.5}, 0.97, 12.0,
)  # fmt: skip
CLASS = replace(
    RIGHT,
    number=1,
    found=("bandwidth",),
    ambiguous=(("roughness",),),
    exact=False,
    name_probability=0.6,
    pulls={},
)
WRONG = replace(RIGHT, number=2, found=("tilt",), right_class=False, exact=False, pulls={})
SILENT = replace(
    RIGHT, number=3, verdict="unexplained", found=(), ambiguous=(), right_class=False, exact=False,
    probability=0.0, name_probability=0.0, pulls={}, signal_to_noise=4.0,
)  # fmt: skip
CLEAN = replace(
    SILENT, kind="none", number=0, truth=(), values={}, verdict="no_discrepancy", signal_to_noise=math.nan
)
FAINT = replace(
    RIGHT,
    kind="two",
    number=0,
    truth=("roughness", "tilt"),
    exact=False,
    weakest=3.0,
    name_probability=0.95,
    pulls={},
)


@pytest.fixture
def result() -> ChallengeResult:
    return ChallengeResult(7, (CLEAN, RIGHT, CLASS, WRONG, SILENT, FAINT))


def test_summary_counts_visible_cases(result: ChallengeResult) -> None:
    summary = result.summary()
    assert summary["false_discoveries"] == [0, 1]
    assert summary["one_right_class"] == [2, 3]
    assert summary["one_exact"] == [1, 3]
    assert summary["one_exact_where_separable"] == [1, 2]
    assert summary["two_right_class"] == [0, 0]
    assert summary["one_of_two_faint_right"] == [1, 1]
    assert summary["named_right"] == [3, 4]


def test_every_named_effect_counts_once_in_the_pulls() -> None:
    """Parameters of one effect are off together; those of two effects, or of two cases, are not."""
    jitter = {f"wavelength_jitter.shift_{number}": -2.0 for number in range(12)}
    cases = (
        RIGHT,
        replace(RIGHT, number=5, pulls={**jitter, "tilt.angle": 0.5}),
        replace(RIGHT, kind="two", number=0, pulls={"roughness.sigma": 1.0}),
    )
    result = ChallengeResult(7, cases)
    summary = result.summary()
    assert result.pulls().size == 15
    assert summary["pulled_effects"] == 4
    np.testing.assert_allclose(summary["pull_mean"], np.mean([1.5, -2.0, 0.5, 1.0]))
    np.testing.assert_allclose(summary["pull_std"], np.std([1.5, -2.0, 0.5, 1.0]))
    assert math.isnan(ChallengeResult(7, (CLEAN,)).summary()["pull_mean"])


def test_calibration_asks_whether_names_are_right(result: ChallengeResult) -> None:
    """A faint second effect that was not named makes the first name no worse."""
    table = result.calibration()
    assert table["cases"].tolist() == [1, 1, 2]
    assert table["right"].tolist() == [0.0, 1.0, 0.5]
    np.testing.assert_allclose(table["stated"], [0.6, 0.95, 0.98])
    assert np.all(table["right_sigma"] > 0.1)


def test_tables_are_written_also_where_there_are_no_cases(result: ChallengeResult, tmp_path) -> None:
    for name, one in (("full", result), ("empty", ChallengeResult(7, ()))):
        path = one.write(tmp_path / name)
        cases = Table.read(path)
        assert len(cases) == len(one.cases)
        assert cases.meta["seed"] == 7
        assert {file.name for file in path.parent.iterdir()} == {
            f"{table}.ecsv" for table in ("challenge", "confusion", "accuracy", "calibration", "pulls")
        }
    assert Table.read(tmp_path / "full" / "pulls.ecsv")["pull"].tolist() == [1.5]


def test_a_case_survives_a_line_of_text() -> None:
    for case in (RIGHT, CLASS, SILENT, FAINT):
        assert CaseResult.from_json(case.to_json()) == case
    assert math.isnan(CaseResult.from_json(CLEAN.to_json()).signal_to_noise)


@pytest.mark.parametrize("line", ["", "{}", "[1]", RIGHT.to_json()[:-3], '{"seed": 1}'])
def test_other_lines_are_refused(line: str) -> None:
    with pytest.raises(InputError, match="one line of JSON"):
        CaseResult.from_json(line)
