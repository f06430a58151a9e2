#!/usr/bin/env bash
# Builds .venv with everything the demo and the tests need: with uv when it is there,
# else with Python 3.12's own venv and pip. Says in one line what is missing.
set -euo pipefail
cd "$(dirname "$0")/.."

say() { printf '%s\n' "$*" >&2; }

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

rm -rf .venv
if command -v uv >/dev/null 2>&1; then
  say "Building .venv with uv (some GB of PyTorch on a first run) ..."
  uv venv --quiet --python 3.12 .venv || {
    say "Missing: Python 3.12, which uv could neither find nor fetch. Install it, then run make again."
    exit 1
  }
  uv pip install --quiet --python .venv/bin/python --constraint constraints.txt --editable '.[all,hardware,dev,docs]'
else
  python=$(find_python) || {
    say "Missing: Python 3.12. Install it (Debian: python3.12 and python3.12-venv; or pyenv, or uv), then run make again."
    exit 1
  }
  "$python" -c 'import ensurepip, venv' 2>/dev/null || {
    say "Missing: the venv module of $python (Debian: apt install python3.12-venv). Install it, then run make again."
    exit 1
  }
  say "Building .venv with $python and pip (some GB of PyTorch on a first run) ..."
  "$python" -m venv .venv
  .venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[all,hardware,dev,docs]'
fi
say "Ready: .venv"
