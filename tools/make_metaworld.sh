#!/usr/bin/env bash
# Builds .venv-metaworld: MetaWorld with the MuJoCo that it demands, which .venv cannot have, and
# all else from .venv. benchmarks/bench_metaworld.py runs there:
#   .venv-metaworld/bin/python benchmarks/bench_metaworld.py
# Run again, it changes nothing.
set -euo pipefail
cd "$(dirname "$0")/.."

metaworld=3.1.1
mujoco=3.3.0  # exactly this one, says metaworld
home=.venv-metaworld
ready="$home/.installed-$metaworld"

say() { printf '%s\n' "$*" >&2; }

if [ -e "$ready" ]; then
  say "Ready: $home"
  exit 0
fi
[ -x .venv/bin/python ] || {
  say "Missing: .venv, which has the interpreter, LeRobot and this package. Run make first."
  exit 1
}

rm -rf "$home"
say "Building $home ..."
# With pip of .venv, as an environment of uv has none.
.venv/bin/python -m venv --without-pip "$home"
site=$("$home/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
.venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --target "$site" \
  "metaworld==$metaworld" "mujoco==$mujoco"
# What is installed here comes first; a folder on its own would leave out its .pth files.
.venv/bin/python -c 'import sysconfig; print("import site; site.addsitedir(%r)"
  % sysconfig.get_path("purelib"))' > "$site/environment_below.pth"
touch "$ready"
say "Ready: $home"
