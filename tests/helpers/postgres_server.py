"""A PostgreSQL server of its own for the tests: on a socket in a temporary folder, gone afterwards.

The server refuses to be run by root. Under root it is run by the user `postgres` that the package of the
distribution brings along; under any other user by that user.
"""

import contextlib
import ctypes
import glob
import importlib.util
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PR_SET_PDEATHSIG = 1  # Linux: a signal for a process whose parent has died

SETTINGS = {
    "listen_addresses": "",
    "unix_socket_permissions": "0700",
    "shared_buffers": "32MB",
    "max_connections": "100",
}


class UnavailableError(Exception):
    """No server can be had here; the text says why."""


class PostgresServer:
    """One cluster of databases."""

    def __init__(self, folder: Path) -> None:
        self.programs = _programs()
        self.user = _server_user()
        self.folder = folder
        folder.chmod(0o700)
        if self.user:
            shutil.chown(folder, self.user, self.user)
        self._as_server(
            *("initdb", "-D", self.data, "-U", "fringe", "--auth=trust", "--encoding=UTF8", "--locale=C")
        )
        with open(self.data / "postgresql.conf", "a", encoding="utf-8") as settings:
            settings.writelines(f"{name} = '{value}'\n" for name, value in SETTINGS.items())
            settings.write(f"unix_socket_directories = '{folder}'\n")
        self.start()

    @property
    def data(self) -> Path:
        """Folder of the data."""
        return self.folder / "data"

    def start(self) -> None:
        """Start the server and wait until it takes connections."""
        with open(self.folder / "log", "a", encoding="utf-8") as log:
            self.process = subprocess.Popen(
                [self.programs / "postgres", "-D", self.data],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                preexec_fn=_die_with_the_parent,
                **self._identity(),
            )
        ready = [self.programs / "pg_isready", "-q", "-h", self.folder]
        for _ in range(1200):
            if subprocess.run(ready, **self._identity(), check=False).returncode == 0:
                return
            if self.process.poll() is not None:
                break
            time.sleep(0.05)
        raise AssertionError(f"the server did not start:\n{(self.folder / 'log').read_text()}")

    def stop(self, *, crash: bool = False) -> None:
        """Stop the server, and wait for its end; a crash writes nothing down."""
        self.process.send_signal(signal.SIGQUIT if crash else signal.SIGINT)
        self.process.wait(60)

    def url(self, database: str) -> str:
        """URL of a database for the configuration of a Butler."""
        return f"postgresql+psycopg2://fringe@/{database}?host={self.folder}"

    def new_database(self, name: str) -> str:
        """Make a database with what the Butler needs, and return its URL."""
        self.ask("postgres", f'CREATE DATABASE "{name}"')
        self.ask(name, "CREATE EXTENSION btree_gist")
        return self.url(name)

    def copy_database(self, name: str, copy: str) -> str:
        """Copy a database, of which the connections are closed, and return the URL of the copy."""
        self.ask(
            "postgres", f"SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = '{name}'"
        )
        self.ask("postgres", f'CREATE DATABASE "{copy}" TEMPLATE "{name}"')
        # Sequences of a copy are logged from the next checkpoint on only: a crash before it would take them back.
        self.ask("postgres", "CHECKPOINT")
        return self.url(copy)

    def ask(self, database: str, statement: str) -> str:
        """Run one statement, and return what it says."""
        return self._as_server(
            *("psql", "-h", self.folder, "-U", "fringe", "-d", database, "-v", "ON_ERROR_STOP=1", "-qAtc"),
            statement,
        )

    def _as_server(self, program: str, *arguments: object) -> str:
        command = [str(self.programs / program), *map(str, arguments)]
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
            **self._identity(),
        )
        if done.returncode:
            raise AssertionError(f"{program} ended with {done.returncode}:\n{done.stdout}")
        return done.stdout

    def _identity(self) -> dict[str, Any]:
        """Who runs the programs of the server, and where."""
        identity: dict[str, Any] = {"cwd": "/", "env": {"PATH": os.defpath, "LC_ALL": "C"}}
        if self.user:
            identity |= {"user": self.user, "group": pwd.getpwnam(self.user).pw_gid, "extra_groups": []}
        return identity


def _die_with_the_parent() -> None:
    """Ask the kernel to stop the server when the tests die; where it cannot, the server outlives them."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGQUIT)


def _programs() -> Path:
    if importlib.util.find_spec("psycopg2") is None:
        raise UnavailableError("psycopg2 is not installed (extra 'postgres')")
    found = sorted(
        glob.glob("/usr/lib/postgresql/*/bin/initdb"), key=lambda path: int(path.split("/")[4]), reverse=True
    )
    on_path = shutil.which("initdb")
    for candidate in [*found, *([on_path] if on_path else [])]:
        if Path(candidate).with_name("pg_ctl").exists():
            return Path(candidate).parent
    raise UnavailableError("the PostgreSQL server is not installed (Debian package postgresql)")


def _server_user() -> str | None:
    """Under root another user, else `None`."""
    if os.geteuid():
        return None
    for name in ("postgres", "nobody"):
        with contextlib.suppress(KeyError):
            pwd.getpwnam(name)
            return name
    raise UnavailableError("the PostgreSQL server refuses to be run by root, and there is no other user")


@contextlib.contextmanager
def postgres_server() -> Iterator[PostgresServer]:
    """A running server, removed with all that is in it."""
    # Not below the folder of pytest, which other users cannot enter and whose name is too long for a socket.
    folder = Path(tempfile.mkdtemp(prefix="fringe-pg-", dir="/tmp"))
    try:
        server = PostgresServer(folder)
        try:
            yield server
        finally:
            server.stop(crash=True)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
