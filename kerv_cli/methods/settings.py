"""Settings of policies and of the methods by which they decode."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from kerv_cli.base.limits import choice, number, setting
from kerv_cli.base.registry import METHOD_KINDS
from kerv_cli.base.settings import RunSettings, part

MODEL, EXPERT = "model", "expert"


@dataclass
class PolicySettings:
    """What chooses the actions. Weights are named by folders of results/pretrained or results/artifacts, or paths."""

    kind: str = choice(MODEL, MODEL, EXPERT, help="expert: the environment's script, privileged, no decoding")
    target: str = setting("mt10-vision", "the policy's weights")
    drafter: str | None = setting(None, "default: the one beside the target")
    early: str | None = setting(None, "the early drafter; default: the one beside the target")
    scout: str | None = setting(None, "the drafter with eyes of its own; default: the one beside the target")
    certificate: str | None = setting(None, "of success; default: the one beside the target")
    datastore: str | None = setting(None, "default: the one beside the target")
    calibration: str | None = setting(None, "default: the one beside the target")
    others: dict[str, str] = setting({}, "artifacts of parts that are not kerv's: kind -> name")

    def named(self, kind: str) -> str | None:
        """The name given for the artifact of this kind, None without one."""
        return self.others.get(kind) or getattr(self, kind, None)


# descriptions of settings that several commands have
POLICY = "what chooses the actions: vision, state, expert, … (conf/policy)"


@dataclass(kw_only=True)
class MethodSettings(RunSettings):
    """A policy and the method by which it decodes. The parts are settings of the classes in kerv_cli/methods."""

    policy: PolicySettings = setting(PolicySettings, POLICY)
    method: str = setting("ar", "how it decodes: ar, spec_vla, kerv, heisd, one_pass, … (conf/method)")
    prefill_draft: Any = part("proposer", help="what drafts before the prefill")
    proposer: Any = part("proposer", help="what drafts behind the prefill: none, drafter, retrieval, hold, …")
    acceptance: Any = part("acceptance", "strict", "which drafted tokens count as right: strict, relaxed, …")
    threshold: Any = part("threshold", "fixed", "how many bins a relaxed acceptance forgives: threshold.r")
    rectifier: Any = part("rectifier", "reinfer", "what becomes of rejected tokens")
    boundary: Any = part("boundary", "always", "where retrieved drafts are used")
    skip: Any = part("skip", help="which drafts are executed without verification")
    chunk: int = number(0, 0, 1024, help="H, control steps decoded at once; 0: as many as the target was trained for")
    datastore: Any = part("datastore", "exact", "what searches the stored chunks")

    def parts(self) -> dict[str, Any]:
        """Kind -> settings, for every part of the method."""
        return {kind: getattr(self, kind) for kind in METHOD_KINDS}
