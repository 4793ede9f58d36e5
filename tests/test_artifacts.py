"""A policy's files: found, checked, and each loaded and hashed once per process, however many settings share them."""

import hashlib
import json
import os
import shutil
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from conftest import refused
from test_calibration import TASKS, write_dataset

from kerv_cli.base.config import compose
from kerv_cli.base.errors import CheckpointError, UnknownName
from kerv_cli.base.manifests import DIGEST, stamped
from kerv_cli.episodes.policy import check, decoder_for
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.lab.database import Database
from kerv_cli.methods.artifacts import Artifacts, MadeFor
from kerv_cli.methods.eagle.drafter import EagleDrafter
from kerv_cli.methods.early import EarlySettings
from kerv_cli.methods.early.drafter import EarlyDrafter
from kerv_cli.methods.heisd.datastore import Datastore
from kerv_cli.methods.settings import PolicySettings
from kerv_cli.targets import checkpoint
from kerv_cli.training.calibration import plan_calibration
from kerv_cli.training.datastore import plan_datastore
from kerv_cli.training.settings import BuildDatastoreSettings, CalibrateSettings

STUDY = (
    "method=ar",
    "method=spec_vla",
    "method=spec_vla threshold.r=3",
    "method=kerv",
    "method=kerv threshold.k_s=0.3",
    "method=spec_vla proposer=retrieval acceptance=sequence",
    "method=heisd skip.s_min=0.9",
    "method=heisd skip.s_min=0.8 boundary=always_retrieval",
    "method=spec_vla proposer=kalman",
)
FILES = {name: f"{name}.json" for name in ("drafter", "early", "calibration")} | {"datastore": "manifest.json"}


@pytest.fixture(scope="module")
def whole(policies, tmp_path_factory):
    """`nano-state` with everything that belongs to it."""
    results = tmp_path_factory.mktemp("artifacts") / "results"
    shutil.copytree(policies, results)
    write_dataset(results / "artifacts/demos/few")
    policy = PolicySettings(target="nano-state")
    built = BuildDatastoreSettings(policy=policy, demos="few", task=list(TASKS), results=str(results))
    plan_datastore(built, Database(results)).make()
    words = ["task=reach,drawer-close", "demos=few", "decodes=4", "policy.target=nano-state"]
    plan_calibration(compose("calibrate", [*words, f"results={results}"], CalibrateSettings), Database(results)).make()
    target, described = checkpoint.load_target(results / "artifacts/target/nano-state")
    drafter = EarlyDrafter().network(EarlySettings(width=16, layers=1), target)
    own = {"settings": asdict(drafter.settings)}
    EarlyDrafter().save(results / "artifacts/early/nano-state", drafter, MadeFor.of(described), {}, **own)
    return results


@pytest.fixture
def results(whole, tmp_path):
    """A copy: other paths, so nothing of it is loaded yet."""
    return Path(shutil.copytree(whole, tmp_path / "results"))


def settings_of(results: Path, overrides: str) -> RolloutSettings:
    words = ["task=reach", "policy.target=nano-state", f"results={results}", *overrides.split()]
    return compose("rollout", words, RolloutSettings)


def counted(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, counts: Counter[str], key: Any) -> None:
    real = getattr(owner, name)

    def counting(*arguments, **options):
        counts[key(*arguments, **options)] += 1
        return real(*arguments, **options)

    monkeypatch.setattr(owner, name, counting)


def test_a_study_loads_and_hashes_everything_once(results, monkeypatch):
    loaded: Counter[str] = Counter()
    hashed: Counter[str] = Counter()
    counted(monkeypatch, checkpoint, "load_target", loaded, lambda folder, *rest: f"target {folder}")
    counted(monkeypatch, Datastore, "open", loaded, lambda folder, *rest: f"datastore {folder}")
    counted(monkeypatch, EagleDrafter, "network", loaded, lambda *rest: "drafter")
    counted(monkeypatch, hashlib, "file_digest", hashed, lambda file, algorithm: os.path.relpath(file.name, results))
    study = [settings_of(results, overrides) for overrides in STUDY]
    decoders = []
    for _ in range(2):
        for asked in study:
            check(asked)
            check(asked)
            decoders.append(decoder_for(asked, "reach-v3"))
    assert set(loaded.values()) == {1}
    assert len(loaded) == 3
    assert set(hashed.values()) == {1}
    names = {"target/nano-state", "drafter/nano-state", "datastore/nano-state", "calibration/nano-state"}
    assert {os.path.dirname(path).removeprefix("artifacts/") for path in hashed} == names
    assert len({id(decoder.target) for decoder in decoders}) == 1
    assert len({id(decoder) for decoder in decoders}) == len(decoders)  # the state of an episode is a decoder's own


def test_a_changed_file_is_another_artifact(results):
    asked = settings_of(results, "method=spec_vla proposer=retrieval")
    files = Artifacts(asked.results, asked.policy)
    before, store = check(asked), files.load("datastore")
    assert files.load("datastore") is store
    policy = PolicySettings(target="nano-state")
    built = BuildDatastoreSettings(policy=policy, demos="few", task=list(TASKS), results=str(results), episodes=1)
    built.replace = True
    plan_datastore(built, Database(results)).make()
    after = check(asked)
    assert {kind for kind in before if before[kind] != after[kind]} == {"datastore"}
    again = Artifacts(asked.results, asked.policy).load("datastore")
    assert len(again.vectors) < len(store.vectors)


def test_an_artifact_can_be_named(results):
    shutil.move(results / "artifacts/drafter/nano-state", results / "artifacts/drafter/better")
    files = Artifacts(str(results), PolicySettings(target="nano-state", artifacts={"drafter": "better"}))
    assert files.path("drafter") == results / "artifacts/drafter/better"
    files.check(["drafter"])
    by_path = PolicySettings(target="nano-state", artifacts={"drafter": str(results / "artifacts/drafter/better")})
    assert Artifacts(str(results), by_path).check(["drafter"]) == files.check(["drafter"])
    with pytest.raises(UnknownName, match="did you mean drafter"):
        files.check(["draftr"])


# --- one rule for every artifact that names a source

OTHER = "f" * 64
MESSAGE = f" {OTHER[:12]}, not for "


@pytest.mark.parametrize("kind", FILES)
def test_what_was_made_for_another_target_is_refused(results, kind):
    files = Artifacts(str(results), PolicySettings(target="nano-state"))
    assert set(files.check(FILES)) == {"target", *FILES}
    path = results / "artifacts" / kind / "nano-state" / FILES[kind]
    described = json.loads(path.read_text())
    described["target"] = {**described["target"], "sha256": OTHER} if isinstance(described["target"], dict) else OTHER
    hashed = described.pop(DIGEST, None)
    path.write_text(json.dumps(stamped(described) if hashed else described))
    with refused(MESSAGE, error=CheckpointError):
        files.check(FILES)


def test_what_was_made_from_another_artifact_is_refused_beside_this_one(whole, monkeypatch):
    files = Artifacts(str(whole), PolicySettings(target="nano-state"))
    monkeypatch.setattr(EarlyDrafter, "sources", lambda self, description: {"datastore": OTHER})
    with refused(MESSAGE, error=CheckpointError):
        files.check(FILES)
    files.check([kind for kind in FILES if kind != "datastore"])  # what is not in use does not matter
