#!/usr/bin/env bash
# Builds .venv-franka-sim with franka-sim, the simulator of Franka's control interface that
# enforces its limits and counts lost packets. It needs NumPy 1.26 and MuJoCo below 3.3, which
# .venv cannot have, so it runs in a process and an environment of its own: start it with
#   .venv-franka-sim/bin/python tools/franka_sim_server.py --host 127.0.0.1
# Run again, it changes nothing. Its model is that of franky-sim, copied out of .venv: nothing
# is downloaded when it starts.
set -euo pipefail
cd "$(dirname "$0")/.."

version=1.1.7
home=.venv-franka-sim
ready="$home/.installed-$version"

say() { printf '%s\n' "$*" >&2; }

if [ -e "$ready" ]; then
  say "Ready: $home"
  exit 0
fi
[ -x .venv/bin/python ] || {
  say "Missing: .venv, which has the interpreter and the model that are used. Run make first."
  exit 1
}
assets=$(.venv/bin/python -c 'from importlib.util import find_spec
spec = find_spec("franky_sim")
print(spec.submodule_search_locations[0] + "/assets" if spec else "")')
[ -n "$assets" ] || {
  say "Missing: franky-sim, which has the model. Install the extra hardware: make."
  exit 1
}

rm -rf "$home"
if command -v uv >/dev/null 2>&1; then
  say "Building $home with uv ..."
  uv venv --quiet --python 3.12 "$home"
  uv pip install --quiet --python "$home/bin/python" "franka-sim==$version"
else
  say "Building $home with pip ..."
  .venv/bin/python -m venv "$home"
  "$home/bin/python" -m pip install --quiet --disable-pip-version-check "franka-sim==$version"
fi
# The model looks for its meshes in a folder "assets" beside it.
mkdir -p "$home/model/assets"
cp "$assets/fr3.xml" "$assets/NOTICE" "$home/model/"
cp "$assets"/meshes/*.obj "$assets"/meshes/*.stl "$home/model/assets/"
touch "$ready"
say "Ready: $home"
