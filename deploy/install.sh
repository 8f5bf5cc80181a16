#!/usr/bin/env bash
# Makes the virtual environment from the hash-pinned locks; `make env` calls it.
# usage: deploy/install.sh VENV [PYTHON] [UV: yes|no]
# uv (itself installed from a pinned lock, inside the environment) takes seconds; where it cannot be had, pip
# installs the same files.
set -euo pipefail
venv=$1 wanted=${2:-} use_uv=${3:-yes}
started=$SECONDS

is_recent() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; }

find_python() {
  for candidate in ${wanted:-python3 python3.13 python3.12 python3.11}; do
    if is_recent "$candidate"; then echo "$candidate"; return; fi
  done
  echo "env: Python 3.11 or newer is needed; '${wanted:-python3}' gives $("${wanted:-python3}" --version 2>&1 || true)." >&2
  echo "env: install one, or name it: make env PYTHON=/path/to/python3.12" >&2
  return 1
}

if ! { [ -x "$venv/bin/python" ] && is_recent "$venv/bin/python" && "$venv/bin/python" -m pip --version >/dev/null 2>&1; }; then
  python=$(find_python)
  echo "env: making $venv with $("$python" --version) ($python)"
  rm -rf "$venv"
  "$python" -m venv "$venv" || { echo "env: 'python -m venv' failed; Debian and Ubuntu need the package python3-venv" >&2; exit 1; }
fi
pip=("$venv/bin/python" -m pip --quiet install)

if [ "$use_uv" = yes ] && "${pip[@]}" --require-hashes --only-binary :all: -r requirements/build.txt \
  && echo "env: installing the locked packages with $("$venv/bin/uv" --version)" \
  && VIRTUAL_ENV="$PWD/$venv" "$venv/bin/uv" pip sync --quiet --require-hashes requirements/build.txt requirements/dev.txt; then
  VIRTUAL_ENV="$PWD/$venv" "$venv/bin/uv" pip install --quiet --no-deps --no-build-isolation --editable .
else
  echo "env: installing the locked packages with pip (this can take a few minutes)"
  "${pip[@]}" --require-hashes -r requirements/dev.txt
  "${pip[@]}" --no-deps --no-build-isolation --editable .
fi
echo "env: ready after $((SECONDS - started)) s"
