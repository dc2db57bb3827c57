"""Which operations a device spent its time on, from what `jax.profiler.trace` wrote."""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from jax.profiler import ProfileData

ORIGIN_PARTS = 3


class Span(NamedTuple):
    """One run of an operation, in nanoseconds since the trace began; `own_ns` without the operations inside it."""

    name: str
    begin_ns: float
    end_ns: float
    own_ns: float


class Operation(NamedTuple):
    name: str
    seconds: float  # of all runs, without the operations inside it (of a loop, its body's)
    share: float  # of all operations' seconds
    times: int


class Profile(NamedTuple):
    seconds: float  # from the begin of the first operation to the end of the last
    busy: float  # share of them in which an operation ran, on the device that was busiest
    launches: int
    operations: list[Operation]  # the longest first


def read(folder: Path, most: int = 15) -> Profile:
    """The profile of the trace in `folder`, with the `most` longest operations; ValueError where it has none."""
    files = sorted(folder.rglob("*.xplane.pb"))
    devices = [spans for file in files for spans in spans_of_devices(ProfileData.from_file(str(file)))]
    if not devices:
        raise ValueError(f"{folder}: expected a trace with operations of a device")
    spans = [span for device in devices for span in device]
    seconds = (max(s.end_ns for s in spans) - min(s.begin_ns for s in spans)) / 1e9
    busy = max(covered_ns(device) for device in devices) / 1e9 / seconds if seconds else 0.0
    return Profile(seconds, busy, len(spans), longest(spans)[:most])


def spans_of_devices(data: Any) -> Iterator[list[Span]]:
    """Of each device that ran operations: a GPU's streams, or the threads of XLA on a CPU."""
    for plane in data.planes:
        if plane.name.startswith("/device:"):
            # The other lines say the same again, by step, module and source.
            lines = [line for line in plane.lines if line.name.startswith("Stream")] or list(plane.lines)
            found = [span for line in lines for span in spans_of_line(line.events, everything=True)]
        elif plane.name == "/host:CPU":
            found = [span for line in plane.lines for span in spans_of_line(line.events, everything=False)]
        else:
            found = []
        if found:
            yield found


def spans_of_line(events: Iterable[Any], everything: bool) -> Iterator[Span]:
    """The operations among the events of a stream or thread, which may lie within each other."""
    named = []
    for event in events:
        operation = dict(event.stats).get("hlo_op")
        if event.duration_ns > 0 and (operation or everything):
            named.append((event.start_ns, event.start_ns + event.duration_ns, str(operation or event.name)))
    within: list[list[Any]] = []  # open operations, the innermost last: name, begin, end, time of those inside
    for begin, end, name in sorted(named, key=lambda e: (e[0], -e[1])):
        while within and begin >= within[-1][2]:
            yield _closed(within.pop())
        if within:
            within[-1][3] += min(end, within[-1][2]) - begin
        within.append([name, begin, end, 0.0])
    while within:
        yield _closed(within.pop())


def _closed(span: list[Any]) -> Span:
    name, begin, end, inside = span
    return Span(name, begin, end, max(0.0, end - begin - inside))


def origins(hlo: str) -> dict[str, str]:
    """Of each operation of a compiled program's text what it was in JAX: the last parts of its name there. A kernel's
    name has underscores for dots.
    """
    found = re.findall(r'^\s*(?:ROOT )?%?([\w.-]+) = .*op_name="([^"]+)"', hlo, flags=re.MULTILINE)
    named = {name: "/".join(path.split("/")[-ORIGIN_PARTS:]) for name, path in found}
    return {name.replace(".", "_"): origin for name, origin in named.items()} | named


def covered_ns(spans: Iterable[Span]) -> float:
    """Length of the union of the spans."""
    length, until = 0.0, -float("inf")
    for span in sorted(spans, key=lambda s: s.begin_ns):
        length += max(0.0, span.end_ns - max(span.begin_ns, until))
        until = max(until, span.end_ns)
    return length


def longest(spans: Iterable[Span]) -> list[Operation]:
    sums: dict[str, tuple[float, int]] = {}
    for span in spans:
        seconds, count = sums.get(span.name, (0.0, 0))
        sums[span.name] = seconds + span.own_ns / 1e9, count + 1
    total = sum(seconds for seconds, _ in sums.values()) or 1.0
    found = [Operation(name, seconds, seconds / total, count) for name, (seconds, count) in sums.items()]
    return sorted(found, key=lambda operation: -operation.seconds)
