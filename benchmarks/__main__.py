"""Run the benchmarks and print their tables."""

from __future__ import annotations

import argparse
import importlib
import pkgutil
import sys
from pathlib import Path

from . import _table

ALONE = ("panel", "demo", "gate")
"""Not among those that run by default: they take long, have arguments of their own and say whether they failed."""


def main() -> None:
    if sys.argv[1:] and sys.argv[1] in ALONE:
        sys.exit(importlib.import_module(f"benchmarks.{sys.argv[1]}").main(sys.argv[2:]))
    here = Path(__file__).parent
    names = [
        module.name
        for module in pkgutil.iter_modules([str(here)])
        if not module.name.startswith("_") and module.name not in ALONE
    ]
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"which ones (default: all of {', '.join(names)})"
    )
    chosen = parser.parse_args().names or names
    unknown = sorted(set(chosen) - set(names))
    if unknown:
        parser.error(f"no benchmark called {', '.join(unknown)}; there are {', '.join(names)}")
    print(f"Machine: {_table.machine()}.\n", flush=True)
    for name in chosen:
        rows = importlib.import_module(f"benchmarks.{name}").run()
        print(f"## {name}\n\n{_table.markdown(rows)}\n", flush=True)


if __name__ == "__main__":
    main()
