"""The page of a challenge."""

from dataclasses import replace

from lsst.fringe_sim.challenge.page import confusion_figure, write_challenge_report
from lsst.fringe_sim.challenge.result import CaseResult, ChallengeResult

CASE = CaseResult(
    0, "one", ("roughness",), {}, "named", ("bandwidth",), (("roughness",),), True, False, 50.0, 50.0, 0.99, 0.7,
    {"roughness.sigma": 1.5}, 0.97, 12.0,
)  # fmt: skip


def test_page_tells_what_was_reached_and_what_is_wanted(tmp_path) -> None:
    result = ChallengeResult(7, (CASE, replace(CASE, number=1, found=("roughness",), exact=True)))
    page = write_challenge_report(tmp_path / "page.html", result).read_text()
    assert "2 with one effect" in page
    assert "2 of 2" in page
    assert page.count("<figure>") == 4


def test_page_without_cases(tmp_path) -> None:
    assert write_challenge_report(tmp_path / "page.html", ChallengeResult(7, ())).exists()


def test_confusion_names_what_was_hidden_and_what_was_said() -> None:
    silent = replace(CASE, number=1, truth=(), kind="none", verdict="no_discrepancy", found=(), ambiguous=())
    axes = confusion_figure(ChallengeResult(7, (CASE, silent))).axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["nothing", "roughness"]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["bandwidth", "no_discrepancy"]
