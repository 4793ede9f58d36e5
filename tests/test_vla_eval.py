"""vla-eval in both directions: kerv serves its benchmarks, Meta-World is one of them, and recordings become studies."""

import io
import json
import re
import shutil
import sqlite3
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio
import msgpack
import numpy as np
import pytest
import vla_eval
from command import kerv, refusal, told
from examples.tiny_openvla import write_checkpoint
from PIL import Image
from studies_synthetic import swept, threshold_study
from test_serve import serving
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.orchestrator import Orchestrator
from vla_eval.recording import RecordingStore
from vla_eval.specs import GRIPPER_CLOSE_POS, IMAGE_RGB, LANGUAGE, POSITION_DELTA, ROTATION_AA, DimSpec, check_specs
from websockets.sync.client import connect

from kerv_cli.base.config import compose
from kerv_cli.base.errors import UsageError
from kerv_cli.catalogue.evaluations import labelled, read_evaluations, read_served
from kerv_cli.episodes.runner import Runner
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.serve import vla_eval as serve_vla_eval
from kerv_cli.serve.policy import Policy
from kerv_cli.serve.settings import ServeSettings
from kerv_cli.serve.vla_eval import dim_specs
from kerv_cli.worlds.vla_eval import MetaWorld

pytestmark = pytest.mark.usefixtures("quick_report")

HORIZON = 10
PARAMS = {"tasks": ["reach"], "seed": 100_000, "horizon": HORIZON}


@pytest.fixture(scope="module")
def results(policies, tmp_path_factory):
    """The policies in a folder that may be written to; the one that sees names its camera, as trained ones do."""
    copy = shutil.copytree(policies, tmp_path_factory.mktemp("results") / "results")
    path = copy / "artifacts" / "target" / "nano-vision" / "target.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"cameras": ["corner4"]}))
    return copy


def policy_of(results: Path, target: str, *words: str) -> Policy:
    typed = ["protocol=vla_eval", f"policy.target={target}", f"results={results}", *words]
    return Policy(compose("serve", typed, ServeSettings))


def config_of(benchmark: str, episodes: int = 2, **params: Any) -> dict[str, Any]:
    return {"benchmarks": [{"benchmark": benchmark, "episodes_per_task": episodes, "params": params}]}


METAWORLD = config_of("kerv_cli.worlds.vla_eval:MetaWorld", **PARAMS)


def evaluated(policy: Policy, config: Mapping[str, Any], folder: Path, name: str) -> Path:
    """Serves the policy and runs the benchmark as `vla-eval run --no-docker` does -> its recording."""
    with serving(policy) as (port, _):
        run(config, f"ws://127.0.0.1:{port}", folder, name)
    return folder / f"recording-{name}.sqlite"


def run(config: Mapping[str, Any], url: str, folder: Path, name: str) -> list[dict[str, Any]]:
    return vla_eval.run(dict(config), server_url=url, output_dir=folder, eval_id=name)


# --- kerv's policies as a model server


@pytest.mark.bits
@pytest.mark.parametrize(("target", "words"), [("nano-state", ["method=ar"]), ("nano-vision", ["method=spec_vla"])])
def test_a_benchmark_run_by_vla_eval_has_the_episodes_of_a_rollout(results, tmp_path, target, words):
    name = f"{target}-{words[0][7:]}"
    evaluated(policy_of(results, target, *words), METAWORLD, tmp_path, name)
    typed = [f"policy.target={target}", f"results={results}", f"world.horizon={HORIZON}", "episodes=2", *words]
    settings = compose("rollout", [*typed, "record=0"], RolloutSettings)
    served = {}
    for path in (results / "served" / f"{name}-MetaWorld").iterdir():
        episode = read_served(path)
        served[episode[0]["task"], episode[0]["seed"]] = episode
    for record in map(Runner(settings, "reach-v3").episode, (100_000, 100_001)):
        row, table = served.pop(("reach-v3", record.seed))
        decodes = table.to_pylist()
        assert (row["success"], row["steps"], row["forwards"]) == (record.success, record.steps, record.forwards)
        assert [one["tokens"] for one in decodes] == [list(one.tokens) for one in record.decodes]
        assert [one["mode"] for one in decodes] == [one.mode for one in record.decodes]
        assert row["path_length"] == pytest.approx(record.path_length)
        assert all(one["seconds"] > 0 for one in decodes)
    assert not served


class Client:
    """Speaks vla-eval's protocol and nothing else."""

    def __init__(self, port: int) -> None:
        self.connection = connect(f"ws://127.0.0.1:{port}", compression=None, max_size=None).__enter__()
        self.seq = 0

    def tell(self, kind: str, payload: Any) -> None:
        self.seq += 1
        message = {"type": kind, "payload": payload, "seq": self.seq, "timestamp": 0.0}
        self.connection.send(msgpack.packb(message, default=plain))

    def ask(self, kind: str, payload: Any) -> tuple[str, Any]:
        self.tell(kind, payload)
        return self.hear()

    def hear(self) -> tuple[str, Any]:
        answer = msgpack.unpackb(self.connection.recv(5))
        assert answer["seq"] == self.seq or answer["type"] == "error"
        return answer["type"], answer["payload"]

    def act(self, **changes: Any) -> np.ndarray:
        kind, payload = self.ask("observation", {**seen(0), **changes})
        assert kind == "action", payload
        made = payload["actions"]
        return np.frombuffer(made["data"], made["dtype"]).reshape(made["shape"])


def plain(value: Any) -> Any:
    """An array as vla-eval writes it: an image as PNG."""
    if value.ndim == 3:
        file = io.BytesIO()
        Image.fromarray(value).save(file, "PNG")
        return {"__image__": True, "format": "png", "data": file.getvalue(), "shape": list(value.shape)}
    return {"__ndarray__": True, "data": value.tobytes(), "dtype": value.dtype.str, "shape": list(value.shape)}


def seen(seed: int) -> dict[str, Any]:
    random = np.random.default_rng(seed)
    image = random.integers(0, 256, (96, 96, 3), dtype=np.uint8)
    return {"images": {"corner4": image}, "task_description": "open a drawer", "state": random.normal(size=4)}


@pytest.fixture(scope="module")
def policy(results):
    return policy_of(results, "nano-vision")


def test_hello_says_what_the_policy_reads_and_sends(policy):
    with serving(policy) as (port, _):
        kind, about = Client(port).ask("hello", {"protocol_version": 1, "harness_version": "0.8.0"})
    assert kind == "hello"
    assert (about["protocol_version"], about["model_server"]) == (1, "kerv")
    assert about["observation_params"] == {"camera": "corner4", "image_size": 96}
    assert about["kerv"]["settings"]["method"] == "ar"
    own = {key: {name: DimSpec.from_dict(one) for name, one in about[key].items()} for key in about if "spec" in key}
    world = MetaWorld()
    pair = own["action_spec"], world.get_action_spec(), own["observation_spec"], world.get_observation_spec()
    assert check_specs(*pair) == []


BLACK = np.zeros((96, 96, 3), np.uint8)
NO_PNG = {"__image__": True, "format": "png", "data": b"cat"}
BOMB = {"__image__": True, "format": "raw", "data": b"", "dtype": "<f8", "shape": [2**40]}


@pytest.mark.parametrize(
    ("kind", "payload", "said"),
    [
        ("hello", {"protocol_version": 9}, "protocol version 9 is unknown: this server speaks version 1"),
        ("greeting", {}, "a message of type greeting: send hello, episode_start, observation, episode_end"),
        ("observation", [1], "a message of type observation"),
        ("observation", {"state": [0.0] * 4, "images": {"corner2": BLACK}}, "images of corner2"),
        ("observation", {"state": [0.0] * 4, "images": {"corner4": BLACK[:64, :64]}}, "images.corner4 is (64, 64, 3)"),
        ("observation", {"state": [0.0] * 4, "images": {"corner4": NO_PNG}}, "cannot be read as PNG or JPEG"),
        ("observation", {"state": [0.0] * 4, "images": {"corner4": BOMB}}, "does not fit its bytes"),
        ("observation", {"state": [0.0] * 7, "images": {"corner4": BLACK}}, "4 or 39 numbers are wanted"),
    ],
)
def test_a_wrong_message_gets_one_line_and_the_next_one_an_answer(policy, kind, payload, said):
    with serving(policy) as (port, log):
        client = Client(port)
        answer, told = client.ask(kind, payload)
        assert answer == "error"
        assert said in told["error"]
        assert "\n" not in told["error"]
        assert any(said in line for line in log)
        assert client.act().shape == (4,)


def test_an_episode_that_never_ends_is_refused_before_it_fills_the_memory(policy, monkeypatch):
    monkeypatch.setattr(serve_vla_eval, "MOST_STEPS", 6)
    with serving(policy) as (port, _):
        client = Client(port)
        for _ in range(6):
            client.act()
        kind, told = client.ask("observation", seen(0))
        assert (kind, "6 control steps" in told["error"]) == ("error", True)
        client.tell("episode_end", {})
        assert client.act().shape == (4,)


def test_names_that_are_no_file_names_are_not_kept(policy, results):
    with serving(policy) as (port, _):
        client = Client(port)
        client.tell("episode_start", {"recording": {"eval_id": "../../outside", "eid": "x"}})
        client.act()
        client.tell("episode_end", {"metrics": {"success": True}})
        client.act()
    assert not list(results.parent.rglob("x.arrow"))


# --- Meta-World as a benchmark


@pytest.mark.parametrize(
    ("params", "said"),
    [
        ({"tasks": "reech"}, "unknown task or suite 'reech'"),
        ({"camera": "corner9"}, "unknown camera 'corner9'"),
        ({"horizon": 501}, "horizon=501"),
        ({"stress": "earthquake", "stress_level": 1}, "unknown world.stress.kind|unknown stress"),
        ({"seed": -1}, "seed"),
    ],
)
def test_a_benchmark_that_cannot_be_says_so(params, said):
    with pytest.raises(UsageError, match=said):
        MetaWorld(**params).reset({"name": "reach-v3"})


class Scripted(PredictModelServer):
    """A model server of vla-eval's own: moves towards the goal, which is privileged."""

    def get_observation_params(self) -> dict[str, Any]:
        return {"privileged": True, "send_images": False}

    def get_action_spec(self) -> dict[str, DimSpec]:
        return {"position": POSITION_DELTA, "gripper": GRIPPER_CLOSE_POS}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        return {"language": LANGUAGE, "state": DimSpec("state", 39, "privileged39")}

    def predict(self, obs: dict[str, Any], ctx: Any) -> dict[str, Any]:
        move = np.clip(10 * (obs["state"][36:39] - obs["state"][:3]), -1, 1)
        return {"actions": np.append(move, 0.0)}


@pytest.fixture(scope="module")
def recordings(results, tmp_path_factory):
    """Evaluations of the same episodes, served by kerv and by vla-eval's own server."""
    root = tmp_path_factory.mktemp("recordings")
    config = config_of("kerv_cli.worlds.vla_eval:MetaWorld", 3, **{**PARAMS, "horizon": 40})
    there = {
        method: evaluated(policy_of(results, "nano-state", f"method={method}"), config, root / method, method)
        for method in ("ar", "naive_sd")
    }
    with vla_eval.serve_background(Scripted()) as server:
        run(config, server.url, root / "scripted", "scripted")
    return {**there, "scripted": root / "scripted" / "recording-scripted.sqlite"}


# --- recordings as studies


def test_evaluations_of_the_same_episodes_are_paired(results, recordings):
    said = told("runs", "import", *map(str, recordings.values()), "name=three", f"results={results}", "--json")
    rows = {r["label"]: r for r in json.loads(said)["settings"] if r["averaging"].startswith("micro")}
    assert list(rows) == ["ar", "naive_sd", "Scripted"]
    assert rows["naive_sd"]["pairs"] == rows["Scripted"]["pairs"] == rows["Scripted"]["only_method"] == 3
    assert rows["naive_sd"]["time_per_step_ms"] > 0
    assert rows["naive_sd"]["forwards_per_step"] <= rows["ar"]["forwards_per_step"] == 4
    assert rows["Scripted"]["time_per_step_ms"] is None
    (scripted,) = read_evaluations(recordings["scripted"])
    assert len({episode.start for episode in scripted.episodes}) == 3
    assert rows["naive_sd"]["speedup"] is None, "the evaluations did not take turns"
    assert rows["ar"]["target_sha256"]
    report = told("report", "study=three", f"results={results}")
    assert "Scripted" in report
    assert "three" in told("runs", "list", f"results={results}")
    assert "success" in told("runs", "compare", "three:ar", "three:Scripted", f"results={results}")
    assert "three" in told("report", "--choose", "study=three", "loss=50", f"results={results}")
    about = json.loads((results / "report/tables/three.json").read_text())["labels"].values()
    assert {one["provenance"]["executor"] for one in about} == {"vla-eval"}
    assert "only sweeps and rollouts" in told("runs", "rerun", "three", f"results={results}", code=2)


def test_an_import_again_replaces_the_study_and_no_other(results, recordings):
    for _ in range(2):
        told("runs", "import", str(recordings["ar"]), "name=again", "labels=mine", f"results={results}")
    assert "mine" in told("runs", "show", "again", f"results={results}")
    swept(results, threshold_study(["reach-v3"], name="own"))
    refused = kerv("runs", "import", str(recordings["ar"]), "name=own", f"results={results}", code=2)
    assert "study 'own' exists and was not imported" in refused.output


def test_a_killed_shard_leaves_episodes_that_are_missing_until_it_ran_again(results, tmp_path):
    config = config_of("kerv_cli.worlds.vla_eval:MetaWorld", 4, **{**PARAMS, "horizon": 5})
    config["output_dir"] = str(tmp_path)
    claim = RecordingStore.claim

    def killed(self, *arguments):
        """Shard 1 claims an episode and is never heard of again."""
        item = claim(self, *arguments)
        if arguments[1] == 1:
            raise KeyboardInterrupt
        return item

    with serving(policy_of(results, "nano-state")) as (port, _), pytest.MonkeyPatch.context() as patch:
        config["server"] = {"url": f"ws://127.0.0.1:{port}"}
        patch.setattr(RecordingStore, "claim", killed)
        with pytest.raises(KeyboardInterrupt):
            anyio.run(Orchestrator(config, 1, 2, "shards").run)
        anyio.run(Orchestrator(config, 0, 2, "shards").run)
        patch.undo()
        words = ["runs", "import", str(tmp_path), "name=shards", f"results={results}"]
        assert "ar: 1 of 4 episodes of MetaWorld are missing" in told(*words)
        assert "3 of 4 episodes" in told("runs", "show", "shards", f"results={results}")
        anyio.run(Orchestrator(config, 1, 2, "shards").run)
    assert "missing" not in told(*words)
    assert re.search(r"state +complete", told("runs", "show", "shards", f"results={results}"))


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _empty(path: Path) -> None:
    with sqlite3.connect(path) as file:
        file.execute("DELETE FROM episode_results")


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (_cut, "is damaged, cut short or no recording"),
        (_empty, "the recording holds no episode"),
        (Path.unlink, "does not exist"),
    ],
)
def test_a_harmed_recording_is_refused_in_one_line(recordings, tmp_path, harm, said):
    path = tmp_path / "recording-x.sqlite"
    shutil.copy(recordings["ar"], path)
    harm(path)
    assert said in refusal("runs", "import", str(path), f"results={tmp_path}")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"config": {"params": {**PARAMS, "horizon": 40, "seed": 5}}}, "params.seed is 100000 and 5"),
        ({"benchmark": "LIBERO"}, "have different benchmarks: MetaWorld and LIBERO"),
        ({"episodes": ()}, "have no episode in common"),
    ],
)
def test_evaluations_of_other_episodes_are_refused(recordings, changes, said):
    (first,), (second,) = (read_evaluations(recordings[name]) for name in ("ar", "naive_sd"))
    changes = {**changes, **({"config": {**second.config, **changes["config"]}} if "config" in changes else {})}
    with pytest.raises(UsageError, match=said):
        labelled([[first], [replace(second, **changes)]])
    with pytest.raises(UsageError, match="each of the 2 recordings"):
        labelled([[first], [second]], ["one"])


def test_a_folder_with_recordings_of_two_servers_is_refused(recordings, tmp_path):
    for name in ("ar", "naive_sd"):
        shutil.copy(recordings[name], tmp_path)
    with pytest.raises(UsageError, match="of several servers: name each file"):
        read_evaluations(tmp_path)


# --- LIBERO up to its container (docs/libero.md)


class Stand(StepBenchmark):
    """In LIBERO's place: its observations, actions, specs and settle steps, in a world of noise."""

    def __init__(self, suite: str = "libero_spatial") -> None:
        super().__init__()
        self.suite, self.steps = suite, 0

    def get_tasks(self) -> list[dict[str, Any]]:
        names = ("pick up the cup", "open the drawer")
        return [{"name": name, "suite": self.suite, "task_id": number} for number, name in enumerate(names)]

    def reset(self, task: dict[str, Any]) -> Any:
        self.steps, self.sum = 0, 0.0
        self.random = np.random.default_rng([7, task["task_id"], task["episode_idx"]])
        return self.random.integers(0, 256, (256, 256, 3), dtype=np.uint8)

    def step(self, action: dict[str, Any]) -> StepResult:
        values = np.asarray(action["actions"])
        assert values.shape == (7,)
        assert values[-1] in (-1.0, 1.0)
        self.steps += 1
        self.sum += float(values[:6].sum())
        return StepResult(self.random.integers(0, 256, (256, 256, 3), dtype=np.uint8), 0.0, self.steps >= 3, {})

    def make_obs(self, raw_obs: Any, task: dict[str, Any]) -> dict[str, Any]:
        return {"images": {"agentview": raw_obs}, "task_description": task["name"]}

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        return {"success": self.sum > 0}

    def get_metadata(self) -> dict[str, Any]:
        return {"max_steps": 220, "max_episodes_per_task": 50, "suite": self.suite}

    def get_action_spec(self) -> dict[str, DimSpec]:
        return {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": GRIPPER_CLOSE_POS}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        return {"agentview": IMAGE_RGB, "language": LANGUAGE}


def test_openvla_on_liberos_interface_from_checkpoint_to_paired_table(tmp_path):
    results = tmp_path / "results"
    checkpoint = write_checkpoint(tmp_path / "checkpoint")
    built = ["target=openvla", f"checkpoint={checkpoint}", "name=libero", "camera=agentview", "control_hz=20"]
    told("build", "target", *built, "crop=true", "libero=true", "prompt_tokens=120", f"results={results}")
    config = config_of(f"{__name__}:Stand", 2, suite="libero_spatial")
    recordings = []
    for method in ("ar", "jacobi"):
        policy = policy_of(results, "libero", f"method={method}", "gripper=signed_inverted")
        stand = Stand()
        own = {k: {n: DimSpec.from_dict(d) for n, d in v.items()} for k, v in dim_specs(policy.interface).items()}
        pair = own["action_spec"], stand.get_action_spec(), own["observation_spec"], stand.get_observation_spec()
        assert check_specs(*pair) == []
        recordings.append(str(evaluated(policy, config, tmp_path / method, method)))
    said = told("runs", "import", *recordings, "name=libero", f"results={results}", "--json")
    rows = {row["label"]: row for row in json.loads(said)["settings"] if row["averaging"].startswith("micro")}
    assert rows["jacobi"]["pairs"] == 4
    assert rows["jacobi"]["difference"] == 0
    assert rows["ar"]["forwards_per_step"] == 7
    assert rows["jacobi"]["task"] == "open the drawer;pick up the cup"
