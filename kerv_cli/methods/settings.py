"""Settings of policies and of the methods by which they decode."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from kerv_cli.base.limits import choice, number, setting
from kerv_cli.base.registry import METHOD_KINDS, parts
from kerv_cli.base.settings import RunSettings, part

MODEL, EXPERT = "model", "expert"


def _unnamed() -> dict[str, str | None]:
    return dict.fromkeys(parts("artifact"))


@dataclass
class PolicySettings:
    """What chooses the actions. Weights are named by folders of results/pretrained or results/artifacts, or paths."""

    kind: str = choice(MODEL, MODEL, EXPERT, help="expert: the environment's script, privileged, no decoding")
    target: str = setting("mt10-vision", "the policy's weights")
    artifacts: dict[str, str | None] = setting(_unnamed, "artifacts.KIND=NAME; null: the one beside the target")


def with_artifacts(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return stored settings with the names of artifacts in one mapping. Version 0.1.0 has a key for each kind."""
    policy = settings.get("policy")
    if not isinstance(policy, Mapping) or "artifacts" in policy:
        return dict(settings)
    named = {kind: policy.get(kind) for kind in parts("artifact")} | dict(policy.get("others", {}))
    kept = {key: value for key, value in policy.items() if key not in (*named, "others")}
    return {**settings, "policy": {**kept, "artifacts": {kind: name for kind, name in named.items() if name}}}


# descriptions of settings that several commands have
POLICY = "what chooses the actions: vision, state, expert, … (conf/policy)"


@dataclass(kw_only=True)
class MethodSettings(RunSettings):
    """A policy and the method by which it decodes. The parts are settings of the classes in kerv_cli/methods."""

    policy: PolicySettings = setting(PolicySettings, POLICY)
    method: str = setting("ar", "how it decodes: ar, spec_vla, kerv, heisd, one_pass, … (conf/method)")
    prefill_draft: Any = part("proposer", help="what drafts before the prefill")
    proposer: Any = part("proposer", help="what drafts after the prefill: none, drafter, retrieval, hold, …")
    acceptance: Any = part("acceptance", "strict", "which drafted tokens count as right: strict, relaxed, …")
    threshold: Any = part("threshold", "fixed", "how many bins a relaxed acceptance forgives: threshold.r")
    rectifier: Any = part("rectifier", "reinfer", "what becomes of rejected tokens")
    boundary: Any = part("boundary", "always", "where retrieved drafts are used")
    skip: Any = part("skip", help="which drafts are executed without verification")
    chunk: int = number(0, 0, 1024, help="H, control steps decoded at once; 0: as many as the target was trained for")
    datastore: Any = part("datastore", "exact", "what searches the stored chunks")

    def parts(self) -> dict[str, Any]:
        """Return kind -> settings, for every part of the method."""
        return {kind: getattr(self, kind) for kind in METHOD_KINDS}
