"""A command of a contestant, in a process group of its own."""

import os
import signal
import subprocess
import tempfile

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
