"""What a command imports before it has anything to do: nothing that takes longer than a person waits for help."""

import subprocess
import sys

import pytest

HEAVY = ("astropy", "batoid", "galsim", "lsst.daf.butler", "matplotlib", "numba", "scipy", "speclite")


def imported_by(*arguments: str) -> set[str]:
    """Heavy packages that a command has imported when it ends, in a process of its own."""
    script = (
        "import sys\n"
        "from lsst.fringe_sim.cli.main import run\n"
        f"run({list(arguments)!r})\n"
        f"print('imported:', *(name for name in {HEAVY!r} if name in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split()[1:])


@pytest.mark.parametrize(
    "arguments",
    [
        ("--help",),
        ("fit", "--help"),
        ("sky", "--help"),
        ("templates", "--help"),
        ("correct", "--help"),
        ("discover", "--help"),
        ("mock-flats", "--help"),
        ("plan-flats", "--help"),
        ("demo", "--help"),
        ("challenge", "--help"),
        ("reproduce-paper", "--help"),
        ("evidence", "--help"),
        ("provenance", "--help"),
        ("fit", "raws"),
        ("fit", "raws", "--setup", "ts8_e2v", "--out", "fit", "--method", "none"),
        ("mock-flats", "raws", "--size", "512by512", "--seed", "1"),
    ],
    ids=" ".join,
)
def test_help_and_usage_errors_import_nothing_heavy(arguments: tuple[str, ...]) -> None:
    assert imported_by(*arguments) == set()


def test_a_list_of_setups_needs_no_compiler_and_no_repository() -> None:
    assert not imported_by("setups") & {"numba", "lsst.daf.butler", "matplotlib", "batoid", "galsim"}


def test_reading_raw_files_needs_no_repository() -> None:
    """Nothing there: the files have been looked for all the same."""
    assert "lsst.daf.butler" not in imported_by("fit", "no_such_folder", "--out", "fit", "--dry-run")
