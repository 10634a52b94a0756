"""A search that runs as a Task stores the correction that the command writes."""

from pathlib import Path

import pytest

from lsst.fringe_sim.algorithms.discovery import Gap, Verdict, Where
from lsst.fringe_sim.effects import effects_from
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.tasks import EffectDiscoveryConfig, EffectDiscoveryTask, SkyFringeSimConfig
from lsst.fringe_sim.tasks import effect_discovery as module

pytestmark = pytest.mark.middleware

OWN = {f"learned_response.{wave}{h}_960": 0.01 / h for wave in ("cos", "sin") for h in (1, 2, 3)}
BESIDE = {"bandwidth.fwhm": 2.4}


def found(believed: bool) -> Verdict:
    told = {"name": "learned_response", "own": OWN, "beside": BESIDE, "believed": believed, "words": "smooth"}
    told |= dict.fromkeys(("before_rms", "after_rms", "noise_floor", "chance"), 0.0)
    gap = Gap("rms", *[float("nan")] * 5)
    return Verdict("unexplained", (), Where(), gap, (), {"reason": "not told"}, "ts8_e2v", 0.0, learned=told)


def run_with(monkeypatch: pytest.MonkeyPatch, verdict: Verdict) -> dict[str, object]:
    """What the Task stores of a verdict."""
    cube = object()  # nothing looks into it
    monkeypatch.setattr(module, "discover", lambda *_, **__: verdict)
    monkeypatch.setattr(module.FringeCube, "from_flats", lambda *_, **__: cube)
    task = EffectDiscoveryTask(config=EffectDiscoveryConfig())
    stored: dict[str, object] = task.run([], 1, Camera.from_name("ts8").detector("RTM-020_S01")).getDict()
    return stored


def test_a_correction_is_stored_as_an_override_and_as_an_effect(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    stored = run_with(monkeypatch, found(believed=True))
    (tmp_path / "learned.py").write_text(str(stored["learned"]))
    config = SkyFringeSimConfig()
    config.load(str(tmp_path / "learned.py"))
    assert dict(config.effects) == {**BESIDE, **OWN}
    assert "# Sensor RTM-020_S01." in str(stored["learned"])
    (tmp_path / "learned_effect.py").write_text(str(stored["learned_effect"]))
    with effects_from(tmp_path / "learned_effect.py") as (unnamed,):
        assert unnamed.name == "unnamed"


def test_one_that_is_not_believed_is_not_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    stored = run_with(monkeypatch, found(believed=False))
    assert stored["learned"] is None
    assert stored["learned_effect"] is None
    assert stored["verdict"]
