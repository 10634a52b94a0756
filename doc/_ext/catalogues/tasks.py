"""Task and pipeline reference in the Rubin manner, from connections, config fields and pipeline files."""

from __future__ import annotations

from importlib import resources
from typing import Any

import yaml
from lsst.pex.config import ChoiceField, ConfigDictField, DictField, ListField

from lsst.fringe_sim import tasks as task_package

from .api import importable
from .markdown import cell, code, sections, table

FRAMEWORK_FIELDS = {"connections", "saveLogOutput"}
PIPELINES = "resource://lsst.fringe_sim/pipelines"


def task_reference() -> str:
    """One section for every task of the package."""
    names = [name for name in task_package.__all__ if name.endswith("Task")]
    found = [task for task in (importable(task_package, name) for name in names) if task is not None]
    order = {label: position for position, label in enumerate(_labels_in_pipelines())}
    found.sort(key=lambda task: (order.get(task._DefaultName, len(order)), task.__name__))
    return sections(_task(task) for task in found)


def _task(task: Any) -> str:
    config = task.ConfigClass()
    connections = config.ConnectionsClass(config=config)
    parts = [
        f"## {task.__name__}",
        f"{_summary(task)} {_summary(type(connections))}",
        table(
            ("", ""),
            [
                ("label", code(task._DefaultName)),
                ("class", code(f"{task_package.__name__}.{task.__name__}")),
                ("one quantum for each", ", ".join(code(each) for each in sorted(connections.dimensions))),
            ],
        ),
        f"### {task.__name__}: datasets",
        table(("connection", "", "dataset type", "storage class", "dimensions", ""), _datasets(connections)),
        f"### {task.__name__}: configuration",
        table(("field", "type", "default", "meaning"), _fields(config)),
    ]
    return sections(parts)


def _datasets(connections: Any) -> list[tuple[str, ...]]:
    kinds = (
        ("input", connections.inputs),
        ("prerequisite", connections.prerequisiteInputs),
        ("output", connections.outputs),
    )
    rows = []
    for kind, names in kinds:
        for name in sorted(names):
            item = getattr(connections, name)
            rows.append(
                (
                    code(name),
                    kind,
                    code(item.name),
                    code(item.storageClass),
                    ", ".join(sorted(item.dimensions)) + (" (calibration)" if item.isCalibration else ""),
                    item.doc,
                )
            )
    return rows


def _fields(config: Any) -> list[tuple[str, ...]]:
    return [
        (code(name), _type(field), code(repr(_default(config, name))), _meaning(field))
        for name, field in config._fields.items()
        if name not in FRAMEWORK_FIELDS
    ]


def _type(field: Any) -> str:
    if isinstance(field, ConfigDictField | DictField):
        return f"{field.keytype.__name__} → {field.itemtype.__name__}"
    if isinstance(field, ListField):
        return f"list of {field.itemtype.__name__}"
    return str(field.dtype.__name__)


def _default(config: Any, name: str) -> Any:
    value = getattr(config, name)
    if isinstance(value, str | int | float) or value is None:
        return value
    return dict(value) if hasattr(value, "keys") else list(value)


def _meaning(field: Any) -> str:
    text = cell(field.doc).split("Allowed values:")[0].strip()
    if isinstance(field, ChoiceField):
        choices = "; ".join(f"`{value!r}` {doc}" for value, doc in field.allowed.items() if value is not None)
        return f"{text} {choices}."
    return text


def pipelines() -> str:
    """Every pipeline of a camera, then the ingredients they share, with tasks, subsets and contracts."""
    base = resources.files("lsst.fringe_sim") / "pipelines"
    folders = sorted((entry for entry in base.iterdir() if entry.is_dir()), key=lambda entry: entry.name)
    parts = []
    for folder in [*(f for f in folders if f.name[0] != "_"), *(f for f in folders if f.name[0] == "_")]:
        for file in sorted(folder.iterdir(), key=lambda entry: entry.name):
            if file.name.endswith(".yaml"):
                content = yaml.safe_load(file.read_text(encoding="utf-8"))
                parts.append(_pipeline(f"{folder.name}/{file.name}", content))
    return sections(parts)


def _pipeline(name: str, content: dict[str, Any]) -> str:
    parts = [f"### `{name}`", f"{content['description']}.", f"`-p {PIPELINES}/{name}`"]
    lines = []
    if "instrument" in content:
        lines.append(f"- instrument: `{content['instrument']}`")
    lines += [
        f"- includes `{item['location'].removeprefix(PIPELINES + '/')}`"
        for item in content.get("imports", [])
    ]
    lines += [
        f"- task `{label}`: `{item['class']}`{_set(item)}" for label, item in content.get("tasks", {}).items()
    ]
    for label, item in content.get("subsets", {}).items():
        members = ", ".join(f"`{member}`" for member in item["subset"])
        lines.append(f"- subset `#{label}` ({members}): {item['description']}")
    lines += [
        f"- contract `{item['contract']}`: {cell(item['msg'])}" for item in content.get("contracts", [])
    ]
    return sections([*parts, "\n".join(lines)])


def _set(item: dict[str, Any]) -> str:
    config = item.get("config", {})
    return f" with {', '.join(f'`{key} = {value}`' for key, value in config.items())}" if config else ""


def _labels_in_pipelines() -> list[str]:
    base = resources.files("lsst.fringe_sim") / "pipelines" / "_ingredients"
    labels: list[str] = []
    for name in (
        "labFlats.yaml",
        "skyFringe.yaml",
        "mapTemplates.yaml",
        "discovery.yaml",
        "skyDiscovery.yaml",
    ):
        if (base / name).is_file():
            labels += list(yaml.safe_load((base / name).read_text(encoding="utf-8"))["tasks"])
    return labels


def _summary(thing: Any) -> str:
    return " ".join((thing.__doc__ or "").strip().split("\n\n")[0].split())
