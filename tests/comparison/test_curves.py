"""Curves and pictures: what is drawn, before any page."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from depthreg.comparison.curves import frozen_spans, mean_curve, stage_figure
from depthreg.comparison.pictures import FINAL, LAST, Moment, make_album
from depthreg.comparison.rows import make_rows
from depthreg.comparison.runs import read_run
from depthreg.data import io

MakeRun = Callable[..., Path]


def test_curves_are_averaged_over_the_epochs_that_all_seeds_have() -> None:
    epochs, mean, std = mean_curve([{0: 1.0, 1: 2.0, 2: 9.0}, {0: 3.0, 1: 6.0}])
    assert epochs == [0, 1] and mean.tolist() == [2.0, 4.0]
    assert std == pytest.approx([math.sqrt(2), math.sqrt(8)])


def test_a_single_curve_is_its_own_mean_without_a_deviation() -> None:
    epochs, mean, std = mean_curve([{0: 1.0, 2: 5.0}])
    assert epochs == [0, 2] and mean.tolist() == [1.0, 5.0] and np.isnan(std).all()


def test_stretches_of_frozen_epochs_are_bars() -> None:
    assert frozen_spans({0: 0.0, 1: 1.0, 2: 1.0, 3: 0.0, 4: 1.0}) == [(1, 2), (4, 4)]
    assert frozen_spans({}) == []


def test_losses_difficulty_and_freezing_share_the_epochs_of_a_stage(make_run: MakeRun) -> None:
    runs = [make_run(f"r{seed}", seed=seed, losses=[4.0 * seed, 2.0, 1.0], frozen=[1]) for seed in (1, 3)]
    figure = stage_figure(make_rows([read_run(run) for run in runs]), "joint")
    scatters = [trace for trace in figure.data if trace.type == "scatter"]
    lines = [trace for trace in scatters if trace.line.width > 1]
    validation, training, difficulty = (list(trace.y) for trace in lines)
    assert validation == [8.0, 2.0, 1.0] and training == [4.0, 1.0, 0.5] and difficulty == [0.5, 0.75, 1.0]
    (band,) = [trace for trace in scatters if trace.fill == "toself" and trace.yaxis == "y"]
    assert band.y[0] == pytest.approx(8 + math.sqrt(32)) and band.y[-1] == pytest.approx(8 - math.sqrt(32))
    (bars,) = [trace for trace in figure.data if trace.type == "bar"]
    assert (bars.base[0], bars.x[0]) == (0.5, 1)  # epoch 1, half an epoch to either side
    ends = {axis.range for axis in (figure.layout.xaxis, figure.layout.xaxis4)}
    assert ends == {(-0.5, 2.5)}


def test_pictures_are_small_and_the_last_epochs_of_different_runs_lie_side_by_side(
    make_run: MakeRun, tmp_path: Path
) -> None:
    runs = [make_run("a", losses=[1.0] * 3), make_run("b", losses=[1.0] * 7, config={"loss": {"weight": 2}})]
    (tmp_path / "a" / "panels").mkdir()
    io.write_png(tmp_path / "a" / "panels" / "000000.png", np.zeros((30, 2000, 3), np.uint8))
    rows = make_rows([read_run(run) for run in runs])
    album = make_album(rows)
    assert album.choice.moments == [Moment("joint", 0), Moment("joint", LAST), Moment(FINAL, LAST)]
    names = {key: path.relative_to(tmp_path).as_posix() for key, path in album.paths.items()}
    assert names[0, 1, 0, 0] == "a/joint/panels/epoch_002_frame_0.png"
    assert names[0, 2, 0, 0] == "a/panels/000000.png"
    assert album.found == len(album.images) == 5


def test_fewer_seeds_and_epochs_are_shown_where_the_page_would_grow_too_large(make_run: MakeRun) -> None:
    runs = [make_run(f"r{seed}", seed=seed) for seed in (1, 2, 3)]
    rows = make_rows([read_run(run) for run in runs])
    whole = make_album(rows)
    assert whole.found == len(whole.images) == 6 and whole.choice.seeds == [1, 2, 3]
    least = make_album(rows, budget_bytes=1)
    assert least.found == 6 and [path.name for path in least.images] == ["epoch_002_frame_0.png"]
    assert least.choice.seeds == [1]
