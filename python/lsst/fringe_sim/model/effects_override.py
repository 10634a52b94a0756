"""Effects in a config override, as a search leaves it: written, and read without executing anything."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping

from ..effects import catalogue_of, known_effects
from ..errors import InputError

_STATEMENT = re.compile(r"""config\.effects\[(["'])([\w.]+)\1\]\s*=\s*([^#]+?)\s*(?:#.*)?""")

_WRITTEN = "config.written_effects = "
_BEGINNING = "# Effects found in data of set-up "
_NEEDS = "# Needs effects of "
_END = "# End; SHA-256 of the lines above: "


def effects_override(
    settings: Mapping[str, float],
    setup: str,
    verdict: str,
    *,
    known: Mapping[str, float] | None = None,
    detector: str | None = None,
) -> str:
    """Text of an override that puts effects into fit, sky simulation and templates.

    Effects that are not those of this package bring a comment that says in which catalogue they are.

    Its first line states the names of the effects and a hash of their values, which the configuration of a task
    compares with what it got; its last line the hash of all others. A file that was cut short is not taken for a
    shorter one.

    ``settings``: values by ``effect.parameter``.
    ``setup``, ``verdict``: set-up of the data in which they were found, and the verdict on them.
    ``known``: effects that were in the model before the search.
    ``detector``: name of the sensor.
    """
    lines = [f"{_WRITTEN}{written_effects({**(known or {}), **settings})!r}"]
    lines.append(f"{_BEGINNING}{_quoted(setup)}; verdict: {_quoted(verdict)}.")
    if detector is not None:
        lines.append(f"# Sensor {_quoted(detector)}.")
    lines.append("# Use with -C label:effects.py on any task that reads effects.")
    lines += _needs({**(known or {}), **settings})
    if known:
        lines += ["# Known before the search:", *_statements(known), "# Found by it:"]
    return ended("\n".join([*lines, *_statements(settings)]) + "\n")


def ended(text: str) -> str:
    """A text with a last line by which it can be told from one that was cut short or changed."""
    return f"{text}{_END}{_hash(text)}\n"


def is_as_written(text: str) -> bool:
    """Whether a text ends as `ended` left it, and nobody has changed it since."""
    content, mark, stated = text.rpartition(_END)
    return bool(mark) and stated.strip() == _hash(content)


def _needs(settings: Mapping[str, float]) -> list[str]:
    """Comments that name the catalogues of effects which are not those of this package."""
    names: dict[str, list[str]] = {}
    for name in dict.fromkeys(key.partition(".")[0] for key in settings):
        source = catalogue_of(name)
        if source:
            names.setdefault(source, []).append(name)
    return [f"{_NEEDS}{_quoted(source)} for {', '.join(found)}" for source, found in names.items()]


def _refuse_unknown(effects: Mapping[str, float], text: str, source: str | None) -> None:
    """Refuse effects that are not known here, where the override says of which catalogue they are."""
    known = {effect.name for effect in known_effects()}
    unknown = {key.partition(".")[0] for key in effects} - known
    for line in text.splitlines():
        catalogue, _, names = line.removeprefix(_NEEDS).rpartition(" for ")
        missing = sorted(unknown & set(names.split(", ")))
        if line.startswith(_NEEDS) and missing:
            how = catalogue if catalogue.startswith("entry point") else f"--effects-from {catalogue}"
            raise InputError("effect", ", ".join(missing), f"known with {how}", source=source)


def _statements(settings: Mapping[str, float]) -> list[str]:
    return [f"config.effects[{str(key)!r}] = {float(value)!r}" for key, value in settings.items()]


def written_effects(settings: Mapping[str, float]) -> str:
    """Names of effects, sorted, and a hash of their values."""
    names = sorted(settings)
    values = "\n".join(f"{name}={float(settings[name])!r}" for name in names)
    return " ".join([*names, _hash(values)[:16]])


def refuse_other_effects(written: str, settings: Mapping[str, float]) -> None:
    """Refuse effects that are not those that an override says it was written with; others may stand beside them.

    ``written``: what `written_effects` returned; empty without such an override.
    ``settings``: values by ``effect.parameter``.
    `InputError`: an effect is missing or has another value.
    """
    *names, _ = written.split() or [""]
    if written and written_effects({name: settings[name] for name in names if name in settings}) != written:
        raise InputError(
            "written_effects",
            written,
            "that of the effects which were set: the override was cut short or changed (run the search again), or "
            "another one changes its values (then set written_effects to '')",
        )


def _quoted(name: str) -> str:
    """A name as it can stand in a comment: nothing in it ends the line."""
    return name if name.isprintable() else repr(name)


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def read_effects_override(text: str, source: str | None = None) -> dict[str, float]:
    """Values by ``effect.parameter`` in the text of an override file; nothing is executed.

    Lines set one effect to a number each. Refused are other lines, effects of a catalogue that is not there, a file
    that a search has begun and not ended, and one written by hand that sets nothing.
    """
    complete = _is_complete(text, source)
    found: dict[str, float] = {}
    for line in map(str.rstrip, text.splitlines()):
        if not line or line.lstrip().startswith("#") or (complete and line.startswith(_WRITTEN)):
            continue
        statement = _STATEMENT.fullmatch(line)
        try:
            if statement is None:
                raise ValueError
            value = float(statement[3])
        except ValueError:
            allowed = 'lines of config.effects["effect.parameter"] = number'
            raise InputError("statement", line, allowed, source=source) from None
        if statement[2] in found and not complete:  # a search may find another value than was known
            raise InputError("statement", line, f"{statement[2]} once", source=source)
        found[statement[2]] = value
    _refuse_unknown(found, text, source)
    if not found and not complete:
        raise InputError("override file", "without any effect", "one that sets at least one", source=source)
    return found


def _is_complete(text: str, source: str | None) -> bool:
    """Whether a search wrote a text to its end; `False` for one written by hand, which says nothing of it."""
    if not text.startswith((_WRITTEN, _BEGINNING)):
        return False
    if not is_as_written(text):
        raise InputError(
            "override file",
            "not what a search has written: cut short, or changed",
            "the whole file (run the search again), or one without its first two lines, if it was changed by hand",
            source=source,
        )
    return True
