"""The page of `depthreg demo`: two files or an example in; pictures, a cloud, words and files out."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import gradio as gr

from depthreg.data import io
from depthreg.demonstration.answer import DEPTH_SUFFIXES, Answer, Upload, answer
from depthreg.demonstration.examples import DEPTH_SCALE, Example
from depthreg.errors import InputError
from depthreg.model import Model

_HEADING = """# depthreg
Aligns colour with sparse depth and completes the depth. Pick an example, or drop two files of your own: they stay on
the machine that serves this page, and are gone when it stops."""
CSS = "#examples .thumbnail-item { aspect-ratio: 2 / 1; }"  # squares by default
_FORGET_S = (600, 3600)  # how often to look for uploads to delete, and how old they are then
_NOTHING = [None] * 7  # of all outputs but the words
_CLOUD_BACKGROUND = (0.05, 0.05, 0.06, 1.0)


def build_page(model: Model, examples: Sequence[Example], folder: Path) -> gr.Blocks:
    """The page, not yet served.

    Args:
        model: What answers, one request at a time.
        examples: To pick from.
        folder: Where its files are made.
    """

    def run(rgb: str | None, depth: str | None, scale: float | None, camera: str | None) -> list[Any]:
        if rgb is None or depth is None:
            return ["Two files are needed: a colour image and a depth map of the same size.", *_NOTHING]
        upload = Upload(Path(rgb), Path(depth), scale or 0, None if camera is None else Path(camera))
        return _shown(model, upload, folder, None)

    def pick(event: gr.SelectData) -> list[Any]:
        example = examples[event.index]
        upload = Upload(example.rgb, example.depth, DEPTH_SCALE, example.intrinsics)
        inputs = [str(example.rgb), str(example.depth), DEPTH_SCALE, str(example.intrinsics)]
        return [*inputs, *_shown(model, upload, folder, example)]

    with gr.Blocks(title="depthreg", analytics_enabled=False, delete_cache=_FORGET_S) as page:
        gr.Markdown(_HEADING)
        gallery = _examples(examples)
        with gr.Row():
            with gr.Column(scale=1, min_width=300):
                inputs = _inputs()
                button = gr.Button("Align and complete", variant="primary")
            with gr.Column(scale=3):
                outputs = _outputs()
        once = {"concurrency_limit": 1, "concurrency_id": "model"}
        button.click(run, inputs, outputs, api_visibility="private", **once)
        gallery.select(pick, None, [*inputs, *outputs], api_visibility="private", **once)
    return page.queue(max_size=20)


def _examples(examples: Sequence[Example]) -> gr.Gallery:
    thumbnails = [(_thumbnail(example.rgb), example.title) for example in examples]
    look = {"columns": len(examples), "height": 210, "object_fit": "cover", "elem_id": "examples"}
    return gr.Gallery(thumbnails, label="Examples", allow_preview=False, buttons=[], **look)


def _thumbnail(path: Path, width: int = 480) -> Any:
    rgb = io.read_rgb(path)
    return cv2.resize(rgb, (width, round(width * rgb.shape[0] / rgb.shape[1])), interpolation=cv2.INTER_AREA)


def _inputs() -> list[gr.Component]:
    return [
        gr.File(label="Colour: PNG or JPEG", file_types=list(io.RGB_SUFFIXES), height=110),
        gr.File(
            label=f"Depth, of the same size: {', '.join(DEPTH_SUFFIXES)}", file_types=list(DEPTH_SUFFIXES), height=110
        ),
        gr.Number(1000, label="Stored value per metre", info="1000 for millimetres, 256 for KITTI, 1 for metres"),
        gr.File(label="For a cloud: the 9 numbers of K in a text file", file_types=[".txt"], height=110),
    ]


def _outputs() -> list[gr.Component]:
    words = gr.Textbox(label="What was found", lines=3, max_lines=8, interactive=False)
    slider = gr.ImageSlider(label="Colour as given | aligned, under the edges of the completed depth", max_height=600)
    with gr.Row():
        sparse, completed = (_picture(label) for label in ("Depth as given", "Depth completed"))
    with gr.Row():
        expected, true = (_picture(label) for label in ("Error to expect", "True error, known of examples"))
    cloud = gr.Model3D(
        label="Cloud: drag to turn, scroll to come nearer",
        display_mode="point_cloud",
        clear_color=_CLOUD_BACKGROUND,
        interactive=False,
        height=500,
    )
    files = gr.File(label="Files", file_count="multiple", interactive=False)
    return [words, slider, sparse, completed, expected, true, cloud, files]


def _picture(label: str) -> gr.Image:
    return gr.Image(label=label, format="png", interactive=False, buttons=[])


def _shown(model: Model, upload: Upload, folder: Path, example: Example | None) -> list[Any]:
    """The outputs' values; a mistake is a sentence where the words are, and nothing else."""
    try:
        made: Answer = answer(model, upload, folder, example)
    except InputError as error:
        return [str(error)[:1].upper() + str(error)[1:] + ".", *_NOTHING]
    pictures = [made.sparse, made.completed, made.expected_error, made.true_error]
    cloud = gr.Model3D(str(made.cloud.path), camera_position=made.cloud.camera) if made.cloud else None
    return [made.words, (made.before, made.after), *pictures, cloud, [str(path) for path in made.files]]
