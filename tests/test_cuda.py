"""On a CUDA device: captured graphs compute what eager forwards do, and strict methods decode AR's tokens."""

import pytest
import torch
from flips import flipped

from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.bench.measure import launches_per_token
from kerv_cli.bench.model import open_model
from kerv_cli.bench.settings import BenchSettings
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.methods.eagle.network import DrafterProposer
from kerv_cli.methods.reuse import JacobiProposer, JacobiProposerSettings
from kerv_cli.targets.attention import CapturedCache
from kerv_cli.targets.compact.trunk import Trunk

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")


def test_a_captured_graph_computes_what_eager_forwards_do():
    torch.manual_seed(0)
    trunk = Trunk(64, 3, 4, 160).cuda().eval()
    x, outputs = torch.randn(1, 40, 64, device="cuda"), []
    with torch.inference_mode():
        for fixed in (True, False):
            cache = trunk.new_cache(1, 48, fixed)
            hidden = []
            for first, last in ((0, 20), (20, 21), (21, 22), (22, 40)):
                hidden.append(trunk(x[:, first:last], torch.arange(first, last, device="cuda"), cache))
            assert isinstance(cache, CapturedCache) == fixed
            assert not fixed or cache.steps
            outputs.append(torch.cat(hidden, 1))
    assert torch.allclose(*outputs, atol=1e-4)


def test_strict_methods_decode_the_baselines_tokens():
    model = open_model(BenchSettings(target="nano", dtype="float32", runtime=RuntimeSettings(device="cuda")))
    autoregressive = Decoder(model.target).decode(model.observation)
    assert sum(autoregressive.phases.values()) == pytest.approx(autoregressive.seconds, rel=0.2)
    assert launches_per_token(model) < 20
    for proposer in (JacobiProposer(JacobiProposerSettings()), DrafterProposer(model.drafter, model.target, 5, 3, 12)):
        assert Decoder(model.target, Parts(proposer=proposer)).decode(model.observation).tokens == autoregressive.tokens


def test_ties_in_bfloat16_are_few():
    model = open_model(BenchSettings(target="nano", dtype="bfloat16", runtime=RuntimeSettings(device="cuda")))
    differ, compared = flipped(model, 4)
    assert differ <= compared // 4
