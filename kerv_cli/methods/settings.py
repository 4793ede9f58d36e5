"""Settings of policies and of decoding methods."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import choice, number, setting
from kerv_cli.base.registry import METHOD_KINDS, parts
from kerv_cli.base.settings import RunSettings, part

MODEL, EXPERT, REMOTE = "model", "expert", "remote"


@dataclass
class PolicySettings:
    """The policy that chooses the actions. Files are chosen by the name of a folder in results/, or by a path."""

    # expert: the environment's scripted policy, without decoding; remote: the policy behind `url`
    kind: str = choice(MODEL, MODEL, EXPERT, REMOTE, help="what decodes: weights, a script, or a server")
    target: str = setting("mt10-h1", "name of the policy's weights, or a path")
    artifacts: dict[str, str | None] = setting(
        lambda: dict.fromkeys(parts("artifact")), "artifacts.KIND=NAME; null: the one beside the target"
    )
    url: str = setting("", "policy=remote: address of the server, ws://HOST:PORT")
    name: str = setting("", "policy=remote: what is served; episodes are reused under the same name; empty: the url")
    interface: str = setting(
        "kerv", "policy=remote: what the server reads and sends: a name in conf/interface, or a file"
    )
    execute: int = number(0, 0, 1024, help="policy=remote: actions of an answer that are executed; 0: the interface's")

    def check_together(self, prefix: str) -> None:
        """Refuse a remote policy without an address, and an address without a remote policy."""
        if self.kind != REMOTE:
            if self.url:
                raise UsageError(f"{prefix}url={self.url} is of policy=remote: add it", f"{prefix}url")
        elif not self.url.startswith(("ws://", "wss://")):
            raise UsageError(
                f"policy=remote with {prefix}url={self.url}: write {prefix}url=ws://HOST:PORT", f"{prefix}url"
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

    def parts(self) -> dict[str, Any]:
        return {kind: getattr(self, kind) for kind in METHOD_KINDS}
