"""Tar files of a data set: opened by `tarfile`, read in ranges over HTTP, split over ranks and workers."""

import tarfile
import threading
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from torch.utils.data import DataLoader, DistributedSampler

from depthreg.cli import main
from depthreg.data import io
from depthreg.data.rendered import FolderStore, RenderedFrames, of_world
from depthreg.data.streaming import TarStore, urls_in
from depthreg.data.synthetic import collate_frames
from depthreg.errors import InputError
from depthreg.rendering import Rig, hdl64

COUNT = 8
CAMERA = ["camera=random", "camera.width=53", "camera.height=37", "camera.focal_px=[30,50]"]
WORLD = {"_target_": "depthreg.worlds.BlocksWorld"}
RIG = Rig(scans=(hdl64(),), surfaces=True)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of eight frames."""
    folder = tmp_path_factory.mktemp("rendered") / "blocks"
    assert main(["render", "world=blocks", *CAMERA, f"count={COUNT}", "workers=1", f"out={folder}"]) == 0
    return folder


@pytest.fixture(scope="module")
def packed(rendered: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same in tar files of three frames."""
    folder = tmp_path_factory.mktemp("packed") / "blocks"
    assert main(["pack", str(rendered), str(folder), "--frames-per-tar", "3"]) == 0
    return folder


def frames_of(store: FolderStore | TarStore) -> RenderedFrames:
    return RenderedFrames(store, range(COUNT), RIG, 24.0, 120.0)


def test_tar_files_hold_the_frames_files(rendered: Path, packed: Path) -> None:
    assert {path.name for path in packed.iterdir()} == {"dataset.json", "index.json"} | {
        f"{number:06d}.tar" for number in range(3)
    }
    found = {}
    for path in packed.glob("*.tar"):
        with tarfile.open(path) as tar:
            found |= {member.name: tar.extractfile(member).read() for member in tar}  # type: ignore[union-attr]
    assert found == {f"{path.parent.name}.{path.name}": path.read_bytes() for path in rendered.glob("0*/*")}


def test_streamed_items_are_those_of_the_folder(rendered: Path, packed: Path) -> None:
    streamed, stored = frames_of(TarStore(str(packed))), frames_of(FolderStore(rendered))
    for index in (7, 0, 3):  # in any order
        assert streamed[index].keys() == stored[index].keys()
        for key, value in stored[index].items():
            np.testing.assert_array_equal(streamed[index][key], value, err_msg=key)


class _Ranges(SimpleHTTPRequestHandler):
    """Serves ranges, as every object storage does."""

    def do_GET(self) -> None:
        content = Path(self.translate_path(self.path)).read_bytes()
        first, last = 0, len(content) - 1
        if asked := self.headers.get("Range"):
            first, last = map(int, asked.removeprefix("bytes=").split("-"))
            type(self).ranges.append((first, last))  # type: ignore[attr-defined]
        self.send_response(206 if asked else 200)
        self.send_header("Content-Range", f"bytes {first}-{last}/{len(content)}")
        self.send_header("Content-Length", str(last + 1 - first))
        self.end_headers()
        self.wfile.write(content[first : last + 1])

    def log_message(self, *args: object) -> None:
        """Nothing."""


@pytest.fixture
def server(packed: Path) -> Iterator[tuple[str, type[_Ranges]]]:
    """Where the packed data set is served, and what notes the ranges that were read."""
    handler = type("Handler", (_Ranges,), {"ranges": []})
    http = ThreadingHTTPServer(("127.0.0.1", 0), partial(handler, directory=packed.parent))  # type: ignore[arg-type]
    thread = threading.Thread(target=http.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{http.server_port}/blocks", handler
    http.shutdown()
    http.server_close()
    thread.join()


def test_a_frame_is_fetched_by_one_ranged_read(server: tuple[str, type[_Ranges]], rendered: Path, packed: Path) -> None:
    url, handler = server
    streamed, stored = frames_of(TarStore(url)), frames_of(FolderStore(rendered))
    np.testing.assert_array_equal(streamed[4]["rgb"], stored[4]["rgb"])
    ((first, last),) = handler.ranges  # type: ignore[attr-defined]
    assert last - first < (packed / "000001.tar").stat().st_size / 2


@pytest.mark.parametrize("epoch", [0, 1])
def test_two_ranks_of_two_workers_see_every_frame_once_an_epoch(epoch: int, packed: Path) -> None:
    seen = []
    for rank in range(2):
        frames = frames_of(TarStore(str(packed)))
        sampler = DistributedSampler(frames, num_replicas=2, rank=rank, shuffle=True)  # what Lightning puts there
        sampler.set_epoch(epoch)
        loader = DataLoader(frames, batch_size=2, sampler=sampler, num_workers=2, collate_fn=collate_frames)
        seen += [index for batch in loader for index in batch["index"].tolist()]
    assert sorted(seen) == list(range(COUNT)) and seen != sorted(seen)


def test_packing_again_changes_nothing_and_gives_the_same_bytes(rendered: Path, packed: Path, tmp_path: Path) -> None:
    for _ in range(2):  # from nothing, and over what is there
        assert main(["pack", str(rendered), str(tmp_path / "again"), "--frames-per-tar", "3"]) == 0
        for path in packed.iterdir():
            assert (tmp_path / "again" / path.name).read_bytes() == path.read_bytes()


def test_the_packed_data_set_of_a_world_is_found(packed: Path) -> None:
    for url in (packed, packed.parent):
        assert of_world(urls_in(str(url)), str(url), WORLD) == str(packed)
    with pytest.raises(InputError, match=r"holds no dataset\.json"):
        of_world(urls_in(str(packed / "nowhere")), "nowhere", WORLD)


@pytest.mark.parametrize("read", [TarStore, urls_in])
@pytest.mark.parametrize("url", ["nosuch://bucket/frames", "http://127.0.0.1:9/frames"])  # 9: nobody listens
def test_a_place_that_cannot_be_read_is_one_sentence(url: str, read: Callable[[str], object]) -> None:
    with pytest.raises(InputError, match=r"/frames.*can't be read") as refusal:
        read(url)
    assert "\n" not in str(refusal.value)


def test_a_data_set_is_not_packed_again_in_other_portions(
    rendered: Path, packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.read_bytes() for path in packed.iterdir()}
    assert main(["pack", str(rendered), str(packed), "--frames-per-tar", "2"]) == 2
    assert "has 3 frames a tar file, not 2" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in packed.iterdir()} == before

    cut = tmp_path / "interrupted"  # before its index was written
    assert main(["pack", str(rendered), str(cut), "--frames-per-tar", "2"]) == 0
    (cut / "index.json").unlink()
    assert main(["pack", str(rendered), str(cut), "--frames-per-tar", "3"]) == 0
    assert {path.name: path.read_bytes() for path in cut.iterdir()} == {p.name: c for p, c in before.items()}


def test_a_cut_tar_file_is_named(packed: Path, tmp_path: Path) -> None:
    for path in packed.iterdir():
        content = path.read_bytes()
        (tmp_path / path.name).write_bytes(content[:100_000] if path.name == "000001.tar" else content)
    frames = frames_of(TarStore(str(tmp_path)))
    frames[0]
    with pytest.raises(InputError, match=r"000001\.tar"):
        frames[5]


def test_what_is_no_intact_data_set_is_not_packed(
    rendered: Path, packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = tmp_path / "damaged"
    for path in rendered.rglob("*"):
        if path.is_file():
            (damaged / path.relative_to(rendered)).parent.mkdir(parents=True, exist_ok=True)
            (damaged / path.relative_to(rendered)).write_bytes(path.read_bytes())
    (damaged / "000003" / "rgb.png").write_bytes(b"damaged")
    (tmp_path / "other").mkdir()
    io.write_json(tmp_path / "other" / "dataset.json", io.read_json(packed / "dataset.json") | {"code_sha256": "0"})
    for source, target, said in (
        (damaged, tmp_path / "target", "000003/rgb.png"),
        (tmp_path, tmp_path / "target", "dataset.json"),
        (rendered, rendered, "holds another"),
        (rendered, tmp_path / "other", "holds another"),
    ):
        status = main(["pack", str(source), str(target)])
        message = capsys.readouterr().err
        assert status == 2 and said in message and message.count("\n") == 1
