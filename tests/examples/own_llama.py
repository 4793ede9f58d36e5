"""Example: a target around a model of Hugging Face's transformers, with its own cache.

`kerv build target target=own_llama checkpoint=FOLDER` takes the Llama in that folder. Without a folder it makes a tiny
random one.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from transformers import DynamicCache, LlamaConfig, LlamaForCausalLM

from kerv_cli.base.spaces import ActionSpace, Observation
from kerv_cli.targets import TargetPart
from kerv_cli.targets.checkpoint import TargetDescription, load_state, save_module, target_fields
from kerv_cli.targets.settings import BuildTargetSettings
from kerv_cli.worlds.metaworld.spec import SPEC

TINY = {"vocab_size": 320, "hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2}


class LlamaCache:
    """transformers' cache, from which kerv takes the tokens that it rejects."""

    def __init__(self, capacity: int) -> None:
        self.stored, self.length, self.capacity = DynamicCache(), 0, capacity

    def compact(self, start: int, slots: Tensor) -> None:
        self.keep(torch.cat([torch.arange(start, device=slots.device), slots]))
        self.length = start + len(slots)

    def keep(self, slots: Tensor | slice) -> None:
        for layer in self.stored.layers:
            layer.keys, layer.values = layer.keys[:, :, slots], layer.values[:, :, slots]


class OwnLlama(nn.Module):
    """The last ids of the vocabulary are the action tokens, in descending order, as in OpenVLA."""

    cameras, max_prompt, chunk = (), 32, 1

    def __init__(self, model: LlamaForCausalLM, actions: ActionSpace) -> None:
        super().__init__()
        self.model, self.actions, self.width = model.eval().requires_grad_(False), actions, model.config.hidden_size
        self.last = model.config.vocab_size - 1

    @property
    def device(self) -> torch.device:
        return self.model.device

    def encode(self, observation: Observation) -> Tensor:
        """Words and measurements as ids; a real policy has a tokenizer, and tokens of images."""
        text = f"{observation.instruction} {np.round(observation.proprioception, 1).tolist()}"
        ids = [sum(word.encode()) % 64 for word in text.split()][: self.max_prompt]
        return self.model.model.embed_tokens(torch.tensor([ids], device=self.device))

    def embed(self, tokens: Tensor) -> Tensor:
        return self.model.model.embed_tokens(self.last - tokens)

    def new_cache(self, batch: int, capacity: int) -> LlamaCache:
        return LlamaCache(capacity)

    def forward(self, x: Tensor, positions: Tensor, cache: LlamaCache | None = None, seen: Any = None) -> Tensor:
        cache = cache or LlamaCache(x.shape[1])
        if cache.stored.get_seq_length() > cache.length:  # kerv lowers the length to drop the newest tokens
            cache.keep(slice(cache.length))
        new = x.shape[1]
        mask = torch.ones(new, cache.length + new, dtype=torch.bool, device=x.device)  # all cached tokens are seen
        seen = torch.as_tensor(np.tri(new, dtype=bool) if seen is None else seen, device=x.device)
        mask[:, mask.shape[1] - seen.shape[1] :] = seen
        found = self.model.model(
            inputs_embeds=x,
            position_ids=positions.expand(len(x), -1),
            attention_mask=mask.expand(len(x), 1, -1, -1),
            past_key_values=cache.stored,
            use_cache=True,
        )
        cache.length += new
        return found.last_hidden_state

    def head(self, hidden: Tensor) -> Tensor:
        return self.model.lm_head(hidden)[..., -self.actions.tokens :].flip(-1)


def write(settings: BuildTargetSettings, folder: Path) -> dict[str, Any]:
    if settings.checkpoint:
        model = LlamaForCausalLM.from_pretrained(settings.checkpoint)
    else:
        torch.manual_seed(0)
        model = LlamaForCausalLM(LlamaConfig(**TINY, initializer_range=0.5))
    policy = OwnLlama(model, SPEC.actions)
    own = {"chunk": policy.chunk, "llama": json.loads(model.config.to_json_string())}
    fields = target_fields("own_llama", own, SPEC.name, policy.actions, SPEC.observation)
    save_module(folder, "target", policy, fields)
    return {"parameters": model.num_parameters()}


@TargetPart("own_llama", importer=write)
def build(folder: Path, description: TargetDescription, device: str, dtype: torch.dtype) -> OwnLlama:
    model = LlamaForCausalLM(LlamaConfig.from_dict(description.settings["llama"]))
    policy = OwnLlama(model, description.actions)
    load_state(policy, folder, "target")
    return policy.to(device=device, dtype=dtype)
