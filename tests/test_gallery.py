"""The gallery: its page shows what its runs found, and every picture that it links is there."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import image

import figure_runs
import figures
import gallery
from figure_captions import CONFIRMED, NOT, Caption
from machines import need
from qrl_envs import task, viewer

CAPTIONS = {
    name: Caption(f"Of {name}", "Shows it.", f"claims {name}", [f"- {name} is 3."], "By a rule.", verdict)
    for name, verdict in zip(figures.FIGURES, [CONFIRMED, NOT] * 3, strict=True)
}
FOUND: dict[str, Any] = {
    "env_steps": 1_234_000,
    "starts": 1000,
    "return_mean": 165.71,
    "success": 0.998,
    "settle_p95_s": 0.91,
    "rms_position_m": 0.00012,
    "baselines": {"lqr": {"return_mean": 120.6, "success": 0.923, "settle_p95_s": np.inf, "rms_position_m": 0.0}},
    "off_nominal": {"latency": {"success": 1.0}},
}


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A gallery whose runs and figures are made up; its page."""

    def drawn(names: list[str], out: Path, *_: Any, **__: Any) -> dict[str, Caption]:
        out.mkdir(parents=True)
        for name in names:
            (out / f"{name}.png").write_text(name)
        return CAPTIONS

    def run(words: list[str], **_: Any) -> None:
        folder = Path(words[1])
        if words[0] == "evaluate":
            (folder / "evaluation.json").write_text(json.dumps(FOUND))
            for name in ("learning_curve", "flight", "evaluation", "settle"):
                (folder / f"{name}.png").write_text(f"{folder.name} {name}")

    def trained(_: Any, folder: Path) -> float:
        folder.mkdir(parents=True)
        return 1.0

    monkeypatch.setattr(figures, "figures", drawn)
    monkeypatch.setattr(figure_runs, "qrl", run)
    monkeypatch.setattr(figure_runs, "make", trained)
    monkeypatch.setattr(gallery, "picture", lambda _, __, target: target.write_text("view"))
    (tmp_path / "runs" / "bench").mkdir(parents=True)
    (tmp_path / "runs" / "bench" / "bench.md").write_text("# qrl beside its peers\n\nfast\n")
    (tmp_path / "runs" / "bench" / "bench.png").write_text("bench")
    assert gallery.main(["--out", str(tmp_path / "docs"), "--runs", str(tmp_path / "runs")]) == 0
    return tmp_path / "docs" / "gallery.md"


def test_every_picture_is_there(made: Path) -> None:
    linked = re.findall(r"!\[[^]]+\]\(([^)]+)\)", made.read_text())
    assert len(linked) == len(set(linked))
    assert {(made.parent / link).name for link in linked} == {path.name for path in (made.parent / "gallery").iterdir()}
    assert (made.parent / "gallery" / "hover_settle.png").read_text() == "hover settle"


def test_each_claim_has_its_verdict(made: Path) -> None:
    for name, told in CAPTIONS.items():
        assert f"| [{told.title}](#{name}) | claims {name} | **{told.verdict}** |" in made.read_text()
        assert f"- {name} is 3.\n\n**{told.verdict.capitalize()}.** By a rule." in made.read_text()


def test_numbers_are_those_of_the_evaluation(made: Path) -> None:
    page = made.read_text()
    assert page.count("| | policy | lqr |") == 3
    assert "| return | 165.7 | 120.6 |" in page
    assert "| success, % | 99.8 | 92.3 |" in page
    assert "| settle, p95, s | 0.91 | never |" in page
    assert "| steady state, mm | 0.1 | 0.0 |" in page
    assert "latency 100.0 %" in page
    assert "`qrl train hover --seeds 1`, 1,234,000 steps" in page


def test_what_other_commands_left_is_a_section(made: Path) -> None:
    assert "\n## qrl beside its peers\n\nfast\n" in made.read_text()
    assert "objectives" not in made.read_text()


def test_a_file_is_no_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "docs").write_text("")
    with pytest.raises(SystemExit) as end:
        gallery.main(["--out", str(tmp_path / "docs")])
    assert end.value.code == 2
    assert (
        capsys.readouterr().err == f"gallery: --out: {tmp_path}/docs is a file; expected a folder, or a name for a"
        " new one\n"
    )


def test_the_viewer_is_photographed(tmp_path: Path) -> None:
    """Its scene and plots in many colours, not an empty page."""
    need([] if any(map(shutil.which, gallery.CHROMIUMS)) else ["chromium"])
    t = np.arange(101) * 0.01
    observations, actions = np.zeros((1, 101, 18)), np.zeros((1, 100, 4))
    observations[..., [0, 4, 8]] = 1.0
    observations[..., 9] = np.cos(t)
    flown = viewer.Flown([0], observations, actions)
    (tmp_path / "view.html").write_text(viewer.page(task.load("hover"), "made up", flown))
    gallery.picture(tmp_path / "view.html", "#start=0&t=0.5", tmp_path / "view.png")
    pixels = (255 * image.imread(tmp_path / "view.png")[..., :3]).astype(int)
    assert pixels.shape == (800, 1280, 3)
    counts = np.unique(pixels.reshape(-1, 3), axis=0, return_counts=True)[1]
    assert len(counts) > 100
    assert counts.max() < 0.9 * counts.sum()


def test_without_chromium_the_picture_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    (tmp_path / "view.png").write_text("old")
    gallery.picture(tmp_path / "view.html", "", tmp_path / "view.png")
    assert (tmp_path / "view.png").read_text() == "old"
    assert "no Chromium" in capsys.readouterr().err
