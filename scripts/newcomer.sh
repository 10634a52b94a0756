#!/usr/bin/env bash
# Walk the path of a newcomer: in a fresh clone, run every command of the README and of the quick start, and print how long
# each took and how it ended. The exit status is 1 if one of them failed.
# usage: newcomer.sh [--list] [--only REGEX] [--skip REGEX] [FOLDER]
#   --list        print the commands, run nothing
#   --only REGEX, --skip REGEX   extended regular expressions for the commands to run, and for those to leave out
#   FOLDER        where to work; by default a new folder in the temporary directory
# What the commands read and do not make is taken from `make demo`: without it, those of folders of flats fail.
# BIN: folder of the programs; by default that of the environment which `make` creates in the clone.
# PAGES: pages with the commands, relative to the checkout.
set -euo pipefail
source=$(cd "$(dirname "$0")/.." && pwd)
pages=${PAGES:-README.md doc/guide/quick_start.md}
list="" only="." skip='^$' work=""
while [ $# -gt 0 ]; do
    case $1 in
        --list) list=yes ;;
        --only) only=$2; shift ;;
        --skip) skip=$2; shift ;;
        -*) sed -n '2,10s/^# //p' "$0" >&2; exit 2 ;;
        *) work=$1 ;;
    esac
    shift
done

# Commands of blocks without a language or in bash, one a line: page, number of the section, command.
commands() {
    for page in $pages; do
        awk -v page="$page" '
            /^```/ { shell = !inside && ($0 == "```" || $0 == "```bash"); inside = !inside; next }
            !inside && /^## / { section++ }
            shell && !/^[[:space:]]*(#|$)/ {
                line = line $0
                if (sub(/\\$/, "", line)) next
                gsub(/[[:space:]]+/, " ", line)
                print page "\t" section + 0 "\t" line
                line = ""
            }' "$source/$page"
    done | awk -F '\t' -v only="$only" -v skip="$skip" '
        $3 ~ only && $3 !~ skip { name = $3; sub(/ #.*/, "", name) }
        # What `make` has done once is not done again.
        $3 ~ only && $3 !~ skip && !(name ~ /^make / && seen[name]++)'
}

if [ -n "$list" ]; then
    commands
    exit
fi

work=${work:-$(mktemp -d)}
mkdir -p "$work"
work=$(cd "$work" && pwd)
clone=$work/clone
git clone --quiet "$source" "$clone"
export PATH=${BIN:-$clone/.venv/bin}:$PATH

# A section has a folder of its own. What its commands read and do not make comes from the demo.
prepare() {
    local folder=$1 section=$2
    mkdir "$folder"
    ln -s "$clone/config" "$folder/config"
    for name in raws flats; do
        if [[ $section == *"$name"* && $section != *"mock-flats $name "* && -d $clone/demo/raws ]]; then
            ln -s "$clone/demo/raws" "$folder/$name"
        fi
    done
}

failed=0 number=0
echo "| seconds | exit | page | command |"
echo "| --: | --: | --- | --- |"
while IFS=$'\t' read -r page section command; do
    number=$((number + 1))
    folder=$work/$(basename "$page" .md)-$section
    if [[ $command == make\ * ]]; then
        folder=$clone
    elif [ ! -d "$folder" ]; then
        prepare "$folder" "$(commands | awk -F '\t' -v p="$page" -v s="$section" '$1 == p && $2 == s { print $3 }')"
    fi
    log=$work/$(printf '%02d' "$number").log
    start=$EPOCHREALTIME status=0
    (cd "$folder" && bash -c "$command") </dev/null >"$log" 2>&1 || status=$?
    seconds=$(awk -v a="$start" -v b="$EPOCHREALTIME" 'BEGIN { printf "%.1f", b - a }')
    echo "| $seconds | $status | $page | \`${command%% #*}\` |"
    [ "$status" = 0 ] || { failed=1; tail -n 3 "$log" | sed 's/^/    /' >&2; }
done < <(commands)
echo "What the commands printed: $work/*.log"
exit "$failed"
