"""The registry: names, collisions, plugins, and that everything it names is there."""

from importlib.metadata import EntryPoint

import pytest
from command import process, told
from conftest import refused

from kerv_cli.base import registry
from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import check_settings
from kerv_cli.base.registry import (
    METHOD_KINDS,
    PREFILL,
    STATES,
    ProposerPart,
    SkipPart,
    ThresholdPart,
    find,
    kinds,
    parts,
)
from kerv_cli.engine.parts import Skip
from kerv_cli.methods.unverified import AlwaysSkip, StreakSkip

PLUGIN = """
from dataclasses import dataclass

from kerv_cli.base.registry import ProposerPart


@dataclass
class Settings:
    kind: str = "{name}"
    width: int = 17


@ProposerPart("{name}", Settings, when="prefill")
class Mine:
    @classmethod
    def build(cls, settings, context):
        raise NotImplementedError
"""


@pytest.fixture
def shelf(monkeypatch):
    """The registry's own parts; what a test adds is gone after it."""
    kinds()
    copy = {kind: dict(named) for kind, named in registry._PARTS.items()}
    monkeypatch.setattr(registry, "_PARTS", copy)
    return copy


# kerv's own: which examples other test modules have registered by now depends on the order of collection
EVERY = [(kind, name) for kind in kinds() for name, part in parts(kind).items() if "examples." not in part.module]


def test_parts_have_one_order_whichever_family_is_imported_first():
    """It is the order of drafters in `kerv prepare`, of costs in a profile and of choices in a help text."""
    script = (
        "from kerv_cli.base.registry import kinds, parts; print([(kind, *parts(kind)) for kind in sorted(kinds())])"
    )
    begin = "import kerv_cli.methods.heisd; "
    first, other = (process("-c", start + script, KERV_PLUGINS="").stdout for start in ("", begin))
    assert first == other != ""


def test_a_name_belongs_to_one_piece_of_code(shelf):
    ProposerPart("mine", when=PREFILL)(StreakSkip)
    ProposerPart("mine", colour=1, when=PREFILL)(StreakSkip)
    assert find("proposer", "mine").colour == 1
    with refused(
        "proposer 'mine' is registered twice: ",
        ":StreakSkip and ",
        ":AlwaysSkip",
        error=UsageError,
    ):
        ProposerPart("mine", when=PREFILL)(AlwaysSkip)
    with pytest.raises(UsageError):
        ProposerPart("drafter", when=STATES)(AlwaysSkip)
    assert find("proposer", "drafter").origin == "kerv_cli.methods.eagle:artifact"
    ThresholdPart("mine")(AlwaysSkip)  # another kind: another name
    assert list(parts("proposer"))[-1] == "mine"  # in the order of registration


@pytest.mark.parametrize(("kind", "name"), EVERY)
def test_what_a_part_names_is_there(kind, name):
    part = find(kind, name)
    assert (part.kind, part.name) == (kind, name)
    assert part.absent or callable(part.code)
    if kind in METHOD_KINDS:
        chosen = part.settings(kind=name)
        assert chosen.kind == name
        assert isinstance(part.needed(chosen), tuple)
        assert set(part.needed(chosen)) <= set(parts("artifact"))
        check_settings(chosen, kind)  # defaults are in range


@pytest.mark.usefixtures("shelf")
def test_a_part_without_a_method_of_its_interface_is_refused_when_it_is_made():
    with pytest.raises(UsageError, match="skip 'idler' lacks the method take"):

        @SkipPart("idler")
        class Idler(Skip):
            pass


@pytest.mark.usefixtures("shelf")
def test_a_plugins_proposer_is_a_choice_like_any_other(tmp_path, monkeypatch):
    (tmp_path / "my_parts.py").write_text(PLUGIN.format(name="mine"))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(registry.PLUGINS, "my_parts")
    registry.load_plugins.__wrapped__()
    shown = told("rollout", "--cfg", "proposer=mine", "prefill_draft=mine", "proposer.width=3")
    assert "\n  kind: mine\n  width: 3\n" in shown
    assert "\n  kind: mine\n  width: 17\n" in shown
    assert "did you mean mine?" in told("rollout", "--cfg", "proposer=mien", code=2)


@pytest.mark.parametrize(
    ("plugins", "says"),
    [
        ("not_there", "plugin not_there: ModuleNotFoundError: No module named 'not_there'"),
        ("collides", "collides.py:13: proposer 'drafter' is registered twice: kerv_cli.methods.eagle"),
        ("unfinished", "unfinished.py:2: SyntaxError: "),
        ("unknown", "unknown.py:1: NameError: name 'nothing' is not defined"),
        ("misspelt", "misspelt.py:2: TypeError: SkipPart.__init__() got an unexpected keyword argument 'take_draft'"),
    ],
)
@pytest.mark.usefixtures("shelf")
def test_a_plugin_that_does_not_work_gets_one_line(tmp_path, plugins, says, monkeypatch):
    (tmp_path / "collides.py").write_text(PLUGIN.format(name="drafter"))
    (tmp_path / "unfinished.py").write_text("x = 1\ndef f(:\n")
    (tmp_path / "unknown.py").write_text("nothing\n")
    (tmp_path / "misspelt.py").write_text(
        "from kerv_cli.base.registry import SkipPart\nSkipPart('mine', take_draft=True).add()\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(registry.PLUGINS, plugins)
    with refused(says, error=UsageError):
        registry.load_plugins.__wrapped__()


def test_an_installed_package_registers_by_an_entry_point(tmp_path, monkeypatch, shelf):
    (tmp_path / "installed_parts.py").write_text(PLUGIN.format(name="installed"))
    monkeypatch.syspath_prepend(tmp_path)

    def entry_points(group):
        return [EntryPoint("anything", "installed_parts", group)] if group == "kerv.parts" else []

    monkeypatch.setattr(registry, "entry_points", entry_points)
    registry.load_plugins.__wrapped__()
    assert find("proposer", "installed").origin == "installed_parts:Mine"
