"""Judges: simulators that no one here wrote fly the exported kernels: `make bench ARGS="--only judges"`.

For each of a judge's vehicles: a policy of `--task` (hover; track; or any, which is trained once for all vehicles) is
trained with our file of that vehicle and exported (or taken from `--runs`), and the kernel is flown in the judge's own
environment by experiments/baselines/*_flights.py, beside RAPTOR and the judge's own controller, from the same starts.
Before that our plant and the judge's go open loop from the same states under the same commands, the judge's one piece
after the other, so that a difference is told apart by its cause.
OUT/judges has judges.json, judges.md and a file for each vehicle, kept while nothing that it depends on changes.
"""

import hashlib
import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.baselines import estimates, kernel_flights
from experiments.baselines.kernel_flights import PERIOD_S, Given, Reference, Rotors, State
from experiments.bench.contestants import Contestant, key
from experiments.bench.install import fingerprint
from experiments.bench.process import run_with_timeout
from experiments.output import table
from qrl.runs import files
from qrl.runs import record as records
from qrl_envs import plant, quadrotor, reference, rotors
from qrl_envs.quadrotor import Body, Disturbance, Pose, Twist
from qrl_envs.reference import FixedReference, evaluation_s, reference_data
from qrl_envs.specfile import build
from qrl_envs.task import QuadrotorTask, load
from qrl_envs.vehicle import Vehicle

BASELINES = Path(__file__).resolve().parents[1] / "baselines"
ROOT = BASELINES.parents[1]
MARK = "BENCH "
SEED = 100  # of the policies
MOST_SECONDS = 6 * 3600.0  # of a judge's process
# The judge's vehicle -> our file of it.
VEHICLES = {
    "crazyflie": "crazyflie",
    "hummingbird": "hummingbird",
    "cf21B_500": "cf21_brushless",
    "cf2x_L250": "cf2x_l250",
}
WITHOUT_DRAG = "no aerodynamics"  # a stage that is compared with our plant without drag
ROLLOUTS, ROLLOUT_STEPS, HELD_STEPS = 16, 30, 5  # commands change every HELD_STEPS
ROLLOUT_SHARE = 0.15  # by which a thrust may differ from that of hover
SHOWN_S = (0.01, 0.1, 0.3)


class Difference(NamedTuple):
    """RMS over flights of where a judge's plant is and where ours is, after a time."""

    stage: str
    after_s: float
    position_mm: float
    velocity_mm_s: float
    attitude_deg: float
    body_rate_rad_s: float


def judge(contestants: list[Contestant], pythons: dict[str | None, Path], out: Path, starts: int, runs: dict[str, Path],
          fresh: bool, task: str = "hover") -> None:  # fmt: skip
    """Fly what is missing or stale, print its table, and write the files of OUT/judges, or of OUT/judges_TASK.

    `runs`: our vehicle's name -> the run folder of a policy of `task`, in place of one trained here.
    """
    folder = out / ("judges" if task == "hover" else f"judges_{task}")
    folder.mkdir(parents=True, exist_ok=True)
    for contestant in contestants:
        if contestant.environment not in pythons:
            continue
        vehicle = VEHICLES[contestant.words[0]]
        try:
            kernel = kernel_of(task, vehicle, runs.get(task if task == "any" else vehicle), folder / "kernels")
        except (subprocess.CalledProcessError, OSError) as error:
            print(f"{key(contestant)}: no kernel, and flown without: {error}", file=sys.stderr, flush=True)
            kernel = None
        path = folder / f"{key(contestant).split('/')[1]}.json"
        made_from = inputs(contestant, kernel, starts, task)
        if not fresh and path.exists() and json.loads(path.read_text())["made_from"] == made_from:
            continue
        python = pythons[contestant.environment]
        compared = compare(contestant, python, vehicle, folder)
        words = ["--starts", str(starts), *(["--kernel", str(kernel.absolute())] if kernel else [])]
        if task != "hover":
            kernel_flights.write_references(folder / "references.npz", references())
            words += ["--references", str((folder / "references.npz").absolute())]
        lines, outcome = fly(contestant, python, words)
        found = {
            "judge": contestant.environment,
            "vehicle": contestant.words[0],
            "ours": vehicle,
            "commit": records.commit(),
            "made_from": made_from,
            "kernel": manifest_of(kernel),
            "outcome": outcome,
            "plants": [difference._asdict() for difference in compared],
            "flights": lines,
        }
        print(section(found), flush=True)
        files.replace_text(path, json.dumps(found, indent=1) + "\n")
    results = [json.loads(path.read_text()) for path in sorted(folder.glob("*-*.json"))]
    files.replace_text(folder / "judges.json", json.dumps(results, indent=1) + "\n")
    files.replace_text(folder / "judges.md", page(results))
    print(f"{folder}/judges.json, judges.md")


FIGURES = ("circle", "circle_fast", "eight_slow", "eight", "eight_fast")  # shipped references, beside a point


def references() -> list[Reference]:
    """A point and FIGURES at the control period, with a second after the flight's end."""
    found = [kernel_flights.HOVER]
    for name in FIGURES:
        spec = build(FixedReference, reference_data(name), name)
        duration_s, tail_s = evaluation_s(spec)
        steps = round(duration_s / PERIOD_S)
        sampled = spec.at(np.arange(steps + 100) * PERIOD_S)
        position, velocity, acceleration = sampled
        found.append(Reference(name, position, velocity, acceleration, steps, round(tail_s / PERIOD_S)))
    return found


def kernel_of(task: str, vehicle: str, run: Path | None, folder: Path) -> Path:
    """A folder with kernel.so and manifest.json of the policy of a task and a vehicle: of `run`, else trained in
    `folder`.

    Raises CalledProcessError where training, export or compiler fail.
    """
    env = os.environ | {"PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{ROOT / 'envs'}"}

    def qrl(*words: str) -> None:
        subprocess.run([sys.executable, "-m", "qrl", *words], env=env, check=True)

    for_all = task == "any"
    vehicle = task if for_all else vehicle
    if run is None:
        run = folder / vehicle
        if not (run / "summary.json").exists():
            resume = ["--resume"] if run.exists() else []
            own = [] if for_all else ["--vehicle", vehicle]
            qrl("train", task, *own, "--seed", str(SEED), "--out", str(run), *resume)
    export = run / "export"
    if not (export / "manifest.json").exists():
        qrl("export", str(run), "--name", task)
    manifest = export / "manifest.json"
    built = folder / f"{vehicle}-built"
    built.mkdir(parents=True, exist_ok=True)
    shutil.copy(manifest, built / "manifest.json")
    source = export / f"{json.loads(manifest.read_text())['name']}.c"
    compiler = os.environ.get("CC", "cc")
    subprocess.run([compiler, "-std=c99", "-O2", "-shared", "-fPIC", "-o", built / "kernel.so", source], check=True)
    return built


def manifest_of(kernel: Path | None) -> dict[str, Any] | None:
    """What says which policy flew."""
    if kernel is None:
        return None
    said = json.loads((kernel / "manifest.json").read_text())
    return {name: said[name] for name in ("commit", "seed", "env_steps", "vehicle", "network")}


def inputs(contestant: Contestant, kernel: Path | None, starts: int, task: str) -> dict[str, Any]:
    """What the flights depend on: hashes of code, vehicle, requirements and kernel."""
    modules = (kernel_flights, estimates, reference, plant)
    code = [BASELINES / contestant.script, Path(__file__), *(Path(str(module.__file__)) for module in modules)]
    shipped = load("hover", VEHICLES[contestant.words[0]]).model_dump_json()
    return {
        "task": task,
        "starts": starts,
        "code": hashlib.sha256("".join([*(path.read_text() for path in code), shipped]).encode()).hexdigest(),
        "requirements": fingerprint(BASELINES / f"{contestant.environment}.txt"),
        "kernel": hashlib.sha256((kernel / "kernel.so").read_bytes()).hexdigest() if kernel else None,
    }


def fly(contestant: Contestant, python: Path, words: list[str]) -> tuple[list[dict[str, Any]], str]:
    """(the lines that a judge's script reports, how it ended); its last line of complaint is printed."""
    env = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_", "PYTHON"))}
    env |= {"JAX_PLATFORMS": "cpu", "PYTHONNOUSERSITE": "1"}
    script = [str(python), str(BASELINES / contestant.script), *contestant.words, *words]
    out, err, outcome = run_with_timeout(script, env, MOST_SECONDS)
    if outcome != "done":
        print(f"{key(contestant)}: {outcome}: {(err.strip().splitlines() or [''])[-1][:300]}", file=sys.stderr)
    return [json.loads(line.removeprefix(MARK)) for line in out.splitlines() if line.startswith(MARK)], outcome


# ---- the plants, step by step ----------------------------------------------------------------------------


def vehicle_of(name: str) -> Vehicle:
    """Our file of that name."""
    task = load("hover", name)
    assert isinstance(task, QuadrotorTask)
    return task.vehicle


def given_for(vehicle: Vehicle) -> Given:
    """Moderate starts, and thrusts about those of hover that change every HELD_STEPS."""
    low, high = (np.array([getattr(motor, name) for motor in vehicle.motors]) for name in ("min_N", "max_N"))
    holds, motors = ROLLOUT_STEPS // HELD_STEPS, len(low)
    draws = np.random.default_rng(SEED).uniform(-ROLLOUT_SHARE, ROLLOUT_SHARE, (ROLLOUTS, holds, motors))
    thrusts = np.clip(vehicle.hover_thrusts_N * (1.0 + np.repeat(draws, HELD_STEPS, axis=1)), low, high)
    spin = np.array([motor.spin for motor in vehicle.motors])
    return Given(kernel_flights.moderate(ROLLOUTS), thrusts, Rotors(vehicle.motor_positions_m[:2].T, spin))


def ours(vehicle: Vehicle, given: Given, drag: bool) -> State:
    """Where our plant goes: each field [n, steps, …]."""
    physics = quadrotor.physics(vehicle)
    none, zero = jnp.zeros(3), jnp.float32(0.0)
    world = plant.World(
        physics=physics,
        motor_factor=jnp.ones(len(vehicle.motors)),
        rotors=rotors.rotors(vehicle),
        disturbance=Disturbance(
            jnp.asarray(vehicle.drag_N_s_m) * drag, none, none, none, jnp.float32(vehicle.drag_height_m)
        ),
        latency_s=zero,
        sensors=plant.Sensors(plant.Noise(zero, zero, zero, zero), none, zero, zero),
    )

    def one(body: Body, thrusts: jax.Array) -> Body:
        def step(flight: plant.Flight, thrust: jax.Array) -> tuple[plant.Flight, Body]:
            flight = plant.step(flight, quadrotor.applied_action(physics, thrust), None, PERIOD_S)
            return flight, flight.body

        return jax.lax.scan(step, plant.begin(body, world, plant.Layout(1, 0, gusts=False), None, PERIOD_S), thrusts)[1]

    quaternion, position, velocity, rate = (jnp.asarray(a, jnp.float32) for a in given.starts)
    bodies = Body(Pose(position, quaternion), Twist(velocity, rate))
    (position, quaternion), (velocity, rate) = jax.vmap(one)(bodies, jnp.asarray(given.thrusts_N, jnp.float32))
    flat = np.asarray(quaternion, np.float64).reshape(-1, 4)
    rotation = kernel_flights.matrices(flat).reshape(*quaternion.shape[:2], 3, 3)
    return State(rotation, *(np.asarray(a, np.float64) for a in (position, velocity, rate)))


def differences(stage: str, theirs: State, ours: State) -> list[Difference]:
    """After each of SHOWN_S; RMS over flights of the lengths of the vectors of difference."""
    found = []
    for after_s in SHOWN_S:
        a, b = (State(*(field[:, round(after_s / PERIOD_S) - 1] for field in state)) for state in (theirs, ours))
        chord = np.linalg.norm(a.rotation - b.rotation, axis=(1, 2)) / 8.0**0.5  # sine of half the angle
        angle = np.degrees(2.0 * np.arcsin(np.minimum(chord, 1.0)))
        apart = [np.linalg.norm(x - y, axis=1) for x, y in zip(a[1:], b[1:], strict=True)]
        position, velocity, rate = (float(np.sqrt((x**2).mean())) for x in apart)
        angle = float(np.sqrt((angle**2).mean()))
        found.append(Difference(stage, after_s, 1e3 * position, 1e3 * velocity, angle, rate))
    return found


def compare(contestant: Contestant, python: Path, name: str, folder: Path) -> list[Difference]:
    """Both plants open loop, the judge's stage by stage; none where the judge's script fails."""
    vehicle = vehicle_of(name)
    given = given_for(vehicle)
    asked, answered = (folder.absolute() / f"{contestant.words[0]}-{word}.npz" for word in ("given", "rollouts"))
    np.savez(
        asked,
        thrusts_N=given.thrusts_N,
        rotor_position_m=given.rotors.position_m,
        rotor_spin=given.rotors.spin,
        **given.starts._asdict(),
    )
    if fly(contestant, python, ["--given", str(asked), "--rollouts", str(answered)])[1] != "done":
        return []
    without, with_drag = (ours(vehicle, given, drag) for drag in (False, True))
    return [
        difference
        for stage, theirs in kernel_flights.read_rollouts(answered).items()
        for difference in differences(stage, theirs, without if stage == WITHOUT_DRAG else with_drag)
    ]


# ---- the page --------------------------------------------------------------------------------------------


def number(value: float | None) -> str:
    """Two digits; a dash for what JSON has no number for."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{value:.1f}" if abs(value) < 10 else f"{value:,.0f}"


def cell(line: dict[str, Any]) -> str:
    """RMSE [mm]; share of flights that succeed; settle [s]."""
    settle = "–" if line["settle_s"] is None else f"{line['settle_s']:.2f}"
    return f"{number(line['rmse_mm'])}; {100 * line['success']:.0f} %; {settle}"


def section(result: dict[str, Any]) -> str:
    """The tables of one vehicle of one judge."""
    lines = result["flights"]
    parts = [f"## {result['judge'].removesuffix('_judge')}: {result['vehicle']}"]
    if (kernel := result["kernel"]) is not None:
        parts.append(
            f"Kernel: vehicle {kernel['vehicle']}, seed {kernel['seed']}, {kernel['env_steps']:,} steps, network"
            f" {kernel['network']}, commit {kernel['commit']}."
        )
    if result["outcome"] != "done":
        parts.append(f"**The judge's process did not finish: {result['outcome']}.**")
    for followed, kind in dict.fromkeys((line.get("reference", "hover"), line["starts"]) for line in lines):
        selected = [line for line in lines if (line.get("reference", "hover"), line["starts"]) == (followed, kind)]
        conditions, controllers = (
            list(dict.fromkeys(line[name] for line in selected)) for name in ("condition", "controller")
        )
        cells = {(line["condition"], line["controller"]): cell(line) for line in selected}
        rows = [[name, *(cells.get((name, c), "") for c in controllers)] for name in conditions]
        title = f"{followed}; starts: {kind}, {selected[0]['flights']} of them."
        parts += [title[0].upper() + title[1:], table(["", *controllers], rows)]
    if result["plants"]:
        head = ["the judge's plant against ours", "after [s]", "position [mm]", "velocity [mm/s]", "attitude [°]"]
        rows = [
            [d["stage"], f"{d['after_s']:g}", *(f"{d[name]:.3g}" for name in Difference._fields[2:])]
            for d in result["plants"]
        ]
        parts.append(table([*head, "body rate [rad/s]"], rows))
    return "\n\n".join(parts)


def page(results: list[dict[str, Any]]) -> str:
    """judges.md."""
    head = (
        "# Kernels in other people's simulators\n\n"
        "A cell: RMSE of the position over the last 2 of 8 s, of a figure over whole laps after the first, median over"
        " starts [mm]; flights that stay within 0.1 m throughout that; time to settle, median [s]."
        " –: no number, as most flights were lost or did not settle."
        " Plants: open loop from the same states under the same commands; RMS over flights; each row of a judge adds to"
        " the one before."
    )
    return "\n\n".join([head, *(section(result) for result in results)]) + "\n"
