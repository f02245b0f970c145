"""The command line: help, version, and bad input in one sentence with status 2 and nothing written."""

import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
import torch

from depthreg import __version__
from depthreg.cli import COMMANDS, main


@pytest.fixture
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory; what a refused command writes would be in it."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


def refusal(argv: list[str], folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """What a refused command says; checks how it says it."""
    assert main(argv) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and len(printed.err.splitlines()) == 1
    assert "Traceback" not in printed.err and printed.err.startswith("depthreg")
    assert list(folder.iterdir()) == []
    return printed.err


@pytest.mark.parametrize("argv", [[], ["-h"], ["--help"]])
def test_help_names_every_command(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(argv) == 0
    printed = capsys.readouterr()
    assert all(f"  {name} " in printed.out for name in COMMANDS) and printed.err == ""


def test_the_version_is_that_of_the_installed_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"depthreg {version('depthreg')}\n" == f"depthreg {__version__}\n"


def test_the_module_runs_like_the_command(tmp_path: Path) -> None:
    def run(*argv: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, "-m", "depthreg", *argv], capture_output=True, text=True, cwd=tmp_path)

    assert run("--version").stdout == f"depthreg {__version__}\n"
    bad = run("trian")
    assert bad.returncode == 2 and bad.stdout == "" and "trian" in bad.stderr
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_command_is_refused(empty_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = refusal(["trian"], empty_folder, capsys)
    assert "'trian'" in said and all(name in said for name in COMMANDS)


@pytest.mark.parametrize("name", ["train", "evaluate", "render"])
@pytest.mark.parametrize("bad", ["zzz=1", "seeed=1", "seed"])
def test_an_override_that_means_nothing_is_refused(
    name: str, bad: str, empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bad.split("=")[0] in refusal([name, bad], empty_folder, capsys)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["data.widht=96"], "did you mean 'data.width'"),
        (["model=papr"], "expected one of paper"),
        (["model=3"], "group"),
        (["learning_rate=[1"], "[1"),
        (["data.train_count=-3"], "data.train_count=-3"),
        (["data.val_count=0"], "data.val_count=0"),
        (["data.batch_size=1.5"], "data.batch_size=1.5"),
        (["data.workers=-1"], "data.workers=-1"),
        (["data.width=63"], "data.width=63"),
        (["epochs.full=0"], "epochs=0"),
        (["seed=-1"], "seed=-1"),
        (["data.train_count=2", "data.batch_size=3"], "at least one batch"),
        (["data=kitti", "data.root=x"], "expected data=synthetic, data=rendered"),
        (["resume=a.ckpt", "init_from=b.ckpt"], "resume and init_from"),
        (["init_from=nowhere.ckpt"], "nowhere.ckpt"),
        (["resume=nowhere.ckpt"], "nowhere.ckpt"),
    ],
)
def test_training_that_cannot_be_meant_is_refused(
    overrides: list[str], said: str, empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert said in refusal(["train", *overrides], empty_folder, capsys)


@pytest.mark.parametrize("key", ["init_from", "resume"])
@pytest.mark.parametrize("kind", ["not a checkpoint", "code", "another program's"])
def test_training_refuses_a_file_that_is_not_its_checkpoint(
    key: str, kind: str, empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = empty_folder.parent / "given.ckpt"
    if kind == "not a checkpoint":
        path.write_text("hello")
    else:
        torch.save({"depthreg": test_the_module_runs_like_the_command if kind == "code" else None}, path)
        if kind == "another program's":
            torch.save({"state_dict": {}}, path)
    assert "given.ckpt" in refusal(["train", f"{key}={path}"], empty_folder, capsys)


def test_training_refuses_a_checkpoint_of_another_model(empty_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = empty_folder.parent / "other.ckpt"
    torch.save({"state_dict": {}, "depthreg": {"network": {"first_channels": 99}, "stage": "joint"}}, path)
    said = refusal(["train", f"init_from={path}"], empty_folder, capsys)
    assert "other.ckpt" in said and "another model" in said


def test_an_interruption_ends_quietly(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(argv: list[str]) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("depthreg.render.main", interrupted)
    assert main(["render"]) == 130
    assert "Traceback" not in capsys.readouterr().err
