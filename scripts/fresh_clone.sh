#!/usr/bin/env bash
# The README's two commands as a new user meets them: a fresh clone, an empty home, no caches, no environment.
# Prints what each took. Needs only Python 3.11+, git and a network; deletes what it made.
set -euo pipefail

here=$(cd "$(dirname "$0")/.." && pwd)
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
git clone --quiet "$here" "$folder/gridnav"
mkdir "$folder/home"
# Settings of pip are part of the machine, not of the user: where packages come from may be set there.
keep=(PATH="$PATH" HOME="$folder/home" LANG="${LANG:-C.UTF-8}")
for name in $(compgen -e | grep -E '^(PIP_|UV_|SSL_|REQUESTS_|HTTPS?_|https?_|NO_PROXY|no_proxy)' || true); do
    keep+=("$name=${!name}")
done

cd "$folder/gridnav"
begin=$SECONDS
env -i "${keep[@]}" python3 start.py ladder --budget quick --run-dir "$folder/run"
echo "first command to finished report: $((SECONDS - begin)) s"
ls -l "$folder/run/report.html" "$folder/run/rollout.rrd"
begin=$SECONDS
env -i "${keep[@]}" python3 start.py test
echo "fast tests: $((SECONDS - begin)) s"
