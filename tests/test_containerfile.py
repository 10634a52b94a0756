"""The image is made from all that the wheel needs, with pinned versions that are there."""

import re
import tomllib
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]


def test_what_the_wheel_needs_is_not_ignored() -> None:
    lines = (CHECKOUT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    taken = {line[1:] for line in lines if line.startswith("!")}
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    linked = {
        path.resolve().relative_to(CHECKOUT).parts[0]
        for path in (CHECKOUT / "python").rglob("*")
        if path.is_symlink()
    }
    needed = {
        "constraints",
        "pyproject.toml",
        "python",
        project["readme"],
        *project["license-files"],
        *linked,
    }
    assert needed == taken
    assert all((CHECKOUT / name).exists() for name in taken)


def test_the_version_of_python_has_pinned_packages() -> None:
    text = (CHECKOUT / "Containerfile").read_text(encoding="utf-8")
    [version] = set(re.findall(r"^ARG PYTHON=(.*)$", text, re.MULTILINE))
    assert (CHECKOUT / "constraints" / f"python-{version}.txt").is_file()
