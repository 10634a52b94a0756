#!/usr/bin/env bash
# Install the package with the newest packages that fit, without the pinned versions, and run a piece of the chain.
# usage: check_newest.sh PYTHON...     (commands or paths; each gets an environment of its own)
set -euo pipefail
[ $# -gt 0 ] || { sed -n '2,3s/^# //p' "$0" >&2; exit 2; }
root=$(cd "$(dirname "$0")/.." && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

check() {
    local python=$1 env=$2
    mkdir "$env"
    # Built from a copy: what an earlier build has left in the checkout would go along.
    (cd "$root" && cp -r python pyproject.toml README.md LICENSE "$env/")
    "$python" -m venv "$env/venv"
    "$env/venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-compile "$env"
    "$env/venv/bin/python" -m pip list --disable-pip-version-check \
        | grep -Ei '^(numpy|scipy|numba|astropy|batoid|galsim|click|pyyaml|matplotlib|lsst-.*) '
    mkdir "$env/run"
    cd "$env/run"
    "$env/venv/bin/python" "$root/scripts/wheel_smoke.py"
}

failed="" number=0
for python in "$@"; do
    name=$("$python" --version)
    echo "== $name with the newest packages"
    # In a shell of its own: the first failure ends it, and the next Python is still tried.
    number=$((number + 1))
    set +e
    (set -e; check "$python" "$work/$number")
    [ $? = 0 ] || failed="$failed, $name"
    set -e
    rm -rf "${work:?}"/*
done
[ -z "$failed" ] || { echo "== failed: ${failed#, }" >&2; exit 1; }
