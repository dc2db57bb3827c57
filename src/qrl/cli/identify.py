"""`qrl identify`: a vehicle's file from logs of its flights, and how well it predicts flights that it has not seen."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from qrl.cli.terminal import DONE, console, plural
from qrl.identification import fit as fitting
from qrl.identification import flight_log, model, plot, report
from qrl.identification.fit import Fit
from qrl.identification.flight_log import FlightLog, Segments
from qrl.identification.model import Model
from qrl.runs import files
from qrl_envs import specfile
from qrl_envs.specfile import BadInput
from qrl_envs.vehicle import STANDARD_GRAVITY_M_S2, Vehicle, vehicle_data, with_default_scale

LEAST_TO_FIT, LEAST_HELD_OUT = 8, 3  # segments
MOST_SEGMENTS = 350  # that are fitted, evenly spaced: more narrow the intervals and take longer
WHOLE_FLIGHTS = 4  # logs from which on a share of the flights is of whole flights
LEAST_SHARE, MOST_SHARE = 0.05, 0.8


def identify(args: argparse.Namespace) -> int:
    """Fit, report, and write the fitted vehicle, its report and the plot."""
    start = vehicle_data(args.vehicle)
    vehicle = specfile.build(Vehicle, with_default_scale(start), args.vehicle)
    share, others = _hold_out(args.hold_out)
    paths = [*args.logs, *others]
    places = [path.resolve() for path in paths]
    if double := [path for i, path in enumerate(paths) if places[i] in places[:i]]:
        raise BadInput(f"{double[0]}: stands twice among the logs")
    beside, picture = _outputs(args, {*places, Path(args.vehicle).resolve()})
    logs = flight_log.read(paths, np.array([motor.max_N for motor in vehicle.motors]))
    fitted_to, unseen, apart = _split(logs, vehicle, len(args.logs), share)
    for log in logs:
        if log.estimated:
            console.print(
                f"{log.name}: no {' and '.join(log.estimated)} logged: from slopes over {flight_log.SMOOTHING_S:g} s"
            )
    for name, segments, least in (("to fit", fitted_to, LEAST_TO_FIT), ("to hold out", unseen, LEAST_HELD_OUT)):
        if len(segments.flight) < least:
            raise BadInput(
                f"{paths[0]}: expected at least {least} segments of {flight_log.HORIZON_S:g} s {name}, without"
                f" gaps and in the air, found {len(segments.flight)}"
            )
    console.print(f"{plural(len(fitted_to.flight), 'segment')} to fit, {len(unseen.flight):,} held out ({apart})")
    free = model.model(vehicle, logs[0].thrust, logs[0].period_s)
    fit = fitting.fit(free, fitted_to, console.print)
    rows, found = report.rows(free, fit), fitting.held_out(free, fit, unseen)
    names = ", ".join(log.name for log in logs[:3]) + (" …" if len(logs) > 3 else "")
    data = report.fitted_data(
        free, fit, start, f"identified by qrl identify from {names}, starting from {Path(args.vehicle).name}"
    )
    summary = report.summary(found)
    _tell(free, fit, rows, summary)
    files.write_json(args.out, data)
    details: dict[str, Any] = {"held_out": {**summary, "of": apart}, "intervals": "sandwich, by segments"}
    details |= {"explained": fit.explained, "parameters": [row._asdict() for row in rows]}
    files.write_json(beside, details)
    with files.writing(picture):
        plot.draw(picture, f"{args.out.name}: {plural(len(logs), 'flight')}, starting from {args.vehicle}", rows, found)
    console.print(f"{args.out}, {beside}, {picture}")
    return DONE


def _outputs(args: argparse.Namespace, taken: set[Path]) -> tuple[Path, Path]:
    """Names of the report and the picture; BadInput unless they and OUT are files of their own, not `taken`."""
    files.check_output(args.out, "--out")
    beside, picture = args.out.with_name(f"{args.out.stem}_report.json"), args.plot or args.out.with_suffix(".png")
    for path, flag in ((args.out, "--out"), (beside, "--out"), (picture, "--plot" if args.plot else "--out")):
        files.check_output(path, flag)
        if path.resolve() in taken:
            raise BadInput(f"{flag}: {path} is read, or written too: expected another name")
        taken.add(path.resolve())
    return beside, picture


def _hold_out(words: list[str]) -> tuple[float, list[Path]]:
    """A share, or logs."""
    try:
        share = float(words[0])
    except ValueError:
        return 0.0, [Path(word) for word in words]
    if len(words) > 1 or not LEAST_SHARE <= share <= MOST_SHARE:
        raise BadInput(
            f"--hold-out: expected logs, or one share of {LEAST_SHARE:g} to {MOST_SHARE:g}, found {' '.join(words)}"
        )
    return share, []


def _split(logs: list[FlightLog], vehicle: Vehicle, given: int, share: float) -> tuple[Segments, Segments, str]:
    """Segments to fit, segments held out, and what the latter are."""
    static = [model.static_thrust_N(vehicle, log.command, log.thrust) for log in logs]

    def cut(spans: list[tuple[float, float]]) -> Segments:
        return flight_log.segments(logs, vehicle.mass_kg * STANDARD_GRAVITY_M_S2, spans, static)

    apart: list[int] = list(range(given, len(logs)))
    if not apart and len(logs) >= WHOLE_FLIGHTS:
        count = min(max(1, round(share * len(logs))), len(logs) - 1)
        apart = sorted({round(x) for x in np.linspace(0, len(logs) - 1, count + 2)[1:-1]})
    if apart:
        seen = cut([(0.0, 0.0 if i in apart else 1.0) for i in range(len(logs))])
        unseen = cut([(0.0, 1.0 if i in apart else 0.0) for i in range(len(logs))])
        what = f"whole flights: {', '.join(logs[i].name for i in apart)}"
    else:
        seen, unseen = cut([(0.0, 1.0 - share)] * len(logs)), cut([(1.0 - share, 1.0)] * len(logs))
        what = f"the last {share:.0%} of each flight"
    step = -(-len(seen.flight) // MOST_SEGMENTS) or 1
    return Segments(*(x[::step] for x in seen)), unseen, what


def _tell(free: Model, fit: Fit, rows: list[report.Row], summary: dict[str, Any]) -> None:
    width = max(len(row.name) for row in rows)
    console.print(f"\n{'':<{width}} {'start':>11} {'fitted':>11}   95 % interval")
    for row in rows:
        interval = row.kept or f"{row.low:.4g} to {row.high:.4g}"
        console.print(f"{row.name:<{width}} {row.start:>11.5g} {row.value:>11.5g}   {interval}")
    believed = (
        "the log's thrusts are believed, and mass and inertia fitted"
        if free.thrust
        else "the file's mass is believed, and thrust fitted"
    )
    console.print(f"a log tells thrust over mass only: {believed}")
    if fit.explained < fitting.LEAST_EXPLAINED:
        console.print(
            f"commands explain {max(fit.explained, 0.0):.0%} of the change of body rates over 0.1 s: sampled slower"
            " than they change? Inertia and yaw moment were fitted to predict, and are not the vehicle's"
        )
    ratio = "" if summary["ratio"] is None else f", ratio {summary['ratio']:.3f}"
    console.print(
        f"\nheld out, {summary['horizon_s']:g} s open loop, median position error of {summary['segments']:,} segments:"
        f" starting vehicle {summary['start_mm']:.1f} mm, fitted {summary['fitted_mm']:.1f} mm{ratio}"
        f" (its file alone: {summary['file_mm']:.1f} mm; constant velocity: {summary['constant_velocity_mm']:.1f} mm)"
    )
