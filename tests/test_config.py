"""What the configurations compose to, and how a bad one is refused."""

import itertools
import re
from pathlib import Path
from typing import get_args

import pytest
from hydra.utils import instantiate
from lightning.fabric.connector import _PRECISION_INPUT_INT, _PRECISION_INPUT_STR, _PRECISION_INPUT_STR_ALIAS
from lightning.pytorch.accelerators import AcceleratorRegistry
from omegaconf import OmegaConf

from depthreg.callbacks import FreezeSchedule
from depthreg.callbacks.difficulty import SHAPES
from depthreg.checks import CHOICES, check_together
from depthreg.config import CONF_DIR, build, compose_config
from depthreg.errors import InputError

NEEDED = {"train": [], "render": [], "evaluate": ["checkpoint=x", "data.root=x"]}
ONLY_WITH = {("data", "folder"): ["data.depth_scale=256"], ("data", "synthetic"): []}
GROUPS_OF = {
    "train": ["stage", "data", "model", "loss", "callbacks", "logger", "trainer", "preset", "experiment", "rendering"],
    "evaluate": ["data", "world", "sensor", "offset", "color", "weather", "rendering"],
    "render": ["world", "camera", "sensor", "offset", "rendering", "precision"],
}


def choices(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF_DIR / group).glob("*.yaml"))


def every_choice() -> list[tuple[str, str, str]]:
    return [
        (name, group, choice) for name, groups in GROUPS_OF.items() for group in groups for choice in choices(group)
    ]


@pytest.mark.parametrize(("name", "group", "choice"), every_choice())
def test_every_choice_of_every_group_composes(name: str, group: str, choice: str) -> None:
    needed = [] if (group, choice) == ("data", "synthetic") else NEEDED[name]
    if group == "data" and name == "train":
        needed = {"synthetic": [], "streaming": ["data.url=x"]}.get(choice, ["data.root=x"])
    if (name, group, choice) == ("evaluate", "data", "streaming"):
        needed = ["checkpoint=x", "data.url=x"]
    key = {"stage": "stage@stages.joint"}.get(group, group)  # there are several stages
    config = compose_config(name, [f"{key}={choice}", *needed, *ONLY_WITH.get((group, choice), [])])
    assert OmegaConf.to_container(config, resolve=True)


def test_no_group_goes_untried() -> None:
    folders = {path.name for path in CONF_DIR.iterdir() if path.is_dir()}
    assert folders <= {group for groups in GROUPS_OF.values() for group in groups} | {"hydra"}


def test_the_papers_preset_is_the_papers_experiment() -> None:
    config = compose_config("train", ["preset=paper"])
    assert config.data.train_count + config.data.val_count == 6000
    assert config.data.train_count == 0.8 * 6000
    assert (config.data.width, config.data.height) == (1242, 375)
    assert list(config.curriculum) == ["joint", "completion", "full"]
    assert [stage.epochs for stage in config.stages.values()] == [50, 50, 100]
    loss = instantiate(config.loss)
    assert {name: term.weight for name, term in loss.terms.items()} == {"depth": 0.9, "ssim": 0.02}
    assert config.stages.joint.freeze == {"modules": ["completion"], "period": 2}
    assert config.stages.joint.max_corner_shift_px == config.stages.full.max_corner_shift_px == 24
    assert len(config.stages.full.module.lr_milestones) == 2
    assert all(0 < stage.module.weight_decay < 1e-3 for stage in config.stages.values())


def test_the_first_stage_has_the_papers_bins() -> None:
    scene = instantiate(compose_config("train").stages.joint.world)(0, 0)
    assert scene.depth_bin_m == 120 / 20


def test_a_stage_number_can_be_overridden_from_the_command_line() -> None:
    config = compose_config("train", ["epochs.joint=3", "stages.full.epochs=7"])
    assert [stage.epochs for stage in config.stages.values()][::2] == [3, 7]


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("data.widht=96", ["data.widht", "'data.width'"]),
        ("widht=96", ["'widht'", "'data.width'"]),
        ("batch_size=2", ["'data.batch_size'"]),
        ("lerning_rate=1", ["lerning_rate", "'learning_rate'"]),
        ("modle=paper", ["'model'"]),
        ("~data.widht", ["data.widht", "'data.width'"]),
        ("zzzzqqqq=1", ["zzzzqqqq", "--help"]),
        ("model=papr", ["papr", "paper", "small"]),
        ("world@stages.full.world=moon", ["moon", "driving", "household"]),
        ("hydra/launcher=cluster", ["cluster", "basic"]),
        ("logger=null", ["logger=null", "csv", "~logger"]),
        ("colour=red", ["colour"]),
        ("data.width", ["data.width", "key=value"]),
        ("learning_rate=[1", ["learning_rate=[1", "quotes"]),
        ("seed=1,2", ["seed=1,2", "-m"]),
    ],
)
def test_a_bad_override_is_one_sentence_that_names_it(override: str, said: list[str]) -> None:
    with pytest.raises(InputError) as refusal:
        compose_config("train", [override])
    message = str(refusal.value)
    assert "\n" not in message and len(message) < 300 and "http" not in message
    assert all(word in message for word in said)


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("data.width=abc", "a whole number, such as 320"),
        ("data.width=96.5", "a whole number"),
        ("seed=1.5", "a whole number"),
        ("seed=null", "a whole number"),
        ("~seed", "a whole number"),
        ("++seed=a", "a whole number"),
        ("learning_rate=high", "a number, such as 0.002"),
        ("epochs.joint=true", "a whole number, such as 7"),
        ("epochs=3", "keys, such as {joint, completion, full}"),
        ("epochs={joint:many}", "a whole number"),
        ("data.cache_dir=[a]", "text"),
        ("model.residual=1", "true or false"),
        ("data.camera.focal_px=300", "a list, such as [186.0,500.0]"),
        ("data.camera.focal_px=[300,x]", "a number"),
        ("stages.full.world=null", "keys, such as {worlds, shares}"),
        ("stages.full.difficulty=0.5", "keys"),
    ],
)
def test_a_value_of_another_type_than_the_default_is_refused(override: str, expected: str) -> None:
    with pytest.raises(InputError, match=re.escape(f"expected {expected}")) as refusal:
        compose_config("train", [override])
    assert str(refusal.value).startswith(override.strip("+~").split("=")[0])


@pytest.mark.parametrize(
    "override",
    [
        "learning_rate=1",  # a whole number is a number
        "data.cache_dir=null",
        "stages.full.offset=null",
        "stages.full.patience=3",
        "stages.full.patience=null",
        "init_from=a.ckpt",
        "callbacks.panels=null",
        "trainer.devices=auto",  # Lightning's own rules
        "trainer.gradient_clip_val=null",
        "data.width=${data.height}",
        "+trainer.max_time=00:01:00:00",
        "model.completion_widths=[16]",
        "~logger",
    ],
)
def test_what_a_key_can_mean_passes(override: str) -> None:
    compose_config("train", [override])


@pytest.mark.parametrize(
    ("name", "overrides", "expected"),
    [
        ("train", ["data.train_count=0"], "data.train_count=0: expected a whole number, at least 1"),
        ("train", ["data.width=63"], "data.width=63: expected a whole number, at least 64"),
        ("train", ["learning_rate=0"], "learning_rate=0: expected a number above 0"),
        ("train", ["stages.full.offset_share=1.5"], "stages.full.offset_share=1.5: expected a number from 0 to 1"),
        ("train", ["stages.full.difficulty.start=2"], "stages.full.difficulty.start=2: expected a number from 0 to 1"),
        ("train", ["stages.full.patience=0"], "stages.full.patience=0: expected a whole number, at least 1"),
        ("train", ["loss.ssim.weight=-1"], "loss.ssim.weight=-1: expected a number, at least 0"),
        (
            "train",
            ["data=rendered", "data.root=x", "data.val_share=2"],
            "data.val_share=2: expected a number from 0 to 1",
        ),
        ("render", ["workers=0"], "workers=0: expected a whole number, at least 1"),
        ("render", ["depth_scale=0"], "depth_scale=0: expected a number above 0"),
        ("evaluate", ["difficulty=1.1"], "difficulty=1.1: expected a number from 0 to 1"),
        ("evaluate", ["panels=-1"], "panels=-1: expected a whole number, at least 0"),
        ("gallery", ["difficulties=[0,2]"], "difficulties=2: expected a number from 0 to 1"),
    ],
)
def test_a_number_out_of_its_range_is_refused(name: str, overrides: list[str], expected: str) -> None:
    with pytest.raises(InputError, match=re.escape(expected)):
        compose_config(name, overrides)


def test_the_choices_of_words_are_those_of_the_code_that_reads_them() -> None:
    assert CHOICES["stages.*.difficulty.shape"] == SHAPES
    assert set(CHOICES["trainer.accelerator"]) - {"auto", "gpu"} == set(AcceleratorRegistry.available_accelerators())
    assert set(CHOICES["trainer.precision"]) <= {*get_args(_PRECISION_INPUT_INT), *get_args(_PRECISION_INPUT_STR)} | {
        *get_args(_PRECISION_INPUT_STR_ALIAS)
    }


@pytest.mark.parametrize(
    ("name", "overrides", "said"),
    [
        ("train", ["data=rendered"], "data.root is missing"),
        ("train", ["curriculum=[joint,ful]"], "expected some of joint, completion, full"),
        ("train", ["data.train_count=2", "data.batch_size=3"], "data.train_count=2 is below data.batch_size=3"),
        ("render", ["shard=2", "shards=2"], "shard=2 of shards=2"),
    ],
)
def test_keys_that_contradict_each_other_are_refused(name: str, overrides: list[str], said: str) -> None:
    with pytest.raises(InputError, match=said):
        check_together(compose_config(name, overrides))


def test_the_configurations_lie_beside_the_package_in_a_checkout() -> None:
    assert (CONF_DIR / "train.yaml").is_file() and Path(CONF_DIR).is_absolute()


ABLATIONS = choices("experiment/ablation")


def test_all_the_papers_ablations_are_there_and_more() -> None:
    figure_8 = {"full", "no_joint", "no_completion", "only_full"}
    assert set(ABLATIONS) == figure_8 | {"no_registration", "no_rgb", "l1_only", "frozen_never", "no_ramp"}


@pytest.mark.parametrize("preset", ["quick", "paper"])
@pytest.mark.parametrize("name", ABLATIONS)
def test_every_ablation_trains_for_as_many_epochs(name: str, preset: str) -> None:
    config = compose_config("train", [f"experiment=ablation/{name}", f"preset={preset}"])
    assert sum(config.stages[stage].epochs for stage in config.curriculum) == sum(config.epochs.values())


CHANGES = {
    "full": [],
    "no_joint": ["curriculum", "stages.full.epochs"],
    "no_completion": ["curriculum", "stages.full.epochs"],
    "only_full": ["curriculum", "stages.full.epochs"],
    "no_registration": ["model.matchers", "model.registration_widths"],
    "no_rgb": ["model.matchers", "model.registration_widths", "model.use_rgb"],
    "l1_only": ["loss.corner.weight", "loss.match.weight", "loss.ssim.weight"],
    "frozen_never": ["stages.completion.freeze.modules", "stages.joint.freeze.modules"],
    "no_ramp": [f"stages.{stage}.difficulty.start" for stage in ("completion", "full", "joint")],
}


def differences(one: object, other: object, key: str = "") -> list[str]:
    if isinstance(one, dict) and isinstance(other, dict):
        names = sorted(one.keys() | other.keys())
        parts = [differences(one.get(n), other.get(n), f"{key}.{n}".lstrip(".")) for n in names]
        return [found for part in parts for found in part]
    return [] if one == other else [key]


@pytest.mark.parametrize("name", ABLATIONS)
def test_an_ablation_changes_what_it_is_named_after_and_nothing_else(name: str) -> None:
    full, ablation = (
        OmegaConf.to_container(compose_config("train", overrides), resolve=True)
        for overrides in ([], [f"experiment=ablation/{name}"])
    )
    assert differences(full, ablation) == CHANGES[name]


RUNGS = [f"experiment=ladder/{name}" for name in choices("experiment/ladder")]


@pytest.mark.parametrize("chosen", [*RUNGS, "preset=release"])
def test_a_rung_of_the_ladder_freezes_what_its_network_has_and_trains_for_as_long(chosen: str) -> None:
    config = compose_config("train", [chosen])
    network = build(config.model)
    for stage in config.stages.values():
        FreezeSchedule(**stage.freeze).check(network)
    assert sum(config.stages[stage].epochs for stage in config.curriculum) == sum(config.epochs.values())


def test_each_rung_of_the_ladder_changes_something() -> None:
    configs = [OmegaConf.to_container(compose_config("train", [rung]), resolve=True) for rung in RUNGS]
    changes = [differences(before, after) for before, after in itertools.pairwise(configs)]
    keys = [{key.split(".")[0] for key in changed} for changed in changes]
    assert keys == [{"loss"}, {"model"}, {"loss", "model", "stages"}, {"model"}, {"stages"}]
