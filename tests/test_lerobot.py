"""LeRobot datasets of version 3 are read and trained on; what was made for other actions is refused."""

import json
import resource
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command import kerv, refusal, told
from examples.tiny_openvla import TINY, write_checkpoint
from loaded import of_target
from test_openvla import edited as changed
from test_openvla import imported

from kerv_cli.base import registry
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.methods.eagle.drafter import EagleDrafter
from kerv_cli.methods.eagle.network import DrafterProposer
from kerv_cli.methods.early.drafter import EarlyDrafter
from kerv_cli.methods.early.network import EarlyProposer
from kerv_cli.targets.checkpoint import load_target
from kerv_cli.targets.openvla.config import Bounds, action_space
from kerv_cli.worlds import instruction_of, specs
from kerv_cli.worlds.demos import files
from kerv_cli.worlds.demos.dataset import DemoDataset
from kerv_cli.worlds.demos.dataset import __name__ as dataset_module
from kerv_cli.worlds.demos.files import encode_png
from kerv_cli.worlds.demos.lerobot import DATA, VIDEO
from kerv_cli.worlds.demos.recording import DemoConfig, record
from kerv_cli.worlds.settings import CameraSettings

SIZE = 56


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Demonstrations of insertion, the same as a LeRobot dataset, and imported under the name `back`."""
    results = tmp_path_factory.mktemp("lerobot")
    config = DemoConfig(("insert-peg", "fetch-peg"), 2, camera=CameraSettings(size=SIZE), workers=1)
    record(config, results / "artifacts/demos/pegs")
    write_lerobot(DemoDataset.open(results / "artifacts/demos/pegs"), results / "lerobot/pegs")
    read = ["demos", "import", f"source={results}/lerobot/pegs", "name=back", "dofs=openvla", "tail=3"]
    kerv(*read, f"results={results}")
    return results


def write_lerobot(dataset: DemoDataset, folder: Path) -> None:
    """Write demonstrations as a LeRobot dataset with images in its table."""
    tasks, rows, episodes = list(dataset.manifest.tasks), [], []
    for number in range(len(dataset.episodes)):
        episode, first = dataset.load(number), len(rows)
        width = len(dataset.manifest.observation.proprioception)
        for step, frame in zip(episode.frame_steps, episode.frames, strict=True):
            vectors = {
                "observation.state": episode.states[step, :width],
                "observation.environment_state": episode.states[step],
                "action": episode.labels[step],
                "action.executed": episode.executed[step],
            }
            picture = {"bytes": encode_png(frame), "path": None}
            index = {"episode_index": number, "task_index": tasks.index(episode.task)}
            rows.append({"observation.images.front": picture, **index, **{k: v.tolist() for k, v in vectors.items()}})
        about = {"episode_index": number, "length": len(rows) - first, "data/chunk_index": 0, "data/file_index": 0}
        episodes.append({**about, "dataset_from_index": first, "dataset_to_index": len(rows)})
    features = {name: {"dtype": "float32", "shape": [len(rows[0][name])], "names": None} for name in vectors}
    features["action"]["names"] = list(dataset.manifest.actions.names)
    features["observation.images.front"] = {"dtype": "image", "shape": [SIZE, SIZE, 3], "names": None}
    info = {"codebase_version": "v3.0", "fps": 20, "features": features}
    info |= {"data_path": DATA, "video_path": VIDEO}
    names = {"task": [instruction_of(task) for task in tasks], "task_index": list(range(len(tasks)))}
    tables = {
        folder / DATA.format(chunk_index=0, file_index=0): pa.Table.from_pylist(rows),
        folder / "meta/episodes/chunk-000/file-000.parquet": pa.Table.from_pylist(episodes),
        folder / "meta/tasks.parquet": pa.table(names),
    }
    for path, table in tables.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, path)
    (folder / "meta/info.json").write_text(json.dumps(info))


def both(results: Path) -> tuple[DemoDataset, DemoDataset]:
    folder = results / "artifacts/demos"
    return DemoDataset.open(folder / "pegs"), DemoDataset.open(folder / "back")


def test_every_number_and_picture_is_read(results):
    before, after = both(results)
    assert len(before.episodes) == len(after.episodes) == 4
    for index in range(4):
        ours, theirs = before.load(index), after.load(index)
        np.testing.assert_array_equal(ours.frames, theirs.frames)
        np.testing.assert_array_equal(ours.states, theirs.states)
        np.testing.assert_array_equal(ours.executed, theirs.executed)
        np.testing.assert_array_equal(ours.labels[: ours.steps], theirs.labels[: theirs.steps])
        assert len(theirs.labels) == theirs.steps + 3
        np.testing.assert_array_equal(theirs.labels[-1], theirs.labels[theirs.steps - 1])
    manifest = after.manifest
    openvla = action_space(TINY, Bounds((-1.0,) * 7, (1.0,) * 7), None, 20.0)
    manifest.actions.check_same(openvla, "the import", "an OpenVLA checkpoint")
    text = "pick up the peg and put it into the slot"
    assert manifest.instructions[text.replace(" ", "-")] == text


@pytest.mark.usefixtures("quick_training")
def test_everything_trains_on_recorded_observations_of_an_openvla(results):
    imported(write_checkpoint(results / "tiny"), results, name="rec", control_hz=20.0)
    common = ["policy.target=rec", "demos=back", f"results={results}"]
    short = ["train.steps=2", "train.batch=2", "train.warmup=1", "train.validate_every=2", "drafter.samples=6"]
    kerv("train", "drafter", *common, *short, "train.held_out=0.5")
    kerv("train", "drafter", "drafter=early", *common, *short, "train.held_out=0.5")
    kerv("build", "datastore", *common, "task=BACK", "key=[vision]")
    calibrate = ["calibrate", *common, "task=BACK", "decodes=2", "window=5", "boundary_windows=[5]"]
    kerv(*calibrate)
    made = json.loads((results / "artifacts/calibration/rec/calibration.json").read_text())
    assert set(made["variability"]) == set(both(results)[1].manifest.instructions)
    refused = refusal("build", "datastore", *common, "task=BACK", "key=[scene]", "replace=true", code=2)
    assert "unknown part of the prompt 'scene'" in refused


def test_a_recording_cannot_be_rolled_out(results):
    both(results)
    words = ["rollout", "task=BACK", "policy.target=rec", "method=ar", "episodes=1", "world.camera.size=56"]
    refused = refusal(*words, f"results={results}", code=2)
    assert "back is a recording: no episode can run in it" in refused
    assert "kerv serve policy.target=" in refused, "what can be done with it"


def trained(results: Path, *words: str) -> str:
    """Train a policy for two steps, and return what the command printed."""
    short = ["train.steps=2", "train.batch=2", "train.validate_every=2", "train.held_out=0.5", f"results={results}"]
    sizes = [f"target.image_size={SIZE}", f"world.camera.size={SIZE}", "target=nano", "target.grid=1"]
    return told("train", "target", *words, *sizes, *short)


@pytest.mark.usefixtures("quick_training")
def test_a_policy_of_data_without_object_positions_acts_in_their_world(results, tmp_path):
    source = edited(results, tmp_path)
    info = json.loads((source / "meta/info.json").read_text())
    del info["features"]["observation.environment_state"]  # as a robot records it: no privileged state
    (source / "meta/info.json").write_text(json.dumps(info))
    data = source / "data/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(data).drop_columns(["observation.environment_state"]), data)
    common = [f"results={tmp_path}", f"world.camera.size={SIZE}"]
    read = ["demos", "import", f"source={source}", "environment=insertion", "name=bare"]
    kerv(*read, f"results={tmp_path}")
    assert "train.places=path" in trained(tmp_path, "name=own", "demos=bare")
    rollout = ["rollout", "task=insert-peg", "policy.target=own", "method=ar", "episodes=1", "record=0"]
    kerv(*rollout, "world.horizon=8", *common)
    short = ["train.steps=2", "train.batch=2", "train.validate_every=2", "train.held_out=0.5", "drafter.samples=6"]
    kerv("train", "drafter", "policy.target=own", *short, f"results={tmp_path}")


@pytest.mark.usefixtures("quick_training")
def test_a_policy_of_a_recording_without_object_positions_decodes(results):
    assert "waypoint_1_error_cm" in trained(results, "name=recorded", "demos=back", "task=BACK")
    target, description = load_target(results / "artifacts/target/recorded")
    assert description.observation.state == 7
    image = np.zeros((SIZE, SIZE, 3), np.uint8)
    shown = Observation(np.full(7, 0.1), np.full(7, 0.1), "pick up the peg", {"front": image})
    assert Decoder(target).decode(shown).actions.shape == (target.chunk, 7)


def edited(results: Path, tmp_path: Path, **changes: Any) -> Path:
    return changed(results / "lerobot/pegs", tmp_path, "meta/info.json", **changes)


@pytest.mark.parametrize(
    ("changes", "words", "said"),
    [
        ({}, ["source="], "source=DIR"),
        ({"codebase_version": "v2.1"}, [], "python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id="),
        ({"features": {"action": {"dtype": "float32", "shape": [7]}}}, [], "no images"),
        ({}, ["camera=side"], "unknown camera 'side': known: front"),
        ({}, ["strict=[jaw]"], "unknown strict DoF 'jaw'"),
        ({}, ["environment=kitchen"], "unknown environment 'kitchen'"),
        ({"fps": 10}, ["environment=insertion"], "20 control steps per second"),
        ({}, ["name=front"], "another name"),
        ({}, ["name=metaworld"], "'metaworld' is an environment of kerv"),
        ({"data_path": "{chunk}"}, [], "not as LeRobot writes it"),
    ],
)
def test_an_import_refuses_in_one_line(results, tmp_path, changes, words, said):
    source = edited(results, tmp_path, **changes)
    (tmp_path / "artifacts/demos/front").mkdir(parents=True)
    given = words if words and words[0].startswith("source=") else [f"source={source}", *words]
    assert said in refusal("demos", "import", *given, f"results={tmp_path}")


def test_a_folders_name_may_begin_with_a_digit_and_no_dof_need_be_strict(results, tmp_path, monkeypatch):
    monkeypatch.setitem(registry._PARTS, "environment", dict(registry._PARTS["environment"]))
    source = edited(results, tmp_path).rename(tmp_path / "2024_lift")
    kerv("demos", "import", f"source={source}", "episodes=1", "strict=[]", f"results={tmp_path}")
    assert specs()["2024_lift"].suites["2024_LIFT"]
    assert DemoDataset.open(tmp_path / "artifacts/demos/2024_lift").manifest.actions.strict == ()


def rewritten(source: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    """Change the table of a dataset, whose rows then make one episode."""
    data, episodes = source / DATA.format(chunk_index=0, file_index=0), source / "meta/episodes/chunk-000"
    rows = change(pq.read_table(data))
    number = rows.column_names.index("episode_index")
    rows = rows.set_column(number, "episode_index", pa.array(np.zeros(len(rows), np.int64)))
    pq.write_table(rows, data, compression="zstd")
    first = pq.read_table(episodes / "file-000.parquet").slice(0, 1).to_pylist()[0]
    pq.write_table(pa.Table.from_pylist([{**first, "length": len(rows)}]), episodes / "file-000.parquet")


def long_action(rows: pa.Table) -> pa.Table:
    """Every action is 20 million zeros: some kilobytes on disk."""
    zeros = pa.array([np.zeros(20_000_000, np.float32)])
    return rows.slice(0, 1).set_column(rows.column_names.index("action"), "action", zeros)


def long_cells(rows: pa.Table) -> pa.Table:
    """1.5 GB of cells in a small file."""
    picture = {"bytes": encode_png(np.zeros((8, 8, 3), np.uint8)) + bytes(5_000_000)}
    rows = pa.concat_tables([rows.slice(0, 1)] * 300)
    return rows.set_column(
        rows.column_names.index("observation.images.front"), "observation.images.front", pa.array([picture] * 300)
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (None, ("info.json", "at most 65536 numbers")),
        (long_action, ("file-000.parquet", "action has 20000000 numbers per row")),
        (long_cells, ("file-000.parquet", "more than 1024 MiB in memory: split it")),
    ],
)
def test_a_dataset_that_is_too_large_is_refused_in_one_line(results, tmp_path, change, said):
    source = edited(results, tmp_path)
    if change is None:
        info = json.loads((source / "meta/info.json").read_text())
        info["features"]["action"]["shape"] = [2**20, 2**20]
        (source / "meta/info.json").write_text(json.dumps(info))
    else:
        rewritten(source, change)
    begun, before = time.monotonic(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused = refusal("demos", "import", f"source={source}", "name=small", f"results={tmp_path}", code=1)
    assert all(word in refused for word in said)
    assert time.monotonic() - begun < 10
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2 * 2**20  # kilobytes


def test_episodes_may_be_in_any_order_and_a_truncated_table_is_refused(results, tmp_path):
    source = edited(results, tmp_path)
    data = source / DATA.format(chunk_index=0, file_index=0)
    pq.write_table(pq.read_table(data).sort_by([("episode_index", "descending")]), data)
    kerv("demos", "import", f"source={source}", "name=order", f"results={tmp_path}")
    before, after = both(results)[0], DemoDataset.open(tmp_path / "artifacts/demos/order")
    for index in range(4):
        ours, theirs = before.load(index), after.load(index)
        assert ours.steps == theirs.steps
        assert {tuple(step) for step in ours.states} == {tuple(step) for step in theirs.states}
    data.write_bytes(data.read_bytes()[:-2000])
    assert data.name in refusal("demos", "import", f"source={source}", "name=cut", f"results={tmp_path}", code=1)


def test_imports_whose_names_differ_in_a_dash_are_environments_of_their_own(results, tmp_path, monkeypatch):
    own = {name: part for name, part in registry._PARTS["environment"].items() if part.module != dataset_module}

    def alone(*words: str, code: int | None = 0) -> str:
        """Run a command that knows no other import, as in a process of its own."""
        monkeypatch.setitem(registry._PARTS, "environment", dict(own))
        return told(*words, f"results={tmp_path}", code=code)

    source = edited(results, tmp_path)
    for name, episodes in (("my-data", 0), ("my_data", 1)):
        alone("demos", "import", f"source={source}", f"name={name}", f"episodes={episodes}")
    for name, tasks in (("my-data", 2), ("my_data", 1)):
        words = [f"demos={name}", f"task={name.upper()}", "target=nano", "target.grid=1", "name=own", "--plan"]
        sizes = [f"target.image_size={SIZE}", f"world.camera.size={SIZE}"]
        # one episode is too few to train on: the command still finds it in its own environment
        assert ("record at least two" in alone("train", "target", *words, *sizes, code=None)) == (tasks == 1)
        assert len(specs()[name].tasks) == tasks
    DemoDataset.open(tmp_path / "artifacts/demos/my-data")
    assert [len(specs()[name].tasks) for name in ("my-data", "my_data")] == [2, 1]


def test_a_dataset_with_videos_is_read(results, tmp_path):
    av = pytest.importorskip("av")
    source = edited(results, tmp_path)
    info = json.loads((source / "meta/info.json").read_text())
    key = "observation.images.front"
    info["features"][key]["dtype"] = "video"
    before = both(results)[0]
    frames = np.concatenate([before.load(i).frames for i in range(4)])
    path = source / info["video_path"].format(video_key=key, chunk_index=0, file_index=0)
    path.parent.mkdir(parents=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=20)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = SIZE, SIZE, "yuv420p", 4_000_000
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    (source / "meta/info.json").write_text(json.dumps(info))
    rows = pq.read_table(source / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    for row in rows:
        first, last = row["dataset_from_index"], row["dataset_to_index"]
        place = {"chunk_index": 0, "file_index": 0, "from_timestamp": first / 20, "to_timestamp": last / 20}
        row |= {f"videos/{key}/{name}": value for name, value in place.items()}
    pq.write_table(pa.Table.from_pylist(rows), source / "meta/episodes/chunk-000/file-000.parquet")
    data = source / "data/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(data).drop_columns([key]), data)
    kerv("demos", "import", f"source={source}", "name=video", f"results={tmp_path}")
    after = DemoDataset.open(tmp_path / "artifacts/demos/video")
    for index in range(4):
        ours, theirs = (np.asarray(dataset.load(index).frames).astype(int) for dataset in (before, after))
        own = np.abs(ours - theirs).mean()
        shifted = np.abs(ours[1:] - theirs[:-1]).mean()
        assert own < 6  # grey levels: what the codec loses
        assert own < shifted
    path.write_bytes(path.read_bytes()[:1000])
    assert path.name in refusal("demos", "import", f"source={source}", "name=cut", f"results={tmp_path}", code=1)


# --- demonstrations and files of other actions


TARGET = "policy.target=nano-state"


@pytest.fixture(scope="module")
def spaces(policies, tmp_path_factory):
    """A policy of Meta-World, and demonstrations of another environment."""
    spaces = tmp_path_factory.mktemp("spaces") / "spaces"
    shutil.copytree(policies, spaces)
    record(DemoConfig(("insert-peg",), 4, frame_stride=16, workers=1), spaces / "artifacts/demos/pegs")
    return spaces


@pytest.mark.parametrize(
    ("command", "owner"),
    [
        (["train", "target", "task=drawer-close", "name=new", "target.observation=state"], "environment metaworld"),
        (["train", "drafter", TARGET], "the target"),
        (["build", "datastore", "task=drawer-close", TARGET], "the target"),
    ],
)
def test_demonstrations_of_another_environment_are_refused_at_once(spaces, command, owner):
    line = refusal(*command, "demos=pegs", f"results={spaces}", "--plan")
    assert "artifacts/demos/pegs has an action space with names dx, dy, dz, droll" in line
    assert f"{owner} one with dx, dy, dz, gripper" in line


def test_a_fine_tuned_target_must_be_of_the_demonstrations_environment(spaces):
    words = ["train", "target", "task=insert-peg", "name=new", "target=nano", "target.observation=state"]
    words += ["train.init=nano-state", "demos=pegs", "world.camera.name=front", f"results={spaces}"]
    assert "the target in" in refusal(*words)


@pytest.mark.bits
@pytest.mark.usefixtures("quick_training")
def test_a_policy_of_seven_dofs_is_trained_and_decodes_with_its_drafters(spaces):
    common = ["demos=pegs", "train.steps=4", "train.batch=4", "train.validate_every=2", "train.held_out=0.34"]
    common.append(f"results={spaces}")
    words = ["task=insert-peg", "name=arm", "target=nano", "target.observation=state", "world.camera.name=front"]
    kerv("train", "target", *words, *common)
    for kind in ("drafter", "early"):
        words = [f"drafter={kind}", "policy.target=arm", "drafter.samples=12"]
        kerv("train", "drafter", *words, *common)
    target, description = load_target(spaces / "artifacts/target/arm")
    loaded = of_target(description, target)
    drafter = EagleDrafter().load(spaces / "artifacts/drafter/arm", loaded)
    early = EarlyDrafter().load(spaces / "artifacts/early/arm", loaded)
    assert early.scale.min() > 0
    assert early.scale.std() > 0  # it knows the spread of what it was shown
    assert early.strict.tolist() == [dof == 6 for dof in range(7)] * target.chunk
    shown = Observation(np.full(7, 0.1), np.full(19, 0.1), "turn the peg and push it into the tilted slot")
    plain = Decoder(target).decode(shown)
    assert plain.actions.shape == (target.chunk, 7)
    tree = Parts(proposer=DrafterProposer(drafter, target, 5, 3, 12))
    for parts in (tree, Parts(prefill_draft=EarlyProposer(early, target))):
        assert Decoder(target, parts).decode(shown).tokens == plain.tokens


def test_a_small_parquet_file_that_expands_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "MOST_EXPANDED", 2**24)
    for name, column in enumerate((pa.array(["x" * 1000] * 50_000), np.zeros(2**22))):
        path = tmp_path / f"{name}.parquet"
        pq.write_table(pa.table({"a": column}), path, compression="zstd")
        with pytest.raises(ValueError, match="expands to more than"):
            files.foreign_table(path, ["a"])
    pq.write_table(pa.table({"a": [1, 2, 3], "b": ["x", "y", "z"]}), path, row_group_size=1)
    assert files.foreign_table(path, ["b", "c"]).to_pylist() == [{"b": "x"}, {"b": "y"}, {"b": "z"}]
