#!/usr/bin/env bash
# Build sdist and wheel, install the wheel in a clean environment, and run a piece of the chain from there; then each
# extra for users in an environment that has nothing but the wheel besides.
# BIN: directory of the development environment's programs.
set -euo pipefail
bin=$(cd "${BIN:-.venv/bin}" && pwd)
root=$(pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

echo "Building sdist and wheel"
"$bin/python" -m build --outdir "$work/dist" "$root" >"$work/build.log" 2>&1 || { tail -n 40 "$work/build.log" >&2; exit 1; }
wheel=$(ls "$work"/dist/*.whl)
version=$("$bin/python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
constraints="$root/constraints/python-$version.txt"
[ -f "$constraints" ] || constraints=/dev/null

echo "Installing $(basename "$wheel") in a clean environment"
"$bin/python" -m venv "$work/clean"
"$work/clean/bin/python" -m pip install --quiet --disable-pip-version-check --no-compile -c "$constraints" "$wheel"

echo "Smoke run from the wheel, outside the checkout"
mkdir "$work/run" && cd "$work/run"
PATH="$work/clean/bin:$PATH" "$work/clean/bin/python" "$root/scripts/wheel_smoke.py"

# An extra sees the clean environment and adds what it lacks; no extra sees another.
below=$("$work/clean/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
extras=$("$work/clean/bin/python" "$root/scripts/wheel_smoke.py" --extras)
for extra in $extras; do
    echo "The extra $extra"
    env="$work/extra-$extra"
    "$bin/python" -m venv "$env"
    echo "$below" >"$("$env/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/below.pth"
    "$env/bin/python" -m pip install --quiet --disable-pip-version-check --no-compile -c "$constraints" "$wheel[$extra]"
    "$env/bin/python" "$root/scripts/wheel_smoke.py" --extra "$extra"
    rm -rf "$env"
done
