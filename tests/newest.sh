#!/usr/bin/env bash
# The tests with the newest versions that pyproject.toml's ranges admit, in place of those of requirements.lock.
#
# For each interpreter, in a virtual environment that is thrown away: what is newer than the lock, and what breaks.
# The ranges admit more on a newer Python, so the oldest and the newest on the PATH have a trial each.
# Usage: tests/newest.sh [PYTHON]…
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
export JAX_PLATFORMS=cpu
unset QRL_STRESS MAKEFLAGS MFLAGS MAKELEVEL # the sample, not the campaign

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

# The packages of the environment "$1" whose versions are not the lock's.
compare() {
  "$1/bin/python" - requirements.lock <<'PYTHON'
import sys
from importlib.metadata import distributions
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

lines = Path(sys.argv[1]).read_text().splitlines()
pins = [Requirement(line) for line in lines if line and not line.lstrip().startswith("#")]
locked = {canonicalize_name(p.name): str(p.specifier)[2:] for p in pins if not p.marker or p.marker.evaluate()}
here = {canonicalize_name(d.metadata["Name"]): d.version for d in distributions()}
other = {name: (locked.get(name, "-"), version) for name, version in here.items() if locked.get(name) != version}
for name in ("pip", "qrl", "setuptools"):  # no requirements of ours
    other.pop(name, None)
print(f"  {'package':<24}{'locked':<24}newest" if other else "  every package is the lock's")
for name, versions in sorted(other.items()):
    print(f"  {name:<24}{versions[0]:<24}{versions[1]}")
PYTHON
}

# One trial with the interpreter "$1".
trial() {
  local venv=$work/venv log=$work/log code=0
  rm -rf "$venv"
  echo "newest: $("$1" --version): installing"
  if ! { "$1" -m venv "$venv" && "$venv/bin/pip" install --upgrade '.[test]' && "$venv/bin/pip" check; } >"$log" 2>&1; then
    tail -n 20 "$log"
    echo "newest: $1: broke: it cannot be installed"
    return 1
  fi
  compare "$venv"
  "$venv/bin/python" -m pytest -n 2 --dist worksteal -q -p no:cacheprovider >"$log" 2>&1 || code=$?
  if ((code == 0)); then
    echo "newest: $1: held: $(tail -n 1 "$log")"
  else
    grep -E '^(FAILED|ERROR) ' "$log" || tail -n 40 "$log"
    echo "newest: $1: broke: $(tail -n 1 "$log")"
  fi
  return "$code"
}

if (($# == 0)); then
  able=()
  for python in python3.{11..30}; do
    if "$python" -c 'import ensurepip' 2>/dev/null; then able+=("$python"); fi
  done
  ((${#able[@]})) || able=(python3)
  set -- "${able[0]}"
  ((${#able[@]} == 1)) || set -- "$1" "${able[-1]}"
fi

broke=0
for python; do
  trial "$python" || broke=1
done
exit "$broke"
