import numpy as np
import pytest
import torch
from scipy import ndimage

from depthreg.sensors.fields import correlated_noise
from depthreg.sensors.windows import largest_within

SIZE = (37, 53)


@pytest.mark.parametrize("radius_px", [1, 3])
def test_the_largest_value_of_a_window_is_scipys(radius_px: int) -> None:
    image = torch.randn(2, 1, *SIZE, generator=torch.Generator().manual_seed(0))
    side = 2 * radius_px + 1
    expected = [ndimage.maximum_filter(one[0].numpy(), side, mode="constant", cval=-torch.inf) for one in image]
    assert torch.equal(largest_within(image, radius_px)[:, 0], torch.from_numpy(np.stack(expected)))


def test_correlated_noise_is_white_noise_through_scipys_boxes() -> None:
    shape = torch.Size([1, 1, *SIZE])
    smooth = correlated_noise(shape, torch.Generator().manual_seed(0), torch.device("cpu"))[0, 0]
    white = torch.randn(1, 1, SIZE[0] + 6, SIZE[1] + 6, generator=torch.Generator().manual_seed(0))[0, 0].numpy()
    boxed = ndimage.uniform_filter(ndimage.uniform_filter(white, 5), 3)[3:-3, 3:-3]
    # The two boxes make a kernel of (1, 2, 3, 3, 3, 2, 1) / 15, which leaves 37 / 225 of the standard deviation.
    np.testing.assert_allclose(smooth, boxed * 225 / 37, atol=1e-5)
