"""The chain closed: effects hidden in raw flats, found, and put into fit and sky by the override that is stored."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from lsst.daf.butler import Butler
from task_commands import WAVELENGTHS_NM, Command, Outcome

from lsst.fringe_sim.algorithms.discovery import Verdict
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.mock.raw_frames import MockRun, write_mock_flats
from lsst.fringe_sim.products import SkyFringe, ThicknessMap
from lsst.fringe_sim.tasks import EffectDiscoveryConfig, SkyFringeSimConfig, SkyFringeSimTask
from lsst.fringe_sim.tasks.sky_fringe_sim import SkyExposure

pytestmark = [pytest.mark.middleware, pytest.mark.slow]

PIPELINES = "resource://lsst.fringe_sim/pipelines/ts8"
ROWS, COLUMNS = 64, 128
ABSORBING, WARM = "RTM-020_S01", "RTM-006_S11"
HIDDEN = {ABSORBING: {"epoxy_absorption.k": 2e-3}, WARM: {"temperature.kelvin": 205.0}}
DETECTORS = {name: Camera.from_name("ts8").detector(name) for name in HIDDEN}
CONFIG = ("-c", "isrFlatPrep:edge_px=2")


@pytest.fixture(scope="module")
def hidden(tmp_path_factory: pytest.TempPathFactory) -> dict[str, MockRun]:
    """Raw frames of two sensors, each with an effect that the set-up does not tell."""
    root = tmp_path_factory.mktemp("hidden")
    y, x = np.mgrid[:ROWS, :COLUMNS]
    return {
        name: write_mock_flats(
            root / name,
            setup="ts8_e2v",
            detector=name,
            thickness_um=13.5 + 0.45 * np.sin(x / 30.0) + 0.3 * np.cos(y / 25.0),
            wavelengths_nm=WAVELENGTHS_NM,
            rng=np.random.default_rng(seed),
            size=f"{COLUMNS}x{ROWS}",
            n_bias=3,
            effects=effects,
        )
        for seed, (name, effects) in enumerate(HIDDEN.items())
    }


@pytest.fixture(scope="module")
def searched(
    command: Command, empty_repo: Path, hidden: dict[str, MockRun], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Repository after the search in both sensors."""
    repo = Path(shutil.copytree(empty_repo, tmp_path_factory.mktemp("discovery") / "repo"))
    folders = [run.paths[0].parent for run in hidden.values()]
    ingested = command("butler", "ingest-fringe-raws", repo, *folders, "--transfer", "direct")
    assert ingested.code == 0, ingested.text
    done = run_pipeline(command, repo, "u/found", "discovery.yaml", *CONFIG)
    assert done.code == 0, done.text
    assert "Executed" in done.text
    return repo


def run_pipeline(
    command: Command,
    repo: Path,
    out: str,
    pipeline: str,
    *extra: object,
    inputs: str = "LSST-TS8/raw/all",
    where: str = "instrument = 'LSST-TS8'",
) -> Outcome:
    return command(
        *("pipetask", "run", "-b", repo, "-i", inputs, "-o", out, "-p", f"{PIPELINES}/{pipeline}"),
        *("-d", where, "-j", "1", "--register-dataset-types", *extra),
    )


def override_file(repo: Path, name: str) -> Path:
    """Where the repository keeps the override of a sensor."""
    with Butler.from_config(str(repo), collections="u/found", instrument="LSST-TS8") as butler:
        ref = butler.query_datasets("effectOverride", where=f"detector = {DETECTORS[name].id}")[0]
        return Path(butler.getURI(ref).ospath)


@pytest.fixture(scope="module")
def maps(command: Command, searched: Path) -> dict[tuple[str, bool], ThicknessMap]:
    """Thickness of both sensors without what was found, and with it."""
    runs = [("u/without", "instrument = 'LSST-TS8'", ())]
    for name, detector in DETECTORS.items():
        extra = ("-C", f"epoxyFit:{override_file(searched, name)}")
        runs.append((f"u/with_{detector.id}", f"instrument = 'LSST-TS8' AND detector = {detector.id}", extra))
    for out, where, extra in runs:
        done = run_pipeline(
            command, searched, out, "labFlats.yaml#epoxyFit", *extra, inputs="u/found", where=where
        )
        assert done.code == 0, done.text
    with Butler.from_config(str(searched), instrument="LSST-TS8") as butler:
        return {
            (name, known): butler.get(
                "epoxyThickness",
                detector=detector.id,
                collections=f"u/with_{detector.id}" if known else "u/without",
            )
            for name, detector in DETECTORS.items()
            for known in (False, True)
        }


def test_one_sensor_of_a_repository_is_chosen_by_its_number_or_its_name(
    searched: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No collection, no sensor and several sensors are one sentence each."""

    def told(*options: str) -> str:
        run(["discover", str(searched), *options, "--dry-run", "--out", str(tmp_path / "out")])
        printed = capsys.readouterr()
        return printed.out + printed.err

    for name, detector in DETECTORS.items():
        for chosen in (name, str(detector.id)):
            assert "would search" in told("--collections", "u/found", "--detector", chosen)
    every = told("--collections", "u/found")
    assert "choose with --detector" in every
    assert all(name in every for name in DETECTORS)
    assert f"LSST-TS8 {next(iter(DETECTORS.values())).id}" in told("--detector", "R99_S99")
    assert "nosuch" in told("--collections", "nosuch")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", HIDDEN)
def test_the_hidden_effect_is_named(name: str, searched: Path) -> None:
    detector = DETECTORS[name]
    with Butler.from_config(str(searched), collections="u/found", instrument="LSST-TS8") as butler:
        stored = butler.get("effectDiscovery", detector=detector.id)
        text = butler.get("effectOverride", detector=detector.id)
    verdict = Verdict.from_json(json.dumps(stored))
    assert verdict.verdict == "named"
    (effect,) = verdict.effects
    (key,) = HIDDEN[name]
    assert key.split(".")[0] == effect.name
    assert effect.probability >= 0.95
    value = effect.parameters[key.split(".")[1]]
    assert abs(value.value - HIDDEN[name][key]) < 5.0 * value.sigma
    assert stored["model_override"] == "effectOverride"
    assert stored["gap"]["heldout_after"] < stored["gap"]["heldout_before"]
    assert stored["gap"]["heldout_after"] == pytest.approx(stored["gap"]["noise_floor"], rel=0.1)
    config = EffectDiscoveryConfig()
    config.load(str(override_file(searched, name)))
    assert dict(config.effects) == {key: value.value}
    assert f"# Sensor {name}.\n" in text


@pytest.mark.parametrize("name", HIDDEN)
def test_the_fit_with_what_was_found_has_the_contrast_of_the_model(
    name: str, maps: dict[tuple[str, bool], ThicknessMap], hidden: dict[str, MockRun]
) -> None:
    without, known = maps[name, False], maps[name, True]
    good = (without.mask == 0) & (known.mask == 0)
    assert good.mean() > 0.5
    truth = hidden[name].truth.thickness_um
    error_nm = {item: 1e3 * np.abs(item_map.value - truth)[good] for item, item_map in
                (("without", without), ("known", known))}  # fmt: skip
    assert np.median(known.chi2[good]) == pytest.approx(1.0, abs=0.2)
    # The default learns what the effect does to the fringes: the map hardly suffers, and the contrast tells.
    assert np.median(error_nm["known"]) < 1.1 * np.median(error_nm["without"])
    off = {item: np.abs(item_map.contrast - 1.0).mean() for item, item_map in
           (("without", without), ("known", known))}  # fmt: skip
    assert off["known"] < off["without"]
    (key,) = HIDDEN[name]
    assert known.metadata["EFFECT0"] == key
    assert "EFFECT0" not in without.metadata


def sky_of(thickness: ThicknessMap, config: SkyFringeSimConfig) -> SkyFringe:
    config.noise = False
    config.validate()
    exposure = SkyExposure(7026112100660, 20261121, 20.0, 30.0, 1.2, "y_10")
    detector = Camera.from_name("lsstCam").detector("R22_S11")
    sky: SkyFringe = SkyFringeSimTask(config=config).run(thickness, exposure, detector).sky
    return sky


def sky_config(override: Path) -> SkyFringeSimConfig:
    config = SkyFringeSimConfig()
    config.load(str(override))
    return config


def test_the_forecast_of_the_sky_follows(
    searched: Path, maps: dict[tuple[str, bool], ThicknessMap], hidden: dict[str, MockRun]
) -> None:
    """An absorbing adhesive changes the pattern of the sky, too: less light returns the thicker it is."""
    without = sky_of(maps[ABSORBING, False], SkyFringeSimConfig())
    known = sky_of(maps[ABSORBING, True], sky_config(override_file(searched, ABSORBING)))
    as_it_is = SkyFringeSimConfig()
    as_it_is.effects.update(HIDDEN[ABSORBING])
    truth = dataclasses.replace(
        maps[ABSORBING, True], value=hidden[ABSORBING].truth.thickness_um, metadata={}
    )
    real = sky_of(truth, as_it_is).fraction()
    good = (without.mask == 0) & (known.mask == 0)
    fringe = np.std(real[good])
    assert np.std((known.fraction() - real)[good]) < 0.05 * fringe
    assert np.std((without.fraction() - real)[good]) > 0.15 * fringe
    assert np.std(known.fraction()[good]) == pytest.approx(fringe, rel=0.03)
    assert known.metadata["EFFECT0"] == "epoxy_absorption.k"


def test_the_cryostat_stays_in_the_laboratory(searched: Path) -> None:
    choice = sky_config(override_file(searched, WARM)).choice()
    assert choice.left_out == ("temperature.kelvin",)
    assert choice.applied_effects == {}


def test_fit_and_sky_must_both_be_told(maps: dict[tuple[str, bool], ThicknessMap], searched: Path) -> None:
    with pytest.raises(InputError, match="effects"):
        sky_of(maps[ABSORBING, True], SkyFringeSimConfig())
    with pytest.raises(InputError, match="effects"):
        sky_of(maps[ABSORBING, False], sky_config(override_file(searched, ABSORBING)))
