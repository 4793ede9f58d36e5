"""A method's settings and a policy -> a decoder: each part's settings become the part."""

from __future__ import annotations

import dataclasses

import numpy as np

from kerv_cli.decoding.chunk import Proposer
from kerv_cli.decoding.decoder import Decoder, Parts
from kerv_cli.decoding.proposers import DrafterProposer, HoldProposer, JacobiProposer, MergedProposer, RetrievalProposer
from kerv_cli.decoding.record import DecodeRecord
from kerv_cli.decoding.rectify import Compensation
from kerv_cli.drafting.kinematics import FILTERS, MINIMUM, build_predictor
from kerv_cli.errors import UnknownName, UsageError
from kerv_cli.rollouts.episode import ActionDecoder
from kerv_cli.rollouts.policy import Policy
from kerv_cli.settings import CameraSettings, MethodSettings, RolloutSettings
from kerv_cli.vla.action_tokens import GRIPPER

WARM_UP_DECODES = 3
PREDICTED_FROM = {"hold": 1, "linear": 2}  # actions that a predictor needs at least; filters: see kinematics


def build_decoder(policy: Policy, method: MethodSettings) -> Decoder:
    """The method's parts around the policy."""
    return Decoder(policy.target, method, build_parts(policy, method))


def build_parts(policy: Policy, method: MethodSettings) -> Parts:
    return Parts(build_opening(policy, method), build_proposer(policy, method), build_compensation(policy, method))


def build_opening(policy: Policy, method: MethodSettings) -> Proposer | None:
    settings = method.opening
    if settings.kind == "none":
        return None
    if settings.kind == "hold":
        return HoldProposer()
    if settings.kind in ("retrieval", "merged"):
        retrieval = build_retrieval(policy, settings.neighbours, settings.nodes)
        return retrieval if settings.kind == "retrieval" else MergedProposer(retrieval, HoldProposer(), settings.nodes)
    raise UnknownName("opening.kind", settings.kind, ["none", "hold", "retrieval", "merged"])


def build_retrieval(policy: Policy, neighbours: int, nodes: int) -> RetrievalProposer:
    assert policy.datastore is not None
    if min(neighbours, nodes) < 1:
        raise UsageError("retrieval needs at least one neighbour and one node")
    return RetrievalProposer(policy.datastore, policy.target, neighbours, nodes)


def build_compensation(policy: Policy, method: MethodSettings) -> Compensation | None:
    settings = method.rectifier
    if settings.kind not in ("reinfer", "compensate"):
        raise UnknownName("rectifier.kind", settings.kind, ["reinfer", "compensate"])
    if settings.kind == "reinfer":
        return None
    chunk = policy.target.settings
    if policy.calibration is not None and settings.predictor in FILTERS:
        predictor = policy.calibration.predictor(settings.predictor, horizon=chunk.chunk)
    else:
        least = PREDICTED_FROM.get(settings.predictor, MINIMUM)
        predictor = build_predictor(settings.predictor, chunk.dofs, {}, least, horizon=chunk.chunk, gripper=GRIPPER)
    return Compensation(settings, predictor)


def build_proposer(policy: Policy, method: MethodSettings) -> Proposer | None:
    settings = method.proposer
    if settings.kind == "none":
        return None
    if settings.kind == "drafter":
        assert policy.drafter is not None
        if min(settings.depth, settings.top_k, settings.nodes) < 1:
            raise UsageError("proposer.depth, proposer.top_k and proposer.nodes must be at least 1")
        return DrafterProposer(policy.drafter, policy.target, settings)
    if settings.kind == "retrieval":
        return build_retrieval(policy, settings.top_k, settings.nodes)
    if settings.kind == "hold":
        return HoldProposer()
    if settings.kind == "jacobi":
        return JacobiProposer()
    raise UnknownName("proposer.kind", settings.kind, ["none", "drafter", "retrieval", "hold", "jacobi"])


class Sampled:
    """A decoder that, every so many decodes, also asks AR about the same observation, outside the timing."""

    def __init__(self, decoder: Decoder, reference: Decoder, every: int) -> None:
        self.decoder, self.reference, self.every, self.count = decoder, reference, every, 0

    @property
    def needs_frame(self) -> bool:
        return self.decoder.needs_frame

    def reset(self, task: str, instruction: str) -> None:
        self.count = 0
        self.decoder.reset(task, instruction)
        self.reference.reset(task, instruction)

    def decode(self, frame: np.ndarray | None, state: np.ndarray) -> DecodeRecord:
        record = self.decoder.decode(frame, state)
        self.count += 1
        if self.count % self.every:
            return record
        tokenizer = self.decoder.target.actions
        wanted = self.reference.decode(frame, state).actions[: len(record.actions)]
        gap = np.abs(tokenizer.normalise(record.actions) - tokenizer.normalise(wanted))
        return dataclasses.replace(record, deviation=float(gap.mean()))

    def observe(self, action: np.ndarray, end_effector: np.ndarray) -> None:
        self.decoder.observe(action, end_effector)

    def finish(self, success: bool) -> None:
        self.decoder.finish(success)


def episode_decoder(policy: Policy, settings: RolloutSettings, task: str) -> ActionDecoder:
    """The method's decoder, with the task's own reference level where the threshold follows one."""
    method = settings.parts()
    if policy.calibration is not None:
        method = dataclasses.replace(method, threshold=policy.calibration.threshold(method.threshold, task))
    decoder = build_decoder(policy, method)
    if settings.deviation_every <= 0:
        return decoder
    return Sampled(decoder, Decoder(policy.target, MethodSettings()), settings.deviation_every)


def warm_up(decoder: ActionDecoder, task: str, camera: CameraSettings) -> None:
    """First calls allocate, choose kernels and fault pages in: they are no part of any inference time."""
    decoder.reset(task, "")
    frame = np.zeros((camera.size, camera.size, 3), dtype=np.uint8)
    for _ in range(WARM_UP_DECODES):
        decoder.decode(frame, np.zeros(39))
