"""Trained runs that ship with the package: run folders with the learner of their last checkpoint."""

import shutil
import tempfile
from pathlib import Path

SHIPPED = Path(__file__).parents[1] / "policies"
COPIES = Path("runs") / "shipped"


def names() -> list[str]:
    return sorted(path.parent.name for path in SHIPPED.glob("*/config.json"))


def run_folder(run: Path) -> Path:
    """`run`; or, where there is no such folder and it is the name of a shipped run, a copy of that in runs/shipped: what
    is made of a run is written to its folder.
    """
    if run.exists() or str(run) not in names():
        return run
    source, copy = SHIPPED / run.name, COPIES / run.name
    if (copy / "config.json").is_file() and _contents(copy) >= _contents(source):
        return copy
    COPIES.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=COPIES, prefix=".copy-") as work:
        made = shutil.copytree(source, Path(work) / run.name)
        if copy.exists():
            copy.replace(Path(work) / "former")
        made.replace(copy)
    return copy


def _contents(folder: Path) -> set[tuple[str, bytes]]:
    """The settings and the checkpoints' manifests of a run."""
    files = [folder / "config.json", *folder.glob("checkpoints/*/manifest.json")]
    return {(str(path.relative_to(folder)), path.read_bytes()) for path in files}
