"""Settings: layering, one clear sentence for every bad key and value, and the written file reads back the same."""

import ast
import dataclasses
import inspect
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import pytest

from nerfvol.config.assemble import assemble, parse_assignment, read_yaml, to_plain, write_yaml
from nerfvol.config.field import DistillConfig, FieldConfig, FieldShape
from nerfvol.config.octree import FINEST_LEVEL, OctreeConfig
from nerfvol.config.parsers import Colour, colour, seconds
from nerfvol.config.splats import SplatConfig
from nerfvol.config.training import Config
from nerfvol.config.values import Checked, Count, above, at_least, hints_of, increasing_to_one, same_length, within
from nerfvol.errors import InputError
from nerfvol.region import SceneBounds


@dataclass(frozen=True)
class Stage(Checked):
    section: ClassVar[str] = "stage"

    resolution: Annotated[int, within(2, 128)] = 64
    end: Annotated[float, above(0, 1)] = 1.0


@dataclass
class Section(Checked):
    section: ClassVar[str] = "section"
    former: ClassVar[dict[str, str]] = {"depth": "levels", "speed": "it is always 3"}

    rate: float = 0.3
    levels: int = 3
    first: list[Annotated[float, at_least(0)]] = dataclasses.field(default_factory=lambda: [0.5, 1.0])
    second: tuple[int, ...] = (1, 2)
    widths: tuple[int, ...] = (4, 8)
    aabb: tuple[float, float, float] | None = None
    weights: dict[str, float] = dataclasses.field(default_factory=dict)

    def check(self):
        same_length(self, "first", "second")
        increasing_to_one(self, "first")


@dataclass
class Settings:
    data: str = ""
    mode: Literal["mlp", "direct"] = "direct"
    budget: Annotated[float | None, seconds] = 300.0
    background: Colour = (1.0, 1.0, 1.0)
    downscale: Count = 1
    resume: bool = False
    folder: Path = Path(".")
    names: list[str] = dataclasses.field(default_factory=list)
    section: Section = dataclasses.field(default_factory=Section)
    stage: Stage = Stage()


def build(mapping, *more):
    return assemble(Settings, (mapping, "a.yaml"), *more)


def test_layers_override_key_by_key():
    settings = build({"section": {"rate": 0.1, "levels": 5}, "data": "x"}, ({"section": {"levels": 7}}, "command line"))
    assert (settings.data, settings.section.rate, settings.section.levels, settings.mode) == ("x", 0.1, 7, "direct")
    assert Settings().section.levels == 3  # defaults are not shared


def test_a_frozen_section_given_as_default_is_not_changed_for_all():
    assert build({"stage": {"resolution": 8}}).stage == Stage(8)
    assert Settings().stage == Stage(64)


def test_every_kind_of_value():
    settings = build(
        {
            "budget": "5m", "background": "0.5, 0,1", "downscale": 4.0, "resume": "yes", "folder": "/tmp",
            "names": ["a", "b"],
            "section": {
                "rate": "1e-3", "widths": [1, 2, 3], "aabb": [0, 1, 2], "weights": {"tv": 1},
            },
        }
    )  # fmt: skip
    assert settings.budget == 300 and settings.background == (0.5, 0, 1) and settings.downscale == 4
    assert settings.resume is True and settings.folder == Path("/tmp") and settings.names == ["a", "b"]
    section = settings.section
    assert section.rate == 1e-3 and section.widths == (1, 2, 3) and section.aabb == (0.0, 1.0, 2.0)
    assert section.weights == {"tv": 1.0}
    assert isinstance(section.aabb[0], float)


@pytest.mark.parametrize(
    "mapping, sentence",
    [
        ({"backgroud": "white"}, "a.yaml: unknown key 'backgroud'; did you mean 'background'?"),
        ({"section": {"level": 1}}, "a.yaml: unknown key 'section.level'; did you mean 'section.levels'?"),
        ({"stage": {"resolutoin": 1}}, "unknown key 'stage.resolutoin'; did you mean 'stage.resolution'?"),
        ({"section": 3}, "a.yaml: section is a section, expected keys and values, got 3"),
        ({"section": None}, "section is a section"),
        ({"mode": "nerf"}, "a.yaml: mode: expected mlp or direct, got 'nerf'"),
        ({"section": {"levels": 1.5}}, "a.yaml: section.levels: expected a whole number, got 1.5"),
        ({"section": {"levels": True}}, "section.levels: expected a whole number, got True"),
        ({"section": {"rate": "fast"}}, "section.rate: expected a number, got 'fast'"),
        ({"section": {"rate": float("nan")}}, "section.rate: expected a number"),
        ({"section": {"rate": 10**400}}, "section.rate: expected a number"),
        ({"section": {"aabb": [1, 2]}}, "section.aabb: expected a list of 3, got 2"),
        ({"section": {"aabb": 5}}, "section.aabb: expected a list, got 5"),
        ({"section": {"weights": 5}}, "section.weights: expected keys and values, got 5"),
        ({"wibble": 1}, "a.yaml: unknown key 'wibble'"),
        ({"rate": 1}, "a.yaml: unknown key 'rate'; did you mean 'section.rate'?"),
        ({"section": {"depth": 17, "levels": 17}}, "a.yaml: section.levels is stated twice, as depth and as levels"),
        ({"section": {"speed": 17}}, "a.yaml: section.speed is no longer a setting: it is always 3"),
        ({"section": {"first": [0.5, -1]}}, "a.yaml: section.first: expected a number of at least 0, got -1"),
        (
            {"section": {"first": [1]}},
            "section.second must have one entry per stage, as many as section.first (1), got 2",
        ),
        ({"section": {"first": []}}, "section.first must have an entry for each stage, got none"),
        ({"section": {"first": [0.7, 0.5]}}, "section.first must increase and end with 1, got [0.7, 0.5]"),
        ({"stage": {"resolution": 1}}, "a.yaml: stage.resolution: expected a number from 2 to 128, got 1"),
        ({"stage": {"end": 0}}, "a.yaml: stage.end: expected a number above 0 and at most 1, got 0"),
        ({"resume": 2}, "resume: expected true or false, got 2"),
        ({"data": 3}, "data: expected text, got 3"),
        ({"downscale": 0}, "downscale: expected a number of at least 1, got 0"),
        ({"downscale": "-2"}, "downscale: expected a number of at least 1, got -2"),
        ({"downscale": "two"}, "downscale: expected a whole number, got 'two'"),
        ({"downscale": None}, "downscale: expected a whole number, got None"),
        ({"budget": "5 minutes"}, "budget: expected a duration such as 120s, 5m or 1h"),
        ({"budget": -3}, "budget: expected a duration"),
        ({"background": "grey"}, "background: expected white, black or R,G,B with numbers from 0 to 1, got 'grey'"),
        ({"background": "255,255,255"}, "background: expected white, black or R,G,B"),
        ({3: 4}, "unknown key '3'"),
    ],
)
def test_one_clear_sentence(mapping, sentence):
    with pytest.raises(InputError) as error:
        build(mapping)
    assert sentence in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text, value", [("120s", 120), ("5m", 300), ("1.5h", 5400), (7, 7), ("none", None)])
def test_seconds(text, value):
    assert seconds(text) == value


@pytest.mark.parametrize("bad", ["", "0s", "nan", "inf", "s", True, "1d", [1]])
def test_bad_seconds(bad):
    if bad == "":
        assert seconds(bad) is None
        return
    with pytest.raises(ValueError, match="duration"):
        seconds(bad)


def test_colour():
    assert colour("White") == (1, 1, 1) and colour("black") == (0, 0, 0) and colour([0, 0.5, 1]) == (0, 0.5, 1)
    for bad in ("1,1", "1,1,1,1", "a,b,c", None, 3, "nan,0,0", [2, 0, 0]):
        with pytest.raises(ValueError, match="white, black"):
            colour(bad)


def test_written_file_reads_back_the_same(tmp_path):
    section = {"aabb": [1, 2, 3]}
    settings = build({"background": "black", "section": section, "data": "é x"})
    write_yaml(tmp_path / "config.yaml", to_plain(settings))
    assert assemble(Settings, (read_yaml(tmp_path / "config.yaml"), "file")) == settings


@pytest.mark.parametrize(
    "content, reason",
    [
        (b"a: [1", "line"),
        (b"- 1\n- 2\n", "expected keys and values, got a list"),
        (b"\xff\xfe\x00", "UTF-8"),
        (b"!!python/object/apply:os.system ['true']", "could not determine a constructor"),
        (b"[" * 50_000, "nested too deeply|not a config"),
        (b"a: &a [*a]\nb: \t- x", "not a config file"),
    ],
)
def test_bad_yaml(tmp_path, content, reason):
    path = tmp_path / "bad.yaml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=reason) as error:
        read_yaml(path)
    assert "bad.yaml" in str(error.value)


def test_empty_and_missing_yaml(tmp_path):
    (tmp_path / "empty.yaml").write_text("# nothing\n")
    assert read_yaml(tmp_path / "empty.yaml") == {}
    with pytest.raises(InputError, match="no such file"):
        read_yaml(tmp_path / "none.yaml")


def test_assignments():
    assert parse_assignment("section.levels=4") == {"section": {"levels": 4}}
    assert parse_assignment("data=a=b") == {"data": "a=b"}
    for bad in ("levels", "=3", "a..b=1", "a-b=1", "x=[1"):
        with pytest.raises(InputError, match="--set"):
            parse_assignment(bad)


def test_nothing_far_off_is_suggested():
    with pytest.raises(InputError) as error:
        build({"section": {"wibble": 1}})
    assert "did you mean" not in str(error.value)


def test_settings_that_belong_together_may_come_one_by_one():
    """What holds between settings is looked at when all of them are there."""
    settings = build({"section": {"first": [1.0]}}, ({"section": {"second": [7]}}, "--set"))
    assert (settings.section.first, settings.section.second) == ([1.0], (7,))


@pytest.mark.parametrize(
    "make, sentence",
    [
        (lambda: Stage(resolution=1), "stage.resolution: expected a number from 2 to 128, got 1"),
        (
            lambda: Section(first=[1]),
            "section.second must have one entry per stage, as many as section.first (1), got 2",
        ),
        (lambda: OctreeConfig(levels=[40]), f"octree.levels: expected a number from 1 to {FINEST_LEVEL}, got 40"),
        (lambda: OctreeConfig(rate_decay=0), "octree.rate_decay: expected a number above 0 and at most 1, got 0.0"),
        (lambda: FieldConfig(rate=0), "field.rate: expected a number above 0 and at most 1000, got 0.0"),
        (lambda: FieldConfig(shape={"width": 3}), "field.shape: expected FieldShape(...), got {'width': 3}"),
        (lambda: FieldShape(skip=1), "field.shape.skip must be below field.shape.depth (1), got 1"),
        (lambda: DistillConfig(level=0), f"distill.level: expected a number from 1 to {FINEST_LEVEL}, got 0"),
        (lambda: SplatConfig(beta2=2), "splats.beta2: expected a number from 0.5 to 0.99999, got 2.0"),
        (lambda: Config(downscale=0), "downscale: expected a number of at least 1, got 0"),
    ],
)
def test_settings_made_in_python_are_checked_the_same_way(make, sentence):
    with pytest.raises(InputError) as error:
        make()
    assert str(error.value) == sentence


SECTIONS = (OctreeConfig, FieldConfig, FieldShape, DistillConfig, SplatConfig)


@pytest.mark.parametrize("cls", SECTIONS)
def test_every_number_has_a_range(cls):
    """A setting that is added without one would go unchecked; a bias may be any number."""
    for name, hint in hints_of(cls).items():
        if any(kind in str(hint) for kind in ("int", "float")) and name != "density_bias":
            assert "Interval" in str(hint), name


@pytest.mark.parametrize("cls", SECTIONS)
def test_old_names_lead_to_present_ones(cls):
    """A former key is taken for the setting that it is now, and that is said; or it is refused with a reason. No setting is
    called so still."""
    present = hints_of(cls)
    for old, new in cls.former.items():
        assert old not in present and (" " in new or new in present)
        if " " in new:
            with pytest.raises(InputError, match=f"{cls.section}.{old} is no longer a setting: "):
                assemble(Config, ({cls.section: {old: 1}}, "a.yaml"))
            continue
        said = []
        value = to_plain(cls())[new] if to_plain(cls())[new] is not None else 1
        given = assemble(Config, ({cls.section: {old: value}}, "a.yaml"), say=said.append)
        section = given
        for part in cls.section.split("."):
            section = getattr(section, part)
        assert getattr(section, new) == value
        assert said == [f"a.yaml: {cls.section}.{old} is called {cls.section}.{new} now, and taken for it"]


@pytest.mark.parametrize("cls", (*SECTIONS, Config))
def test_every_setting_is_explained(cls):
    """One docstring each, below it: it is all the reference there is besides config.yaml."""
    body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0].body
    for setting, after in zip(body, [*body[1:], None], strict=True):
        if isinstance(setting, ast.AnnAssign) and "ClassVar" not in ast.unparse(setting.annotation):
            assert isinstance(after, ast.Expr) and isinstance(after.value.value, str), setting.target.id


@pytest.mark.parametrize(
    "octree, distill, degree", [({}, {}, 1), ({"sh_degree": 2}, {}, 2), ({"sh_degree": 2}, {"sh_degree": 0}, 0)]
)
def test_a_distilled_octree_has_the_bands_of_the_octree_section(octree, distill, degree):
    """Unless its own says otherwise."""
    config = assemble(Config, ({"octree": octree, "distill": distill}, "a.yaml"))
    assert config.for_scene(SceneBounds([[-1] * 3, [1] * 3], None, True)).distill.sh_degree == degree


@pytest.mark.parametrize("text, reason", [
    ("a: &x [1, 2]\nb: *x", "aliases are not read at line 2"), ("a: 1\na: 2", "'a' is stated twice at line 2"),
    ("a: " + "9" * 5000, "number or date"), ("a: 2000-99-99", "number or date"),
])  # fmt: skip
def test_yaml_that_grows_or_says_two_things_is_refused(tmp_path, text, reason):
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(InputError, match=reason):
        read_yaml(tmp_path / "a.yaml")


@pytest.mark.parametrize(
    "setting", [{"seed": -1}, {"threads": 100_000}, {"background": [10**400, 0, 0]}, {"seed": 10**400}]
)
def test_numbers_beyond_all_sense_are_a_sentence(setting):
    with pytest.raises(InputError, match="^a.yaml: "):
        assemble(Config, (setting, "a.yaml"))
