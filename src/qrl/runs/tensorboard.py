"""The rows of metrics.csv as TensorBoard events.

tensorboardX's SummaryWriter is not used: its thread dies when the disk is full, and the training then waits for ever.
"""

import math
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue]
from tensorboardX.summary import scalar

from qrl.runs.files import Row, writing


class EventLog:
    """One event file; TensorBoard discards the events of earlier files from `purge_step` on."""

    def __init__(self, folder: Path, purge_step: int) -> None:
        self._folder = folder
        with writing(folder):
            folder.mkdir(exist_ok=True)
            self._events = EventsWriter(str(folder / "events"))
            self._write(Event(step=purge_step, session_log=SessionLog(status=SessionLog.START)))

    def add(self, row: Row) -> None:
        """Write and flush the finite numbers of a report. OSError, naming the folder, if it cannot be written."""
        with writing(self._folder):
            for name, value in row.items():
                if name != "env_steps" and math.isfinite(value):
                    self._write(Event(step=int(row["env_steps"]), summary=scalar(name, value)))
            self._events.flush()

    def close(self) -> None:
        with suppress(OSError):  # every row was flushed already
            self._events.close()

    def _write(self, event: Any) -> None:
        event.wall_time = time.time()
        self._events.write_event(event)
