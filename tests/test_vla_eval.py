"""vla-eval runs benchmarks against policies that kerv serves, up to LIBERO's interface."""

import io
import json
import shutil
from pathlib import Path
from typing import Any, ClassVar

import msgpack
import numpy as np
import pytest
import vla_eval
from command import told
from examples.tiny_openvla import write_checkpoint
from PIL import Image
from test_serve import serving
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.specs import GRIPPER_CLOSE_POS, IMAGE_RGB, LANGUAGE, POSITION_DELTA, ROTATION_AA, DimSpec, check_specs
from websockets.sync.client import connect

from kerv_cli.base.config import compose
from kerv_cli.episodes.runner import Runner
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.serve import vla_eval as serve_vla_eval
from kerv_cli.serve.policy import Policy
from kerv_cli.serve.settings import ServeSettings
from kerv_cli.serve.vla_eval import dim_specs
from kerv_cli.worlds import spec_of
from kerv_cli.worlds.settings import CameraSettings

HORIZON = 10


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


class Reach(StepBenchmark):
    """Meta-World's reach-v3 as a benchmark. `executed` keeps the actions and states of every episode."""

    executed: ClassVar[dict[int, list[np.ndarray]]] = {}

    def __init__(self) -> None:
        super().__init__()
        self.spec = spec_of("reach-v3")
        self.camera = self.spec.camera(CameraSettings("corner4"))
        self.world: Any = self.spec.open_world("reach-v3", self.camera, HORIZON)

    def get_tasks(self) -> list[dict[str, Any]]:
        return [{"name": "reach-v3", "suite": "MT10", "seed": 100_000}]

    def reset(self, task: dict[str, Any]) -> Any:
        seed = task["seed"] + task["episode_idx"]
        self.actions = self.executed[seed] = []
        return self.world.reset(seed)

    def step(self, action: dict[str, Any]) -> StepResult:
        self.actions.append(np.asarray(action["actions"]))
        return StepResult(self.world.step(self.actions[-1]), float(self.world.success), self.world.done, {})

    def make_obs(self, raw_obs: Any, task: dict[str, Any]) -> dict[str, Any]:
        images = self.world.observe([self.camera.name]).images
        return {"images": images, "task_description": self.world.instruction, "state": raw_obs.state}

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        return {"success": bool(self.world.succeeded)}

    def get_metadata(self) -> dict[str, Any]:
        return {"max_steps": HORIZON}

    def get_action_spec(self) -> dict[str, DimSpec]:
        return {"position": POSITION_DELTA, "gripper": GRIPPER_CLOSE_POS}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        return {}


@pytest.mark.bits
def test_a_benchmark_run_by_vla_eval_has_the_actions_of_a_rollout(results, tmp_path):
    target, words = "nano-vision", ["method=spec_vla"]
    Reach.executed.clear()
    config = {"benchmarks": [{"benchmark": f"{__name__}:Reach", "episodes_per_task": 2, "params": {}}]}
    with serving(policy_of(results, target, *words)) as (port, log):
        vla_eval.run(config, server_url=f"ws://127.0.0.1:{port}", output_dir=tmp_path, eval_id=target)
        assert not [line for line in log if "error" in line]
    typed = [f"policy.target={target}", f"results={results}", f"world.horizon={HORIZON}", "episodes=2", *words]
    settings = compose("rollout", [*typed, "record=0"], RolloutSettings)
    assert sorted(Reach.executed) == [100_000, 100_001]
    for record in map(Runner(settings, "reach-v3").episode, sorted(Reach.executed)):
        np.testing.assert_array_equal(np.stack(Reach.executed[record.seed]), record.actions)


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
    assert "observation_params" not in about  # no benchmark of vla-eval takes kerv's cameras
    assert about["kerv"]["settings"]["method"] == "ar"
    own = {key: {name: DimSpec.from_dict(one) for name, one in about[key].items()} for key in about if "spec" in key}
    world = {"corner4": IMAGE_RGB, "language": LANGUAGE, "state": DimSpec("state", 4, "_".join(OBSERVED))}
    assert check_specs(own["action_spec"], Reach.get_action_spec(None), own["observation_spec"], world) == []


OBSERVED = spec_of("reach-v3").observation.proprioception
BLACK = np.zeros((96, 96, 3), np.uint8)
BOMB = {"__image__": True, "format": "raw", "data": b"", "dtype": "<f8", "shape": [2**40]}


@pytest.mark.parametrize(
    ("kind", "payload", "said"),
    [
        ("hello", {"protocol_version": 9}, "protocol version 9 is unknown: this server speaks version 1"),
        ("greeting", {}, "a message of type greeting: send hello, episode_start, observation, episode_end"),
        ("observation", {"state": [0.0] * 4, "images": {"corner2": BLACK}}, "images of corner2"),
        ("observation", {"state": [0.0] * 4, "images": {"corner4": BLACK[:64, :64]}}, "images.corner4 is (64, 64, 3)"),
        ("observation", {"state": [0.0] * 4, "images": {"corner4": BOMB}}, "does not fit its bytes"),
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


def test_a_task_is_known_by_its_instruction_too(policy):
    """vla-eval's LIBERO sends the instruction as the task's name; imported demonstrations name tasks by its words."""
    spec = spec_of("reach-v3")
    policy.tasks |= {"pick-up-the-black-bowl": "pick-up-the-black-bowl"}
    asked = (spec.task("reach-v3").instruction, "reach-v3", "pick up the black bowl", "something else")
    assert list(map(policy.named, asked)) == ["reach-v3", "reach-v3", "pick-up-the-black-bowl", "something else"]


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


# --- LIBERO up to its container (docs/libero.md)


def test_openvla_is_served_on_liberos_interface(tmp_path):
    results = tmp_path / "results"
    checkpoint = write_checkpoint(tmp_path / "checkpoint")
    built = ["target=openvla", f"checkpoint={checkpoint}", "name=libero", "camera=agentview", "control_hz=20"]
    told("build", "target", *built, "crop=true", "libero=true", "prompt_tokens=120", f"results={results}")
    images = np.random.default_rng(7).integers(0, 256, (3, 256, 256, 3), dtype=np.uint8)
    sent = []
    for method in ("ar", "jacobi"):
        policy = policy_of(results, "libero", f"method={method}", "gripper=signed_inverted")
        own = {k: {n: DimSpec.from_dict(d) for n, d in v.items()} for k, v in dim_specs(policy.interface).items()}
        taken = {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": GRIPPER_CLOSE_POS}
        given = {"agentview": IMAGE_RGB, "language": LANGUAGE}
        assert check_specs(own["action_spec"], taken, own["observation_spec"], given) == []
        with serving(policy) as (port, _):
            client = Client(port)
            sent.append([client.act(images={"agentview": image}, state=None).tolist() for image in images])
    assert {len(action) for action in sent[0]} == {7}
    assert {action[-1] for action in sent[0]} <= {-1.0, 1.0}
    assert sent[0] == sent[1], "Jacobi decoding is lossless"
