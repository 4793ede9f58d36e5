"""No command replaces what another command has made, unless `replace=true` is typed."""

import contextlib
import multiprocessing
import os
import shutil
from pathlib import Path

import pytest
from command import kerv, process, refusal, told

from kerv_cli.base.errors import Interrupted, KervError, UsageError
from kerv_cli.base.files import owned, temporary_beside
from kerv_cli.base.paths import RELEASED, artifact, check_free, check_name
from kerv_cli.engine.chunk import WINDOW
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
    shown = {name: data for name, data in content(results / "artifacts").items() if not name.endswith(".lock")}
    return shown


@pytest.mark.parametrize(
    "words",
    [
        ("build", "target", "grow=60m", "policy.target=nano-vision", "name=nano-state"),
        ("train", "target", "name=nano-state", *TRAINING),
        ("train", "drafter", "policy.target=nano-vision", "demos=few", "train.steps=2"),
        ("build", "drafter", "policy.target=nano-vision", "checkpoint=DIR"),
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
    told("calibrate", *CALIBRATION, f"results={results}", "complete=true")


@pytest.mark.parametrize("name", RELEASED)
def test_a_name_does_not_shadow_a_policy_that_ships(tmp_path, name):
    for words in (("train", "target"), ("build", "target", "grow=60m")):
        line = refusal(*words, f"name={name}", f"results={tmp_path}", "replace=true", code=2)
        assert "ships with kerv" in line


def test_names_are_limited_in_bytes(tmp_path):
    assert "380 bytes: at most 200" in refusal("train", "target", f"name={'é' * 190}", f"results={tmp_path}", code=2)
    folder = artifact(str(tmp_path), "target", check_name("é" * 100, "name"))
    with owned(folder, lambda: False):
        folder.mkdir()
        temporary_beside(folder).mkdir()


# --- the lock


def hold(folder: Path, ready: "multiprocessing.synchronize.Event", end: "multiprocessing.synchronize.Event") -> None:
    with owned(folder, lambda: True):
        ready.set()
        end.wait(60)


def test_two_trainings_of_one_name_do_not_write_at_the_same_time(results, monkeypatch):
    """In another container with the same host name, the process id says nothing: the operating system's lock does."""
    folder, context = results / "artifacts/target/shared", multiprocessing.get_context("spawn")
    ready, end = context.Event(), context.Event()
    holder = context.Process(target=hold, args=(folder, ready, end))
    holder.start()
    assert ready.wait(60)
    line = refusal("train", "target", "name=shared", *TRAINING, f"results={results}", code=2)
    assert f"another command is making {folder}" in line
    assert not folder.exists()
    holder.kill()  # the lock ends with its process
    holder.join()
    with owned(folder, lambda: False):
        pass


def test_a_lock_needs_no_process_id(tmp_path):
    text = (
        f"from pathlib import Path; from kerv_cli.base.files import owned; import contextlib\n"
        f"with owned(Path({str(tmp_path / 'x')!r}), lambda: True): print('held')"
    )
    with owned(tmp_path / "x", lambda: True):
        assert "another command is making" in process("-c", text).stderr
    assert process("-c", text).stdout == "held\n"


@pytest.mark.parametrize(
    ("error", "made", "left"),
    [
        (None, "new", "new"),
        (KervError("x"), "new", "old"),
        (KeyboardInterrupt(), "new", "new"),
        (Interrupted("x"), None, "old"),
        (UsageError("x"), None, "old"),
    ],
)
def test_what_is_replaced_comes_back_after_a_failure(tmp_path, error, made, left):
    folder = tmp_path / "a"
    folder.mkdir()
    (folder / "old").touch()
    expected = pytest.raises((KervError, KeyboardInterrupt)) if error else contextlib.nullcontext()
    with expected, owned(folder, lambda: False):
        assert not folder.exists()
        if made:
            folder.mkdir()
            (folder / made).touch()
        if error:
            raise error
    assert os.listdir(folder) == [left]
    assert [name for name in os.listdir(tmp_path) if name.endswith(".tmp")] == []


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
    import torch

    from kerv_cli.base.config import compose
    from kerv_cli.training.demonstrations import plan_demos, recording_of
    from kerv_cli.training.settings import DemosSettings

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    words = ["policy=state", "policy.target=nano-state", "task=drawer-close", "name=d", f"results={results}"]
    assert "no CUDA device" in refusal("demos", *words, "runtime.device=cuda", "--plan", code=2)
    settings = compose("demos", [*words, "runtime.dtype=bfloat16"], DemosSettings)
    config, actor = recording_of(settings)
    assert actor is not None
    assert str(actor(config).decoder_of("drawer-close-v3").target.dtype) == "torch.bfloat16"
    other = recording_of(compose("demos", words, DemosSettings))[1]
    assert other is not None
    assert other.sha256 != actor.sha256
    assert plan_demos(settings).units == 100


def test_the_plan_of_a_training_measures_how_long_it_takes(results):
    words = ("train", "target", "name=planned", *TRAINING[:-1], f"results={results}", "--plan")
    line = kerv(*words).stdout
    assert "measured now" in line
    assert "unknown" not in line
    assert not (results / "artifacts/target/planned").exists()
