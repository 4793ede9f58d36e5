"""OpenVLA as the package transformers computes it, to compare with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import gelu, linear

from kerv_cli.targets.openvla.config import Tower, read_shape
from kerv_cli.targets.openvla.loading import is_unread, open_shards

_DINO = {
    "blocks.": "encoder.layer.",
    "attn.proj": "attention.o_proj",
    "attn.qkv": "attention.qkv",
    "ls1.scale_factor": "layer_scale1.lambda1",
    "ls2.scale_factor": "layer_scale2.lambda1",
    "cls_token": "embeddings.cls_token",
    "reg_token": "embeddings.register_tokens",
    "pos_embed": "embeddings.position_embeddings",
    "patch_embed.proj": "embeddings.patch_embeddings.projection",
}
_SIGLIP = {
    "blocks.": "encoder.layers.",
    "attn.proj": "self_attn.out_proj",
    "attn.qkv": "self_attn.qkv",
    "norm1": "layer_norm1",
    "norm2": "layer_norm2",
    "pos_embed": "embeddings.position_embedding.weight",
    "patch_embed.proj": "embeddings.patch_embedding",
}
"""`_DINO` and `_SIGLIP` map a part of a weight's name in timm to the part of its name in transformers."""


class Reference:
    """OpenVLA put together from transformers' Llama, Dinov2WithRegisters and Siglip, from a checkpoint's folder."""

    def __init__(self, folder: Path) -> None:
        self.shape = read_shape(folder)
        self.state = {name: x for name, x in open_shards(folder).items() if not is_unread(name, self.shape)}
        self.dino, self.siglip, self.llama = self._dino(), self._siglip(), self._llama()

    def _part(self, prefix: str) -> dict[str, Tensor]:
        return {k.removeprefix(prefix): v for k, v in self.state.items() if k.startswith(prefix)}

    def _loaded(self, model: Any, weights: Mapping[str, Tensor], strict: bool = False) -> Any:
        assert not model.load_state_dict(weights, strict=strict).unexpected_keys
        return model.eval()

    def _dino(self) -> Any:
        from transformers import Dinov2WithRegistersConfig, Dinov2WithRegistersModel

        tower = self.shape.towers[0]
        hidden: Any = {"mlp_ratio": tower.feed_forward // tower.width, "num_register_tokens": tower.registers}
        weights = _renamed(self._part("vision_backbone.featurizer."), _DINO)
        # timm adds positions to the patches alone: transformers' class token gets a position of zero
        nowhere = torch.zeros(1, 1, tower.width)
        weights["embeddings.position_embeddings"] = torch.cat([nowhere, weights["embeddings.position_embeddings"]], 1)
        weights["embeddings.mask_token"] = nowhere[0]
        return self._loaded(Dinov2WithRegistersModel(Dinov2WithRegistersConfig(**hidden, **_sizes(tower))), weights)

    def _siglip(self) -> Any:
        from transformers import SiglipVisionConfig, SiglipVisionModel

        tower = self.shape.towers[1]
        # this GELU is timm's; transformers' own default is its tanh approximation
        config = SiglipVisionConfig(intermediate_size=tower.feed_forward, hidden_act="gelu", **_sizes(tower))
        weights = _renamed(self._part("vision_backbone.fused_featurizer."), _SIGLIP)
        weights["embeddings.position_embedding.weight"] = weights["embeddings.position_embedding.weight"][0]
        return self._loaded(SiglipVisionModel(config), weights)

    def _llama(self) -> Any:
        from transformers import LlamaConfig, LlamaForCausalLM

        numbers = asdict(self.shape.language)
        model = LlamaForCausalLM(LlamaConfig(**numbers))
        return self._loaded(model, self._part("language_model."), strict=True)

    def patches(self, pixels: Tensor) -> Tensor:
        """Map an image (1, 6, s, s) to vision tokens (1, n, E): both towers without final norm, then the projector."""
        first = self.dino(pixels[:, :3], output_hidden_states=True).hidden_states[-1]
        second = self.siglip(pixels[:, 3:], output_hidden_states=True).hidden_states[-1]
        x = torch.cat([first[:, 1 + self.shape.towers[0].registers :], second], -1)
        for number in (1, 2, 3):
            layer = self._part(f"projector.fc{number}.")
            x = linear(x, layer["weight"], layer["bias"])
            x = gelu(x) if number < 3 else x
        return x

    @torch.inference_mode()
    def logits(self, pixels: Tensor, ids: list[int], following: list[int]) -> Tensor:
        """The logits (n + 1, vocabulary) after the prompt, and after each of n following ids. pixels: (1, 6, s, s)."""
        words = self.llama.model.embed_tokens(torch.tensor([[*ids, *following]]))
        x = torch.cat([words[:, :1], self.patches(pixels), words[:, 1:]], 1)
        found: Tensor = self.llama(inputs_embeds=x).logits[0, -len(following) - 1 :]
        return found


def _sizes(tower: Tower) -> dict[str, Any]:
    """Return a tower's sizes, under the names that transformers' configurations of both towers share."""
    image = {"image_size": tower.image, "patch_size": tower.patch}
    layers = {"num_hidden_layers": tower.depth - 1}  # OpenVLA takes the last but one
    return {"hidden_size": tower.width, "num_attention_heads": tower.heads, **layers, **image}


def _renamed(weights: Mapping[str, Tensor], names: Mapping[str, str]) -> dict[str, Tensor]:
    """A tower's weights under transformers' names; queries, keys and values get separate weights."""
    found: dict[str, Tensor] = {}
    for name, weight in weights.items():
        for ours, theirs in names.items():
            name = name.replace(ours, theirs)
        if "qkv" in name:
            found |= zip([name.replace("qkv", f"{part}_proj") for part in "qkv"], weight.chunk(3), strict=True)
        else:
            found[name] = weight
    return found
