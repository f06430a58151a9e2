#!/usr/bin/env bash
# Builds .venv with everything the demo and the tests need: with uv when it is there,
# else with Python 3.12's own venv and pip. Says in one line what is missing.
#
#   UV_TORCH_BACKEND=cpu make demo   PyTorch without CUDA, much smaller; uv's own switch, which
#                                    knows cu128, rocm6.4, auto and more.
set -euo pipefail
cd "$(dirname "$0")/.."
torch=${UV_TORCH_BACKEND:-}
extras='.[all,hardware,ros2,dev,docs]'

say() { printf '%s\n' "$*" >&2; }

# Sizes of a set-up on Linux, PyTorch 2.10 with CUDA: du of .venv, and of what pip fetched.
announce() {
  if [ -n "$torch" ]; then
    say "Building .venv with $1, PyTorch for $torch. A first run fetches what is not cached."
  else
    say "Building .venv with $1. A first run fetches about 4 GB, most of it PyTorch with CUDA; 8 GB on disk."
    say "PyTorch without CUDA: UV_TORCH_BACKEND=cpu make demo (needs uv)."
  fi
}

find_python() {
  local name
  for name in python3.12 python3 python; do
    if "$name" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 12))' >/dev/null 2>&1; then
      command -v "$name"
      return 0
    fi
  done
  return 1
}

if [ -n "$torch" ] && ! command -v uv >/dev/null 2>&1; then
  say "UV_TORCH_BACKEND=$torch needs uv, which knows where that build of PyTorch is: install uv, or unset it."
  exit 1
fi

# Simulators of whose packages the descriptions of arms alone are wanted, not what they require
# (gym-aloha's MuJoCo is older than ours, robosuite's OpenCV replaces the headless one).
arms=(robosuite==1.5.2 gym-aloha==0.1.5)

rm -rf .venv
if command -v uv >/dev/null 2>&1; then
  announce uv
  uv venv --quiet --python 3.12 .venv || {
    say "Missing: Python 3.12, which uv could neither find nor fetch. Install it, then run make again."
    exit 1
  }
  uv pip install --python .venv/bin/python --constraint constraints.txt --editable "$extras"
  install_arms=(uv pip install --quiet --python .venv/bin/python)
else
  python=$(find_python) || {
    say "Missing: Python 3.12. Install it (Debian: python3.12 and python3.12-venv; or pyenv, or uv), then run make again."
    exit 1
  }
  "$python" -c 'import ensurepip, venv' 2>/dev/null || {
    say "Missing: the venv module of $python (Debian: apt install python3.12-venv). Install it, then run make again."
    exit 1
  }
  announce "$python and pip"
  "$python" -m venv .venv
  # Since 25.1 pip shows how far it is while it installs what it has fetched, some 100 s.
  .venv/bin/python -m pip install --quiet --disable-pip-version-check "pip>=25.1" ||
    say "An older pip is used: it says nothing while it installs."
  install=(.venv/bin/python -m pip install --disable-pip-version-check --constraint constraints.txt --editable "$extras")
  if [ -t 1 ]; then
    "${install[@]}"  # pip's own bars
  else
    # In a log, a line a package rather than none for minutes.
    "${install[@]}" | awk '/Downloading|Processing|Building|Installing/ && !/metadata/ {print substr($0, 1, 100); fflush()}'
  fi
  install_arms=(.venv/bin/python -m pip install --quiet --disable-pip-version-check)
fi
"${install_arms[@]}" --no-deps "${arms[@]}" ||
  say "Left out: iiwa7, ur5e, gen3, jaco, sawyer (robosuite) and viperx (gym-aloha): not to be had."
if command -v node >/dev/null 2>&1 && command -v npm >/dev/null 2>&1; then
  .venv/bin/python tools/build_xr.py >/dev/null 2>&1 ||
    say "The client for headsets was not built; 'make xr' says why. All else works without it."
fi
say "Ready: .venv"
