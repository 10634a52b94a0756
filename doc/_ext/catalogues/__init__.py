"""Pages that the package writes itself: a comment ``<!-- generated: NAME ARGUMENT -->`` becomes Markdown.

The comment is replaced when Sphinx reads the page, so that headings, links and the search see the result like any
other text. Every generator is a function of at most one word that returns Markdown.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

from . import api, commands, headers, physics, provenance, tasks

GENERATORS: dict[str, Callable[..., str]] = {
    "api": api.module_reference,
    "bandpasses": physics.bandpasses,
    "cameras": physics.cameras,
    "changes": provenance.changes,
    "commands": commands.fringe_sim_commands,
    "butler-commands": commands.butler_commands,
    "effects": physics.effects,
    "file-keywords": headers.file_keywords,
    "mask-planes": physics.mask_planes,
    "media": physics.media,
    "pipelines": tasks.pipelines,
    "provenance": provenance.tables,
    "raw-keywords": headers.raw_keywords,
    "setups": physics.setups,
    "stacks": physics.stacks,
    "tasks": tasks.task_reference,
    "telescopes": physics.telescopes,
}

_COMMENT = re.compile(r"^<!-- generated: ([\w-]+) ?([\w./]*) -->$", re.MULTILINE)


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect to the event that Sphinx sends for every source file."""
    app.connect("source-read", _expand)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _expand(app: Sphinx, docname: str, source: list[str]) -> None:
    def replacement(match: re.Match[str]) -> str:
        name, argument = match.groups()
        if name not in GENERATORS:
            raise ExtensionError(f"{docname}: nothing generates {name!r}")
        return GENERATORS[name](argument) if argument else GENERATORS[name]()

    source[0] = _COMMENT.sub(replacement, source[0])
