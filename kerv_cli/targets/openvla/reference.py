"""Compare a target with OpenVLA as the `transformers` package computes it: `kerv build target … check=true`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import gelu, linear

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.decoder import Decoder
from kerv_cli.targets.openvla.config import Tower, read_shape
from kerv_cli.targets.openvla.inputs import pixels_of
from kerv_cli.targets.openvla.loading import is_unread, open_shards

SAMPLES = ("pick up the cup", "put the spoon on the towel", "open the drawer", "stack the blocks")
"""Instructions of the observations that are compared. Their images are noise."""
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


def check_installed() -> None:
    """Check that transformers is installed.

    Raises:
        UsageError: transformers is not installed.
    """
    try:
        import transformers  # noqa: F401
    except ImportError as error:
        raise UsageError("check=true compares with transformers: pip install 'transformers>=5.23,<6'") from error


class Reference:
    """OpenVLA put together from transformers' Llama, Dinov2WithRegisters and Siglip.

    Args:
        folder: Folder of the checkpoint.
        device: Device of the weights.
        dtype: Number format of the weights.

    Raises:
        UsageError: transformers is not installed.
        CheckpointError: The checkpoint is damaged.
    """

    def __init__(self, folder: Path, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> None:
        check_installed()
        self.shape, self.device, self.dtype = read_shape(folder), device, dtype
        self.state = {name: x for name, x in open_shards(folder).items() if not is_unread(name, self.shape)}
        self.dino, self.siglip, self.llama = self._dino(), self._siglip(), self._llama()

    def _part(self, prefix: str) -> dict[str, Tensor]:
        return {k.removeprefix(prefix): v for k, v in self.state.items() if k.startswith(prefix)}

    def _loaded(self, model: Any, weights: Mapping[str, Tensor], strict: bool = False) -> Any:
        """Load weights into a model, move it to the device, and return it. Every weight must belong to the model.

        Args:
            model: A model of transformers.
            weights: The weights, under transformers' names.
            strict: Whether `weights` must contain every weight of the model.
        """
        assert not model.load_state_dict(weights, strict=strict).unexpected_keys
        return model.to(device=self.device, dtype=self.dtype).eval()

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
        rope = {"rope_type": "default", "rope_theta": numbers.pop("rope_theta")}
        model = LlamaForCausalLM(LlamaConfig(**numbers, rope_parameters=rope))
        return self._loaded(model, self._part("language_model."), strict=True)

    def patches(self, pixels: Tensor) -> Tensor:
        """Map an image (1, 6, s, s) to vision tokens (1, n, E): both towers without final norm, then the projector."""
        pixels = pixels.to(self.device, self.dtype)
        first = self.dino(pixels[:, :3], output_hidden_states=True).hidden_states[-1]
        second = self.siglip(pixels[:, 3:], output_hidden_states=True).hidden_states[-1]
        x = torch.cat([first[:, 1 + self.shape.towers[0].registers :], second], -1)
        for number in (1, 2, 3):
            layer = {k: v.to(self.device, self.dtype) for k, v in self._part(f"projector.fc{number}.").items()}
            x = linear(x, layer["weight"], layer["bias"])
            x = gelu(x) if number < 3 else x
        return x

    @torch.inference_mode()
    def logits(self, pixels: Tensor, ids: list[int], following: list[int]) -> Tensor:
        """Return the logits after the prompt and after each of n following ids, in one forward.

        Args:
            pixels: (1, 6, s, s) image.
            ids: Ids of the prompt's text.
            following: The n ids after the prompt.

        Returns:
            (n + 1, vocabulary).
        """
        words = self.llama.model.embed_tokens(torch.tensor([[*ids, *following]], device=self.device))
        x = torch.cat([words[:, :1], self.patches(pixels), words[:, 1:]], 1)
        found: Tensor = self.llama(inputs_embeds=x).logits[0, -len(following) - 1 :]
        return found


def _sizes(tower: Tower) -> dict[str, Any]:
    """Return a tower's sizes, under the names that transformers' configurations of both towers share."""
    image = {"image_size": tower.image, "patch_size": tower.patch}
    layers = {"num_hidden_layers": tower.depth - 1}  # OpenVLA takes the last but one
    return {"hidden_size": tower.width, "num_attention_heads": tower.heads, **layers, **image}


def _renamed(weights: Mapping[str, Tensor], names: Mapping[str, str]) -> dict[str, Tensor]:
    """Return a vision tower's weights under transformers' names. Queries, keys and values get separate weights.

    Args:
        weights: Weights of the tower.
        names: Map from a part of a weight's name in timm to the part of its name in transformers.
    """
    found: dict[str, Tensor] = {}
    for name, weight in weights.items():
        for ours, theirs in names.items():
            name = name.replace(ours, theirs)
        if "qkv" in name:
            found |= zip([name.replace("qkv", f"{part}_proj") for part in "qkv"], weight.chunk(3), strict=True)
        else:
            found[name] = weight
    return found


@torch.inference_mode()
def parity(target: Any) -> dict[str, float]:
    """Decode sample observations, and compare the tokens and logits with the results of the transformers package.

    kerv and transformers compute the logits of a token after the same prompt and the same earlier tokens.

    Args:
        target: An `OpenVLATarget`. The `Reference` is loaded in float32, then moved to the target's device and
            number format.

    Returns:
        Numbers by name, in this order:

        - Number of compared tokens.
        - Number of tokens that differ from transformers' most probable action token.
        - Number of differing tokens whose two largest logits are equal in bfloat16.
        - Number of compared tokens whose two largest logits are equal in bfloat16.
        - Number of tokens for which transformers' most probable id is not an action token.
        - Largest difference between a logit of kerv and the same logit of transformers.

    Raises:
        UsageError: transformers is not installed.
    """
    reference, settings = Reference(Path(target.settings.checkpoint), target.device, target.dtype), target.settings
    last, size = target.shape.vocabulary, settings.image_size
    tokens, own, theirs = [], [], []
    for seed, instruction in enumerate(SAMPLES):
        image = np.random.default_rng(seed).integers(0, 256, (size, size, 3), dtype=np.uint8)
        observation = Observation(np.zeros(0), np.zeros(0), instruction, {target.cameras[0]: image})
        decoded = torch.tensor(Decoder(target).decode(observation).tokens, device=target.device)
        prompt = target.encode(observation)
        x = torch.cat([prompt, target.embed(decoded[None, :-1])], 1)
        hidden = target.forward(x, torch.arange(x.shape[1], device=target.device))
        pixels = pixels_of(image, target.shape, target.normalisations, settings.crop, settings.libero)
        following = (last - 1 - decoded[:-1]).tolist()
        tokens.append(decoded)
        own.append(target.head(hidden[0, prompt.shape[1] - 1 :]).float())
        theirs.append(reference.logits(pixels, target.prompter.ids(instruction), following).float())
    chosen, logits, all_logits = torch.cat(tokens), torch.cat(own), torch.cat(theirs)
    of_actions = all_logits[:, last - target.shape.bins : last].flip(-1)
    first, second = logits.bfloat16().topk(2).values.unbind(-1)
    ties, differs, best = first == second, of_actions.argmax(-1) != chosen, all_logits.argmax(-1)
    return {
        "tokens compared with transformers": len(chosen),
        "tokens that differ": int(differs.sum()),
        "of these where two logits tie in bfloat16": int((ties & differs).sum()),
        "ties of the two largest logits in bfloat16": int(ties.sum()),
        "tokens where transformers chooses no action": int(((best < last - target.shape.bins) | (best >= last)).sum()),
        "largest difference of logits": float((logits - of_actions).abs().max()),
    }
