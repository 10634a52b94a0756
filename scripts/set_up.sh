#!/usr/bin/env bash
# Create the virtual environment and install the package with pinned dependencies.
# usage: set_up.sh run|docs|test      (PYTHON and VENV from the environment)
set -euo pipefail
flavour=${1:?run, docs or test}
python=${PYTHON:-python3}
venv=${VENV:-.venv}

if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
    found=$("$python" --version 2>&1 || true)
    echo "lsst-fringe-sim needs Python 3.11 or newer; '$python' is: ${found:-not there}." >&2
    echo "Say which one to use: make demo PYTHON=/path/to/python3.11" >&2
    exit 2
fi

version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
constraints="constraints/python-$version.txt"
if [ ! -f "$constraints" ]; then
    echo "No pinned versions for Python $version; taking the newest that fit." >&2
    constraints=/dev/null
fi

if [ ! -x "$venv/bin/python" ]; then
    echo "Creating $venv with $("$python" --version)"
    "$python" -m venv "$venv"
fi
case $flavour in
    run) extra="" ready="run" ;;
    docs) extra="[docs]" ready="run docs" ;;
    test) extra="[test,docs,postgres]" ready="run docs test" ;;
    *) echo "set_up.sh run|docs|test" >&2; exit 2 ;;
esac
echo "Installing lsst-fringe-sim$extra into $venv (about 500 MB the first time)"
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check -c "$constraints" --editable ".$extra"
echo "Compiling for this processor, so that no command waits for it (once, less than a minute)"
"$venv/bin/fringe-sim" compile || echo "That failed; commands compile what they need themselves." >&2
for name in $ready; do touch "$venv/.ready-$name"; done
