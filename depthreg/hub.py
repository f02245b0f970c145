"""Weights on the Hugging Face Hub, or in a folder laid out as there: `HubModel.from_pretrained("user/name")`."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

from depthreg.checkpoint import load_network, write_published
from depthreg.errors import InputError
from depthreg.model import Model

if find_spec("huggingface_hub") is None:
    raise InputError("depthreg.hub needs huggingface_hub: expected pip install 'depthreg[hub]' before it")

from huggingface_hub import ModelHubMixin, hf_hub_download

WEIGHTS = "model.safetensors"


class HubModel(Model, ModelHubMixin, library_name="depthreg", tags=["depth-completion", "image-registration"]):
    """A model with `from_pretrained`, `save_pretrained` and `push_to_hub`, which are the Hub's own.

    A repository holds `model.safetensors`, as `depthreg publish` writes it; its metadata tell the architecture.
    """

    def _save_pretrained(self, save_directory: Path) -> None:
        write_published(Path(save_directory) / WEIGHTS, self.network, {})

    @classmethod
    def _from_pretrained(cls, *, model_id: str, device: str = "cpu", **options: Any) -> "HubModel":
        folder = Path(model_id)
        keys = ("revision", "cache_dir", "force_download", "local_files_only", "token")
        path = (
            folder / WEIGHTS
            if folder.is_dir()
            else Path(hf_hub_download(model_id, WEIGHTS, **{key: options[key] for key in keys if key in options}))
        )
        return cls(load_network(path)).to(device)
