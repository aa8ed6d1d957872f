"""Check that each setting is stated in one field, and that it can be set by an option, by --set and in a
file.
"""

from __future__ import annotations

import functools
import json
import math
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Literal, get_args, get_origin

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from litho_data.commands.settings import Leaf, changed, leaves
from litho_data.foundation.errors import InputError
from litho_data.foundation.quantities import LENGTH_UM
from litho_design.cli.app import app
from litho_design.cli.options import _described
from litho_design.holograms.settings import HologramSettings, hologram_settings
from litho_design.holograms.task import HologramTask
from litho_design.lenses.settings import LensSettings, lens_settings
from litho_design.lenses.task import LensTask
from litho_design.optimisation.settings import StartName
from litho_design.reliefs.settings import ReliefSettings
from litho_design.reliefs.task import ReliefTask

ROOT = Path(__file__).parents[2]
PRESETS = {"hoe": HologramSettings(), "lens": LensSettings(), "relief": ReliefSettings()}
# Choosing another preset or another kind of lens changes more than one value.
CHOOSE = ("variant", "task")
of_each_task = pytest.mark.parametrize("task", PRESETS)


def other(leaf: Leaf):
    """Return a different value that the field accepts."""
    if get_origin(leaf.kind) is Literal:
        return next(choice for choice in get_args(leaf.kind) if choice != leaf.value)
    if isinstance(leaf.value, tuple):
        if all(isinstance(value, float) for value in leaf.value):
            return tuple(value / 2 for value in leaf.value) or (0.25,)
        return leaf.value[::-1]
    if leaf.kind is float:
        return leaf.value / 2 if leaf.value else 0.25
    if leaf.kind is str:
        return "none"
    assert leaf.kind is int, leaf
    return leaf.value + 7


@functools.cache
def printed(task, *words):
    """Return the settings by path, as `litho-design settings` prints them."""
    result = CliRunner().invoke(app, ["settings", task, *map(str, words)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return flat(tomllib.loads(result.stdout))


def flat(content, prefix=""):
    found = {}
    for name, value in content.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return found


def single(task):
    """Return the settings that can be changed without changing others."""
    return [leaf for leaf in leaves(PRESETS[task]) if leaf.path not in CHOOSE]


@of_each_task
def test_every_setting_is_reached_by_its_path(task):
    values = {leaf.path: json.loads(json.dumps(other(leaf))) for leaf in single(task)}
    before = flat(json.loads(PRESETS[task].model_dump_json()))
    for path, value in values.items():
        after = flat(json.loads(changed(PRESETS[task], {path: value}).model_dump_json()))
        assert {one: after[one] for one in before if before[one] != after[one]} == {path: value}
    # The command passes paths and values on unchanged.
    words = [
        f"{path}={value if isinstance(value, str) else json.dumps(value)}" for path, value in values.items()
    ]
    assert printed(task) | values == printed(task, *(word for one in words for word in ("--set", one)))


@of_each_task
def test_every_option_sets_the_field_that_states_it(task):
    """Check all options at once, so that an option that sets a wrong field is noticed."""
    given = [leaf for leaf in single(task) if leaf.options]
    for number in range(max(len(leaf.options) for leaf in given)):
        having = [leaf for leaf in given if len(leaf.options) > number]
        words = [word for leaf in having for word in (leaf.options[number], other(leaf))]
        assert printed(task) | {leaf.path: other(leaf) for leaf in having} == printed(task, *words)


@of_each_task
def test_what_chooses_a_preset_is_reached_by_path_and_option(task):
    for leaf in (leaf for leaf in leaves(PRESETS[task]) if leaf.path in CHOOSE):
        value = other(leaf)
        for words in (("--set", f"{leaf.path}={value}"), *((option, value) for option in leaf.options)):
            assert printed(task, *words)[leaf.path] == value


@of_each_task
def test_every_setting_has_a_description_and_a_unit(task):
    for leaf in leaves(PRESETS[task]):
        assert leaf.help, leaf.path
        assert not leaf.help.endswith("."), leaf.path
        suffix = leaf.path.rpartition("_")[2]
        assert {"um": "µm", "px": "px"}.get(suffix, leaf.unit) == leaf.unit, leaf.path


@of_each_task
@pytest.mark.parametrize("wrong", [math.nan, math.inf, -1e300, 1e300, 10**400])
def test_no_setting_accepts_an_impossible_number(task, wrong):
    for leaf in leaves(PRESETS[task]):
        with pytest.raises(InputError) as said:
            changed(PRESETS[task], {leaf.path: wrong})
        assert str(said.value).startswith(f"setting {leaf.path}")
        assert "\n" not in str(said.value)


@of_each_task
def test_no_setting_accepts_a_length_above_the_limit(task):
    for leaf in leaves(PRESETS[task]):
        if leaf.unit == "µm":
            with pytest.raises(InputError, match="wanted less than"):
                changed(PRESETS[task], {leaf.path: 1.01 * LENGTH_UM.high})


@of_each_task
def test_no_two_settings_share_an_option(task):
    options = [option for leaf in leaves(PRESETS[task]) for option in leaf.options]
    assert len(options) == len(set(options))


@pytest.mark.parametrize("command", ["hoe", "lens", "compare"])
def test_help_shows_default_and_unit_of_every_option(command, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("TERMINAL_WIDTH", "200")
    shown = CliRunner().invoke(app, [command, "--help-all"]).stdout
    presets = [PRESETS["hoe"], PRESETS["lens"]] if command == "compare" else [PRESETS[command]]
    offered = options_of(command)
    for leaf in (leaf for preset in presets for leaf in leaves(preset) if offered & set(leaf.options)):
        assert leaf.options[0] in shown
        value = f"{leaf.value:g}" if isinstance(leaf.value, float) else str(leaf.value)
        assert value in shown
    assert ", µm" in shown


@pytest.mark.parametrize(
    ("meaning", "wanted"), [("Height map", "height map, nm"), ("AFM height map", "AFM height map, nm")]
)
def test_a_help_text_begins_in_lower_case_except_in_an_abbreviation(meaning, wanted):
    leaf = Leaf(path="scan", kind=str, value="", help=meaning, unit="nm", options=("--scan",))
    assert _described(leaf) == wanted


def options_of(command):
    return {option for param in get_command(app).commands[command].params for option in param.opts}


@pytest.mark.parametrize("page", ["docs/optics.md", "docs/README.md"])
def test_the_options_that_pages_name_are_there(page):
    text = (ROOT / page).read_text("utf-8")
    lines = [line for line in text.splitlines() if line.startswith("litho-design ")]
    assert lines
    for line in lines:
        _, command, *words = line.split()
        assert {word for word in words if word.startswith("--")} <= options_of(command), line


def test_the_printed_settings_are_a_file_of_settings(tmp_path):
    for task, words in (("hoe", ("--variant", "paper")), ("lens", ("--task", "computational"))):
        file = tmp_path / f"{task}.toml"
        file.write_text(CliRunner().invoke(app, ["settings", task, *words]).stdout)
        assert printed(task, "--config", file) == printed(task, *words)
    assert hologram_settings(changes=tomllib.loads((tmp_path / "hoe.toml").read_text())) == hologram_settings(
        "paper"
    )


def test_options_win_over_the_file_and_the_file_over_the_preset(tmp_path):
    file = tmp_path / "mine.json"
    content = {"variant": "authors", "layout": {"levels": 9, "size_px": 64}, "loss.efficiency_weight": 0.3}
    file.write_text(json.dumps(content))
    found = printed("hoe", "--config", file, "--levels", 5, "--set", "optics.index_step=0.6")
    authors = flat(json.loads(hologram_settings("authors").model_dump_json()))
    given = {
        "layout.levels": 5,
        "layout.size_px": 64,
        "loss.efficiency_weight": 0.3,
        "optics.index_step": 0.6,
    }
    assert found == authors | given
    assert printed("hoe", "--config", file, "--variant", "paper")["variant"] == "paper"


def test_python_takes_the_same_changes():
    changes = {"layout.size_px": 64, "loss": {"efficiency_weight": 0.3}}
    settings = hologram_settings("paper", changes)
    assert (settings.layout.size_px, settings.loss.efficiency_weight) == (64, 0.3)
    assert settings.search == hologram_settings("paper").search
    assert lens_settings("computational", changes={"task": "direct"}).task == "direct"
    assert changed(settings, {}) == settings
    with pytest.raises(InputError, match="variant"):
        hologram_settings(changes={"variant": "ours"})


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("hoe", "--set", "loss.weight=0.2"), "got 'loss.weight', wanted loss.scale"),
        (("hoe", "--set", "los.weight=0.2"), "got 'los.weight', wanted variant, layout, optics, search"),
        (("hoe", "--set", "loss=0.2"), "wanted a value for one of loss.scale"),
        (("hoe", "--set", "layout.levels.top=2"), "layout.levels itself, which is a single value"),
        (("hoe", "--set", "layout.levels"), "PATH=VALUE"),
        (("hoe", "--set", "layout.levels=many"), "setting layout.levels, got 'many', wanted a valid integer"),
        (("hoe", "--set", "layout.levels=1"), "wanted greater than or equal to 2"),
        (("hoe", "--set", "optics.distance_um=Infinity"), "wanted a finite number"),
        (("hoe", "--set", "layout.levels=5", "--set", "layout.levels=6"), "layout.levels twice"),
        (("hoe", "--levels", "5", "--set", "layout.levels=6"), "another option sets too"),
        (("hoe", "--config", "unknown.toml"), "setting of unknown.toml, got 'layout.size'"),
        (("hoe", "--config", "broken.toml"), "broken.toml"),
        (("hoe", "--config", "list.json"), "wanted a table of settings by name"),
        (("hoe", "--config", "value.toml"), "layout, got 5"),
        (("hoe", "--config", "nowhere.toml"), "nowhere.toml"),
        (("hoe", "--config", "settings.yaml"), ".toml or .json"),
        (("lens", "--set", "imaging.objects=[]"), "are needed"),
        (("compare", "--models", "none", "--window-px", "64"), "got an option of another task"),
        (("compare", "--models", "none", "--task", "lens-direct", "--loss-scale", "paper"), "--loss-scale"),
        (("compare", "--models", "none", "--set", "search.seed=4"), "search.seed"),
    ],
)  # fmt: skip
def test_bad_settings_are_one_line_and_exit_code_2(tmp_path, monkeypatch, refused, words, complaint):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "unknown.toml").write_text("[layout]\nsize = 5\n")
    (tmp_path / "broken.toml").write_text("[layout\n")
    (tmp_path / "list.json").write_text("[]")
    (tmp_path / "value.toml").write_text("layout = 5\n")
    (tmp_path / "settings.yaml").write_text("layout: 5\n")
    model = () if words[0] == "compare" else ("--model", "none")
    assert complaint in refused(*words, *model, "--out", "out")
    assert not (tmp_path / "out").exists()


def test_every_start_that_can_be_named_can_be_made():
    named = {start for task in (HologramTask, LensTask, ReliefTask) for start in task.starts}
    assert named == set(get_args(StartName))


def test_help_needs_no_torch():
    code = (
        "import sys; from litho_design.cli.app import app\n"
        "try: app(['hoe', '--help'])\n"
        "except SystemExit: pass\n"
        "sys.exit('torch' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_designs_with_removed_choices_stay_readable():
    """Check that settings with removed choices can still be read, and that other unknown choices are
    refused.
    """
    now = hologram_settings().model_dump(mode="json")
    older = {
        **now,
        "search": {**now["search"], "start_iterations": 40, "hard_from": 1.0},
        "window": {**now["window"], "risk": "cvar", "weight": 1.0, "stitch": {"sigma_um": 0.0}},
        "fabrication": {**now["fabrication"], "max_step_levels": 0},
        "camera": {"pitch_um": 0.345, "numerical_aperture": 0.3},
    }
    assert HologramSettings.model_validate(older) == hologram_settings()
    for strange in ({"search": {"start_iteration": 4}}, {"flash": True}):
        with pytest.raises(ValueError, match="Extra inputs are not permitted"):
            HologramSettings.model_validate(now | strange)
