#!/usr/bin/env bash
# Every command end to end on a CPU, with tiny budgets: `make smoke`.
#
# It proves the contracts of the command line, so it stands with the other proofs; it is not a
# pytest because it goes the user's way: through make, a process for each command, and signals.
# What was trained is thrown away. Usage: tests/smoke.sh
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
export JAX_PLATFORMS=cpu
unset MAKEFLAGS MFLAGS MAKELEVEL TASK VEHICLE UNCERTAINTY REFERENCE INIT LOG NAME SEED SEEDS FIRST OUT RESUME CONFIG ARGS RUN GRID

qrl=.venv/bin/qrl
python=.venv/bin/python
budget="--num-timesteps 1e5 --num-evals 3 --num-eval-envs 10" # a little beyond the warm-up
long="--num-timesteps 2.4e5 --num-evals 12 --num-eval-envs 10"  # long enough to be interrupted after the first report
vehicle=envs/qrl_envs/vehicles/crazyflie.json

work=$(mktemp -d)
out="$work/a run" # with a space: it must survive make and the shell
log=$work
tracks=()
mkdir "$out"
tidy() {
  for pid in "${tracks[@]}"; do kill -- "-$pid" 2>/dev/null || true; done
  rm -rf "$work"
}
trap tidy EXIT

fail() {
  echo "smoke: FAILED: $1" >&2
  for file in "$log/stdout" "$log/stderr"; do
    echo "-- the end of ${file##*/}:" >&2
    tail -n 30 "$file" >&2 || true
  done
  exit 1
}

# The one line per step; "$1" says what is tried.
try() {
  echo "smoke: [$SECONDS s] $1"
}

# Run "$2"… and expect it to succeed, without a traceback.
passes() {
  try "$1"
  "${@:2}" >"$log/stdout" 2>"$log/stderr" </dev/null || fail "$1: exit code $?"
  ! grep -q Traceback "$log/stdout" "$log/stderr" || fail "$1: a traceback"
}

# Run "$3"… and expect exit code 2 and one line on stderr, which matches the regular expression "$2".
refuses() {
  local code=0
  try "refused: $1"
  "${@:3}" >"$log/stdout" 2>"$log/stderr" </dev/null || code=$?
  ((code == 2)) || fail "$1: exit code $code, not 2"
  (($(wc -l <"$log/stderr") == 1)) || fail "$1: $(wc -l <"$log/stderr") lines on stderr, not 1"
  grep -qE -e "$2" "$log/stderr" || fail "$1: the line does not match /$2/"
}

# The run folder "$1" holds all that it should.
complete() {
  "$python" - "$1" >"$log/stdout" 2>"$log/stderr" <<'PYTHON' || fail "the run folder $1 is not complete"
import csv, json, math, sys
from pathlib import Path

run = Path(sys.argv[1])
json.loads((run / "config.json").read_text())
json.loads((run / "summary.json").read_text())
rows = list(csv.DictReader((run / "metrics.csv").open()))
assert rows, "metrics.csv has no rows"
wanted = {"env_steps", "updates", "return_mean", "return_min", "success", "train_seconds"}
assert wanted <= rows[0].keys(), f"metrics.csv lacks {wanted - rows[0].keys()}"
assert math.isfinite(float(rows[-1]["return_mean"])), "the last return_mean is not a number"
assert any((run / "checkpoints").iterdir()), "checkpoints/ is empty"
assert len(list(run.rglob("*.png"))) >= 2, "a learning curve and a flight are wanted"
assert list(run.rglob("*tfevents*")), "nothing for TensorBoard"
PYTHON
}

# The page "$1" is there, and no larger than promised.
page() {
  local size
  size=$(wc -c <"$1") || fail "no page $1"
  ((size > 4000000 && size <= 8000000)) || fail "the page $1 has $size bytes"
}

contents() {
  (cd "$1" && find . -type f -print0 | sort -z | xargs -0 sha256sum)
}

# The runs "$1" and "$2" tell the same story, clocks aside.
same_metrics() {
  "$python" - "$1" "$2" >"$log/stdout" 2>"$log/stderr" <<'PYTHON' || fail "$1 and $2 differ"
import csv, sys
from pathlib import Path

def story(run):
    rows = csv.DictReader((Path(run) / "metrics.csv").open())
    return [{k: v for k, v in row.items() if not k.endswith(("_seconds", "_per_second"))} for row in rows]

first, second = map(story, sys.argv[1:])
assert first, "no rows"
assert first == second, next(pair for pair in zip(first, second) if pair[0] != pair[1])
PYTHON
}

# ---- what is tried: two tracks side by side, for most of a command's time is one busy core ------------------

pendulum() {
  passes "train pendulum, two seeds" make train TASK=pendulum SEEDS=2 OUT="$out/pendulum" ARGS="$budget"
  complete "$out/pendulum/seed-0"
  complete "$out/pendulum/seed-1"

  passes "export a seed" make export RUN="$out/pendulum/seed-0" NAME=swing_up ARGS="--starts 100 --vectors 500"
  test -e "$out/pendulum/seed-0/export/swing_up.c" || fail "the kernel has another name"
  passes "build and run the exported example" make -C "$out/pendulum/seed-0/export/examples/bare_metal"
  grep -q '^torque: ' "$log/stdout" || fail "the example gave no torque"
  refuses "a name that C cannot have" "expected a C identifier" "$qrl" export "$out/pendulum/seed-0" --name swing-up
  refuses "to export two seeds at once" "seed-0" "$qrl" export "$out/pendulum"
  passes "view two seeds" make view RUN="$out/pendulum" ARGS="--starts 3 900"
  page "$out/pendulum/seed-0/view.html"
  page "$out/pendulum/seed-1/view.html"

  local before
  before=$(contents "$out/pendulum")
  passes "resume pendulum, finished" make train TASK=pendulum SEEDS=2 OUT="$out/pendulum" RESUME=1 ARGS="$budget"
  [[ $(contents "$out/pendulum") == "$before" ]] || fail "resuming a finished run changed it"

  sweep_pendulum
  refuses "a run folder that exists" "a run/pendulum" "$qrl" train pendulum --out "$out/pendulum"
  bad_input
}

sweep_pendulum() {
  cat >"$work/grid.json" <<'JSON'
{"task": "pendulum", "fixed": {"num_timesteps": 2e4, "num_evals": 2, "num_eval_envs": 10},
 "axes": {"learning_rate": {"from": 1e-3, "to": 1e-2, "count": 2, "spacing": "log"}, "task.rod.mass_kg": [1, 1.5]},
 "seeds": 2}
JSON
  passes "sweep, four points of two seeds" make sweep GRID="$work/grid.json" OUT="$out/sweep"
  [[ $(wc -l <"$out/sweep/results.csv") == 9 && -s $out/sweep/sweep.png ]] || fail "the sweep's results are not whole"
  local before
  before=$(contents "$out/sweep")
  passes "the same sweep, finished" make sweep GRID="$work/grid.json" OUT="$out/sweep"
  [[ $(contents "$out/sweep") == "$before" ]] || fail "going on with a finished sweep changed it"
  "$python" -m json.tool "$out/sweep/best.json" >"$log/stdout" 2>"$log/stderr" || fail "best.json"

  refuses "make sweep without GRID" "GRID is missing" make sweep
  sed 's/learning_rate/learning_rat/' "$work/grid.json" >"$work/typo_grid.json"
  refuses "a misspelt axis" "typo_grid.json.*learning_rat.*learning_rate" "$qrl" sweep "$work/typo_grid.json" --out "$out/no"
}

bad_input() {
  refuses "make train without TASK" "TASK is missing" make train
  refuses "make evaluate without RUN" "RUN is missing" make evaluate
  refuses "make export without RUN" "RUN is missing" make export
  refuses "make view without RUN" "RUN is missing" make view
  refuses "to view a run that is not there" "nowhere" "$qrl" view "$out/nowhere"
  refuses "a misspelt task" "'hover'" "$qrl" train hoverr --out "$out/no"
  refuses "a misspelt flag" "--num-timestepz.*--num-timesteps" "$qrl" train hover --num-timestepz 10 --out "$out/no"
  refuses "a run that is not there" "nowhere" "$qrl" evaluate "$out/nowhere"

  echo '{"gama": 0.9}' >"$work/typo.json"
  refuses "a misspelt key" "typo.json.*gama" "$qrl" train hover --config "$work/typo.json" --out "$out/no"

  sed -E 's/("mass_kg": *)[0-9.]+/\1-1.0/' "$vehicle" >"$work/heavy.json"
  refuses "a negative mass" "heavy.json.*mass_kg" "$qrl" train hover --vehicle "$work/heavy.json" --out "$out/no"
  [[ ! -e $out/no ]] || fail "a refused run left its folder"
}

circle_and_hover() {
  interrupted_circle
  passes "resume circle" make train TASK=circle OUT="$out/circle" RESUME=1 ARGS="$long"
  complete "$out/circle"
  passes "evaluate circle" make evaluate RUN="$out/circle" ARGS="--starts 100"
  "$python" -m json.tool "$out/circle/evaluation.json" >"$log/stdout" 2>"$log/stderr" || fail "evaluation.json"
  passes "view circle" make view RUN="$out/circle"
  page "$out/circle/view.html"
  passes "fly a vehicle of mine" make fly VEHICLE="$vehicle" ARGS="--starts 8"

  grep -q geometric "$out/circle/evaluation.json" || fail "no baselines"
  [[ -s $out/circle/settle.png ]] || fail "no map of settle times"

  passes "train a vehicle of one's own" make train TASK=hover VEHICLE="$vehicle" OUT="$out/crazyflie" ARGS="$budget"
  complete "$out/crazyflie"
  passes "repeat it from its config.json" make train CONFIG="$out/crazyflie/config.json" OUT="$out/again"
  complete "$out/again"
  same_metrics "$out/crazyflie" "$out/again"
}

interrupted_circle() {
  try "train circle, and Ctrl-C after the first report"
  set -m # else a background command starts deaf to SIGINT
  # shellcheck disable=SC2086
  "$qrl" train circle --out "$out/circle" $long >"$log/stdout" 2>"$log/stderr" </dev/null &
  local pid=$! code=0
  set +m
  trap 'kill -KILL "$pid"; exit 1' TERM # in a process group of its own, it would outlive this script
  for ((i = 0; i < 1200; i++)); do
    (($(cat "$out/circle/metrics.csv" 2>/dev/null | wc -l) >= 2)) && break
    kill -0 "$pid" 2>/dev/null || break
    sleep 0.1
  done
  kill -INT "$pid" 2>/dev/null || true
  wait "$pid" || code=$?
  trap - TERM
  ((code == 1)) || fail "Ctrl-C: exit code $code, not 1"
  ! grep -q Traceback "$log/stdout" "$log/stderr" || fail "Ctrl-C: a traceback"
  grep -q RESUME=1 "$log/stdout" || fail "Ctrl-C: the way on is not said"
  [[ ! -e $out/circle/summary.json ]] || fail "Ctrl-C: it went on to the end"
}

passes "make: the help" make
passes "tasks" make tasks
for task in pendulum hover circle; do
  grep -qw "$task" "$work/stdout" || fail "tasks does not list $task"
done

set -m # each track a process group, so that Ctrl-C here ends all of it
for track in pendulum circle_and_hover; do
  (
    trap - EXIT
    log=$work/$track
    mkdir "$log"
    $track
  ) &
  tracks+=($!)
done
set +m
for pid in "${tracks[@]}"; do
  wait "$pid" || exit 1
done
# Four minutes of two cores, counted in what they worked: a busy machine is not a fault of ours.
times >"$work/times"
cpu=$(tail -n 1 "$work/times" | tr 'ms' '  ' | awk '{ printf "%d", 60 * ($1 + $3) + $2 + $4 }')
echo "smoke: passed in $SECONDS s ($cpu s of CPU time)"
((cpu <= 480)) || fail "it worked for more than four minutes of two cores"
