"""The command line: help, version, and bad input in one sentence with status 2 and nothing written."""

import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
import torch
import yaml
from omegaconf import OmegaConf

from depthreg import __version__
from depthreg.cli import APPLICATIONS, COMMANDS, main
from depthreg.config import CONF_DIR


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


FLAGS = [["-m"], ["--multirun"], ["--cfg", "job"], ["-c", "job", "--resolve"], ["--info", "defaults"]]


@pytest.mark.parametrize("flags", FLAGS, ids=" ".join)
@pytest.mark.parametrize("bad", ["seeed=1", "seed", "seed=1.5", "seed=-1"])
def test_an_override_that_means_nothing_is_refused_whatever_the_flags(
    flags: list[str], bad: str, empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bad.split("=")[0] in refusal(["train", *flags, bad], empty_folder, capsys)


@pytest.mark.parametrize("name", APPLICATIONS)
@pytest.mark.parametrize("argv", [["zzz=1"], ["-m", "seed=1.5"]], ids=" ".join)
def test_an_override_that_means_nothing_is_refused_by_every_command(
    name: str, argv: list[str], empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert argv[-1].split("=")[0] in refusal([name, *argv], empty_folder, capsys)


def test_a_mistake_is_found_before_pytorch_is_imported(tmp_path: Path) -> None:
    """Which takes seconds. `-X importtime` lists every module as it is imported."""
    command = [sys.executable, "-X", "importtime", "-m", "depthreg", "train", "data.batch_size=300"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2 and "depthreg train: data.train_count=240 is below" in done.stderr
    modules = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "omegaconf" in modules and not {"torch", "lightning", "wandb"} & modules
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--sweep"], "--sweep"),
        (["--cfg", "jobs"], "invalid choice: 'jobs'"),
        (["-cn", "trian"], "trian"),
        (["--config-dir", "nowhere"], "nowhere"),
        (["-m", "--cfg", "job"], "Only one of"),
    ],
)
def test_a_flag_that_means_nothing_is_refused(
    flags: list[str], said: str, empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert said in refusal(["train", *flags], empty_folder, capsys)


@pytest.mark.parametrize("name", APPLICATIONS)
def test_help_shows_every_group_and_key_of_a_command_and_nothing_of_hydra(
    name: str, empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([name, "--help"]) == 0
    text = capsys.readouterr().out
    own = OmegaConf.load(CONF_DIR / f"{name}.yaml")
    groups = {group for default in own.defaults if isinstance(default, dict) for group in default}
    plain = {group for group in groups if not group.startswith(("stage@", "override ", "optional "))}
    assert all(f"\n  {group} " in text for group in plain)
    assert all(f"\n  {key}" in text for key in own if key not in ("defaults", "hydra"))
    assert f"\n  depthreg {name} " in text and "Hydra" not in text and "_target_" not in text
    assert max(map(len, text.splitlines())) <= 120
    assert list(empty_folder.iterdir()) == []


@pytest.mark.parametrize("name", APPLICATIONS)
def test_the_composed_configuration_is_shown_without_running_it(
    name: str, empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([name, "--cfg", "job", "seed=7"]) == 0
    assert yaml.safe_load(capsys.readouterr().out)["seed"] == 7
    assert list(empty_folder.iterdir()) == []


def test_choices_of_a_users_own_folder_are_found(empty_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = empty_folder.parent / "mine" / "experiment"
    folder.mkdir(parents=True)
    (folder / "slow.yaml").write_text("# @package _global_\nlearning_rate: 1.0e-5\n")
    assert main(["train", "--config-dir", str(folder.parent), "experiment=slow", "--cfg", "job"]) == 0
    assert yaml.safe_load(capsys.readouterr().out)["learning_rate"] == 1e-5


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["data.widht=96"], "did you mean 'data.width'"),
        (["model=papr"], "expected one of paper"),
        (["model=3"], "model=3: expected one of paper, release, small"),
        (["learning_rate=[1"], "[1"),
        (["data.train_count=-3"], "data.train_count=-3"),
        (["data.val_count=0"], "data.val_count=0"),
        (["data.batch_size=1.5"], "data.batch_size=1.5"),
        (["data.workers=-1"], "data.workers=-1"),
        (["data.width=63"], "data.width=63"),
        (["epochs.full=0"], "epochs.full=0"),
        (["seed=-1"], "seed=-1"),
        (["data.train_count=2", "data.batch_size=3"], "at least one batch"),
        (["data=kitti", "data.root=x"], "expected data=synthetic, data=rendered"),
        (["resume=a.ckpt", "init_from=b.ckpt"], "expected no init_from=b.ckpt"),
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
    torch.save(
        {"state_dict": {}, "depthreg": {"architecture": "JointNetwork", "network": {"first_channels": 99}}}, path
    )
    said = refusal(["train", f"init_from={path}"], empty_folder, capsys)
    assert "other.ckpt" in said and "another model" in said


def test_an_interruption_ends_quietly(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(argv: list[str]) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("depthreg.pack.main", interrupted)
    assert main(["pack"]) == 130
    assert "Traceback" not in capsys.readouterr().err
