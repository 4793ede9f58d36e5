"""How fast are AR's tokens beside a plain decoder with the same weights? A slow baseline makes every speedup false.

    python tests/plain_decoder.py [TARGET] [REPEATS]

The references share nothing with the package but the weights: a plain decoder in numpy, and one in C where there is a
compiler, as one would write them down. They also have to give the same tokens. Decodes take turns."""

import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import torch

from kerv_cli.engine.decoder import Decoder
from kerv_cli.targets.checkpoint import load_target
from kerv_cli.targets.compact.target import CompactTarget


class PlainStep:
    """A Llama-style trunk, its embedding and head in numpy: RMSNorm, RoPE with split halves, SwiGLU."""

    def __init__(self, target: CompactTarget) -> None:
        arrays = {name: tensor.float().numpy() for name, tensor in target.state_dict().items()}
        self.layers = []
        for i in range(target.settings.layers):
            of = {name: arrays[f"trunk.layers.{i}.{name}.weight"] for name in ("qkv", "out", "gate_up", "down")}
            norms = [arrays[f"trunk.layers.{i}.{name}.weight"] for name in ("attention_norm", "feed_norm")]
            self.layers.append(({k: np.ascontiguousarray(v) for k, v in of.items()}, norms))
        self.norm, self.embedding = arrays["trunk.norm.weight"], arrays["embedding.weight"]
        self.head, self.heads = np.ascontiguousarray(arrays["head.weight"]), target.heads
        self.channels = target.width // target.heads
        self.frequency = 10_000.0 ** (-np.arange(0, self.channels, 2) / self.channels)

    def begin(self, keys: np.ndarray, values: np.ndarray, room: int) -> None:
        """keys, values (layers, heads, S, C) of the prompt; room: tokens to come."""
        shape = (*keys.shape[:2], keys.shape[2] + room, keys.shape[3])
        self.keys, self.values, self.length = np.zeros(shape, np.float32), np.zeros(shape, np.float32), keys.shape[2]
        self.keys[:, :, : self.length], self.values[:, :, : self.length] = keys, values

    def turned(self, x: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """x (heads, C) rotated."""
        half = self.channels // 2
        cos, sin = np.cos(angle).astype(np.float32), np.sin(angle).astype(np.float32)
        first, second = x[:, :half], x[:, half:]
        return np.concatenate([first * cos - second * sin, second * cos + first * sin], 1)

    def __call__(self, token: int) -> int:
        """The token behind this one."""
        x, stop = self.embedding[token].copy(), self.length + 1
        angle = self.length * self.frequency
        for i, (w, (before, behind)) in enumerate(self.layers):
            q, k, v = (w["qkv"] @ self.rms(x, before)).reshape(3, self.heads, self.channels)
            self.keys[i, :, self.length], self.values[i, :, self.length] = self.turned(k, angle), v
            scores = np.matmul(self.keys[i, :, :stop], self.turned(q, angle)[:, :, None])[:, :, 0]
            scores = np.exp(scores / np.float32(self.channels**0.5) - scores.max() / np.float32(self.channels**0.5))
            scores /= scores.sum(1, keepdims=True)
            x += w["out"] @ np.matmul(scores[:, None], self.values[i, :, :stop]).reshape(-1)
            gate, up = np.split(w["gate_up"] @ self.rms(x, behind), 2)
            x += w["down"] @ (gate / (1 + np.exp(-gate)) * up)
        self.length = stop
        return int(np.argmax(self.head @ self.rms(x, self.norm)))

    def rms(self, x: np.ndarray, gain: np.ndarray) -> np.ndarray:
        """RMSNorm."""
        return x / np.sqrt(np.mean(x * x) + np.float32(1e-5)) * gain


class PlainC:
    """The same in C (`plain_decoder.c`), for weights in half precision."""

    def __init__(self, plain: PlainStep, folder: Path) -> None:
        """Compile it into a folder. Raises OSError without a compiler."""
        library, source = folder / "plain_decoder.so", Path(__file__).with_suffix(".c")
        # not -ffast-math: linked, it would flush subnormal numbers to zero in the whole process
        flags = "-O3 -march=native -fno-math-errno -fno-trapping-math -fassociative-math -fno-signed-zeros"
        flags += " -freciprocal-math -shared -fPIC"
        subprocess.run(["gcc", *flags.split(), str(source), "-o", str(library), "-lm"], check=True)
        self.decode, self.plain = ctypes.CDLL(str(library)).decode, plain
        matrices = [w[name] for w, _ in plain.layers for name in ("qkv", "out", "gate_up", "down")] + [plain.head]
        self.weights = np.concatenate([matrix.ravel() for matrix in matrices]).astype(np.float16)
        self.gains = np.concatenate([*(gain for _, gains in plain.layers for gain in gains), plain.norm])

    def __call__(self, token: int, count: int) -> list[int]:
        """The `count` tokens after this one; the plain step's cache holds those before it."""
        plain, tokens = self.plain, np.zeros(count + 1, np.int32)
        tokens[0] = token
        arrays = self.weights, self.gains, plain.embedding, plain.keys, plain.values, tokens
        width, hidden = plain.head.shape[1], plain.layers[0][0]["down"].shape[1]
        sizes = count, len(plain.layers), width, hidden, plain.heads, len(plain.head), plain.keys.shape[2], plain.length
        self.decode(*(ctypes.c_void_p(array.ctypes.data) for array in arrays), *sizes)
        return [int(token) for token in tokens[1:]]


@torch.inference_mode()
def main(name: str, repeats: int, folder: Path) -> bool:
    """Print the thread's milliseconds of all tokens after the prefill -> whether all tokens are the same."""
    torch.set_num_threads(1)
    found = Path(name) if Path(name).is_dir() else Path("results/pretrained") / name / "target"
    target: Any = load_target(found, "cpu", torch.float32)[0]
    decoder, plain, seconds, same = Decoder(target), PlainStep(target), dict[str, list[float]](), True
    in_c = PlainC(plain, folder) if shutil.which("gcc") else None
    for seed in range(repeats):
        prompt = torch.randn(1, target.max_prompt, target.width, generator=torch.Generator().manual_seed(seed))
        chunk = decoder.decode_prompt(prompt)
        first, count, length = chunk.tokens[0], chunk.size - 1, target.max_prompt
        cached = decoder.cache.buffer[:, :, 0, :, :length].numpy()
        plain.begin(cached[:, 0], cached[:, 1], chunk.size)

        def compiled(first=first, count=count, length=length):
            decoder.cache.length = length
            return target.continue_greedily(first, count, decoder.cache)

        def numpy(first=first, count=count):
            tokens = [first]
            for _ in range(count):
                tokens.append(plain(tokens[-1]))
            return tokens[1:]

        decoders = {"kerv": compiled} | ({"C": lambda: in_c(first, count)} if in_c else {}) | {"numpy": numpy}  # noqa: B023
        for label, decode in decoders.items():
            begun = time.thread_time()
            tokens = decode()
            seconds.setdefault(label, []).append(1e3 * (time.thread_time() - begun))
            same &= tokens == chunk.tokens[1:]
    for label, times in seconds.items():
        ratio = np.min(seconds["kerv"]) / np.min(times)
        print(f"{label}: least {np.min(times):.2f} ms, median {np.median(times):.2f} ms; kerv takes {ratio:.2f} × it")
    return same


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        arguments = sys.argv[1] if len(sys.argv) > 1 else "mt10-h1", int(sys.argv[2]) if len(sys.argv) > 2 else 100
        print("the same tokens:", main(*arguments, Path(scratch)))
