"""The documentation builds without a warning, its examples run, and what it names exists."""

import doctest
import importlib
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import click
import pytest

from lsst.fringe_sim.cli.main import cli
from lsst.fringe_sim.middleware import get_cli_subcommands
from lsst.fringe_sim.resources import list_resources

CHECKOUT = Path(__file__).resolve().parents[1]
DOC = CHECKOUT / "doc"
PAGES = sorted(
    path.relative_to(DOC)
    for path in DOC.rglob("*.md")
    if not {"changes", "_build"} & set(path.relative_to(DOC).parts)
)
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
ROLE = re.compile(r"\{py:\w+\}`[~!]?([\w.]+)`")
RESOURCE = re.compile(r"resource://lsst\.fringe_sim/([\w./]+\w)")


def blocks(page: Path, language: str) -> Iterator[tuple[int, str]]:
    """Fenced blocks of one language, with the line of the page before their first line."""
    text = (DOC / page).read_text(encoding="utf-8")
    for match in BLOCK.finditer(text):
        if match[1] == language:
            yield text[: match.start(2)].count("\n"), match[2]


def names(pages: list[Path]) -> list[str]:
    return [str(page) for page in pages]


LONG = (
    "guide/interoperability.md",
    "guide/observed_frames.md",
    "tutorials/discovering_an_effect.md",
    "tutorials/flats_to_thickness.md",
    "tutorials/thickness_to_sky.md",
)
"""Pages of which the examples take a minute or more."""

WITH_EXAMPLES = [page for page in PAGES if any(True for _ in blocks(page, "pycon"))]


def test_there_are_executed_examples() -> None:
    wanted = {"extend/effect.md", "extend/material.md", "extend/ccd.md", "extend/telescope.md"}
    wanted |= {"extend/test_stand.md", "guide/physics.md", "tutorials/flats_to_thickness.md"}
    wanted |= {
        "tutorials/thickness_to_sky.md",
        "tutorials/discovering_an_effect.md",
        "guide/interoperability.md",
    }
    assert wanted <= set(names(WITH_EXAMPLES))


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=str(page), marks=[pytest.mark.slow] * (str(page) in LONG))
        for page in WITH_EXAMPLES
    ],
)
def test_examples_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All examples of a page share their names, as in one session; they may write files."""
    monkeypatch.chdir(tmp_path)
    parser, runner, namespace = doctest.DocTestParser(), doctest.DocTestRunner(), {"__name__": "__main__"}
    report: list[str] = []
    for line, text in blocks(page, "pycon"):
        example = parser.get_doctest(text, namespace, page.stem, str(page), line)
        runner.run(example, clear_globs=False, out=report.append)
        namespace.update(example.globs)
    assert runner.summarize(verbose=False).failed == 0, "".join(report)


@pytest.mark.parametrize("page", PAGES, ids=names(PAGES))
def test_linked_names_exist(page: Path) -> None:
    for dotted in ROLE.findall((DOC / page).read_text(encoding="utf-8")):
        assert _find(dotted) is not None, f"{page} links to {dotted}"


def _find(dotted: str) -> object | None:
    parts = dotted.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for name in parts[length:]:
            fields = getattr(found, "__dataclass_fields__", {})
            found = fields[name] if name in fields else getattr(found, name, None)
        return found
    return None


@pytest.mark.parametrize("page", PAGES, ids=names(PAGES))
def test_resources_exist(page: Path) -> None:
    for path in RESOURCE.findall((DOC / page).read_text(encoding="utf-8")):
        package = CHECKOUT / "python" / "lsst" / "fringe_sim"
        assert (package / path).exists(), f"{page} names resource://lsst.fringe_sim/{path}"


def test_resource_listing_is_not_empty() -> None:
    assert "configs/butler.yaml" in {
        path for page in PAGES for path in RESOURCE.findall((DOC / page).read_text(encoding="utf-8"))
    }
    assert list_resources("setups")


def shell_commands() -> Iterator[tuple[Path, list[str]]]:
    """Commands of this package in the shell blocks of all pages."""
    own = {str(command.name) for command in get_cli_subcommands()}
    for page in PAGES:
        for _, text in blocks(page, "bash"):
            for line in text.replace("\\\n", " ").splitlines():
                words = shlex.split(line, comments=True)
                if words[:1] == ["fringe-sim"] or (words[:1] == ["butler"] and words[1] in own):
                    yield page, words


COMMANDS = list(shell_commands())


@pytest.mark.parametrize(("page", "words"), COMMANDS, ids=[f"{p}: {' '.join(w)}" for p, w in COMMANDS])
def test_commands_and_options_exist(page: Path, words: list[str]) -> None:
    group = cli if words[0] == "fringe-sim" else _butler_group()
    context = click.Context(group, info_name=words[0])
    command = group.get_command(context, words[1])
    assert command is not None, f"{page}: {words[1]}"
    known = {
        name for option in command.get_params(context) for name in (*option.opts, *option.secondary_opts)
    }
    used = {word.partition("=")[0] for word in words[2:] if word.startswith("-")}
    assert used <= known, f"{page}: {used - known}"


def _butler_group() -> click.Group:
    group = click.Group("butler")
    for command in get_cli_subcommands():
        group.add_command(command)
    return group


class _Links(HTMLParser):
    """Targets of links, sources of what a page loads, and the places inside a page that a link may name."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.anchors: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        if tag in ("script", "img", "iframe") and "src" in values:
            self.loads.append(values["src"])
        if tag == "link" and values.get("rel") in ("stylesheet", "icon", "preload"):
            self.loads.append(values["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pages as HTML, built with every warning an error."""
    out = tmp_path_factory.mktemp("doc")
    command = [sys.executable, "-m", "sphinx", "-b", "html", "-W", "--keep-going", "-q", "-E"]
    done = subprocess.run(
        [*command, "-d", str(out / "doctrees"), str(DOC), str(out / "html")],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "NUMBA_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    return out / "html"


@pytest.mark.slow
def test_site_builds_without_warnings(site: Path) -> None:
    built = {path.relative_to(site).with_suffix("") for path in site.rglob("*.html")}
    assert {page.with_suffix("") for page in PAGES} <= built


@pytest.mark.slow
def test_site_is_whole_and_needs_no_network(site: Path) -> None:
    pages = {path: _Links() for path in site.rglob("*.html")}
    for path, parsed in pages.items():
        parsed.feed(path.read_text(encoding="utf-8"))
    for path, parsed in pages.items():
        for target in parsed.loads:
            url = urlsplit(target)
            if url.scheme == "data":  # the picture itself
                continue
            assert not url.netloc, f"{path.name} loads {target}"
            assert (path.parent / unquote(url.path)).is_file(), f"{path.name} lacks {target}"
        for target in parsed.links:
            url = urlsplit(target)
            if url.scheme or url.netloc:
                continue
            place = (path.parent / unquote(url.path)).resolve() if url.path else path
            assert place.is_file(), f"{path.name} links to {target}"
            if url.fragment and place in pages:
                assert unquote(url.fragment) in pages[place].anchors, f"{path.name} links to {target}"


@pytest.mark.slow
@pytest.mark.parametrize(("notebook", "figures"), [("flats_to_thickness", 4), ("thickness_to_sky", 4)])
def test_notebooks_show_what_they_computed(site: Path, notebook: str, figures: int) -> None:
    parsed = _Links()
    parsed.feed((site / "notebooks" / f"{notebook}.html").read_text(encoding="utf-8"))
    assert sum(source.startswith("../_images/") for source in parsed.loads) == figures
    # Products, set-ups and models show a table, with a picture where there is one.
    assert sum(source.startswith("data:image/png") for source in parsed.loads) == 2


@pytest.mark.slow
def test_linked_names_are_documented(site: Path) -> None:
    for page in PAGES:
        html = (site / page).with_suffix(".html").read_text(encoding="utf-8")
        if page.parts[:2] != ("reference", "api"):
            plain = re.findall(r'(?<!">)<code class="xref py[^>]*>.*?</code>', html)
            assert not plain, f"{page}: {plain}"


@pytest.mark.slow
def test_catalogues_are_complete(site: Path) -> None:
    from lsst.fringe_sim.effects import EFFECTS
    from lsst.fringe_sim.instrument.header_keywords import RAW_KEYWORDS
    from lsst.fringe_sim.model import setup_names
    from lsst.fringe_sim.tasks import EpoxyFitConfig

    effects = (site / "reference" / "effects.html").read_text(encoding="utf-8")
    for effect in EFFECTS:
        for parameter in effect.parameters:
            assert f"{effect.name}.{parameter.name}" in effects
    setups = (site / "reference" / "setups.html").read_text(encoding="utf-8")
    assert all(name in setups for name in setup_names())
    tasks = (site / "reference" / "tasks.html").read_text(encoding="utf-8")
    of_the_framework = {"connections", "saveLogOutput"}
    assert all(field in tasks for field in EpoxyFitConfig._fields if field not in of_the_framework)
    provenance = (site / "reference" / "provenance.html").read_text(encoding="utf-8")
    assert all(name in provenance for name in list_resources("media", ".ecsv"))
    headers = (site / "reference" / "headers.html").read_text(encoding="utf-8")
    assert all(item.name in headers for item in RAW_KEYWORDS)
    changes = (site / "reference" / "changes.html").read_text(encoding="utf-8")
    assert "simulate_sky_frame" in changes
