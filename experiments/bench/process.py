"""A command of a contestant, in a process group of its own."""

import os
import signal
import subprocess
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress

OUT_OF_TIME = "out of time"


def run_with_timeout(words: list[str], env: dict[str, str], seconds: float) -> tuple[str, str, str]:
    """(standard output, standard error, how it ended) of a command in a temporary working directory."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with (
        tempfile.TemporaryDirectory() as folder,
        subprocess.Popen(words, env=env, cwd=folder, start_new_session=True, **pipes) as process,
    ):
        try:
            out, err = process.communicate(timeout=seconds)
            return out, err, "done" if process.returncode == 0 else f"exit code {process.returncode}"
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return *process.communicate(), OUT_OF_TIME
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            raise


def follow(words: list[str], env: dict[str, str], seconds: float, each: Callable[[str], None]) -> tuple[str, str]:
    """(standard error, how it ended) of a command that is given so long; each line of its standard output goes to
    `each` as it comes.
    """
    pipes = {"stdout": subprocess.PIPE, "text": True, "start_new_session": True}
    with tempfile.TemporaryFile("w+") as errors, subprocess.Popen(words, env=env, stderr=errors, **pipes) as process:
        late = threading.Event()

        def kill() -> None:
            late.set()
            with suppress(ProcessLookupError):  # it has ended just now
                os.killpg(process.pid, signal.SIGKILL)

        timer = threading.Timer(max(0.0, seconds), kill)
        timer.start()
        try:
            assert process.stdout
            for line in process.stdout:
                each(line)
            process.wait()
        except BaseException:
            kill()
            raise
        finally:
            timer.cancel()
        errors.seek(0)
        ended = "done" if process.returncode == 0 else f"exit code {process.returncode}"
        return errors.read(), OUT_OF_TIME if late.is_set() else ended
