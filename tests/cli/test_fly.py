"""The runs that ship, and `qrl fly`."""

import argparse
import errno
import os
import shutil
from pathlib import Path

import pytest

from qrl.cli import fly as command
from qrl.cli.arguments import build_parser
from qrl.evaluation.trained_run import TrainedRun
from qrl.runs import shipped


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package that ships one run, and an empty working folder."""
    folder = tmp_path / "package" / "any"
    (folder / "checkpoints/100").mkdir(parents=True)
    (folder / "config.json").write_text("{}")
    (folder / "checkpoints/100/manifest.json").write_text("one")
    monkeypatch.setattr(shipped, "SHIPPED", folder.parent)
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return folder


def test_a_run_that_ships_is_copied_once(package: Path) -> None:
    """What is made of the copy stays; another version has a copy of its own."""
    copy = shipped.run_folder(Path("any"))
    assert copy.parent == Path("runs/shipped")
    assert (copy / "checkpoints/100/manifest.json").read_text() == "one"
    (copy / "view.html").touch()
    assert shipped.run_folder(Path("any")) == copy
    assert (copy / "view.html").exists()
    (package / "checkpoints/100/manifest.json").write_text("two")
    other = shipped.run_folder(Path("any"))
    assert other != copy
    assert (other / "checkpoints/100/manifest.json").read_text() == "two"
    assert (copy / "view.html").exists()
    assert sorted(copy.parent.iterdir()) == sorted([copy, other])


@pytest.mark.usefixtures("package")
def test_a_copy_that_fails_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """By its name; nothing of it stays."""

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(shutil, "copytree", full)
    with pytest.raises(OSError, match=r"^runs/shipped/any-\w{8}: cannot be written \(No space left on device\)$"):
        shipped.run_folder(Path("any"))
    assert not [*Path("runs/shipped").iterdir()]


def test_another_process_may_copy_it_first(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def late(_: Path, target: Path) -> None:
        shutil.copytree(package, target)
        raise OSError(errno.ENOTEMPTY, os.strerror(errno.ENOTEMPTY))

    monkeypatch.setattr(Path, "rename", late)
    assert (shipped.run_folder(Path("any")) / "checkpoints/100/manifest.json").read_text() == "one"


@pytest.mark.usefixtures("package")
def test_a_folder_comes_before_a_run_that_ships() -> None:
    Path("any").mkdir()
    assert shipped.run_folder(Path("any")) == Path("any")
    assert shipped.run_folder(Path("runs/mine")) == Path("runs/mine")
    assert shipped.run_folder(Path("missing")) == Path("missing")


def test_fly_judges_and_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    """With all that the two commands read."""
    seen: list[argparse.Namespace] = []
    monkeypatch.setattr(command, "evaluate", lambda args: seen.append(args) or 0)
    monkeypatch.setattr(command, "view", lambda args: seen.append(args) or 0)
    args = build_parser().parse_args(["fly", "--vehicle", "mine.json", "--starts", "7", "--off-nominal"])
    assert command.fly(args) == 0
    for name, given in zip(("evaluate", "view"), seen, strict=True):
        wanted = vars(build_parser().parse_args([name, "any", "--vehicle", "mine.json"]))
        wanted.pop("command")
        if name == "evaluate":
            wanted |= {"starts": 7, "off_nominal": True}
        assert vars(given) == wanted


def test_the_policy_that_ships_is_read_and_small() -> None:
    """Its settings are of this version, its checkpoint is whole, and no path of the machine that made it is in it."""
    assert shipped.names() == ["any"]
    run = TrainedRun.load(shipped.SHIPPED / "any")
    policy = run.float_policy()
    assert policy.unit
    assert policy.provenance.seed >= 100, "none that settings were chosen on"
    weights = sum(w.size + b.size for w, b in policy.layers) + sum(x.size for x in policy.unit.of_input)
    assert weights + policy.unit.of_memory[0].size + policy.memory_size - 7 <= 4500
    files = [path for path in (shipped.SHIPPED / "any").rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 300_000
    assert not any(b"/home/" in path.read_bytes() or b"/tmp/" in path.read_bytes() for path in files)
