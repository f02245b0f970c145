import exported
import numpy as np
import pytest
import torch

from depthreg.data.sample import Measurement


def test_differences_are_of_depths_that_a_sensor_sees_and_errors_of_known_truth() -> None:
    ours = np.array([[10.0, 20.0], [30.0, 90.0]])
    theirs = np.array([[10.001, 20.0], [30.0, 95.0]])
    truth_m = np.array([[13.001, 0.0], [0.0, 0.0]])
    found = exported.differences([(theirs, ours, truth_m)])
    assert found["largest_mm"] == pytest.approx(1) and found["mean_mm"] == pytest.approx(1 / 3)
    assert found["rmse_m"] == pytest.approx(3) and found["rmse_pytorch_m"] == pytest.approx(3.001)


def test_every_way_of_exporting_is_a_row(make_network) -> None:
    pytest.importorskip("onnxruntime", reason="pip install 'depthreg[export]'")
    generator = torch.Generator().manual_seed(0)
    depth_m = 5 + torch.rand(1, 1, 64, 70, generator=generator)
    sample = Measurement(rgb=torch.rand(1, 3, 64, 70, generator=generator), depth_m=depth_m, truth_depth_m=depth_m)
    rows = list(exported.compare(make_network(), {"made": [sample]}))
    assert [(row["format"], row["precision"]) for row in rows] == list(exported.WAYS)
    assert all(row["largest_mm"] < 1 for row in rows if row["precision"] == "fp32")
    assert len(exported.markdown(rows).splitlines()) == 2 + len(rows)
