#!/usr/bin/env bash
# The long campaign: every fault, every fuzz case, and the tests with the newest versions: `make stress`.
#
# Each file gives its own summary, and a failure stops nothing; the last line says what ran and what broke.
# A test says how many faults it injected in a line such as "stress: 24 kills". Usage: tests/stress.sh
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
export JAX_PLATFORMS=cpu QRL_STRESS=1
unset MAKEFLAGS MFLAGS MAKELEVEL

files=(tests/{runs/test_kills,training/test_multihost,runs/test_checkpoint,runs/test_faults,cli/test_fuzz,cli/test_cli}.py)

work=$(mktemp -d)
touch "$work/codes"
trap 'rm -rf "$work"' EXIT
trap 'exit 1' INT TERM

for file in "${files[@]}"; do
  echo "== $file"
  code=0
  .venv/bin/python -m pytest "$file" --hypothesis-profile=stress \
    -o junit_family=xunit1 --junitxml="$work/$(basename "$file" .py).xml" 2>&1 | tee -a "$work/said" || code=$?
  echo "$file $code" >>"$work/codes"
done

echo "== the newest versions"
tests/newest.sh 2>&1 | tee "$work/newest"

.venv/bin/python - "$work" "$SECONDS" <<'PYTHON'
"""The closing line, from what pytest wrote down of each file."""

import base64
import re
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

work, seconds = Path(sys.argv[1]), sys.argv[2]
cases = 0
broke = []
skipped = []
codes = [line.split() for line in (work / "codes").read_text().splitlines()]
for file, code in codes:
    report = work / f"{Path(file).stem}.xml"
    found = []
    if report.exists():
        suite = ET.parse(report).getroot()
        for entry in suite.iter("property"):
            if entry.get("name", "").startswith("hypothesis-statistics-"):
                text = base64.b64decode(entry.get("value")).decode()
                cases += sum(int(n) + int(m) for n, m in re.findall(r"(\d+) passing\D*, (\d+) failing", text))
        for test in suite.iter("testcase"):
            if test.find("failure") is not None or test.find("error") is not None:
                found.append(f"{file}::{test.get('name')}" if test.get("classname") else f"{file}, as it was collected")
        skipped += [test.get("name") for test in suite.iter("testcase") if test.find("skipped") is not None]
    broke += found or ([f"{file} (pytest's exit code {code})"] if code != "0" else [])
faults = sum(int(n) for n in re.findall(r"^stress: (\d+) (?:faults|kills?)\b", (work / "said").read_text(), re.MULTILINE))
trials = re.findall(r"^newest: (.*?): (held|broke):", (work / "newest").read_text(), re.MULTILINE)
broke += [f"the newest versions on {python}" for python, held in trials if held != "held"]
broke += [f"no {what} ran" for what, n in (("fault", faults), ("fuzz case", cases), ("version trial", len(trials))) if not n]
print(
    f"stress: {faults:,} faults, {cases:,} fuzz cases and {len(trials)} version trials in {seconds} s; "
    + (f"{len(skipped)} skipped ({', '.join(skipped)}); " if skipped else "")
    + (f"broke: {', '.join(broke)}" if broke else "nothing broke")
)
sys.exit(bool(broke))
PYTHON
