"""No command replaces what another command has made, unless `replace=true` is typed."""

import os
import shutil
import signal
from pathlib import Path
from random import Random

import pytest
import torch
from command import kerv, refusal, told
from conftest import python, until

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import owned, temporary_beside, unfinished
from kerv_cli.base.paths import RELEASED, RESUME, artifact, check_free, check_name
from kerv_cli.engine.chunk import WINDOW
from kerv_cli.targets.checkpoint import load_target, read_target
from kerv_cli.training.fit import Destination
from kerv_cli.training.settings import CalibrateSettings

TRAINING = ("target=nano", "target.observation=state", "demos=few", "train.batch=2", "train.steps=2")
SMALL = ("grow=60m", "grow.width=64", "grow.heads=2", "grow.feed_forward=64", "grow.layers=2")
CALIBRATION = ("policy.target=nano-vision", "demos=few", "decodes=0", "policy.artifacts.calibration=mine")


@pytest.fixture
def results(demonstrated, tmp_path):
    """The policies `nano-state` and `nano-vision` without resume files, and demonstrations."""
    return Path(shutil.copytree(demonstrated, tmp_path / "results"))


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def artifacts(results: Path) -> dict[str, bytes]:
    return {name: data for name, data in content(results / "artifacts").items() if not name.endswith(".lock")}


@pytest.mark.parametrize(
    "words",
    [
        ("build", "target", "grow=60m", "policy.target=nano-vision", "name=nano-state"),
        ("train", "target", "name=nano-state", *TRAINING),
        ("train", "drafter", "policy.target=nano-vision", "demos=few", "train.steps=2"),
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_weights_that_another_command_made_stay(results, words):
    before = artifacts(results)
    for more in ((), ("--plan",)) if words[0] == "train" else ((),):
        line = refusal(*words, f"results={results}", *more, code=2)
        assert "is there already: choose another" in line
        assert "replace=true" in line
    assert artifacts(results) == before


def test_a_target_is_replaced_as_a_whole_if_that_is_typed(results):
    folder = results / "artifacts/target/nano-state"
    words = ("build", "target", *SMALL, "policy.target=nano-vision", "name=nano-state", f"results={results}")
    told(*words, "replace=true")
    assert list(content(folder)) == ["target.json"]
    assert '"grown"' in (folder / "target.json").read_text()


@pytest.mark.parametrize("more", [(), ("replace=true",)])
def test_a_target_never_grows_from_itself(results, more):
    before = artifacts(results)
    words = ("build", "target", "grow=60m", "policy.target=nano-vision", "name=nano-vision", *more)
    assert "cannot grow from itself" in refusal(*words, f"results={results}", code=2)
    assert artifacts(results) == before


def test_a_failing_import_leaves_what_it_would_have_replaced(results, tmp_path):
    before = artifacts(results)
    words = ("build", "target", f"checkpoint={tmp_path}", "name=nano-state", "replace=true", f"results={results}")
    refusal(*words, code=1)
    assert artifacts(results) == before


@pytest.mark.usefixtures("quick_training")
def test_another_training_of_a_name_replaces_it_only_if_that_is_typed(results):
    words = ("train", "target", "name=twice", *TRAINING, f"results={results}")
    told(*words)
    first = (results / "artifacts/target/twice/target.json").read_bytes()
    told(*words)  # the same training is complete
    assert (results / "artifacts/target/twice/target.json").read_bytes() == first
    assert "replace=true" in refusal(*words, "train.lr=3e-4", code=2)
    assert (results / "artifacts/target/twice/target.json").read_bytes() == first
    told(*words, "train.lr=3e-4", "replace=true")
    assert (results / "artifacts/target/twice/target.json").read_bytes() != first


def test_a_datastore_and_a_calibration_are_not_replaced_by_their_own_command(results):
    store = ("build", "datastore", "policy.target=nano-vision", "demos=few", "policy.artifacts.datastore=mine")
    for words in (store, ("calibrate", *CALIBRATION)):
        told(*words, f"results={results}")
        before = artifacts(results)
        assert "replace=true" in refusal(*words, f"results={results}", "episodes=5", code=2)
        assert artifacts(results) == before
        told(*words, f"results={results}", "episodes=5", "replace=true")
        assert artifacts(results) != before


@pytest.mark.parametrize("name", RELEASED)
def test_a_name_does_not_shadow_a_policy_that_ships(tmp_path, name):
    for words in (("train", "target"), ("build", "target", "grow=60m")):
        line = refusal(*words, f"name={name}", f"results={tmp_path}", "replace=true", code=2)
        assert "ships with kerv" in line


def test_names_are_limited_in_bytes(tmp_path):
    assert "380 bytes: at most 200" in refusal("train", "target", f"name={'é' * 190}", f"results={tmp_path}", code=2)
    folder = artifact(str(tmp_path), "target", check_name("é" * 100, "name"))
    with owned(folder, lambda: None):
        folder.mkdir()
        temporary_beside(folder).mkdir()


# --- the lock


HOLD = """
import sys, time
from pathlib import Path
from kerv_cli.base.files import owned
with owned(Path(sys.argv[1]), lambda: None):
    Path(sys.argv[2]).touch()
    time.sleep(60)
"""


def test_two_trainings_of_one_name_do_not_write_at_the_same_time(results, tmp_path):
    folder = results / "artifacts/target/shared"
    with python(HOLD, folder, tmp_path / "held") as holder:
        until((tmp_path / "held").exists)
        line = refusal("train", "target", "name=shared", *TRAINING, f"results={results}", code=2)
        assert f"another command is making {folder}" in line
        assert not folder.exists()
        holder.kill()  # the lock ends with its process
        holder.join()
    with owned(folder, lambda: None):
        pass


# --- a command that replaces is killed

KILLED = """
import os, signal, sys
from kerv_cli.base import files
from kerv_cli.cli.app import app

left, sync = int(sys.argv[1]), files.sync

def killed(path):
    global left
    left -= 1
    if not left:
        os.kill(os.getpid(), signal.SIGKILL)
    sync(path)

files.sync = killed
app(sys.argv[2:])
"""


@pytest.mark.bits
@pytest.mark.usefixtures("quick_training")
def test_a_killed_training_that_replaces_leaves_the_old_weights_and_goes_on(results):
    words = ["train", "target", *TRAINING[:-1], "train.steps=4", "train.validate_every=1", f"results={results}"]
    told(*words, "name=whole")
    whole, old = (read_target(results / "artifacts/target" / name).sha256 for name in ("whole", "nano-state"))
    folder, random = results / "artifacts/target/nano-state", Random(70)
    words += ["name=nano-state", "replace=true"]
    for moment in (random.randrange(12, 24), random.randrange(3, 14)):  # a validation syncs the disk 12 times
        with python(KILLED, moment, *words) as run:
            run.join(120)
            assert run.exitcode == -signal.SIGKILL
        load_target(folder)
        assert read_target(folder).sha256 == old
        assert unfinished(folder).is_dir()
    assert "resuming at step" in told(*words)
    assert read_target(folder).sha256 == whole
    assert not unfinished(folder).exists()
    assert {RESUME, "curves.png"} < set(content(folder))


def test_an_unfinished_training_of_other_settings_is_begun_again(tmp_path):
    folder, other = tmp_path / "a", tmp_path / ".a.new"
    for path, identity, step in ((folder, "old", 9), (other, "abandoned", 3)):
        path.mkdir()
        torch.save({"identity": identity, "step": step}, path / RESUME)
    for identity, steps, kept in (("abandoned", 5, True), ("abandoned", 2, False), ("new", 5, False)):
        place = Destination(folder, identity, steps, "name", replace=True, begun=True)
        place.check()
        opened = place.opened()
        made = opened.__enter__()
        assert made == other
        assert (made / RESUME).exists() == kept
        torch.save({"identity": "abandoned", "step": 3}, made / RESUME)
        assert not opened.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)
    with place.opened() as made:
        (made / "new").touch()
    assert os.listdir(folder) == ["new"]
    assert os.listdir(tmp_path) == ["a"]


def test_an_existing_file_or_folder_is_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()
    for path in (tmp_path / "empty", tmp_path / "none"):
        check_free(path, "name", False)
    with pytest.raises(UsageError, match="choose another name=NAME, or type replace=true"):
        check_free(tmp_path / "file", "name", False)
    check_free(tmp_path / "file", "name", True)


# --- settings of the machine


def test_the_calibrations_window_is_what_an_episode_keeps():
    assert CalibrateSettings().window == WINDOW
    assert "window=30: from 4 to 10" in refusal("calibrate", "window=30", code=2)


def test_a_calibration_measures_in_the_format_and_on_the_device_that_it_records(results, monkeypatch):
    from kerv_cli.training import calibration

    seen = []
    measure = calibration.presample
    monkeypatch.setattr(
        calibration, "presample", lambda decoder, *more: seen.append(decoder) or measure(decoder, *more)
    )
    words = ("policy.target=nano-vision", "demos=few", "decodes=2", f"results={results}", "runtime=auto")
    told("calibrate", *words, "runtime.dtype=bfloat16", "policy.artifacts.calibration=b")
    (decoder,) = seen
    assert str(decoder.target.dtype) == "torch.bfloat16"


def test_a_recording_by_a_policy_honours_the_device_and_the_format(results, monkeypatch):
    from kerv_cli.base.config import compose
    from kerv_cli.training.demonstrations import plan_demos, recording_of
    from kerv_cli.training.settings import DemosSettings

    monkeypatch.setattr(torch.cuda, "is_available", lambda: None)
    words = ["policy=state", "policy.target=nano-state", "task=drawer-close", "name=d", f"results={results}"]
    assert "no CUDA device" in refusal("demos", *words, "runtime.device=cuda", "--plan", code=2)
    settings = compose("demos", [*words, "runtime.dtype=bfloat16"], DemosSettings)
    config, actor = recording_of(settings)
    assert actor is not None
    assert str(actor(config).decoder_of("drawer-close-v3").target.dtype) == "torch.bfloat16"
    longer, other = recording_of(compose("demos", [*words, "tail=15"], DemosSettings))
    assert longer.tail == 15  # as the message asks that refuses chunks of sixteen
    assert other is not None
    assert other.sha256 != actor.sha256
    assert plan_demos(settings).text.startswith("1 task x 100 episodes")


@pytest.mark.parametrize(
    "words",
    [
        ("target", "name=planned", *TRAINING[:-1]),
        ("drafter", "policy.target=nano-vision", "demos=few", "policy.artifacts.drafter=planned"),
        ("drafter", "drafter=early", "policy.target=nano-state", "demos=few", "policy.artifacts.early=planned"),
    ],
)
def test_the_plan_of_a_training_measures_how_long_it_takes(results, words):
    before = artifacts(results)
    line = kerv("train", *words, f"results={results}", "--plan").stdout
    assert "measured now" in line
    assert "unknown" not in line
    assert artifacts(results) == before
