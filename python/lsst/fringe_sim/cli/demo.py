"""``fringe-sim demo``: from raw laboratory frames to certified fringe templates, with the real programs."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import click

from .. import __version__
from ..errors import FringeSimError, InputError
from ..files import write_whole
from .output import LOCK, OutputFolder, output_folder
from .parameters import SIZE

__all__ = ["demo"]

SETUP = "ts8_e2v"
SENSOR = "E2V-CCD250-321"
NIGHT = "20260115"
FIRST_HOUR, LAST_HOUR = 19, 29
VALID = ("2025-01-01", "2035-01-01")
LAB_RUN, THICKNESS_RUN, SKY_RUN, CALIBRATIONS = "demo/lab", "demo/thickness", "demo/sky", "demo/calib"
PIPELINES = "resource://lsst.fringe_sim/pipelines"
SEED_CONFIG = "resource://lsst.fringe_sim/configs/butler.yaml"
STATE = "demo.json"
PRODUCTS = (STATE, "repo", "raws", "logs", "discovery", "report.html")


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
        self._done: list[str] = []
        if self._state.is_file():
            former = json.loads(self._state.read_text(encoding="utf-8"))
            if former["settings"] != asdict(self.settings):
                raise InputError(
                    "demo folder",
                    str(self.folder),
                    f"an empty folder, or one made with the same settings ({former['settings']})",
                )
            self._done = list(former["done"])
        elif any(entry.name != LOCK for entry in self.folder.iterdir()):
            raise InputError("demo folder", str(self.folder), "an empty folder, or one that a demo has made")
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

    def program(self, log: str, *command: str) -> None:
        """Run a program of this environment; its output goes to ``logs/<log>.log``."""
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
        if done.returncode != 0:
            tail = "\n".join(path.read_text(encoding="utf-8").splitlines()[-15:])
            raise DemoError(f"{command[0]} {command[1]} failed; see {path}\n{tail}")

    def _remember(self) -> None:
        text = json.dumps({"settings": asdict(self.settings), "done": self._done}, indent=2)
        write_whole(self._state, text)


@click.command()
@output_folder("Folder.", *PRODUCTS, default=Path("demo"), resumes=True)
@click.option("--size", type=SIZE, default="1024x1000", show_default=True, help="Pixels of the sensor.")
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True, help="Of the raw frames.")
@click.option("--fresh", is_flag=True, help="The same as --overwrite.")
@click.option("--dry-run", is_flag=True, help="Say what would be done.")
def demo(out: OutputFolder, size: tuple[int, int], seed: int, fresh: bool, dry_run: bool) -> None:
    """Run the whole chain on the built-in sensor: raw flats, thickness, sky, templates, report.

    The sensor is E2V-CCD250-321, sampled at fewer pixels. Everything is done by butler and pipetask in a SQLite
    repository; running it again does only what is missing.

    \b
    Example:
      fringe-sim demo --out demo
    """
    from ..instrument.camera import Camera

    text = f"{size[0]}x{size[1]}"
    shape = (size[1], size[0])
    Camera.from_name("ts8").detector(SENSOR).cut_down(shape)
    if dry_run:
        click.echo(f"would simulate {SENSOR} with {text} pixels and process it in {out}/repo")
        return
    from .demo_report import DemoDatasets, write_demo_report

    folder = _folder(replace(out, overwrite=True) if fresh else out).prepare()
    run = DemoRun(folder, DemoSettings(__version__, text, seed))
    click.echo(f"Demo in {folder}: {SENSOR}, {text} pixels")
    _laboratory(run, shape, text, seed)
    _sky(run)
    datasets = DemoDatasets.read(run.repo, LAB_RUN, SKY_RUN, CALIBRATIONS)
    if importlib.util.find_spec("lsst.fringe_sim.cli.discover") is not None:
        run.step("discovery", "search for a missing effect", lambda: _discover(run, seed))
    run.step("report", "figures and report", lambda: write_demo_report(folder, datasets))
    _closing_words(folder, datasets)


def _folder(out: OutputFolder) -> OutputFolder:
    """The same folder; cleared only if a demo made it, and nothing else lies there."""
    if not out.overwrite or not out.path.is_dir():
        return out
    others = sorted({entry.name for entry in out.path.iterdir()} - {*PRODUCTS, LOCK})
    if others:
        allowed = f"an empty folder, or one that a demo alone has made (there is {others[0]})"
        raise InputError("demo folder", str(out), allowed)
    return replace(out, overwrite=(out.path / STATE).is_file())


def _laboratory(run: DemoRun, shape: tuple[int, int], size: str, seed: int) -> None:
    import numpy as np

    from ..instrument.camera import Camera
    from ..instrument.measured_thickness import e2v_321
    from ..instrument.setup import Setup
    from ..middleware.instruments import Ts8Fringe
    from ..mock.raw_frames import write_mock_flats

    raws = run.folder / "raws"
    repo = str(run.repo)

    def simulate() -> None:
        shutil.rmtree(raws, ignore_errors=True)
        write_mock_flats(
            raws,
            setup=SETUP,
            detector=SENSOR,
            thickness_um=e2v_321(shape),
            wavelengths_nm=Setup.from_name(SETUP).wavelengths_nm,
            rng=np.random.default_rng(seed),
            size=size,
        )

    def create() -> None:
        shutil.rmtree(run.repo, ignore_errors=True)
        run.program("create", "butler", "create", repo, "--seed-config", SEED_CONFIG)

    def register() -> None:
        for instrument in ("Ts8Fringe", "LsstCamFringe"):
            run.program("register", "butler", "register-instrument", repo, f"lsst.fringe_sim.{instrument}")

    run.step("raws", "simulate raw bias frames and flats", simulate)
    run.step("create", "butler create", create)
    run.step("register", "butler register-instrument", register)
    run.step(
        "ingest",
        "butler ingest-fringe-raws",
        lambda: run.program("ingest", "butler", "ingest-fringe-raws", repo, str(raws)),
    )
    detector = Camera.from_name("ts8").detector(SENSOR).id
    where = f"instrument='{Ts8Fringe.getName()}' AND detector={detector}"
    run.step(
        "lab",
        "pipetask run: biases, flats, thickness",
        lambda: _pipetask(run, "lab", f"{Ts8Fringe.getName()}/raw/all", LAB_RUN, "ts8/labFlats.yaml", where),
    )


def _sky(run: DemoRun) -> None:
    from ..instrument.camera import Camera
    from ..middleware.instruments import LsstCamFringe

    repo, camera = str(run.repo), LsstCamFringe.getName()
    hours = f"{FIRST_HOUR}:{LAST_HOUR}"
    run.step(
        "night",
        "butler define-fringe-night",
        lambda: run.program(
            "night", "butler", "define-fringe-night", repo, camera, "--date", NIGHT, "--hours", hours
        ),
    )
    run.step(
        "adopt",
        "butler adopt-sensor-datasets",
        lambda: run.program(
            "adopt", "butler", "adopt-sensor-datasets", repo, "epoxyThickness", LAB_RUN, camera, THICKNESS_RUN
        ),
    )
    detector = Camera.from_name("lsstCam").detector(SENSOR).id
    where = f"instrument='{camera}' AND detector={detector}"
    run.step(
        "sky",
        "pipetask run: sky frames, templates",
        lambda: _pipetask(run, "sky", THICKNESS_RUN, SKY_RUN, "lsstCam/skyFringe.yaml", where),
    )
    begin, end = VALID
    run.step(
        "certify",
        "butler certify-calibrations",
        lambda: run.program(
            "certify",
            *("butler", "certify-calibrations", repo, SKY_RUN, CALIBRATIONS, "fringe"),
            *("--begin-date", begin, "--end-date", end),
        ),
    )


def _pipetask(run: DemoRun, log: str, inputs: str, output: str, pipeline: str, where: str) -> None:
    options: Sequence[str] = ("-i", inputs, "-o", output, "-p", f"{PIPELINES}/{pipeline}", "-d", where)
    run.program(log, "pipetask", "run", "-b", str(run.repo), *options, "--register-dataset-types", "-j", "1")


def _discover(run: DemoRun, seed: int) -> None:
    run.program(
        "discover",
        *("fringe-sim", "discover", str(run.folder / "raws"), "--setup", SETUP),
        *("--out", str(run.folder / "discovery"), "--overwrite", "--seed", str(seed)),
    )


def _closing_words(folder: Path, datasets: Any) -> None:
    click.echo("")
    click.echo(f"report            {folder / 'report.html'}")
    click.echo(f"fringe frames     {datasets.sky_folder}")
    click.echo(f"fringe template   {datasets.template_path}")
    click.echo(f"thickness map     {datasets.thickness_path}")
    verdict = folder / "discovery" / "discovery.json"
    if verdict.is_file():
        text = json.loads(verdict.read_text(encoding="utf-8"))["verdict"]
        click.echo(f"discovery verdict {verdict} ({text})")
