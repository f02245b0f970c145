"""`depthreg render` as a user runs it: interrupted, killed, without room, beside others, and twice."""

import errno
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from depthreg import render
from depthreg.cli import main
from depthreg.data import io, rendered
from depthreg.data.sample import Frame, LidarReturns
from depthreg.frame_pictures import frame_panel, lidar_image
from depthreg.render import shard_indices
from depthreg.rendering import Camera, hdl64, render_frame
from depthreg.worlds import BlocksWorld

SMALL = ["world=blocks", "camera.width=70", "camera.height=40", "camera.focal_px=50.5", "camera.margin_px=3", "seed=3"]
COUNT = 4
FRAMES = [f"{index:06d}" for index in range(COUNT)]

Render = Callable[..., int]


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """Where the data set is to be."""
    return tmp_path / "frames"


@pytest.fixture
def run(out: Path) -> Render:
    """Runs the command with small frames and gives its exit status."""

    def run(*overrides: str, flags: Sequence[str] = ()) -> int:
        return main(["render", *flags, *SMALL, f"count={COUNT}", "workers=1", f"out={out}", *overrides])

    return run


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Every file of a data set that one process wrote without interruption."""
    folder = tmp_path_factory.mktemp("whole")
    assert main(["render", *SMALL, f"count={COUNT}", "workers=1", f"out={folder}"]) == 0
    return files(folder)


def files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def stamps(folder: Path) -> dict[Path, tuple[int, int]]:
    """Of the finished frames' files: what changes when one is written anew."""
    paths = [path for path in folder.glob("[0-9]*/*")]
    return {path: (path.stat().st_ino, path.stat().st_mtime_ns) for path in paths}


def complaint(capsys: pytest.CaptureFixture[str]) -> str:
    """What the command said, which has to be one sentence."""
    message = capsys.readouterr().err
    assert message.startswith("depthreg render: ") and message.count("\n") == 1
    return message


def test_the_folder_says_what_generated_it(run: Render, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run() == 0
    assert str(out) in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == {*FRAMES, "dataset.json", "manifest.sha256", "overview.png"}
    description = io.read_json(out / "dataset.json")
    assert description["config"]["world"] == {"_target_": "depthreg.worlds.BlocksWorld"}
    assert description["config"]["seed"] == 3 and description["depthreg"]
    assert not {"out", "workers", "shard", "shards"} & description["config"].keys()
    overview = cv2.imread(str(out / "overview.png"))
    assert overview.shape[0] > 274 and overview.shape[1] > 4 * 480  # four frames of 480 x 274 beside each other


def test_a_frame_is_what_the_camera_sees(whole: dict[str, bytes]) -> None:
    stored = cv2.imdecode(np.frombuffer(whole["000002/depth.png"], np.uint8), cv2.IMREAD_UNCHANGED)
    expected = render_frame(BlocksWorld()(3, 2), Camera(70, 40, 50.5), None, right=False)
    np.testing.assert_allclose(stored / 256, expected.depth_m, atol=0.5 / 256)


def test_without_a_folder_runs_are_told_apart_by_their_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["render", *SMALL, "count=1", "workers=1", "panels=true"]) == 0
    (folder,) = (tmp_path / "runs" / "render").iterdir()
    panel = cv2.imread(str(folder / "000000" / "panel.png"))
    assert panel.shape[0] > 40 and (folder / "overview.png").exists()
    assert "000000/panel.png" in (folder / "manifest.sha256").read_text()


def in_a_child(task: Callable[[], Any]) -> int | None:
    """Exit status of a process that does a task; -9 where it was killed."""
    child = multiprocessing.get_context("fork").Process(target=task)
    child.start()
    child.join()
    return child.exitcode


def _kill(*args: Any, **kwargs: Any) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _kill_at(target: object, name: str, call: int, patch: pytest.MonkeyPatch) -> None:
    """Let the `call`-th call of a function kill this process before it does anything."""
    original, calls = getattr(target, name), iter(range(10_000))

    def deadly(*args: Any, **kwargs: Any) -> Any:
        return (_kill if next(calls) == call else original)(*args, **kwargs)

    patch.setattr(target, name, deadly)


MOMENTS = {  # which function is called for the how-many-th time, and how many frames are complete by then
    "before the description": (rendered.io, "write_json", 0, 0),
    "before the first frame": (render, "write_frame", 0, 0),
    "within the second frame's files": (io, "write_ply_vertices", 1, 1),
    "before the third frame gets its name": (Path, "rename", 2, 2),
    "before the overview": (render, "overview", 0, COUNT),
    "before the manifest": (rendered, "write_manifest", 0, COUNT),
    "before the manifest gets its name": (Path, "replace", 1 + COUNT * 10 + 1, COUNT),
}


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_killed_run_goes_on_where_it_was(moment: str, run: Render, out: Path, whole: dict[str, bytes]) -> None:
    *where, finished = MOMENTS[moment]

    def killed() -> None:
        with pytest.MonkeyPatch.context() as patch:
            _kill_at(*where, patch)
            run()

    assert in_a_child(killed) == -signal.SIGKILL
    left = stamps(out)
    assert {path.parent.name for path in left} == set(FRAMES[:finished])  # nothing partial has a final name
    assert {name for name in files(out) if "/." not in f"/{name}"} <= whole.keys() - {"manifest.sha256"}
    assert run() == 0
    assert {name: content for name, content in files(out).items() if name[0] != "."} == whole
    assert left.items() <= stamps(out).items()  # nothing was done twice
    assert not [path for path in out.iterdir() if "partial" in path.name]


def test_workers_end_with_a_killed_parent_and_leave_what_another_run_completes(
    run: Render, out: Path, whole: dict[str, bytes]
) -> None:
    command = [sys.executable, "-m", "depthreg", "render", *SMALL, "count=400", f"out={out}", "workers=2"]
    parent = subprocess.Popen(command)
    try:
        while not (out / "000003").exists():
            assert parent.poll() is None
            time.sleep(0.02)
    finally:
        parent.kill()
        parent.wait()
    deadline = time.monotonic() + 20
    while _processes_of(out) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert _processes_of(out) == []
    left = {name: content for name, content in files(out).items() if name[0] == "0" and name in whole}
    assert len(left) > 20 and all(whole[name] == content for name, content in left.items())


def _processes_of(out: Path) -> list[str]:
    """Processes that work in a folder."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            links = [str(link.readlink()) for link in (folder / "fd").iterdir()]
        except OSError:
            continue
        found += [folder.name for link in links if link.startswith(str(out))]
    return found


def test_several_workers_write_what_one_does(run: Render, out: Path, whole: dict[str, bytes]) -> None:
    assert run("workers=2") == 0
    assert files(out) == whole


def test_shards_of_any_number_and_order_make_the_whole(run: Render, out: Path, whole: dict[str, bytes]) -> None:
    for shard in (2, 0, 1):
        assert not (out / "manifest.sha256").exists()
        assert run(f"shard={shard}", "shards=3") == 0
    assert files(out) == whole


def test_shards_part_the_frames() -> None:
    for count in (1, 5, 12):
        parts = [shard_indices(count, shard, 5) for shard in range(5)]
        assert [index for part in parts for index in part] == list(range(count))
        assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_a_sweep_runs_all_shards(run: Render, out: Path, whole: dict[str, bytes], monkeypatch: Any) -> None:
    monkeypatch.chdir(out.parent)
    assert run("shard=0,1", "shards=2", flags=["-m"]) == 0
    assert files(out) == whole


def test_a_shard_that_fails_in_a_sweep_is_named(
    run: Render, out: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(out.parent)
    write_frame = render.write_frame

    def full(folder: Path, *args: Any) -> None:
        if "000003" in folder.name:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write_frame(folder, *args)

    monkeypatch.setattr(render, "write_frame", full)
    assert run("shard=0,1", "shards=2", flags=["-m"]) == 2
    message = capsys.readouterr().err
    assert message.splitlines()[-2] == "depthreg render: 1 of 2 jobs failed:"
    assert message.splitlines()[-1].startswith("  job 1 (shard=1): shard 1 of 2: ")
    assert "No space left" in message
    assert {path.name for path in out.glob("0*")} == {"000000", "000001", "000002"}


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("seed=4", "seed=3, not 4"),
        ("camera.focal_px=60.5", "camera.focal_px=50.5, not 60.5"),
        ("world=driving", "world._target_=depthreg.worlds.BlocksWorld"),
        ("count=3", "count=4, not 3"),
    ],
)
def test_another_configuration_is_refused_by_the_first_key_that_differs(
    override: str, said: str, tmp_path: Path, whole: dict[str, bytes], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "dataset.json").write_bytes(whole["dataset.json"])
    command = ["render", *SMALL, f"count={COUNT}", f"out={tmp_path}", override]
    camera = ["camera=driving", *SMALL[1:5]] if override.startswith("world") else []
    assert main([*command, *camera]) == 2
    assert said in complaint(capsys)
    assert files(tmp_path) == {"dataset.json": whole["dataset.json"]}


@pytest.mark.parametrize("name", ["worlds", "rendering"])
def test_frames_of_other_code_are_not_mixed_in(
    name: str, run: Render, out: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("shards=2") == 0
    code_of = rendered.code_of
    monkeypatch.setattr(rendered, "code_of", lambda *names: code_of(*names) + b"#" * (name in names))
    capsys.readouterr()
    assert run() == 2
    assert "code_sha256" in complaint(capsys)


@pytest.mark.parametrize("content", ["{", "[]", '{"format": 99}'])
def test_a_description_that_is_none_is_refused(
    content: str, run: Render, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out.mkdir()
    (out / "dataset.json").write_text(content)
    assert run() == 2
    assert "dataset.json" in complaint(capsys)


def test_a_foreign_folder_is_left_alone(run: Render, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out.mkdir()
    (out / "thesis.txt").write_text("mine")
    assert run() == 2
    assert "isn't empty" in complaint(capsys)
    assert files(out) == {"thesis.txt": b"mine"}


def test_a_folder_that_cannot_be_made_is_one_sentence(
    run: Render, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert run(f"out={tmp_path / 'file' / 'frames'}") == 2
    assert "is a file" in complaint(capsys)
    assert run("out=/proc/frames") == 2  # not even root can write there
    assert "/proc/frames can't be written" in complaint(capsys)


def test_a_full_disk_is_one_sentence_and_the_same_command_goes_on(
    run: Render, out: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_bytes, room = Path.write_bytes, iter([True] * 15)

    def full(path: Path, content: bytes) -> int:
        if next(room, False):
            return write_bytes(path, content)
        write_bytes(path, content[:7])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "write_bytes", full)
        assert run() == 2
    assert "No space left on device" in complaint(capsys)
    assert {path.name for path in out.iterdir()} == {"000000", "dataset.json", ".lock"}
    assert run() == 0
    assert files(out) == whole


@pytest.mark.skipif(sys.platform != "linux" or os.geteuid() != 0, reason="only root can mount a small disk")
def test_a_disk_that_is_really_full(
    run: Render, tmp_path: Path, whole: dict[str, bytes], capsys: pytest.CaptureFixture[str]
) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    size = sum(map(len, whole.values())) // 2
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(disk)]
    if not shutil.which("mount") or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("no small disk can be mounted here")
    try:
        assert run(f"out={disk}") == 2
        assert "No space left on device" in complaint(capsys)
        for name, content in files(disk).items():
            assert name == ".lock" or whole[name] == content
        subprocess.run(["mount", "-o", f"remount,size={8 * size}", str(disk)], check=True)
        assert run(f"out={disk}") == 0
        assert files(disk) == whole
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.skipif(sys.platform == "win32", reason="no locks there")
def test_two_processes_do_not_render_the_same_frames(run: Render, out: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out.mkdir()
    with render.claim(out, shard_indices(COUNT, 0, 2)):
        assert in_a_child(lambda: os._exit(run())) == 2
        assert "another process" in complaint(capfd)
        assert in_a_child(lambda: os._exit(run("shard=1", "shards=2"))) == 0
        assert {path.name for path in out.glob("0*")} == {"000002", "000003"}
    assert run() == 0


@pytest.mark.parametrize(
    "override",
    [
        *("count=0", "count=-1", "count=2.5", "seed=-1", "camera.focal_px=far", "camera.focal_px=-1", "camera.width=0"),
        *("wrld=blocks", "shard=1", "shards=0", "workers=0", "depth_scale=0", "sensor=nothing"),
    ],
)
def test_bad_overrides_are_one_sentence_and_write_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], override: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["render", override]) == 2
    assert override.split("=")[0].removeprefix("camera.") in complaint(capsys)
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def frame() -> Frame:
    return render_frame(BlocksWorld()(3, 1), Camera(width=97, height=41, focal_px=60.0, margin_px=5), hdl64())


def test_the_nearest_return_of_a_pixel_wins() -> None:
    one = np.ones(3, np.float32)
    uv = np.array([[2.2, 1.0], [1.8, 1.4], [0.0, 0.0]], np.float32)
    returns = LidarReturns(
        uv, np.array([9, 4, 7], np.float32), *[one] * 6, np.zeros(3, np.int16), *[one] * 3, np.zeros((3, 3))
    )
    image = np.zeros((3, 5), np.float32)
    planes = dict.fromkeys(("rgb", "object_id", "normal", "albedo", "gloss", "rgb_right", "depth_right_m"), image)
    frame = Frame(**planes, depth_m=image, margin_px=0, intrinsics=np.eye(3), baseline_m=0.5, lidar=returns)
    expected = np.zeros((3, 5))
    expected[1, 2], expected[0, 0] = 4, 7
    np.testing.assert_array_equal(lidar_image(frame), expected)


def test_the_panel_shows_five_pictures_of_the_frame(frame: Frame) -> None:
    panel = frame_panel(frame)
    assert panel.dtype == np.uint8
    assert panel.shape[0] > 5 * 41
    # The right camera's image appears in it, pixel for pixel.
    found = cv2.matchTemplate(panel, frame.rgb_right, cv2.TM_SQDIFF)
    _, _, (x, y), _ = cv2.minMaxLoc(found)
    np.testing.assert_array_equal(panel[y : y + 41, x : x + 97], frame.rgb_right)
