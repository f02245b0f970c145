"""Sweeps: which jobs run, what is checked before, and what becomes of those that fail."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from depthreg import gallery
from depthreg.cli import main
from depthreg.config import CONF_DIR, open_hydra
from depthreg.errors import InputError
from depthreg.sweeps import Failure, expand_globs

TINY = [
    *("data.width=80", "data.height=64", "data.train_count=4", "data.val_count=2", "data.batch_size=2"),
    *("data.workers=0", "model.completion_widths=[16,16]", "trainer.accelerator=cpu", "logger=csv"),
    *("curriculum=[joint]", "epochs.joint=1", "callbacks.panels=null"),
]
Job = Callable[[DictConfig], Any]


@pytest.fixture
def jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Job], list[DictConfig]]:
    """Gives `depthreg gallery` another task, in an empty folder; the list fills with what the command checked."""
    monkeypatch.chdir(tmp_path)

    def put(job: Job) -> list[DictConfig]:
        checked: list[DictConfig] = []
        monkeypatch.setattr(gallery, "check", checked.append)
        monkeypatch.setattr(gallery, "run", job)
        return checked

    return put


def test_every_combination_of_values_is_one_job_and_its_result_is_told(
    jobs: Callable[[Job], list[DictConfig]], capsys: pytest.CaptureFixture[str]
) -> None:
    done = []

    def job(config: DictConfig) -> float:
        done.append((config.seed, config.scenes))
        return config.seed + config.scenes / 10

    jobs(job)
    assert main(["gallery", "-m", "seed=1,2", "scenes=range(3,5)"]) == 0
    assert done == [(1, 3), (1, 4), (2, 3), (2, 4)]
    printed = capsys.readouterr()
    assert "job 2  RMSE 2.3 m  seed=2 scenes=3" in printed.out and printed.err == ""


@pytest.mark.parametrize("batch", ["null", "1"])
def test_a_failed_job_is_named_and_the_others_are_done(
    batch: str, jobs: Callable[[Job], list[DictConfig]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done = []

    def job(config: DictConfig) -> None:
        if config.seed == 1:
            raise ArithmeticError("a number\nis missing")
        if config.seed == 2:
            raise InputError("seed 2 is unlucky")
        done.append(config.seed)

    jobs(job)
    flags = ["-m", f"hydra.sweeper.max_batch_size={batch}", "hydra.sweep.dir=sweep"]
    assert main(["gallery", *flags, "seed=0,1,2,3", "scenes=2"]) == 1
    assert done == [0, 3]
    assert capsys.readouterr().err.splitlines() == [
        "depthreg gallery: 2 of 4 jobs failed:",
        "  job 1 (seed=1): ArithmeticError: a number is missing",
        "  job 2 (seed=2): seed 2 is unlucky",
    ]
    error = (tmp_path / "sweep" / "1" / "error.txt").read_text()
    assert error.startswith("Traceback") and "a number\nis missing" in error
    assert not (tmp_path / "sweep" / "2" / "error.txt").exists()


def test_bad_input_alone_is_exit_status_2(jobs: Callable[[Job], list[DictConfig]]) -> None:
    def job(config: DictConfig) -> None:
        if config.seed == 1:
            raise InputError("seed 1 is unlucky")

    jobs(job)
    assert main(["gallery", "-m", "seed=0,1"]) == 2


def test_a_programming_error_in_a_single_run_keeps_its_traceback(jobs: Callable[[Job], list[DictConfig]]) -> None:
    def job(config: DictConfig) -> None:
        raise ValueError("shapes differ")

    jobs(job)
    with pytest.raises(ValueError, match="shapes differ"):
        main(["gallery"])


def test_each_value_is_checked_once_and_before_anything_is_written(
    jobs: Callable[[Job], list[DictConfig]], tmp_path: Path
) -> None:
    there: list[int] = []
    checked = jobs(lambda config: there.append(len(checked)))
    sweep = ["seed=0,1,2", "scenes=1,2", "learning_rate=interval(0.1,0.3)"]
    assert main(["gallery", "-m", *sweep]) == 2  # only now does Hydra's own sweeper find that it has no intervals
    assert [(config.seed, config.scenes, config.learning_rate) for config in checked] == [
        *((seed, 1, 0.1) for seed in (0, 1, 2)),
        *((0, 2, 0.1), (0, 1, 0.3)),
    ]
    assert main(["gallery", "-m", *sweep[:2]]) == 0
    assert there == [9] * 6  # four of them of the second sweep, all before its first job


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["seed=1,2", "learning_rate=0.1,high"], "learning_rate=high"),
        (["seed=1,-2"], "seed=-2"),
        (["learning_rate=interval(-1,1)"], "learning_rate=-1"),
        (["data.width=64,63"], "data.width=63"),
        (["data.widht=64,63"], "did you mean 'data.width'"),
        (["model=small,papr"], "model=papr"),
        (["experiment=glob(ablations/*)"], "fits no choice: expected some of ablation/"),
        (["data.train_count=8,2", "data.batch_size=4"], "data.train_count=2 is below"),
        (["trainer.precision=32-true,17"], "trainer.precision=17"),
        (["curriculum=[joint],[ful]"], "expected some of joint"),
        (["trainer.gradient_clip_val=1.0,x"], "trainer: `gradient_clip_val` should be an int or a float"),
    ],
)
def test_a_sweep_with_a_bad_value_is_refused_before_anything_is_written(
    overrides: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["train", "-m", *overrides]) == 2
    message = capsys.readouterr().err
    assert said in message and len(message.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("glob", "pattern"),
    [("glob(ablation/*)", "ablation/*"), ("glob(ablation/no_r*)", "ablation/no_r*"), ("glob(*)", "**/*")],
)
def test_a_glob_looks_into_the_folders_of_a_group(glob: str, pattern: str) -> None:
    group = CONF_DIR / "experiment"
    files = sorted(path.relative_to(group).with_suffix("").as_posix() for path in group.glob(f"{pattern}.yaml"))
    with open_hydra("train") as hydra:
        assert expand_globs(hydra, [f"experiment={glob}", "seed=1,2"]) == [f"experiment={','.join(files)}", "seed=1,2"]


def test_the_ablations_are_jobs_of_one_command(
    jobs: Callable[[Job], list[DictConfig]], capsys: pytest.CaptureFixture[str]
) -> None:
    curricula = []
    jobs(lambda config: curricula.append(list(config.curriculum)))
    assert main(["gallery", "-m", "experiment=glob(ablation/*,exclude=ablation/no_r*)"]) == 0
    kept = [path for path in (CONF_DIR / "experiment" / "ablation").iterdir() if not path.stem.startswith("no_r")]
    assert len(curricula) == len(kept)
    assert ["full"] in curricula and ["completion", "full"] in curricula and ["joint", "full"] in curricula


def weights(run: Path) -> dict[str, torch.Tensor]:
    return torch.load(run / "joint" / "last.ckpt", weights_only=True)["state_dict"]


def test_jobs_of_one_process_are_what_they_are_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    threads, handlers = torch.get_num_threads(), list(logging.getLogger("lightning.pytorch").handlers)
    hydra = GlobalHydra.instance().is_initialized(), HydraConfig.instance().cfg
    shared = [*TINY, "data.cache_dir=frames"]
    assert main(["train", "-m", *shared, "seed=1,0", "hydra.sweep.dir=sweep"]) == 0
    assert main(["train", *shared, "hydra.run.dir=alone"]) == 0
    ours, theirs = weights(tmp_path / "sweep" / "1"), weights(tmp_path / "alone")
    assert [key for key in theirs if not torch.equal(ours[key], theirs[key])] == []
    assert torch.get_num_threads() == threads
    assert logging.getLogger("lightning.pytorch").handlers == handlers
    assert (GlobalHydra.instance().is_initialized(), HydraConfig.instance().cfg) == hydra


def test_a_failure_names_what_happened_first() -> None:
    try:
        try:
            raise OSError("the disk is full")
        finally:
            raise RuntimeError("cleaning up failed too")
    except RuntimeError as error:
        assert Failure.of(error) == Failure("error", "OSError: the disk is full")


def test_joblib_runs_jobs_side_by_side_and_names_the_one_that_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="pip install 'depthreg[sweeps]'")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sweep" / "1").mkdir(parents=True)
    (tmp_path / "sweep" / "1" / "joint").touch()  # where the second job wants a folder
    flags = ["-m", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "hydra.sweep.dir=sweep"]
    assert main(["train", *flags, *TINY, "data.cache_dir=null", "data.workers=1", "seed=0,1"]) in (1, 2)
    assert "1 of 2 jobs failed:\n  job 1 (seed=1): " in capsys.readouterr().err
    assert (tmp_path / "sweep" / "0" / "metrics.csv").is_file()
