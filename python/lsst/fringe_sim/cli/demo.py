"""``fringe-sim demo``: an effect hidden in raw flats, found, and taken along to certified fringe templates."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .. import __version__
from ..errors import FringeSimError, InputError
from ..files import json_text, write_whole
from .command import command, flag, option
from .output import LOCK, OutputFolder, output_folder
from .parameters import SIZE

if TYPE_CHECKING:
    from .demo_outcome import Outcome
    from .demo_report import DemoDatasets

SETUP = "ts8_e2v"
SENSOR = "E2V-CCD250-321"
NIGHT = "20260115"
FIRST_HOUR, LAST_HOUR = 19, 29
VALID = ("2025-01-01", "2035-01-01")
LAB_RUN, FOUND_RUN, THICKNESS_RUN = "demo/lab", "demo/found", "demo/thickness"
SKY_RUN, CALIBRATIONS = "demo/sky", "demo/calib"
PIPELINES = "resource://lsst.fringe_sim/pipelines"
SEED_CONFIG = "resource://lsst.fringe_sim/configs/butler.yaml"
STATE = "demo.json"
SEALED = "sealed"
PRODUCTS = (
    *(STATE, "repo", "raws", "logs", "figures", SEALED, "discovery", "model.py", "report.html"),
    *("sky_without", "sky_with", "visits", "corrected"),
)
VISITS = 6


class DemoError(FringeSimError):
    """One of the programs that the demo runs has failed."""


@dataclass(frozen=True)
class DemoSettings:
    """What decides the content of a demo folder."""

    version: str
    size: str
    seed: int


@dataclass
class DemoRun:
    """Steps of the demo; those that a former run has finished are not done again."""

    folder: Path  # where everything goes
    settings: DemoSettings  # written beside the results; a folder made with other settings is refused

    def __post_init__(self) -> None:
        self._state = self.folder / STATE
        self._done = _steps_done(self.folder, self.settings)
        (self.folder / "logs").mkdir(exist_ok=True)

    @property
    def repo(self) -> Path:
        """The Butler repository."""
        return self.folder / "repo"

    def step(self, name: str, title: str, action: Callable[[], None]) -> None:
        """Do one step, say how long it took, and remember that it is done."""
        if name in self._done:
            click.echo(f"  {title}: done before")
            return
        start = time.monotonic()
        click.echo(f"  {title} … ", nl=False)
        try:
            action()
        except Exception:
            click.echo("failed")
            raise
        click.echo(f"{time.monotonic() - start:.1f} s")
        self._done.append(name)
        self._remember()

    def beside(self, name: str, title: str, action: Callable[[], None]) -> Callable[[], None]:
        """Begin a step beside those that follow; what is returned waits for its end."""
        if name in self._done:
            return lambda: self.step(name, title, action)
        click.echo(f"  {title}: begun")
        with_thread = ThreadPoolExecutor(1)
        future: Future[None] = with_thread.submit(action)
        with_thread.shutdown(wait=False)
        return lambda: self.step(name, f"{title}, what was left of it", future.result)

    def program(self, log: str, *command: str, may_refuse: bool = False) -> None:
        """Run a program of this environment; its output goes to ``logs/<log>.log``.

        ``may_refuse``: whether a run that ended with 1 after it had refused some of its frames is as good.
        """
        path = self.folder / "logs" / f"{log}.log"
        binary = Path(sys.executable).parent / command[0]
        environment = {**os.environ, "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "2")}
        with path.open("w", encoding="utf-8") as output:
            output.write("$ " + " ".join(command) + "\n")
            output.flush()
            done = subprocess.run(
                [str(binary), *command[1:]],
                stdout=output,
                stderr=subprocess.STDOUT,
                env=environment,
                check=False,
            )
        if done.returncode not in ((0, 1) if may_refuse else (0,)):
            tail = "\n".join(path.read_text(encoding="utf-8").splitlines()[-15:])
            raise DemoError(f"{command[0]} {command[1]} failed; see {path}\n{tail}")

    def butler(self, name: str, command: str, *words: str) -> None:
        """A step that is one command of ``butler`` on the repository."""
        title = f"butler {command}"
        self.step(name, title, lambda: self.program(name, "butler", command, str(self.repo), *words))

    def pipetask(
        self, name: str, what: str, inputs: str, output: str, pipeline: str, where: str, *overrides: str
    ) -> None:
        """A step that runs a pipeline in the repository."""
        options = ("-i", inputs, "-o", output, "-p", f"{PIPELINES}/{pipeline}", "-d", where)
        given = [word for override in overrides for word in ("-C", override)]
        words = (
            "pipetask",
            "run",
            "-b",
            str(self.repo),
            *options,
            *given,
            "--register-dataset-types",
            "-j",
            "1",
        )
        self.step(name, f"pipetask run: {what}", lambda: self.program(name, *words))

    def _remember(self) -> None:
        text = json_text({"settings": asdict(self.settings), "done": self._done})
        write_whole(self._state, text)


@command()
def demo(
    out: OutputFolder = output_folder("Folder.", *PRODUCTS, default=Path("demo"), resumes=True),
    size: tuple[int, int] = option("Pixels of the part of the sensor.", "1024x1024", SIZE),
    seed: int = option("Of the hidden effect, its size and all noise.", 1, click.IntRange(0)),
    fresh: bool = flag("The same as --overwrite."),
    dry_run: bool = flag("Say what would be done."),
) -> None:
    """Hide an effect in raw flats, find it, and make templates with what was found.

    The sensor is a part of E2V-CCD250-321. The seed decides which effect is hidden in its flats beside the weak
    fringes that real sensors show. They are fitted and searched by programs that cannot see the truth, what was
    found is added to the model, templates are made by butler and pipetask in a SQLite repository, and visits with
    stars are corrected. The last page shows truth and verdict side by side, whatever they are. Running it again
    does only what is missing.

    \b
    Example:
      fringe-sim demo --seed 2 --out demo
    """
    from ..instrument.camera import Camera

    text = f"{size[0]}x{size[1]}"
    shape = (size[1], size[0])
    Camera.from_name("ts8").detector(SENSOR).cut_down(shape)
    settings = DemoSettings(__version__, text, seed)
    out = _folder(replace(out, overwrite=True) if fresh else out)
    if dry_run:
        if not out.overwrite:
            _steps_done(out.path, settings)
        words = f"would simulate {text} pixels of {SENSOR} with a hidden effect and process them in"
        click.echo(f"{words} {out}/repo")
        return
    from .demo_outcome import Outcome
    from .demo_report import DemoDatasets, write_demo_report
    from .demo_truth import DemoTruth

    folder = out.prepare()
    run = DemoRun(folder, settings)
    truth = DemoTruth(folder / SEALED, seed, shape)
    click.echo(f"Demo in {folder}: {text} pixels of {SENSOR}, seed {seed}")
    words = "hide an effect, simulate raw bias frames and flats"
    run.step("raws", words, lambda: truth.write_flats(folder / "raws"))
    searched = run.beside("discovery", "search for a missing effect", lambda: _discover(run, seed))
    _laboratory(run)
    run.step("visits", "simulate visits with stars", lambda: truth.write_visits(folder / "visits", VISITS))
    run.step("sky_without", "forecast of the sky, unchanged model", lambda: _forecast(run, "sky_without"))
    searched()
    _with_what_was_found(run)
    _sky(run)
    run.step("correct", "correct the visits", lambda: _correct(run))
    datasets = DemoDatasets.read(run.repo, LAB_RUN, FOUND_RUN, SKY_RUN)
    outcome = Outcome.read(folder, truth, (datasets.first_thickness, datasets.thickness))
    run.step("report", "figures and report", lambda: write_demo_report(folder, datasets, outcome))
    _closing_words(folder, datasets, outcome)


def _steps_done(folder: Path, settings: DemoSettings) -> list[str]:
    """Steps that a former run with these settings has done in the folder; another folder is refused."""
    state = folder / STATE
    if state.is_file():
        former = json.loads(state.read_text(encoding="utf-8"))
        if former["settings"] != asdict(settings):
            allowed = f"an empty folder, or one made with the same settings ({former['settings']})"
            raise InputError("demo folder", str(folder), allowed)
        return list(former["done"])
    if folder.is_dir() and any(entry.name != LOCK for entry in folder.iterdir()):
        raise InputError("demo folder", str(folder), "an empty folder, or one that a demo has made")
    return []


def _folder(out: OutputFolder) -> OutputFolder:
    """The same folder; cleared only if a demo made it, and nothing else lies there."""
    if not out.overwrite or not out.path.is_dir():
        return out
    others = sorted({entry.name for entry in out.path.iterdir()} - {*PRODUCTS, LOCK})
    if others:
        allowed = f"an empty folder, or one that a demo alone has made (there is {others[0]})"
        raise InputError("demo folder", str(out), allowed)
    return replace(out, overwrite=(out.path / STATE).is_file())


def _laboratory(run: DemoRun) -> None:
    """Raw frames into a repository, and the thickness with the unchanged model."""
    repo = str(run.repo)

    def create() -> None:
        shutil.rmtree(run.repo, ignore_errors=True)
        run.program("create", "butler", "create", repo, "--seed-config", SEED_CONFIG)

    def register() -> None:
        for instrument in ("Ts8Fringe", "LsstCamFringe"):
            run.program("register", "butler", "register-instrument", repo, f"lsst.fringe_sim.{instrument}")

    run.step("create", "butler create", create)
    run.step("register", "butler register-instrument", register)
    run.butler("ingest", "ingest-fringe-raws", str(run.folder / "raws"))
    inputs = f"{_ts8()}/raw/all"
    run.pipetask("lab", "biases, flats, thickness", inputs, LAB_RUN, "ts8/labFlats.yaml", _in_ts8())


def _with_what_was_found(run: DemoRun) -> None:
    """The verdict becomes an override of the model, and the thickness is fitted again with it."""
    override = run.folder / "model.py"

    def write() -> None:
        from ..algorithms.discovery import Verdict
        from ..challenge.demo_case import of_the_layers
        from ..model.effects_override import effects_override

        verdict = Verdict.from_json((run.folder / "discovery" / "discovery.json").read_text(encoding="utf-8"))
        text = effects_override(of_the_layers(verdict.settings), verdict.setup, verdict.verdict)
        write_whole(override, text)

    run.step("model", "add what was found to the model", write)
    words = "thickness with what was found"
    pipeline, changed = "ts8/labFlats.yaml#epoxyFit", f"epoxyFit:{override}"
    run.pipetask("found", words, LAB_RUN, FOUND_RUN, pipeline, _in_ts8(), changed)
    forecast = partial(_forecast, run, "sky_with", "--effects-file", str(override))
    run.step("sky_with", "forecast of the sky, with it", forecast)


def _sky(run: DemoRun) -> None:
    from ..instrument.camera import Camera
    from ..middleware.instruments import LsstCamFringe

    camera = LsstCamFringe.getName()
    run.butler(
        "night", "define-fringe-night", camera, "--date", NIGHT, "--hours", f"{FIRST_HOUR}:{LAST_HOUR}"
    )
    run.butler("adopt", "adopt-sensor-datasets", "epoxyThickness", FOUND_RUN, camera, THICKNESS_RUN)
    detector = Camera.from_name("lsstCam").detector(SENSOR).id
    where = f"instrument='{camera}' AND detector={detector}"
    override = f"skyFringeSim:{run.folder / 'model.py'}"
    pipeline = "lsstCam/skyFringe.yaml"
    run.pipetask("sky", "sky frames, templates", THICKNESS_RUN, SKY_RUN, pipeline, where, override)
    dates = ("--begin-date", VALID[0], "--end-date", VALID[1])
    run.butler("certify", "certify-calibrations", SKY_RUN, CALIBRATIONS, "fringe", *dates)


def _ts8() -> str:
    from ..middleware.instruments import Ts8Fringe

    return str(Ts8Fringe.getName())


def _in_ts8() -> str:
    from ..instrument.camera import Camera

    return f"instrument='{_ts8()}' AND detector={Camera.from_name('ts8').detector(SENSOR).id}"


def _discover(run: DemoRun, seed: int) -> None:
    from ..challenge.demo_case import CELLS

    run.program(
        "discover",
        *("fringe-sim", "discover", str(run.folder / "raws"), "--setup", SETUP),
        *("--out", str(run.folder / "discovery"), "--overwrite", "--seed", str(seed)),
        *("--cells", str(CELLS)),
    )


def _forecast(run: DemoRun, name: str, *effects: str) -> None:
    from .demo_report import dataset_path

    collection = FOUND_RUN if effects else LAB_RUN
    thickness = dataset_path(run.repo, "epoxyThickness", collection)
    run.program(
        name,
        *("fringe-sim", "sky", "--thickness", str(thickness), "--detector", SENSOR, "--noiseless", *effects),
        *("--out", str(run.folder / name), "--overwrite"),
    )


def _correct(run: DemoRun) -> None:
    from .demo_report import dataset_path

    template = dataset_path(run.repo, "fringe", SKY_RUN)
    run.program(
        "correct",
        *("fringe-sim", "correct", str(run.folder / "visits"), "--templates", str(template)),
        *("--out", str(run.folder / "corrected"), "--overwrite"),
        may_refuse=True,
    )
    if not (run.folder / "corrected" / "report.html").is_file():
        raise DemoError(f"fringe-sim correct failed; see {run.folder / 'logs' / 'correct.log'}")


def _closing_words(folder: Path, datasets: DemoDatasets, outcome: Outcome) -> None:
    click.echo("")
    for what, said in outcome.lines():
        click.echo(f"{what}: {said}")
    click.echo("")
    click.echo(f"report            {folder / 'report.html'}")
    click.echo(f"evidence          {folder / 'discovery' / 'report.html'}")
    click.echo(f"fringe frames     {datasets.sky_folder}")
    click.echo(f"fringe template   {datasets.template_path}")
    click.echo(f"thickness map     {datasets.thickness_path}")
    click.echo(f"corrected visits  {folder / 'corrected'}")
