"""The seal of a checkpoint: a file, written last, with the SHA-256 of every other and of the run whose it is."""

import hashlib
import json
import os
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from qrl.runs.files import Row, replace_text

NAME = "seal.json"
FORMAT: Literal[2] = 2


class Record(BaseModel):
    """What a checkpoint holds besides the training state."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=True, ser_json_inf_nan="constants")

    rows: list[Row]  # of metrics.csv, up to here
    train_seconds: float
    report_seconds: float  # of these, since the last report


class Seal(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=True, ser_json_inf_nan="constants")

    format: Literal[2] = FORMAT
    run_sha256: str  # whose it is
    record: Record
    record_sha256: str
    sha256: dict[str, str]  # of each file, by its path in the checkpoint


class Damaged(OSError):
    """A checkpoint is not what was written; the message says which file of which."""


class Foreign(OSError):
    """A checkpoint is whole, and not one of this run, or of another version of qrl."""


def close(path: Path, run_sha256: str, record: Record) -> None:
    """Seal the checkpoint at `path`, once all that it vouches for is on disk."""
    seal = Seal(
        run_sha256=run_sha256,
        record=record,
        record_sha256=_record_sha256(record),
        sha256={name: _sha256(path / name, on_disk=True) for name in _files(path)},
    )
    for inside in (path, *(place for place in path.rglob("*") if place.is_dir())):
        _sync(inside)
    replace_text(path / NAME, seal.model_dump_json() + "\n")


def checked(path: Path) -> Seal:
    """The seal of a checkpoint whose every file is as it was sealed; Damaged, or Foreign, if one is not."""
    try:
        text = (path / NAME).read_bytes()
        version = json.loads(text)
    except (OSError, ValueError, RecursionError) as error:
        raise Damaged(f"{path}/{NAME}: cannot be read ({first_line(error)})") from None
    if isinstance(version, dict) and isinstance(found := version.get("format"), int) and found != FORMAT:
        when = "a later" if found > FORMAT else "an earlier"
        raise Foreign(f"{path}: of {when} version of qrl (format {str(found)[:20]}; this one reads {FORMAT})")
    try:
        seal = Seal.model_validate_json(text)
    except ValidationError as error:
        raise Damaged(f"{path}/{NAME}: is damaged ({error.errors()[0]['msg']})") from None
    if _record_sha256(seal.record) != seal.record_sha256:
        raise Damaged(f"{path}/{NAME}: is damaged")
    found = set(_files(path))
    for name, digest in seal.sha256.items():
        if name not in found:
            raise Damaged(f"{path}: {json.dumps(name)[:120]} is missing")
        try:
            same = _sha256(path / name) == digest
        except OSError as error:
            raise Damaged(f"{path}/{name}: cannot be read ({first_line(error)})") from None
        if not same:
            raise Damaged(f"{path}/{name}: is damaged")
    return seal


def _files(path: Path) -> list[str]:
    return sorted(str(f.relative_to(path)) for f in path.rglob("*") if f.is_file() and f.name != NAME)


def _sha256(path: Path, *, on_disk: bool = False) -> str:
    with path.open("rb") as file:
        if on_disk:  # a seal that outlives a crash must not vouch for what did not; Orbax leaves it to the system
            os.fsync(file.fileno())
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync(folder: Path) -> None:
    at = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(at)
    finally:
        os.close(at)


def _record_sha256(record: Record) -> str:
    return hashlib.sha256(record.model_dump_json().encode()).hexdigest()


def first_line(error: Exception) -> str:
    text = (isinstance(error, OSError) and error.strerror) or str(error).strip()
    return text.split("\n")[0][:120]
