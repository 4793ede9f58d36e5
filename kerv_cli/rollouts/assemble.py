"""A method's settings and a policy -> a decoder: each part's settings become the part."""

from __future__ import annotations

import dataclasses

import numpy as np

from kerv_cli.decoding.boundary import Boundary, build_boundary
from kerv_cli.decoding.chunk import Proposer
from kerv_cli.decoding.decoder import Decoder, Parts
from kerv_cli.decoding.proposers import (
    DrafterProposer,
    EarlyProposer,
    HybridProposer,
    JacobiProposer,
    MergedProposer,
    PredictionProposer,
    RetrievalProposer,
)
from kerv_cli.decoding.record import DecodeRecord
from kerv_cli.decoding.rectify import DRAFT, Compensation
from kerv_cli.decoding.verify_skip import SkipLevels, VerifySkip
from kerv_cli.drafting.kinematics import FILTERS, MINIMUM, Predictor, build_predictor
from kerv_cli.environments import spec_of
from kerv_cli.rollouts.composition import check_composition
from kerv_cli.rollouts.policy import Policy
from kerv_cli.settings import SPARE, MethodSettings, RolloutSettings
from kerv_cli.spaces import GRIPPER, Observation

WARM_UP_DECODES = 6
PREDICTED_FROM = {"hold": 1, "linear": 2}  # actions that a predictor needs at least; filters: see kinematics


def build_decoder(policy: Policy, method: MethodSettings, task: str = "") -> Decoder:
    """The method's parts around the policy."""
    return Decoder(policy.target, method, build_parts(policy, method, task))


def build_parts(policy: Policy, method: MethodSettings, task: str = "") -> Parts:
    """task: whose calibrated levels hold, where a part has one per task."""
    check_composition(method, policy.target.chunk)
    proposer = build_proposer(policy, method)
    return Parts(
        opening=build_opening(policy, method),
        proposer=proposer,
        compensation=build_compensation(policy, method),
        boundary=build_part_boundary(policy, method),
        skip=build_skip(policy, method, proposer, task),
    )


def build_part_boundary(policy: Policy, method: MethodSettings) -> Boundary | None:
    ranges = (
        policy.calibration.ranges(method.boundary.window)
        if policy.calibration is not None and method.boundary.kind == "fused"
        else None
    )
    return build_boundary(method.boundary, ranges)


def build_opening(policy: Policy, method: MethodSettings) -> Proposer | None:
    settings = method.opening
    if not settings.sources:
        return None
    counts = settings.neighbours, settings.nodes
    built = {name: build_source(policy, name.removesuffix(SPARE), *counts) for name in settings.sources}
    first = [source for name, source in built.items() if not name.endswith(SPARE)]
    return MergedProposer(first, settings.nodes, [source for source in built.values() if source not in first])


def build_source(
    policy: Policy, name: str, neighbours: int, nodes: int
) -> PredictionProposer | EarlyProposer | RetrievalProposer:
    """What drafts whole chunks without the target's states."""
    if name == "early":
        assert policy.early is not None
        return EarlyProposer(policy.early, policy.target)
    if name == "retrieval":
        assert policy.datastore is not None
        return RetrievalProposer(policy.datastore, policy.target, neighbours, nodes)
    return PredictionProposer(predictor_of(policy, name))


def predictor_of(policy: Policy, name: str) -> Predictor:
    target = policy.target
    if policy.calibration is not None and name in FILTERS:
        return policy.calibration.predictor(name, horizon=target.chunk)
    least = PREDICTED_FROM.get(name, MINIMUM)
    return build_predictor(name, target.actions.dofs, {}, least, horizon=target.chunk, gripper=GRIPPER)


def build_compensation(policy: Policy, method: MethodSettings) -> Compensation | None:
    settings = method.rectifier
    if settings.kind == "reinfer":
        return None
    return Compensation(settings, predictor_of(policy, "hold" if settings.predictor == DRAFT else settings.predictor))


def build_proposer(policy: Policy, method: MethodSettings) -> Proposer | None:
    settings = method.proposer
    if settings.kind == "none":
        return None
    if settings.kind == "jacobi":
        return JacobiProposer()
    if settings.kind in ("drafter", "hybrid"):
        assert policy.drafter is not None
        drafter = DrafterProposer(policy.drafter, policy.target, settings)
        if settings.kind == "drafter":
            return drafter
        retrieval = build_source(policy, "retrieval", settings.neighbours, settings.nodes)
        assert isinstance(retrieval, RetrievalProposer)
        return HybridProposer(drafter, retrieval)
    return build_source(policy, settings.kind, settings.neighbours, settings.nodes)


def build_skip(policy: Policy, method: MethodSettings, proposer: Proposer | None, task: str) -> VerifySkip | None:
    settings = method.skip
    if settings.kind == "none":
        return None
    retrieval = proposer.sides["retrieval"] if isinstance(proposer, HybridProposer) else proposer
    if not isinstance(retrieval, RetrievalProposer):  # nothing else of the method retrieves
        assert policy.datastore is not None
        retrieval = RetrievalProposer(policy.datastore, policy.target, 1, 1)
    if settings.s_min is not None:
        return VerifySkip(settings, retrieval, SkipLevels(settings.s_min, settings.s_min, settings.s_min))
    assert policy.calibration is not None
    return VerifySkip(settings, retrieval, SkipLevels(*policy.calibration.skip_levels(task, policy.datastore_sha256)))


class Sampled:
    """A decoder that, every so many decodes, also asks AR about the same observation, outside the timing."""

    def __init__(self, decoder: Decoder, reference: Decoder, every: int) -> None:
        self.decoder, self.reference, self.every, self.count = decoder, reference, every, 0

    @property
    def cameras(self) -> tuple[str, ...]:
        return self.decoder.cameras

    def reset(self, task: str, instruction: str, seed: int = 0) -> None:
        self.count = 0
        self.decoder.reset(task, instruction, seed)
        self.reference.reset(task, instruction, seed)

    def decode(self, observation: Observation) -> DecodeRecord:
        record = self.decoder.decode(observation)
        self.count += 1
        if self.count % self.every:
            return record
        tokenizer = self.decoder.target.actions
        wanted = self.reference.decode(observation).actions[: len(record.actions)]
        gap = np.abs(tokenizer.normalise(record.actions) - tokenizer.normalise(wanted))
        return dataclasses.replace(record, deviation=float(gap.mean()))

    def observe(self, action: np.ndarray, end_effector: np.ndarray) -> None:
        self.decoder.observe(action, end_effector)

    def finish(self, success: bool) -> None:
        self.decoder.finish(success)


def episode_decoder(policy: Policy, settings: RolloutSettings, task: str) -> Decoder | Sampled:
    """The method's decoder, with the task's own reference level where the threshold follows one."""
    method = settings.parts()
    if policy.calibration is not None:
        method = dataclasses.replace(method, threshold=policy.calibration.threshold(method.threshold, task))
    decoder = build_decoder(policy, method, task)
    if settings.deviation_every <= 0:
        return decoder
    return Sampled(decoder, Decoder(policy.target, MethodSettings(chunk=method.chunk)), settings.deviation_every)


def warm_up(decoder: Decoder | Sampled, task: str, size: int) -> None:
    """First calls allocate, choose kernels and fault pages in: they are no part of any inference time. The hand moves,
    so that parts which wait for a history or a path take their turn. size: pixels of the images."""
    decoder.reset(task, "", 0)
    space, frame = spec_of(task).observation, np.zeros((size, size, 3), dtype=np.uint8)
    images = dict.fromkeys(decoder.cameras, frame)
    nothing = Observation(np.zeros(len(space.proprioception)), np.zeros(space.state), "", images)
    for i in range(WARM_UP_DECODES):
        for action in decoder.decode(nothing).actions:
            decoder.observe(action, np.array([0.01 * i, 0.0, 0.1]))
