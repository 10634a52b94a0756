"""Opening a repository, also one whose last writer was killed.

A process that dies in the middle of a write leaves the journal of its transaction beside an SQLite registry. SQLite
undoes the transaction when the file is next opened for writing; a reader may not, and is refused with "attempt to
write a readonly database". `pipetask` reads before it writes, so that it cannot resume by itself.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from sqlalchemy.exc import DBAPIError

from lsst.daf.butler import Butler, ButlerConfig, Config

from ..errors import InputError
from ..files import write_whole

SEED = "resource://lsst.fringe_sim/configs/butler.yaml"
"""Storage classes and formatters that a repository needs for the datasets of this package."""

SECTIONS = (("storageClasses",), ("datastore", "formatters"))


@contextlib.contextmanager
def open_repository(repo: str, *, writeable: bool = False) -> Iterator[Butler]:
    """Open a repository, and close it afterwards.

    ``repo``: the repository.
    ``writeable``: whether anything will be stored.
    `InputError`: there is no such repository, or its registry cannot be opened.
    """
    with _open(repo, writeable) as butler:
        yield butler


def recover_repository(repo: str) -> None:
    """Undo what a killed process has left half done in the registry.

    A repository on which all is well stays as it is; processes that are at work on it are waited for.

    `InputError`: there is no such repository, or its registry cannot be opened for writing.
    """
    try:
        with Butler.from_config(repo, writeable=True) as butler:
            butler.collections.query("*")
    except (FileNotFoundError, ValueError, RuntimeError) as error:
        raise _refusal(repo, error) from error
    except DBAPIError as error:
        raise InputError("registry", repo, f"one that can be read and written ({error.orig})") from error


def require_prepared(repo: str) -> None:
    """Refuse a repository in which datasets of this package cannot be stored.

    `InputError`: there is no such repository, or it lacks storage classes or formatters.
    """
    found = unprepared(_config(repo), repo)
    if found is not None:
        raise found


def unprepared(config: Config, repo: str) -> InputError | None:
    """What a repository of this configuration lacks for datasets of this package; `None` if nothing."""
    missing = _missing(config)
    if not missing:
        return None
    names = ", ".join(dict.fromkeys(key[-1] for key in missing))
    allowed = f"one that knows them; butler prepare-fringe-repo {repo} adds what is missing"
    return InputError("storage classes and formatters", f"without {names}", allowed, source=repo)


def prepare_repository(repo: str) -> list[str]:
    """Add to the configuration of a repository what it lacks for the datasets of this package.

    What it has of the same names stays as it is. Doing it twice changes nothing.

    Returns names of storage classes and formatters.
    `InputError`: there is no such repository, or its datastore or configuration has to be changed by hand.
    """
    config = _config(repo)
    missing, file = _missing(config), config.configFile
    if not missing:
        return []
    if file is None or not file.isLocal or "formatters" not in config["datastore"]:
        raise InputError(
            "repository", repo, f"one with a file datastore and a local configuration, or {SEED} by hand"
        )
    own, seed = Config(file), Config(SEED)
    for key in missing:
        own[key] = seed[key]
    write_whole(file.ospath, str(own.dump(format="yaml")))
    return [key[-1] for key in missing]


def _config(repo: str) -> ButlerConfig:
    try:
        return ButlerConfig(repo)
    except (FileNotFoundError, ValueError, RuntimeError) as error:
        raise _refusal(repo, error) from error


def _missing(config: Config) -> list[tuple[str, ...]]:
    """Keys of the seed that a configuration has not."""
    seed = Config(SEED)
    return [
        (*section, name) for section in SECTIONS for name in seed[section] if (*section, name) not in config
    ]


def _open(repo: str, writeable: bool) -> Butler:
    try:
        return Butler.from_config(repo, writeable=writeable)
    except (FileNotFoundError, ValueError, RuntimeError) as error:
        raise _refusal(repo, error) from error
    except DBAPIError:
        recover_repository(repo)
        return Butler.from_config(repo, writeable=writeable)


def _refusal(repo: str, error: Exception) -> InputError:
    return InputError("repository", repo, f"a butler repository ({error})")
