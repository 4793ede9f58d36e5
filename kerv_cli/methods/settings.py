"""Settings of policies and of decoding methods."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from kerv_cli.base.limits import choice, number, setting
from kerv_cli.base.registry import METHOD_KINDS, parts
from kerv_cli.base.settings import RunSettings, part

MODEL, EXPERT = "model", "expert"


@dataclass
class PolicySettings:
    """The policy that chooses the actions.

    Target and artifacts are chosen by the name of a folder in results/pretrained or results/artifacts, or by a path.
    """

    kind: str = choice(MODEL, MODEL, EXPERT, help="expert: the environment's scripted policy, without decoding")
    target: str = setting("mt10-vision", "name of the policy's weights, or a path")
    artifacts: dict[str, str | None] = setting(
        lambda: dict.fromkeys(parts("artifact")), "artifacts.KIND=NAME; null: the one beside the target"
    )


# help text of a setting that several commands have
POLICY = "what chooses the actions: vision, state, expert, … (conf/policy)"


@dataclass(kw_only=True)
class MethodSettings(RunSettings):
    """A policy and its decoding method. The settings of each part are a dataclass in kerv_cli/methods."""

    policy: PolicySettings = setting(PolicySettings, POLICY)
    method: str = setting("ar", "decoding method: ar, spec_vla, kerv, heisd, one_pass, … (conf/method)")
    prefill_draft: Any = part("proposer", help="what drafts before the prefill")
    proposer: Any = part("proposer", help="what drafts after the prefill: none, drafter, retrieval, hold, …")
    acceptance: Any = part("acceptance", "strict", "which draft tokens are accepted: strict, relaxed, …")
    threshold: Any = part("threshold", "fixed", "accepted distance of a draft token, in bins: threshold.r")
    rectifier: Any = part("rectifier", "reinfer", "what happens after a rejection: reinfer (decode on), compensate")
    boundary: Any = part("boundary", "always", "proposer=hybrid: when retrieval drafts and when the drafter")
    skip: Any = part("skip", help="which drafts are executed without verification")
    chunk: int = number(0, 0, 1024, help="control steps per chunk; 0: as many as the target was trained for")
    datastore: Any = part("datastore", "exact", "how stored chunks are searched: exact, or a search of a plugin")

    def parts(self) -> dict[str, Any]:
        return {kind: getattr(self, kind) for kind in METHOD_KINDS}
