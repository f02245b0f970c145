"""`depthreg compare` as a user runs it: rows, means, deviations, names, notes, and bad input."""

import csv
import math
import statistics
from collections.abc import Callable
from pathlib import Path

import pytest

from depthreg.cli import main
from depthreg.comparison.rows import Row, make_rows, warnings
from depthreg.comparison.runs import find_runs, read_run, read_stage

MakeRun = Callable[..., Path]
RMSE = ("depth, misaligned", "rmse_m")


def rows_of(*folders: Path) -> list[Row]:
    return make_rows([read_run(folder) for folder in folders])


def weight(value: float) -> dict:
    """A run whose loss has this weight, asked for on the command line."""
    return {"overrides": [f"loss.weight={value}"], "config": {"loss": {"weight": value}}}


def test_runs_that_differ_in_the_seed_alone_are_one_row_with_mean_and_sample_deviation(make_run: MakeRun) -> None:
    runs = [make_run(f"r{seed}", seed=seed, rmse_m=value) for seed, value in ((1, 2.0), (2, 4.0), (3, 9.0))]
    (row,) = rows_of(*runs)
    assert row.seeds == "1, 2, 3"
    assert row.score(RMSE)[:2] == (5.0, pytest.approx(statistics.stdev([2, 4, 9])))
    assert str(row.score(RMSE)) == "5.000 ± 3.606"  # the root of (9 + 1 + 16) / 2


def test_one_seed_has_no_deviation_and_a_diverged_one_is_not_averaged_away(make_run: MakeRun) -> None:
    (alone,) = rows_of(make_run("alone", rmse_m=2.0))
    assert str(alone.score(RMSE)) == "2.000"
    (diverged,) = rows_of(make_run("a", rmse_m=2.0), make_run("b", seed=2, rmse_m=math.nan))
    assert str(diverged.score(RMSE)) == "-"


def test_rows_are_named_by_the_words_that_tell_them_apart(make_run: MakeRun) -> None:
    shared = {"trainer": {"devices": 1, "max_time": "1h"}}
    base = {"overrides": ["trainer.max_time=1h"], "config": shared}
    other = {"overrides": ["trainer.max_time=1h", "loss.weight=0.1"], "config": {**shared, "loss": {"weight": 0.1}}}
    rows = rows_of(make_run("a", **base), make_run("b", **other))
    assert [row.name for row in rows] == ["loss.weight=0.5", "loss.weight=0.1"]
    assert [row.differences for row in rows] == [{"loss.weight": "0.5"}, {"loss.weight": "0.1"}]


def test_a_groups_choice_is_named_as_it_was_asked_for_and_its_effect_is_shown(make_run: MakeRun) -> None:
    twice = {"config": {"curriculum": ["joint", "joint"]}, "stages": ["joint", "joint_2"]}
    rows = rows_of(make_run("a", overrides=["experiment=twice"], **twice), make_run("b"))
    assert [row.name for row in rows] == ["experiment=twice", "defaults"]
    assert rows[0].differences == {"curriculum": "[joint,joint]"}
    assert list(rows[0].runs[0].stages) == ["joint", "joint_2"]


def test_rows_of_the_same_words_are_named_by_their_configurations(make_run: MakeRun) -> None:
    rows = rows_of(make_run("a", config={"loss": {"weight": 1}}), make_run("b", config={"loss": {"weight": None}}))
    assert [row.name for row in rows] == ["loss.weight=1", "loss.weight=null"]


@pytest.mark.parametrize(
    ("second", "said"),
    [
        ({"revision": "f" * 40}, "2 revisions of the code: 01234567, ffffffff"),
        ({"losses": [1.0]}, "number of optimisation steps"),
        ({"config": {"data": {"batch_size": 8}}}, "number of training frames"),
        ({"seed": 2, "config": {"loss": {"weight": 2}}}, "different seeds"),
        ({"frames_differ": True}, "evaluated on different frames"),
        ({}, "seed 1 was run more than once"),
    ],
)
def test_what_makes_a_comparison_unfair_is_said(second: dict, said: str, make_run: MakeRun) -> None:
    notes = warnings(rows_of(make_run("a"), make_run("b", **second)))
    assert any(said in note for note in notes)


def test_an_equal_comparison_has_nothing_to_note(make_run: MakeRun) -> None:
    runs = [make_run(f"{value}_{seed}", seed=seed, **weight(value)) for value in (0.1, 0.2) for seed in (1, 2)]
    assert warnings(rows_of(*runs)) == []


def test_steps_and_frames_are_counted_over_all_stages(make_run: MakeRun) -> None:
    trainer = {"devices": 2, "num_nodes": 3, "accumulate_grad_batches": 5}
    config = {"curriculum": ["joint", "joint"], "trainer": trainer}
    run = read_run(make_run("a", config=config, stages=["joint", "joint_2"]))
    assert run.steps == 2 * 3 * 10  # stages, epochs, steps an epoch
    assert run.frames == 60 * 4 * 2 * 3 * 5  # in batches of 4


def test_jobs_are_found_below_a_sweep_in_their_order_and_lost_ones_too(make_run: MakeRun, tmp_path: Path) -> None:
    expected = [make_run(f"sweep/{job}", seed=job) for job in (0, 2, 10)]
    (tmp_path / "sweep" / "multirun.yaml").touch()
    (tmp_path / "sweep" / "1" / ".hydra").mkdir(parents=True)
    found, lost = find_runs([tmp_path / "sweep", expected[1]])  # given twice, counted once
    assert found == expected and lost == [tmp_path / "sweep" / "1"]


def test_the_last_line_of_a_killed_runs_log_may_be_cut_off(make_run: MakeRun) -> None:
    stage = make_run("a") / "joint"
    whole = (stage / "metrics.csv").read_text()
    (stage / "metrics.csv").write_text(whole + "3,39,1.2")
    assert read_stage(stage).curves["val/loss"] == {0: 4.0, 1: 2.0, 2: 1.0}


@pytest.mark.parametrize(
    ("losses", "state"),
    [([4.0, 2.0], "unfinished: joint, 2 epochs"), ([4.0, math.nan], "failed: loss isn't finite in joint, epoch 1")],
)
def test_runs_without_a_final_table_stay_in_the_table_but_are_never_the_best(
    losses: list[float], state: str, make_run: MakeRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_run("runs/a", seed=1, rmse_m=3.0, **weight(0.1))
    make_run("runs/b", seed=2, rmse_m=None, losses=losses, **weight(0.1))
    make_run("runs/c", seed=1, rmse_m=None, losses=losses, **weight(0.2))
    make_run("runs/d", seed=1, rmse_m=2.0, **weight(0.3))
    assert main(["compare", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]) == 0
    table = (tmp_path / "out" / "compare.md").read_text().splitlines()
    assert f"| loss.weight=0.1 | 1 | 20 to 30 | 3.000 | seed 2 {state} |" in table
    assert f"| loss.weight=0.2 | 0 | 20 | - | seed 1 {state} |" in table
    assert "| loss.weight=0.3 | 1 | 30 | **2.000** | finished |" in table
    assert state.split(":")[0] in capsys.readouterr().out


def test_csv_has_the_mean_the_deviation_and_each_seed_in_full_precision(make_run: MakeRun, tmp_path: Path) -> None:
    make_run("runs/a", seed=1, rmse_m=1 / 3)
    make_run("runs/b", seed=2, rmse_m=2 / 3)
    assert main(["compare", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]) == 0
    with (tmp_path / "out" / "compare.csv").open() as file:
        (line,) = csv.DictReader(file)
    assert float(line["mean"]) == 0.5 and float(line["std"]) == pytest.approx(statistics.stdev([1 / 3, 2 / 3]))
    assert [float(value) for value in line["values"].split()] == [1 / 3, 2 / 3]
    assert (line["configuration"], line["n"], line["seeds"], line["best"]) == ("defaults", "2", "1 2", "False")


def test_the_terminals_table_fits_into_80_columns(
    make_run: MakeRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in (1, 2):
        make_run(f"runs/{seed}", seed=seed, overrides=["a.very.long.key.of.some.group=123456789"], rmse_m=10.0 * seed)
    assert main(["compare", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "15.000 ± 7.071" in printed and "note" not in printed
    assert all(len(line) <= 80 for line in printed.splitlines()[:-1])  # the last one is the page's path


@pytest.mark.parametrize(
    ("break_it", "said"),
    [
        (lambda run: (run / "run.yaml").unlink(), "holds no run"),
        (lambda run: (run / "run.yaml").write_text("{"), "run.yaml can't be read"),
        (lambda run: (run / "run.yaml").write_text("{id: 0, overrides: [], config: {}}"), "no config.curriculum"),
        (lambda run: (run / "metrics.csv").write_text("a,b\n1,2\n"), "metrics.csv isn't a table"),
        (lambda run: (run / "joint" / "metrics.csv").write_text("a,b\n1,2\n"), "metrics.csv can't be read"),
        (lambda run: (run / "joint/panels/epoch_000_frame_0.png").write_text("?"), "epoch_000_frame_0.png can't be"),
        (lambda run: (run.parent / "out").write_text("mine"), "can't be made a folder"),
    ],
)
def test_what_cannot_be_compared_is_refused_in_one_sentence(
    break_it: Callable[[Path], None], said: str, make_run: MakeRun, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run("a")
    break_it(run)
    before = sorted(run.parent.iterdir())
    assert main(["compare", str(run), "--out", str(run.parent / "out")]) == 2
    printed = capsys.readouterr()
    assert said in printed.err and len(printed.err.splitlines()) == 1 and printed.out == ""
    assert sorted(run.parent.iterdir()) == before


@pytest.mark.parametrize(("argv", "said"), [([], "RUN"), (["nowhere"], "nowhere can't be read"), (["a", "-x"], "-x")])
def test_arguments_that_cannot_be_meant_are_refused(
    argv: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["compare", *argv]) == 2
    printed = capsys.readouterr()
    assert said in printed.err and len(printed.err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_differences_are_taken_seed_by_seed(
    make_run: MakeRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed, ours_m, theirs_m in ((1, 2.0, 2.5), (2, 4.0, 4.4), (3, 9.0, 9.9)):  # frames of seed 3 are hard for both
        make_run(f"runs/a{seed}", seed=seed, rmse_m=ours_m, **weight(0.1))
        make_run(f"runs/b{seed}", seed=seed, rmse_m=theirs_m, **weight(0.2))
    make_run("runs/b4", seed=4, rmse_m=99.0, **weight(0.2))  # has no partner
    out = tmp_path / "out"
    assert main(["compare", str(tmp_path / "runs"), "--against", "weight=0.1", "--out", str(out)]) == 0
    deviation = statistics.stdev([0.5, 0.4, 0.9])
    expected = f"+0.600 ± {deviation:.3f}"
    assert expected in capsys.readouterr().out
    assert f"({expected})" in (out / "compare.md").read_text() and expected in (out / "compare.html").read_text()
    with (out / "compare.csv").open() as file:
        first, second = csv.DictReader(file)
    assert float(first["difference_mean"]) == 0 and float(second["difference_std"]) == pytest.approx(deviation)


@pytest.mark.parametrize("words", ["weight=0.3", "1"])
def test_a_reference_is_one_of_the_rows(
    words: str, make_run: MakeRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for i, value in enumerate((0.1, 1.1)):
        make_run(f"runs/{i}", rmse_m=2.0, **weight(value))
    assert main(["compare", str(tmp_path / "runs"), "--against", words, "--out", str(tmp_path / "out")]) == 2
    assert f"--against {words}: expected one of loss.weight=0.1, loss.weight=1.1" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
