#!/usr/bin/env bash
# Do what the Containerfile does where there is no container engine: the wheel with the pinned packages in a clean
# environment, the functions compiled into a folder that is then only read, and commands of a user who has no entry in
# /etc/passwd. The exit status is 1 if a command fails or compiles something. Needs root, for that user.
# usage: container_steps.sh [FOLDER]
#   FOLDER   where to work; by default a new folder in the temporary directory
# PYTHON: interpreter, of a version that has a file in constraints/, and which that user can read.
set -euo pipefail
source=$(cd "$(dirname "$0")/.." && pwd)
python=${PYTHON:-python3}
work=${1:-$(mktemp -d)}
mkdir -p "$work/run" "$work/watch"
work=$(cd "$work" && pwd)
chmod 755 "$work" "$work/watch"
chmod 777 "$work/run"
version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')

timed() {
    local start=$EPOCHREALTIME
    "$@" >"$work/log" 2>&1 || { echo "failed: $*" >&2; tail -n 20 "$work/log" >&2; exit 1; }
    awk -v a="$start" -v b="$EPOCHREALTIME" -v what="$(printf '%s ' "$@" | tail -c 90)" 'BEGIN { printf "%6.1f s  %s\n", b - a, what }'
}
# What the stage `wheel` and the line `pip install` do.
timed "$python" -m venv "$work/env"
git -C "$source" ls-files -z bps config constraints python LICENSE README.md pyproject.toml |
    (cd "$source" && xargs -0 cp --parents -P -t "$work/run")
timed "$work/env/bin/pip" wheel --no-cache-dir --no-deps --wheel-dir "$work/wheel" "$work/run"
rm -r "${work:?}"/run/*
timed "$work/env/bin/pip" install --no-cache-dir -c "$source/constraints/python-$version.txt" "$work"/wheel/*.whl

# The other lines, read from the Containerfile, with another name of the folder.
line() { sed -n "s/^$1 //p" "$source/Containerfile" | grep "$2" | sed "s#/opt/fringe-sim#$work/opt#g"; }
read -ra variables <<<"$(line ENV NUMBA_CACHE_DIR) $(line ENV HOME)"
place=(env -i PATH="$work/env/bin:/usr/bin:/bin" "${variables[@]}")
timed "${place[@]}" bash -c "$(line RUN 'fringe-sim compile')"

# Every function that is compiled from here on is named in a file.
cat >"$work/watch/sitecustomize.py" <<EOF
from numba.core import event

class Watch(event.Listener):
    def on_start(self, event):
        with open("$work/run/compiled", "a") as file:
            print(event.data["dispatcher"], file=file)

    def on_end(self, event):
        pass

event.register("numba:compile", Watch())
EOF
user=(setpriv --reuid 54321 --regid 54321 --clear-groups --no-new-privs "${place[@]}" PYTHONPATH="$work/watch")
cd "$work/run"
for command in "--help" "setups" "mock-flats raws --size 128x100 --seed 1" "fit raws --out fit" \
    "sky --thickness fit/thickness.fits --detector R22_S11 --templates --out sky"; do
    read -ra words <<<"$command"
    timed "${user[@]}" bash -c 'exec fringe-sim "$@"' _ "${words[@]}"
done
mv compiled compiled_by_commands 2>/dev/null || :
# Whether the watch would have seen it.
timed "${user[@]}" python -c 'import numba; numba.njit(lambda x: x + 1)(1)  # one function that no command has'
[ -s compiled ] || { echo "what is compiled is not seen" >&2; exit 1; }
if [ -s compiled_by_commands ]; then
    echo "compiled all the same:" >&2
    cat compiled_by_commands >&2
    exit 1
fi
echo "Nothing was compiled; $(find "$work/opt" -type f | wc -l) files of compiled functions."
