"""Opening a repository, also one whose last writer was killed.

A process that dies in the middle of a write leaves the journal of its transaction beside an SQLite registry. SQLite
undoes the transaction when the file is next opened for writing; a reader may not, and is refused with "attempt to
write a readonly database". `pipetask` reads before it writes, so that it cannot resume by itself.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from sqlalchemy.exc import DBAPIError

from lsst.daf.butler import Butler

from ..errors import InputError

__all__ = ["open_repository", "recover_repository"]


@contextlib.contextmanager
def open_repository(repo: str, *, writeable: bool = False) -> Iterator[Butler]:
    """Open a repository, and close it afterwards.

    Parameters
    ----------
    repo : `str`
        The repository.
    writeable : `bool`, optional
        Whether anything will be stored.

    Raises
    ------
    InputError
        There is no such repository, or its registry cannot be opened.
    """
    with _open(repo, writeable) as butler:
        yield butler


def recover_repository(repo: str) -> None:
    """Undo what a killed process has left half done in the registry.

    A repository on which all is well stays as it is; processes that are at work on it are waited for.

    Raises
    ------
    InputError
        There is no such repository, or its registry cannot be opened for writing.
    """
    try:
        with Butler.from_config(repo, writeable=True) as butler:
            butler.collections.query("*")
    except (FileNotFoundError, ValueError, RuntimeError) as error:
        raise _refusal(repo, error) from error
    except DBAPIError as error:
        raise InputError("registry", repo, f"one that can be read and written ({error.orig})") from error


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
