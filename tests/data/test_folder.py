import cv2
import numpy as np
import pytest
from torch.utils.data import default_collate

from depthreg.data.folder import FolderDataset
from depthreg.errors import InputError

SIZE = (37, 53)
K_TEXT = "50 0 26\n0 50 18\n0 0 1\n"


def write(path, array):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), array)


def write_image(path, seed=0):
    write(path, np.random.default_rng(seed).integers(0, 256, (*SIZE, 3), dtype=np.uint8))


def write_depth(path, value, size=SIZE):
    write(path, np.full(size, value, np.uint16))


@pytest.fixture
def root(tmp_path):
    for number, stem in enumerate(["b", "a"]):
        write_image(tmp_path / f"image/{stem}.png", number)
        write_depth(tmp_path / f"depth/{stem}.png", 1500 + 1000 * number)
    return tmp_path


def test_pairs_come_in_the_order_of_their_names_and_in_metres(root):
    dataset = FolderDataset(root, 1000)
    assert [item["name"] for item in (dataset[0], dataset[1])] == ["a", "b"]
    assert [dataset[i]["depth_m"][0, 3, 4].item() for i in (0, 1)] == [2.5, 1.5]


def test_colour_is_rgb_in_0_to_1(root):
    rgb = FolderDataset(root, 1000)[1]["rgb"]
    stored = cv2.imread(str(root / "image/b.png"))[..., ::-1] / 255
    np.testing.assert_allclose(rgb.permute(1, 2, 0), stored, atol=1e-6)


def test_items_collate_into_a_batch_without_what_is_unknown(root):
    dataset = FolderDataset(root, 1000)
    batch = default_collate([dataset[0], dataset[1]])
    assert set(batch) == {"rgb", "depth_m", "name"}
    assert batch["rgb"].shape == (2, 3, *SIZE) and batch["depth_m"].shape == (2, 1, *SIZE)


def test_truth_and_intrinsics_are_found_where_they_are(root):
    write_depth(root / "truth/a.png", 3000)
    (root / "intrinsics.txt").write_text(K_TEXT)
    with_truth, without = FolderDataset(root, 1000)
    assert with_truth["truth_depth_m"].unique().item() == 3
    assert "truth_depth_m" not in without
    assert without["intrinsics"].tolist() == [[50, 0, 26], [0, 50, 18], [0, 0, 1]]


def test_a_pairs_own_intrinsics_go_before_those_of_all(root):
    (root / "intrinsics.txt").write_text(K_TEXT)
    (root / "intrinsics").mkdir()
    (root / "intrinsics/a.txt").write_text(K_TEXT.replace("50", "60"))
    assert [item["intrinsics"][0, 0].item() for item in FolderDataset(root, 1000)] == [60, 50]


@pytest.mark.parametrize(
    ("image", "depth"), [("*.color.png", "*.depth.png"), ("*/rgb.png", "*/sparse.png"), ("rgb/x_*", "raw/*")]
)
def test_a_star_pairs_files_wherever_it_stands(tmp_path, image, depth):
    for stem in ("one", "two"):
        write_image((tmp_path / image.replace("*", stem)).with_suffix(".png"))
        write_depth((tmp_path / depth.replace("*", stem)).with_suffix(".png"), 256)
    assert [item["name"] for item in FolderDataset(tmp_path, 256, image, depth)] == ["one", "two"]


def test_patterns_without_a_star_name_the_only_pair(tmp_path):
    write_image(tmp_path / "scene/rgb.png")
    write_depth(tmp_path / "scene/sparse.png", 256)
    (item,) = FolderDataset(tmp_path / "scene", 256, "rgb.png", "sparse.png")
    assert item["name"] == "scene"


def test_a_final_star_pairs_files_of_different_suffixes(root):
    write_image(root / "image/c.jpg")
    np.save(root / "depth/c.npy", np.full(SIZE, 4000.0))
    assert [item["name"] for item in FolderDataset(root, 1000)] == ["a", "b", "c"]


def test_a_file_without_its_partner_is_named(root):
    write_image(root / "image/c.png")
    with pytest.raises(InputError, match=r"image/c\.png has no partner"):
        FolderDataset(root, 1000)


@pytest.mark.parametrize("key", ["image", "depth", "truth", "intrinsics"])
def test_a_pattern_that_matches_nothing_is_named(root, key):
    with pytest.raises(InputError, match=r"holds no elsewhere/\*\.png"):
        FolderDataset(root, 1000, **{key: "elsewhere/*.png"})


def test_two_stars_are_refused(root):
    with pytest.raises(InputError, match="one star at most"):
        FolderDataset(root, 1000, image="*/*.png")


def test_two_files_of_one_name_are_refused(root):
    write_image(root / "image/a.jpg")
    with pytest.raises(InputError, match="have one name"):
        FolderDataset(root, 1000)


def test_sizes_that_differ_are_named(root):
    write_depth(root / "depth/a.png", 1000, size=(20, 30))
    with pytest.raises(InputError, match=r"a\.png is 30x20 but .* is 53x37"):
        FolderDataset(root, 1000)[0]
